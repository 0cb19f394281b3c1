"""Questions to a module whose answers a faithful emulator must give, too.

They change nothing that outlives a restart, send no frames, and end as they begin: stopped, without
a profile. A mask is a pattern for a field that differs from module to module; everything else of an
answer is compared byte for byte.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from xethru_protocol import messages as m
from xethru_protocol.codes import InfoItem, OutputFeature, ProfileId, SensorMode, X4Setting

__all__ = ["TRANSACTIONS", "Transaction"]

_VERSION = r"[0-9]+\.[0-9]+\.[0-9]+.*"
_ANYTHING = r"(?s).*"
_NUMBERS = r"\[-?[0-9]+(, -?[0-9]+)*\]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Transaction:
    """One question.

    Attributes
    ----------
    name
        What it is called in tables and cassettes; unique.
    command
        The question.
    masks
        Fields of the answer that may differ, each with a pattern that both values match.
    """

    name: str
    command: m.Command[m.Response]
    masks: Mapping[str, str] = field(default_factory=dict)


def _pings() -> Sequence[Transaction]:
    return [
        Transaction(name=f"ping {seed:08X}", command=m.Ping(seed=seed))
        for seed in (0xEEAAEAAE, 0, 0x7D7E7F7D)
    ]


def _identity() -> Sequence[Transaction]:
    masks = {
        InfoItem.XTID_SSIC_ITEMNUMBER: r"[0-9]{6}-[0-9]{3}",
        InfoItem.XTID_SSIC_FIRMWAREID: r"\w+",
        InfoItem.XTID_SSIC_VERSION: _VERSION,
        InfoItem.XTID_SSIC_BUILD: _VERSION,
        InfoItem.XTID_SSIC_SERIALNUMBER: r"[0-9]{12}",
        InfoItem.XTID_SSIC_VERSIONLIST: r".*XEP:.*",
        InfoItem.XTID_SSIC_SYSTEMCOREID: _ANYTHING,
        InfoItem.XTID_SSIC_BOOTLOADER: _ANYTHING,
    }
    told = [
        Transaction(
            name=f"info {item.name.removeprefix('XTID_SSIC_').lower()}",
            command=m.SystemGetInfo(item=item),
            masks={"value": masks[item]} if item in masks else {},
        )
        for item in InfoItem
    ]
    return [*told, Transaction(name="info unknown", command=m.SystemGetInfo(item=0x55))]


def _modes() -> Sequence[Transaction]:
    presence = ProfileId.XTS_ID_APP_PRESENCE_2
    return [
        Transaction(name="mode", command=m.GetMode()),
        Transaction(name="profile id without profile", command=m.GetProfileId()),
        Transaction(name="stop twice", command=m.SetMode(mode=SensorMode.XTID_SM_STOP)),
        Transaction(name="run without profile", command=m.SetMode(mode=SensorMode.XTID_SM_RUN)),
        Transaction(name="idle without profile", command=m.SetMode(mode=SensorMode.XTID_SM_IDLE)),
        Transaction(name="unknown mode", command=m.SetMode(mode=0x77)),
        Transaction(name="sensitivity without profile", command=m.GetSensitivity()),
        Transaction(name="zone without profile", command=m.GetDetectionZone()),
        Transaction(name="load unknown profile", command=m.LoadApp(profile_id=0x12345678)),
        Transaction(name="load presence", command=m.LoadApp(profile_id=presence)),
        Transaction(name="profile id", command=m.GetProfileId()),
        Transaction(name="mode with profile", command=m.GetMode()),
    ]


def _profile() -> Sequence[Transaction]:
    settings: list[Transaction] = [
        Transaction(name="zone limits", command=m.GetDetectionZoneLimits())
    ]
    for start_m, end_m in ((0.4, 5.0), (1.0, 2.0), (0.4, 9.4)):
        settings += [
            Transaction(
                name=f"set zone {start_m} {end_m}",
                command=m.SetDetectionZone(start_m=start_m, end_m=end_m),
            ),
            Transaction(name=f"zone {start_m} {end_m}", command=m.GetDetectionZone()),
        ]
    for value in (0, 9, 5):
        settings += [
            Transaction(
                name=f"set sensitivity {value}", command=m.SetSensitivity(sensitivity=value)
            ),
            Transaction(name=f"sensitivity {value}", command=m.GetSensitivity()),
        ]
    for band in (4, 3):
        command = m.SetTxCenterFrequency(tx_center_frequency=band)
        settings += [
            Transaction(name=f"set band {band}", command=command),
            Transaction(name=f"band {band}", command=m.GetTxCenterFrequency()),
        ]
    for control in (3, 6):
        settings += [
            Transaction(
                name=f"set noise map {control}", command=m.NoiseMapSetControl(control=control)
            ),
            Transaction(name=f"noise map {control}", command=m.NoiseMapGetControl()),
        ]
    for feature in (OutputFeature.BASEBAND_IQ, OutputFeature.BASEBAND_AMPLITUDE_PHASE):
        name = feature.name.lower()
        settings += [
            Transaction(
                name=f"set output {name}", command=m.OutputSetControl(feature=feature, control=1)
            ),
            Transaction(name=f"output {name}", command=m.OutputGetControl(feature=feature)),
        ]
    settings.append(
        Transaction(
            name="the other output is off",
            command=m.OutputGetControl(feature=OutputFeature.BASEBAND_IQ),
        )
    )
    settings.append(Transaction(name="unload", command=m.SetMode(mode=SensorMode.XTID_SM_STOP)))
    return settings


def _x4() -> Sequence[Transaction]:
    listed: list[Transaction] = [
        Transaction(name="manual", command=m.SetMode(mode=SensorMode.XTID_SM_MANUAL)),
        Transaction(name="x4 init", command=m.X4DriverInit()),
    ]
    registers = {X4Setting.SPIREGISTER, X4Setting.PIFREGISTER, X4Setting.XIFREGISTER}
    listed += [
        Transaction(name=f"default {setting.name.lower()}", command=m.X4DriverGet(setting=setting))
        for setting in X4Setting
        if setting not in registers
    ]
    listed += [
        Transaction(
            name=f"spi register {address}",
            command=m.X4DriverGet(setting=X4Setting.SPIREGISTER, address=address),
        )
        for address in range(4)
    ]
    values: Sequence[tuple[X4Setting, Sequence[m.X4Value]]] = (
        (X4Setting.PULSESPERSTEP, (0x7D, 0x7E, 0x7F, 300)),
        (X4Setting.ITERATIONS, (0x7D, 0x7E, 0x7F, 16)),
        (X4Setting.DACMIN, (0x7F, 949, 2048)),
        (X4Setting.DACMAX, (0x7F, 1100, 2048)),
        (X4Setting.DACSTEP, (3, 4, 0)),
        (X4Setting.TXPOWER, (0, 3, 4, 2)),
        (X4Setting.TXCENTERFREQUENCY, (4, 5, 3)),
        (X4Setting.PRFDIV, (4, 3, 16)),
        (X4Setting.FRAMEAREAOFFSET, (0.0, 0.2, 0.18)),
        (X4Setting.FRAMEAREA, ((5.0, 0.4), (0.0, 9.9), (-0.5, 5.0), (0.2, 9.4))),
        (X4Setting.DOWNCONVERSION, (1, 0)),
    )
    for setting, wanted in values:
        for value in wanted:
            name = f"{setting.name.lower()} {value}"
            listed += [
                Transaction(
                    name=f"set {name}", command=m.X4DriverSet(setting=setting, value=value)
                ),
                Transaction(name=name, command=m.X4DriverGet(setting=setting)),
                Transaction(
                    name=f"bins with {name}",
                    command=m.X4DriverGet(setting=X4Setting.FRAMEBINCOUNT),
                ),
            ]
    listed.append(Transaction(name="end", command=m.SetMode(mode=SensorMode.XTID_SM_STOP)))
    return listed


def _files() -> Sequence[Transaction]:
    return [
        Transaction(name="all files", command=m.FindAllFiles(), masks={"values": _ANYTHING}),
        Transaction(
            name="length of no file",
            command=m.GetFileLength(file_type=0x8000007D, identifier=0x7E7E7E7E),
        ),
        Transaction(
            name="read of no file",
            command=m.GetFileData(file_type=0x8000007D, identifier=0x7E7E7E7E, offset=0, length=16),
        ),
        Transaction(
            name="crash dump length", command=m.GetCrashDumpLength(), masks={"values": _NUMBERS}
        ),
        Transaction(name="format with a wrong key", command=m.FormatFilesystem(key=0)),
    ]


def _others() -> Sequence[Transaction]:
    return [
        Transaction(name="unhandled command", command=m.SystemGetDebugData(item=0)),
        Transaction(name="baud rate of no module", command=m.SetBaudRate(baudrate=300)),
        Transaction(name="debug level", command=m.DebugLevel(level=0)),
        Transaction(name="ping at the end", command=m.Ping()),
    ]


TRANSACTIONS: Sequence[Transaction] = (
    *_pings(),
    *_identity(),
    *_modes(),
    *_profile(),
    *_x4(),
    *_files(),
    *_others(),
)
"""In the order in which they are asked; later answers depend on earlier questions."""
