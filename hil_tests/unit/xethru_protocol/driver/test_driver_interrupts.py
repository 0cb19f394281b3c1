"""What interrupts and faulty modules leave behind."""

from collections.abc import Sequence

import pytest

from hil_tests.unit.xethru_protocol.both_drivers import DriverOn, Scripted
from hil_tests.unit.xethru_protocol.scripted import PlainModule, frame
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import PongCode

Said = Sequence[m.Message | bytes]


class Interrupted(BaseException):
    """As KeyboardInterrupt, which a test runner would take for its own."""


def test_interrupt_while_bytes_are_sorted_leaves_a_driver_that_works(raw: Scripted) -> None:
    radar, line = raw

    def interrupt(message: m.Message, arrival_ns: int) -> None:
        raise Interrupted

    radar.listener = interrupt
    line.say(b"".join(line.bytes_of(frame(k)) for k in (1, 2)) + line.bytes_of(frame(3))[:100])
    with pytest.raises(Interrupted):
        radar.read_frame()
    radar.listener = None
    line.say(line.bytes_of(frame(3))[100:], frame(4))
    assert radar.read_frame().counter == 4
    assert radar.ping() is PongCode.XTS_SPRP_READY
    assert radar.statistics.faults  # the rest of frame 3


def test_a_frame_cut_by_the_end_of_the_driver_is_not_counted_as_lost(raw: Scripted) -> None:
    radar, line = raw
    line.say(line.bytes_of(frame(1)) + line.bytes_of(frame(2))[:100])
    with radar:
        assert radar.read_frame().counter == 1
        line.say(line.bytes_of(frame(2))[100:], frame(3))
    assert radar.frames_lost == 0


def test_interrupted_request_waits_for_nothing_any_more(driver_on: DriverOn) -> None:
    """What answers it later is a stray, also where others send such messages unasked."""
    plain = PlainModule()

    def module(command: m.Message) -> Said:
        if isinstance(command, m.GetMode):
            raise Interrupted
        return plain(command)

    radar, line = driver_on(module)
    radar.configure_raw()
    with pytest.raises(Interrupted):
        radar.request(m.GetMode())
    line.say(m.ReplyByte(values=b"\x12"), frame(1))
    assert radar.read_frame().counter == 1
    assert radar.stray_count == 1


def test_answers_to_nothing_are_counted_and_not_kept(raw: Scripted) -> None:
    radar, line = raw
    line.say(*[m.Ack()] * 1000, frame(1))
    radar.read_frame()
    assert radar.stray_count == 1000
    assert radar.ping() is PongCode.XTS_SPRP_READY
    assert radar.stray_count == 1000  # those that were kept would count once more


def test_warnings_are_kept_up_to_a_thousand(raw: Scripted) -> None:
    radar, _ = raw
    for _ in range(1000):
        radar.start(20.0)
    radar.start(20.5)
    assert len(radar.warnings) == 1000
    assert "20.5 frames/s" in radar.warnings[-1]
