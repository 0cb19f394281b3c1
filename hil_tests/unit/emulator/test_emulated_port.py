"""An emulated module in one line of Python, and control of it."""

import math
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from emulator import control, emulated_port
from emulator.cli import _is_same_port
from hil_tests.device.emulator_process import emulator, open_radar
from xethru_protocol.wire.codes import PongCode


def test_a_module_answers_at_the_port_until_the_block_ends() -> None:
    with emulated_port("visitor", "--pace", "asap") as port, open_radar(port) as radar:
        assert radar.ping() is PongCode.XTS_SPRP_READY
        assert radar.info().serial_number == "202305070401"
        assert Path(port).with_name("right").exists()
    assert not Path(port).exists()


@pytest.fixture
def stranger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Go to a folder with a package that is called as ours, and is not to be run."""
    (tmp_path / "emulator").mkdir()
    (tmp_path / "emulator" / "__init__.py").touch()
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("stranger")
def test_an_error_in_the_block_ends_the_emulator() -> None:
    with pytest.raises(ZeroDivisionError), emulated_port() as port:
        _ = 1 / 0
    assert not Path(port).exists()


def test_an_emulator_that_does_not_start_has_said_why(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RuntimeError, match="did not start: exit code 2"), emulated_port("nowhere"):
        pass
    assert "xethru-emulator: nowhere: no such scene" in capfd.readouterr().err


@pytest.fixture(scope="module")
def port() -> Iterator[str]:
    with emulated_port() as place:
        yield place


def test_a_running_emulator_is_controlled_by_its_port(port: str, tmp_path: Path) -> None:
    assert control(port, "fault add stall seconds=2")["ids"] == {"radar_1": 1}
    (fault,) = control(port, "state")["radars"]["radar_1"]["faults"]
    assert (fault["kind"], fault["parameters"]) == ("stall", {"seconds": 2.0})
    with pytest.raises(ValueError, match="rain"):
        control(port, "fault add rain")
    with pytest.raises(ValueError, match="explode"):
        control(port, "explode")
    with pytest.raises(
        FileNotFoundError, match=f"no emulator answers: No such file.*{tmp_path}/port"
    ):
        control(tmp_path / "port", "state")


def test_a_link_is_of_its_port_while_that_is_being_unplugged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The port goes between the looks at the two paths."""
    terminal, place, link = (tmp_path / name for name in ("terminal", "port", "link"))
    terminal.touch()
    place.symlink_to(terminal)
    link.symlink_to(place)
    read = os.readlink

    def and_unplug(path: str) -> str:
        target = read(path)
        if Path(path) == place:
            place.unlink()
        return target

    monkeypatch.setattr(os, "readlink", and_unplug)
    assert _is_same_port(link, place)
    assert not place.is_symlink()
    assert _is_same_port(link, place)


def test_any_path_to_a_port_finds_its_emulator(port: str, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    place = Path(port)
    folder = tmp_path / "folder"
    folder.symlink_to(place.parent)
    link, second = tmp_path / "link", tmp_path / "second"
    link.symlink_to(place)
    second.symlink_to(link)
    roundabout = tmp_path / "elsewhere" / ".." / "link"
    terminal = place.resolve()
    for path in (link, second, folder / place.name, roundabout, terminal):
        assert control(path, "state")["ok"], path
    control(port, "unplug")
    for path in (link, folder / place.name):
        assert control(path, "state")["radars"]["radar_1"]["present"] is False
    control(port, "plug")
    # another folder has no such port, even by the same name
    with pytest.raises(OSError, match="no emulator answers"):
        control(tmp_path / "elsewhere" / place.name, "state")


def test_a_scene_says_what_its_modules_are_and_what_is_true_of_its_people() -> None:
    with emulated_port("two_people", "--pace", "asap") as port:
        for name, product in (("respiration", "X4M200"), ("presence", "X4M300")):
            with open_radar(str(Path(port).with_name(name))) as radar:
                assert radar.info().order_code == product
        near, far = control(port, "people 100")["people"]
    assert near["distance_m"]["presence"] == pytest.approx(math.hypot(1.2, 0.3))
    assert 17 < far["mean_breaths_per_min"] < 19
    with (
        emulated_port("two_people", "--pace", "asap", "--model", "x4m300") as port,
        open_radar(port) as radar,
    ):
        assert radar.info().order_code == "X4M300"


@pytest.mark.rare
@pytest.mark.usefixtures("stranger")
def test_a_package_of_the_same_name_in_the_current_folder_is_not_run() -> None:
    with emulator("serve", "--bare") as served:
        assert Path(served.paths[0]).exists()
