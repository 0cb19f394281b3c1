"""What differs from one firmware version to another: one table. Protocol reference 17.

Two lines of versions count on their own: the base firmware's (XEP), and the sensor firmware's,
which is XEP with profiles. A module reports both in its version list. The driver asks the table
before it sends a command, ``xethru doctor`` names what a module lacks, and the emulator plays a
version as its place in the table says.
"""

import functools
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from xethru_protocol.validation import shown
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import (
    InfoItem,
    IoPinFeature,
    OutputFeature,
    ProfileId,
    SensorMode,
    TestCode,
    TxCenterFrequency,
)

_VERSION = re.compile(r"(\d+)\.(\d+)\.(\d+)(?:-([a-z]+)(?:\.(\d+))?)?")
_BASE = "XEP"
# What the sensor firmware calls itself: before 1.3.1 as the product (Protocol reference 17).
_SENSORS = ("Annapurna", "X4M300", "X4M200", "X4M210")
Key = tuple[int, int, int, bool, str, int]
Concerns = Callable[[Any], bool]


@functools.lru_cache(maxsize=64)  # the emulator asks with every frame
def version_key(text: str) -> Key | None:
    """Return what orders versions, a pre-release before its release; None for no version.

    >>> version_key("1.0.5-rc.2") < version_key("1.0.5") < version_key("1.5.10")
    True
    """
    found = _VERSION.match(text)
    if found is None:
        return None
    major, minor, patch, label, number = found.groups()
    return int(major), int(minor), int(patch), label is None, label or "", int(number or 0)


@dataclass(frozen=True, slots=True, kw_only=True)
class FirmwareVersions:
    """Versions of what runs on a module; None for what it lacks or does not report."""

    sensor: str | None = None
    xep: str | None = None

    @classmethod
    def of_list(cls, version_list: str) -> "FirmwareVersions":
        """Return what a module's version list (SYSTEM_GET_INFO 07) says. Protocol reference 4.10.

        >>> FirmwareVersions.of_list("Annapurna:1.6.8;XEP:3.4.8;X4C51:2.1.0;DSP:1.0.0")
        FirmwareVersions(sensor='1.6.8', xep='3.4.8')
        >>> FirmwareVersions.of_list("XEP:3.4.8;X4C51:2.1.0")
        FirmwareVersions(sensor=None, xep='3.4.8')

        An application of somebody else on XEP has versions of its own, which say nothing here:

        >>> FirmwareVersions.of_list("Lidar:0.1.0;XEP:3.4.8")
        FirmwareVersions(sensor=None, xep='3.4.8')
        """
        words = re.split("[;:]", version_list)
        versions = dict(zip(words[::2], words[1::2], strict=False))
        xep = versions.get(_BASE)
        return cls(
            sensor=next((versions[name] for name in _SENSORS if name in versions), None),
            xep=xep if xep and version_key(xep) else None,
        )

    @property
    def name(self) -> str:
        """How messages call it."""
        return f"XEP {self.xep}" if self.sensor is None else f"sensor firmware {self.sensor}"

    @property
    def is_released(self) -> bool:
        """Whether its versions are those of a release, of which the table is certain."""
        return self.sensor in {None, *SENSOR_VERSIONS} and self.xep in {None, *XEP_VERSIONS}


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """A row of the table.

    Attributes
    ----------
    topic
        What differs.
    before
        How it was in older versions.
    sensor, xep
        The first version that has it as today; None: the row is of the other line.
    commands
        Commands, each with the cases that need it, that an older version does not know.
    is_fault
        Whether older versions work wrongly, where a host can only know it.
    """

    topic: str
    before: str
    sensor: str | None = None
    xep: str | None = None
    commands: dict[type[m.Message], Concerns] | None = None
    is_fault: bool = False

    def is_in(self, firmware: FirmwareVersions) -> bool:
        """Whether a module has it as today; assumed of a text that is not a version."""
        for since, has in ((self.sensor, firmware.sensor), (self.xep, firmware.xep)):
            oldest = None if since is None else version_key(since)
            version = None if has is None else version_key(has)
            if oldest is not None and version is not None:
                return version >= oldest
        return True

    @property
    def since(self) -> str:
        """The version to ask for."""
        lines = (("sensor firmware", self.sensor), (_BASE, self.xep))
        return " or ".join(f"{name} {version}" for name, version in lines if version is not None)


def _always(command: m.Message) -> bool:
    return True


def _any_of(*commands: type[m.Message]) -> dict[type[m.Message], Concerns]:
    return dict.fromkeys(commands, _always)


_CERTIFICATION = frozenset(
    {
        TestCode.CERTIFICATION_ON,
        TestCode.CERTIFICATION_OFF,
        TestCode.TX_ONLY,
        TestCode.TX_ONLY_TX_OFF,
        TestCode.STREAM_TX_OFF,
    }
)
_MATRICES = frozenset(
    {
        OutputFeature.PULSEDOPPLER_FLOAT,
        OutputFeature.PULSEDOPPLER_BYTE,
        OutputFeature.NOISEMAP_FLOAT,
        OutputFeature.NOISEMAP_BYTE,
    }
)
_LATE_PROFILES = frozenset({ProfileId.XTS_ID_APP_RESPIRATION_4, ProfileId.XTS_ID_APP_RESPIRATION_5})
_NORMALIZED = OutputFeature.RESPIRATION_NORMALIZEDMOVEMENTLIST

FIRMWARE_ID = Difference(
    topic="firmware id Annapurna", before="it is the product's name", sensor="1.3.1"
)
SETTINGS_WHILE_RUNNING = Difference(
    topic="an error for settings that a running profile does not take",
    before="they are acknowledged and ignored",
    sensor="1.0.5-rc.2",
    is_fault=True,
)
STOP_WITHOUT_PROFILE = Difference(
    topic="STOP without a profile", before="it is not acknowledged", sensor="1.1.4"
)
BOOTLOADER_KEY = Difference(
    topic="the key of START_BOOTLOADER", before="it is A2B95EF0", sensor="1.1.4", xep="1.1.3"
)
MATRIX_OUTPUTS = Difference(
    topic="noise map control and pulse-Doppler outputs",
    before="absent",
    sensor="1.2.1",
    commands={
        **_any_of(m.NoiseMapSetControl, m.NoiseMapGetControl, m.StoreNoiseMap, m.LoadNoiseMap),
        m.OutputSetControl: lambda command: command.feature in _MATRICES,
    },
)
PIN_FUNCTIONS = Difference(
    topic="IO pin functions and certification by protocol",
    before="absent",
    sensor="1.4.7",
    commands={
        m.IoPinSetControl: _always,
        m.SystemTest: lambda command: command.code in _CERTIFICATION,
        m.SetMode: lambda command: command.mode == SensorMode.XTID_SM_REG,
    },
)
RUN_AND_IDLE = Difference(
    topic="switching between RUN and IDLE, and counting of faults for safe mode",
    before="faulty",
    sensor="1.4.7",
    is_fault=True,
)
READ_BACKS = Difference(
    topic="GETs of outputs, LED, IO pin control and sensitivity, and the high band",
    before="absent",
    sensor="1.5.10",
    commands={
        **_any_of(m.OutputGetControl, m.AppGetLedControl, m.IoPinGetControl, m.GetSensitivity),
        m.SetTxCenterFrequency: lambda command: (
            command.tx_center_frequency == TxCenterFrequency.HIGH_BAND
        ),
    },
)
USB_ENUMERATION = Difference(
    topic="USB enumeration", before="faulty", sensor="1.5.10", xep="3.3.0", is_fault=True
)
DELETE_NOISE_MAP = Difference(
    topic="DELETE_NOISEMAP, default noise map, RESPIRATION_4 and 5, NormalizedMovementList",
    before="absent",
    sensor="1.6.6",
    commands={
        m.DeleteNoiseMap: _always,
        m.LoadApp: lambda command: command.profile_id in _LATE_PROFILES,
        m.OutputSetControl: lambda command: command.feature == _NORMALIZED,
    },
)
FACTORY_PRESET = Difference(
    topic="FACTORY_PRESET", before="some settings survive it", sensor="1.6.6", is_fault=True
)
LONG_REQUESTS = Difference(
    topic="reception on a UART",
    before="the module crashes after 1024 bytes without a pause",
    sensor="1.6.6",
    xep="3.4.7",
    is_fault=True,
)
DAC_STEP = Difference(
    topic="the DAC step",
    before="set wrongly, which costs 3 dB of signal",
    sensor="1.6.8",
    is_fault=True,
)
NO_PRESENCE_PIN = Difference(
    topic="IO pin feature no-presence",
    before="absent",
    sensor="1.6.8",
    commands={m.IoPinSetControl: lambda c: c.pin_feature == IoPinFeature.NO_PRESENCE},
)
BAUD_RATE = Difference(
    topic="SETBAUDRATE, and NoEscape framing of baseband",
    before="absent; baseband comes in Normal framing",
    xep="1.0.7-beta",
    commands=_any_of(m.SetBaudRate),
)
FILES = Difference(
    topic="files",
    before="absent",
    xep="1.1.0-beta",
    commands=_any_of(
        m.SearchFileType,
        m.FindAllFiles,
        m.CreateFile,
        m.OpenFile,
        m.SetFileData,
        m.CloseFile,
        m.GetFileLength,
        m.GetFileData,
        m.DeleteFile,
    ),
)
FORMAT = Difference(
    topic="FORMAT_FILESYSTEM", before="absent", xep="2.0.0", commands=_any_of(m.FormatFilesystem)
)
NORMALISATION = Difference(
    topic="normalisation of RF to -1 ... 1, and the filter of the high band",
    before="wrong scale, lost signal",
    xep="2.0.0",
    is_fault=True,
)
Q_SIGN = Difference(topic="the sign of Q", before="not negated", xep="2.1.0", is_fault=True)
DUPLICATE_FRAMES = Difference(
    topic="radar frames", before="some may come twice", xep="2.1.3", is_fault=True
)
SAFE_MODE_PONG = Difference(topic="safe mode in PONG", before="PONG says ready", xep="2.1.4")
LAST_SAMPLE = Difference(
    topic="the last RF sample of a frame",
    before="corrupt with some frame areas",
    xep="2.1.8",
    is_fault=True,
)
BOARD_CONFIGURATION = Difference(
    topic="configuration of each board, such as its frame area offset",
    before="compiled values only",
    xep="2.2.0",
    is_fault=True,
)
X4_GETS = Difference(
    topic="several X4DRIVER GETs and the system core id",
    before="absent",
    xep="3.3.0",
    commands={m.SystemGetInfo: lambda c: c.item == InfoItem.XTID_SSIC_SYSTEMCOREID},
)

DIFFERENCES = (
    *(FIRMWARE_ID, SETTINGS_WHILE_RUNNING, STOP_WITHOUT_PROFILE, BOOTLOADER_KEY, MATRIX_OUTPUTS),
    *(PIN_FUNCTIONS, RUN_AND_IDLE, READ_BACKS, USB_ENUMERATION, DELETE_NOISE_MAP),
    *(FACTORY_PRESET, LONG_REQUESTS, DAC_STEP, NO_PRESENCE_PIN, BAUD_RATE, FILES, FORMAT),
    *(NORMALISATION, Q_SIGN, DUPLICATE_FRAMES, SAFE_MODE_PONG, LAST_SAMPLE),
    *(BOARD_CONFIGURATION, X4_GETS),
)
"""The table; FPS as integers, before XEP 1.0.3-rc.1, is another wire format and no row."""
_BY_COMMAND = {
    kind: tuple(row for row in DIFFERENCES if row.commands and kind in row.commands)
    for kind in {kind for row in DIFFERENCES for kind in row.commands or ()}
}


def needed_by(command: m.Message) -> tuple[Difference, ...]:
    """Return the rows that a module must have to know a command; most need none.

    >>> [row.since for row in needed_by(m.GetSensitivity())], needed_by(m.Ping())
    (['sensor firmware 1.5.10'], ())
    """
    rows = _BY_COMMAND.get(type(command), ())
    return tuple(row for row in rows if row.commands and row.commands[type(command)](command))


def lacking(firmware: FirmwareVersions) -> tuple[Difference, ...]:
    """Return the rows that are not as today in a version."""
    return tuple(row for row in DIFFERENCES if not row.is_in(firmware))


SENSOR_VERSIONS = {
    "1.0.5-rc.1": "1.0.3-rc.1",
    "1.0.5-rc.2": "1.0.3-rc.2",
    "1.0.7": "1.0.5",
    "1.1.4": "1.1.3",
    "1.2.1": "2.1.0",
    "1.3.1": "2.1.8",
    "1.4.7": "3.0.0",
    "1.5.10": "3.3.0",
    "1.6.6": "3.4.6",
    "1.6.8": "3.4.8",
}
"""Released sensor firmware and the XEP in it; from 1.2.1 to 1.5.10 and for 1.6.8 assumed."""
XEP_VERSIONS = (
    *("1.0.3-rc.1", "1.0.3-rc.2", "1.0.5", "1.0.7-beta", "1.1.0-beta", "1.1.3", "2.0.0"),
    *("2.1.0", "2.1.3", "2.1.4", "2.1.8", "2.2.0", "3.0.0", "3.3.0", "3.4.6", "3.4.7", "3.4.8"),
)
FIRMWARE_NAMES = (
    *("sensor", *(f"sensor-{version}" for version in SENSOR_VERSIONS)),
    *("xep", *(f"xep-{version}" for version in XEP_VERSIONS)),
)


def firmware_named(name: str) -> FirmwareVersions:
    """Return the firmware of a name: ``sensor``, ``xep``, or one of them, a hyphen and a version.

    Without version it is the newest. Raises `ValueError`, which lists the known versions.

    >>> firmware_named("sensor")
    FirmwareVersions(sensor='1.6.8', xep='3.4.8')
    >>> firmware_named("xep-3.3.0")
    FirmwareVersions(sensor=None, xep='3.3.0')
    """
    if name not in FIRMWARE_NAMES:
        raise ValueError(
            f"firmware {shown(name)} is not known; it is one of {', '.join(FIRMWARE_NAMES)} "
            "(without a version: the newest)"
        )
    line, _, version = name.partition("-")
    if line == _BASE.lower():
        return FirmwareVersions(xep=version or XEP_VERSIONS[-1])
    sensor = version or [*SENSOR_VERSIONS][-1]
    return FirmwareVersions(sensor=sensor, xep=SENSOR_VERSIONS[sensor])
