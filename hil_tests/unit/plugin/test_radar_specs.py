"""Values of --radar, and the errors for all others."""

from pathlib import Path

import pytest

from hil_tests.plugin.radar_specs import RadarArgument, RadarKind, SpecError, parse_specs


def one(text: str) -> RadarArgument:
    (spec,) = parse_specs([text])
    return spec


@pytest.mark.parametrize(
    ("text", "kind", "target", "name"),
    [
        ("emu", RadarKind.EMULATED, "", "emu"),
        ("emu:lab", RadarKind.EMULATED, "lab", "emu-lab"),
        ("emu:rooms/a.toml?fps=17&seed=3", RadarKind.EMULATED, "rooms/a.toml", "emu-a"),
        ("emu:?line=uart", RadarKind.EMULATED, "", "emu-uart"),
        ("emu:?firmware=xep", RadarKind.EMULATED, "", "emu-xep"),
        ("emu:lab?radar=left_front", RadarKind.EMULATED, "lab", "emu-lab-left_front"),
        ("/dev/ttyACM0", RadarKind.PORT, "/dev/ttyACM0", "ttyACM0"),
        ("./ports/radar_1?line=uart", RadarKind.PORT, "ports/radar_1", "radar_1"),
        ("ports/left", RadarKind.PORT, "ports/left", "left"),
        ("ports/usb:1", RadarKind.PORT, "ports/usb:1", "usb:1"),
        ("/dev/serial/by-path/pci-0:1", RadarKind.PORT, "/dev/serial/by-path/pci-0:1", "pci-0:1"),
        ("serial=202611210001", RadarKind.SERIAL_NUMBER, "202611210001", "202611210001"),
        ("tcp://192.0.2.7:3000", RadarKind.NETWORK, "tcp://192.0.2.7:3000", "tcp-192.0.2.7-3000"),
        ("rfc2217://pi:7000", RadarKind.NETWORK, "rfc2217://pi:7000", "rfc2217-pi-7000"),
        ("auto", RadarKind.AUTO, "", "auto"),
        ("mylab:rack3?slot=2", RadarKind.OWN, "mylab:rack3", "mylab-rack3"),
    ],
)
def test_what_a_spec_names(text: str, kind: RadarKind, target: str, name: str) -> None:
    spec = one(text)
    assert (spec.kind, spec.target, spec.name) == (kind, target, name)
    assert spec.emulated == (kind is RadarKind.EMULATED)


def test_a_name_without_a_slash_is_a_port_if_it_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SpecError):
        one("left")
    (tmp_path / "left").touch()
    assert (one("left").kind, one("left").target) == (RadarKind.PORT, "left")


def test_recordings_must_exist(tmp_path: Path) -> None:
    recording = tmp_path / "drive.mcap"
    with pytest.raises(SpecError):
        one(f"replay:{recording}")
    recording.touch()
    assert one(f"replay:{recording}").name == "replay-drive"
    assert one(f"replay:{recording}").emulated


def test_options() -> None:
    spec = one("emu:lab?fps=10&seed=7&has=reflector,stage")
    assert (spec.fps, spec.seed, spec.has) == (10.0, 7, frozenset({"reflector", "stage"}))
    assert (one("emu").fps, one("emu").seed, one("emu").has) == (17.0, 0, frozenset())


def test_radars_that_would_share_a_name_get_numbers() -> None:
    names = [spec.name for spec in parse_specs(["/a/radar", "/b/radar", "/c/radar"])]
    assert names == ["radar", "radar.2", "radar.3"]


def test_what_this_program_starts_itself_is_emulated() -> None:
    assert one("emu:?line=tcp").emulated
    others = ("/dev/ttyACM0", "tcp://h:1", "serial=202611210001")
    assert not any(one(text).emulated for text in others)


@pytest.mark.parametrize(
    "text",
    [
        *("ttyACM0", "", "serial=12", "replay:", "replay:a\0b", f"replay:{'a' * 5000}"),
        *("tcp://host", "tcp://host:99999", "tcp://host:\u00b2", f"tcp://h:{'9' * 5000}"),
        *("emu:lab?colour=red", "emu:lab?seed", "emu:lab?seed=-1", "emu:lab?seed=\u00b2"),
        *(f"emu:?seed={'9' * 5000}", "emu:lab?fps=0", "emu:lab?fps=fast", "emu:?firmware=own"),
        *("emu:?firmware=xep&line=pty", "emu:?line=wifi"),
        *("/dev/ttyACM0?line=pty", "/dev/ttyACM0?seed=3"),
    ],
)
def test_specs_that_name_nothing_are_one_line(text: str) -> None:
    with pytest.raises(SpecError, match="--radar") as refusal:
        one(text)
    assert "\n" not in str(refusal.value)


def test_the_home_of_an_unknown_user_is_a_plain_path() -> None:
    assert one("~nobody-of-this-name/port").target == "~nobody-of-this-name/port"
