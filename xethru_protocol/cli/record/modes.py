"""What a module is made to send while it is recorded: raw frames, a profile, or what it sends."""

from argparse import Namespace
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from xethru_protocol.cli.arguments import refuse_raw_settings
from xethru_protocol.cli.output import (
    CommandFailed,
    frame_timeout_s,
    let_send,
    set_up,
    warn,
)
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.validation import choices, shown
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import (
    FileType,
    MatrixControl,
    OutputFeature,
    ProfileId,
)
from xethru_protocol.wire.errors import (
    DeviceError,
    OldFirmwareError,
    RemoteProtocolError,
    ResponseTimeout,
)

POLL_S = 0.2  # how late a signal, or the end, may be noticed


class Listen:
    """How to get a module to send what is recorded: here, whatever it sends by itself."""

    profile_id: int | None = None  # that runs then; None if there is none, or it is not known
    parameter_file: bytes | None = None  # the module's own

    def prepare(self, radar: X4M300) -> None:
        """Set the module up without starting it; data that come meanwhile are old."""

    def start(self, radar: X4M300) -> float:
        """Let it send; returns after how much silence [s] something must be wrong."""
        return float("inf")

    def about(self, radar: X4M300) -> dict[str, Any]:
        """Return what is known of it once it sends, by the names in an MCAP file's info."""
        return {}

    def wait(self, radar: X4M300, timeout_s: float) -> None:
        """Receive until a message came or the time is over, and empty the driver's queues."""
        with suppress(ResponseTimeout):
            radar.read_message(m.Response, timeout_s)
        for _ in range(radar.messages_waiting()):
            radar.read_message(m.Response)
        for _ in range(radar.frames_waiting()):
            radar.read_frame()


class RawFrames(Listen):
    """Radar frames of raw mode."""

    def __init__(self, config: RawConfig | None, fps: float | None) -> None:
        self._config = config
        self._fps = fps
        self._rate_hz = 0.0

    def prepare(self, radar: X4M300) -> None:
        set_up(radar, self._config)

    def start(self, radar: X4M300) -> float:
        self._rate_hz = let_send(radar, self._config, self._fps)
        return frame_timeout_s(self._rate_hz)

    def about(self, radar: X4M300) -> dict[str, Any]:
        return radar.description | {"rate_hz": self._rate_hz}

    def wait(self, radar: X4M300, timeout_s: float) -> None:
        """Receive until a frame came or the time is over; other messages are not kept."""
        with suppress(ResponseTimeout):
            radar.read_frame(timeout_s)


_BOTH = MatrixControl.SLOW | MatrixControl.FAST
_COMMON_OUTPUTS = {
    "iq": (OutputFeature.BASEBAND_IQ, 1),
    "ap": (OutputFeature.BASEBAND_AMPLITUDE_PHASE, 1),
    "pulsedoppler": (OutputFeature.PULSEDOPPLER_FLOAT, _BOTH),
    "pulsedoppler-byte": (OutputFeature.PULSEDOPPLER_BYTE, _BOTH),
    "noisemap": (OutputFeature.NOISEMAP_FLOAT, _BOTH),
    "noisemap-byte": (OutputFeature.NOISEMAP_BYTE, _BOTH),
}
_RIVALS = [
    ("iq", "ap"),
    ("pulsedoppler", "pulsedoppler-byte"),
    ("noisemap", "noisemap-byte"),
]
"""Outputs of which the module sends one: the one that is switched on last (4.7)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProfileKind:
    """A profile: its id, which modules have it, its own outputs by name."""

    profile_id: ProfileId
    modules: str
    own_outputs: Mapping[str, OutputFeature]

    @property
    def outputs(self) -> dict[str, tuple[OutputFeature, int]]:
        """All outputs with the control that switches them on."""
        return _COMMON_OUTPUTS | {name: (one, 1) for name, one in self.own_outputs.items()}


PROFILES = {
    "presence": ProfileKind(
        profile_id=ProfileId.XTS_ID_APP_PRESENCE_2,
        modules="an X4M300",
        own_outputs={
            "single": OutputFeature.PRESENCE_SINGLE,
            "movinglist": OutputFeature.PRESENCE_MOVINGLIST,
        },
    ),
    "respiration": ProfileKind(
        profile_id=ProfileId.XTS_ID_APP_RESPIRATION_2,
        modules="an X4M200 or X4M210",
        own_outputs={
            "status": OutputFeature.RESP_STATUS,
            "sleep": OutputFeature.SLEEP_STATUS,
            "vitalsigns": OutputFeature.VITAL_SIGNS,
            "movinglist": OutputFeature.RESPIRATION_MOVINGLIST,
            "detectionlist": OutputFeature.RESPIRATION_DETECTIONLIST,
            "normalizedmovementlist": OutputFeature.RESPIRATION_NORMALIZEDMOVEMENTLIST,
        },
    ),
}


class ProfileMode(Listen):
    """Messages of a profile, about one a second, and what else its outputs bring."""

    def __init__(
        self,
        name: str,
        *,
        outputs: Sequence[str] | None,
        zone_m: tuple[float, float] | None,
        sensitivity: int | None,
    ) -> None:
        self._name = name
        self._kind = PROFILES[name]
        self._outputs = outputs
        self._zone_m = zone_m
        self._sensitivity = sensitivity
        self.profile_id = self._kind.profile_id

    def prepare(self, radar: X4M300) -> None:
        try:
            radar.profile.load(self._kind.profile_id)
        except DeviceError as error:
            raise CommandFailed(
                f"this module does not load the profile {self._name}, which {self._kind.modules} "
                f"has: {error}"
            ) from error
        # the vendor's recorder stores this file beside the data; a module need not have it
        with suppress(DeviceError, OldFirmwareError, RemoteProtocolError):
            self.parameter_file = radar.files.read(FileType.PARAMETER_FILE, 0)
        if self._zone_m is not None:
            zone_m = radar.profile.set_zone(*self._zone_m)
            warn(f"xethru record: the detection zone is {zone_m[0]:.3f} ... {zone_m[1]:.3f} m")
        if self._sensitivity is not None:
            radar.profile.set_sensitivity(self._sensitivity)
        if self._outputs is not None:
            self._set_outputs(radar, self._outputs)

    def _set_outputs(self, radar: X4M300, names: Sequence[str]) -> None:
        """Switch others off first: switching one off switches its rival off, too (4.7)."""
        for name, (feature, _) in self._kind.outputs.items():
            # a module without this output does not send it
            with suppress(DeviceError, OldFirmwareError):
                if name not in names and _may_be_on(radar, feature):
                    radar.profile.set_output(feature, 0)
        for name in names:
            try:
                radar.profile.set_output(*self._kind.outputs[name])
            except DeviceError as error:
                raise CommandFailed(f"this module does not take output {name}: {error}") from error

    def start(self, radar: X4M300) -> float:
        radar.profile.run()
        # noise maps alone are sent only now and then
        return 10.0 if self._outputs is None or {*self._outputs} - {*_COMMON_OUTPUTS} else 60.0


def _may_be_on(radar: X4M300, feature: OutputFeature) -> bool:
    try:
        return radar.profile.output(feature) != 0
    except OldFirmwareError:  # it has the output perhaps, and no question for it
        return True


def profile_of(arguments: Namespace) -> ProfileMode | None:
    """Return the profile to record, None for none; ends the program on wrong usage."""
    name = arguments.profile
    if name != "raw":
        is_set = "takes --zone, not raw settings" if name in PROFILES else "changes nothing"
        refuse_raw_settings(arguments, f"--profile {name} {is_set}")
    if name not in PROFILES:
        for option in ("output", "zone", "sensitivity"):
            if getattr(arguments, option) is not None:
                arguments.refuse(f"--{option} needs --profile presence or respiration")
        return None
    names: list[str] | None = None
    if arguments.output is not None:
        known = PROFILES[name].outputs
        names = [part.strip() for part in arguments.output.split(",")]
        for part in names:
            others = [other for other, kind in PROFILES.items() if part in kind.own_outputs]
            if part not in known and others:
                arguments.refuse(f"output {part} belongs to --profile {others[0]}, not {name}")
            if part not in known:
                arguments.refuse(
                    f"profile {name} has no output {shown(part)}; {choices(part, known)}"
                )
        for rivals in _RIVALS:
            both = [part for part in names if part in rivals]
            if len(set(both)) > 1:
                warn(
                    f"xethru record: outputs {rivals[0]} and {rivals[1]} exclude each other; "
                    f"the module sends {both[-1]}"
                )
    if arguments.zone is not None and arguments.zone[0] >= arguments.zone[1]:
        arguments.refuse("argument --zone: START must be smaller than END")
    return ProfileMode(
        name, outputs=names, zone_m=arguments.zone, sensitivity=arguments.sensitivity
    )
