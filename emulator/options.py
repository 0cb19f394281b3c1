"""What the protocol reference leaves open, as one named option each with its default.

A question the reference answers is no option. Where it marks a guess, the default is that guess;
where it reports an observation of hardware, the default is the observation.

Source: protocol reference, the rows marked [INF], 4.3, 4.4, 8.3, 8.5 and chapter 15.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from xethru_protocol.codes import ErrorCode, OutputFeature, ProfileId

__all__ = ["X4M300_PROFILES", "DeviceOptions"]

X4M300_PROFILES = frozenset({ProfileId.XTS_ID_APP_PRESENCE_2})


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceOptions:
    """How one emulated module behaves where the reference allows more than one answer.

    Attributes
    ----------
    firmware
        "sensor": a stock X4M300. "xep": the bare base firmware, which has no profiles and no
        modes.
    profiles
        Profiles that LOADAPP accepts (4.3).
    default_output
        The presence message that is on in a module as shipped (15, question 3).
    port_on_reset
        Whether a reset keeps the port ("stay") or takes it away until the USB is back ("vanish").
    bad_value
        What a profile setting out of its range gets (15, question 1): "refuse" answers
        `bad_value_error`, "clamp" takes the nearest value.
    bad_value_error
        ERROR of a refused value.
    busy_profile_error
        ERROR of a profile setting while the profile runs, is paused, or in MANUAL (8.3).
    no_profile_error
        ERROR of a profile setting without a loaded profile (8.3).
    run_without_profile_error
        ERROR of RUN and IDLE without a loaded profile (8.3).
    get_without_profile
        Whether GETs other than of sensitivity and band stay without answer ("silence", as
        observed) or get ERROR 1 ("error") when no profile is loaded (4.4).
    presence_output_while_running
        Whether OUTPUT control takes presence messages while the profile runs; baseband,
        pulse-Doppler and noise maps are taken in any case (8.3).
    run_to_manual
        Whether SETMODE MANUAL is taken from a running profile ("accept") or answered with
        `busy_profile_error` ("refuse") (8.3).
    profile_switch
        "direct", or "restart": RUN of another profile than the last one answers 22h, and the
        module resets itself (8.2).
    manual_settings
        Whether X4 settings survive MANUAL, STOP, MANUAL ("keep") or INIT is carried out on
        entering MANUAL ("init") (15, question 4).
    parameter_file_reply
        As what a parameter file is answered (4.4, 16).
    baseband_sampling_hz
        Sampling-frequency field of baseband messages [Hz] (15, question 9).
    storage_bytes
        Size of the file storage: 0x48000, or 0x18000 with the small microcontroller (4.11).
    bootloader_status
        Status byte of the bootloader for a command carried out (15, question 8).
    noise_map_store_ns
        How long a noise map takes to store; another store meanwhile is refused (4.4).
    x4_init_ns
        How long INIT takes to answer (4.9); 0 because emulated time is the host's time too.
    file_delete_ns
        How long DELETE_FILE takes to answer (4.11).
    watchdog_memory_ns
        Time without fault after which the count of consecutive faults is cleared (8.5).
    """

    firmware: Literal["sensor", "xep"] = "sensor"
    profiles: frozenset[int] = X4M300_PROFILES
    default_output: OutputFeature = OutputFeature.PRESENCE_SINGLE
    port_on_reset: Literal["stay", "vanish"] = "stay"
    bad_value: Literal["refuse", "clamp"] = "refuse"
    bad_value_error: int = ErrorCode.XTS_SPRE_COMMAND_FAILED
    busy_profile_error: int = ErrorCode.XTS_SPRE_COMMAND_FAILED
    no_profile_error: int = ErrorCode.XTS_SPRE_NOT_RECOGNIZED
    run_without_profile_error: int = ErrorCode.XTS_SPRE_APP_INVALID
    get_without_profile: Literal["silence", "error"] = "silence"
    presence_output_while_running: bool = False
    run_to_manual: Literal["accept", "refuse"] = "accept"
    profile_switch: Literal["direct", "restart"] = "direct"
    manual_settings: Literal["keep", "init"] = "keep"
    parameter_file_reply: Literal["string", "appdata", "byte"] = "string"
    baseband_sampling_hz: float = 2.916e9
    storage_bytes: int = 0x48000
    bootloader_status: int = 0
    noise_map_store_ns: int = 100_000_000
    x4_init_ns: int = 0
    file_delete_ns: int = 100_000_000
    watchdog_memory_ns: int = 300_000_000_000
