"""What a live view says of a person."""

from dataclasses import replace

from xethru_protocol.cli.live.analysis import VitalAnswer

LISTENING = VitalAnswer(t_s=59.0, heard_s=59.0, window_s=60.0, breathing=None, presence=None)


def test_a_full_window_without_a_rate_is_not_waited_for() -> None:
    full, longer = (replace(LISTENING, t_s=t_s, heard_s=t_s) for t_s in (60.0, 61.0))
    assert full.text == longer.text != LISTENING.text
