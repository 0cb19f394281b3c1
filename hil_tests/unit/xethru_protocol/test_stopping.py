"""Signals: a flag between steps, at once while waiting, a request to a loop; nohup is respected."""

import os
import signal
import threading

import pytest

from hil_tests.patience import seconds
from xethru_protocol.system import StopFlag, StopRequestedError


@pytest.mark.parametrize(
    ("which", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)]
)
def test_a_signal_raises_at_the_next_check_only(which: signal.Signals, code: int) -> None:
    with StopFlag() as stop:
        stop.check()
        os.kill(os.getpid(), which)
        done = "work goes on until the check"
        with pytest.raises(StopRequestedError, match=f"stopped by {which.name}") as caught:
            stop.check()
    assert done
    assert caught.value.exit_code == code


def test_while_waiting_a_signal_raises_where_it_arrives() -> None:
    with StopFlag() as stop:
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGTERM)).start()
        with pytest.raises(StopRequestedError), stop.at_once():
            pytest.fail(f"it waited to the end: {threading.Event().wait(seconds(10))}")


def test_a_second_signal_gets_the_systems_default() -> None:
    before = signal.getsignal(signal.SIGINT)
    with StopFlag():
        os.kill(os.getpid(), signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_DFL
    assert signal.getsignal(signal.SIGINT) is before


def test_a_closing_terminals_second_hang_up_does_not_end_the_clean_stop() -> None:
    before = signal.getsignal(signal.SIGHUP)
    with StopFlag() as stop:
        os.kill(os.getpid(), signal.SIGHUP)
        os.kill(os.getpid(), signal.SIGHUP)
        with pytest.raises(StopRequestedError):
            stop.check()
    assert signal.getsignal(signal.SIGHUP) is before


def test_a_second_signal_gets_the_previous_handler() -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    stop = StopFlag("previous")

    def twice() -> None:
        with stop:
            signal.raise_signal(signal.SIGINT)
            assert stop.received is signal.SIGINT
            signal.raise_signal(signal.SIGINT)

    try:
        with pytest.raises(KeyboardInterrupt):
            twice()
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_every_signal_ends_an_attached_loop(number: signal.Signals) -> None:
    ended: list[str] = []
    with StopFlag("same") as stop:
        os.kill(os.getpid(), number)
        stop.attach(lambda: ended.append("loop"))
        assert ended == ["loop"]  # for the signal that came before
        os.kill(os.getpid(), number)
        assert ended == ["loop", "loop"]
        stop.detach()
        os.kill(os.getpid(), number)
    assert (stop.requested, len(ended)) == (True, 2)


def test_nohup_is_respected() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopFlag() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            stop.check()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_signal_before_waiting_begins_is_not_lost() -> None:
    with StopFlag() as stop:
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(StopRequestedError), stop.at_once():
            pytest.fail("must not begin to wait")


class StopFlagWithASlowCheck(StopFlag):
    """A signal comes just after the check found nothing, where a lost one would go unseen."""

    def check(self) -> None:
        first = self.received is None
        super().check()
        if first:
            os.kill(os.getpid(), signal.SIGINT)


def test_a_signal_just_after_the_check_is_not_lost() -> None:
    with StopFlagWithASlowCheck() as stop:
        with pytest.raises(StopRequestedError), stop.at_once():
            pytest.fail("must not begin to wait")
        assert not stop._at_once
