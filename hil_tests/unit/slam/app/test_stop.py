"""Signals: a flag between steps, at once while waiting, the old handler afterwards."""

import os
import signal
import threading
import time

import pytest

from slam.app.stop import StopFlag, StopRequestedError


@pytest.mark.parametrize(("which", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
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
        started = time.monotonic()
        threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGTERM)).start()
        with pytest.raises(StopRequestedError), stop.at_once():
            time.sleep(10)
    assert time.monotonic() - started < 5


def test_a_second_signal_is_pythons_own() -> None:
    before = signal.getsignal(signal.SIGINT)
    with StopFlag():
        os.kill(os.getpid(), signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_DFL
    assert signal.getsignal(signal.SIGINT) is before
