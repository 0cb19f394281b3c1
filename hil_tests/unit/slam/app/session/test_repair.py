"""What `uwb-slam repair` says and refuses; what it keeps is tested in property/."""

import errno
import signal
from pathlib import Path

import pytest

from hil_tests.unit.slam.app.sessions import run, write_session
from slam.app.session.reader import open_session
from slam.app.session.repair import repair
from xethru_protocol.system import StopFlag, StopRequestedError, locked


@pytest.fixture
def cut(tmp_path: Path) -> Path:
    path = write_session(tmp_path / "session.mcap", 30)
    path.write_bytes(path.read_bytes()[:-200_000])
    return path


def test_it_says_what_is_kept_and_where_the_old_file_is(
    cut: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    size = cut.stat().st_size
    code, out, err = run(capsys, "repair", cut)
    assert (code, err) == (0, "")
    n_scans = sum(1 for _ in open_session(cut).scans())
    assert f"{(n_scans - 1) * 0.199261498:.1f} s" in out
    assert f"{cut}.unrepaired" in out
    assert Path(f"{cut}.unrepaired").stat().st_size == size
    assert run(capsys, "repair", cut)[0] == 0


def test_it_never_overwrites_what_it_did_not_write(
    cut: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = cut.read_bytes()
    kept = Path(f"{cut}.unrepaired")
    kept.write_text("precious")
    assert run(capsys, "repair", cut)[:2] == (1, "")
    assert run(capsys, "repair", cut, "--out", kept)[0] == 1
    assert (cut.read_bytes(), kept.read_text()) == (before, "precious")
    assert sorted(tmp_path.iterdir()) == [cut, kept]


def test_a_folder_in_which_a_run_is_recording_is_left_alone(
    cut: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = cut.read_bytes()
    with locked(tmp_path):
        code, out, err = run(capsys, "repair", cut)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert cut.read_bytes() == before


def test_a_signal_leaves_everything_as_it_was(cut: Path, tmp_path: Path) -> None:
    before = cut.read_bytes()

    class StopWhileWriting(StopFlag):
        def check(self) -> None:
            if (tmp_path / f".{cut.name}.repairing").exists():
                raise StopRequestedError(signal.SIGTERM)

    with pytest.raises(StopRequestedError):
        repair(cut, None, StopWhileWriting())
    assert list(tmp_path.iterdir()) == [cut]
    assert cut.read_bytes() == before


@pytest.mark.parametrize("has_second_names", [True, False], ids=["hard links", "none, as on FAT"])
def test_a_file_that_cannot_take_its_place_leaves_everything_as_it_was(
    has_second_names: bool,
    cut: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = cut.read_bytes()
    replace = Path.replace

    def fail(path: Path, target: Path) -> Path:
        if path.suffix == ".repairing":
            raise OSError(errno.EIO, "Input/output error", str(path))
        return replace(path, target)

    def no_names(path: Path, target: Path) -> None:
        raise OSError(errno.EPERM, "Operation not permitted", str(path))

    monkeypatch.setattr(Path, "replace", fail)
    if not has_second_names:
        monkeypatch.setattr(Path, "hardlink_to", no_names)
    code, _, err = run(capsys, "repair", cut)
    assert (code, err.count("\n")) == (1, 1)
    assert f"{cut} is as it was" in err
    assert (list(tmp_path.iterdir()), cut.read_bytes()) == ([cut], before)
    monkeypatch.setattr(Path, "replace", replace)
    assert run(capsys, "repair", cut)[0] == 0
    assert Path(f"{cut}.unrepaired").read_bytes() == before
