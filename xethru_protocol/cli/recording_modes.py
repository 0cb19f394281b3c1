"""What `record` brings a module to before it writes down what comes."""

from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

from xethru_protocol.codes import ProfileId
from xethru_protocol.driver import X4M300, RawConfig
from xethru_protocol.errors import ResponseTimeout

_FRAMES_AT_ONCE = 100


class RecordingMode(Protocol):
    """How to get a module to send what shall be recorded."""

    @property
    def profile_id(self) -> int | None:
        """Profile that runs then; None if that is none, or not known."""

    def prepare(self, radar: X4M300) -> None:
        """Bring the module to where it sends nothing yet; what comes meanwhile is old."""

    def start(self, radar: X4M300) -> float:
        """Let it send; returns after how much silence [s] something must be wrong."""

    def wait(self, radar: X4M300, timeout_s: float) -> None:
        """Receive, until something came or the time is over, and let go what the driver keeps."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RawFrames:
    """Radar frames of raw mode."""

    config: RawConfig
    fps: float
    profile_id: int | None = None

    def prepare(self, radar: X4M300) -> None:
        """Configure the chip."""
        radar.configure_raw(self.config)

    def start(self, radar: X4M300) -> float:
        """Start frames."""
        return max(2.0, 3.0 / radar.start(self.fps))

    def wait(self, radar: X4M300, timeout_s: float) -> None:
        """Take a frame."""
        _wait_for_frame(radar, timeout_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class Presence:
    """Messages of the X4M300's own profile, about one a second."""

    profile_id: int | None = ProfileId.XTS_ID_APP_PRESENCE_2

    def prepare(self, radar: X4M300) -> None:
        """Load the profile."""
        radar.presence.load()

    def start(self, radar: X4M300) -> float:
        """Run it."""
        radar.presence.run()
        return 10.0

    def wait(self, radar: X4M300, timeout_s: float) -> None:
        """Take a message, and the frames that the profile sends if its outputs are on."""
        with suppress(ResponseTimeout):
            next(radar.presence.messages(1, timeout_s))
        with suppress(ResponseTimeout):
            for _ in radar.frames(_FRAMES_AT_ONCE, timeout_s=0.0):
                pass


@dataclass(frozen=True, slots=True, kw_only=True)
class Listen:
    """Whatever the module sends by itself."""

    profile_id: int | None = None

    def prepare(self, radar: X4M300) -> None:
        """Send nothing."""

    def start(self, radar: X4M300) -> float:
        """Wait for ever."""
        return float("inf")

    def wait(self, radar: X4M300, timeout_s: float) -> None:
        """Take a frame; other messages the driver does not keep."""
        _wait_for_frame(radar, timeout_s)


def _wait_for_frame(radar: X4M300, timeout_s: float) -> None:
    with suppress(ResponseTimeout):
        radar.read_frame(timeout_s)


def recording_mode(profile: str, config: RawConfig, fps: float) -> RecordingMode:
    """Mode by its name on the command line: raw, presence or none."""
    if profile == "raw":
        return RawFrames(config=config, fps=fps)
    return Presence() if profile == "presence" else Listen()
