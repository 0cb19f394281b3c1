"""What `xethru` and `xethru-emulator` print, one transcript per command; see `test_uwb_slam`, too.

A transcript holds command lines behind ``$``, what each prints (lines of stderr behind ``!``) and
its exit code in brackets. The commands run in a folder with the files that `folder` makes.
``XETHRU_UPDATE_SNAPSHOTS=1`` writes the transcripts anew: read the difference before you commit it.
"""

import os
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import pytest

from emulator.cli import main as xethru_emulator
from hil_tests.paths import FIXTURES
from hil_tests.unit.emulator.test_playback_control import write_session
from hil_tests.unit.xethru_protocol.pty_module import PtyModule
from slam.app.cli import main as uwb_slam
from xethru_protocol.cli import main as xethru
from xethru_protocol.recordings import WireCapture

HERE = Path(__file__).parent
MOST_LINES = 40
UPDATE = os.environ.get("XETHRU_UPDATE_SNAPSHOTS") == "1"
PROGRAMS: dict[str, Callable[[Sequence[str]], int]] = {
    "xethru": xethru,
    "xethru-emulator": xethru_emulator,
    "uwb-slam": uwb_slam,
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Return a folder with a port, recordings, and files that are neither."""
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "none"))
    monkeypatch.chdir(tmp_path)
    for name in ("iq", "single"):
        (tmp_path / name).symlink_to(FIXTURES / "recordings" / name)
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("no recording")
    # eight bytes at 410000h: a stack, and 410005h as the entry
    image = ":020000040041B9\n:0800000000804420050041 00CE\n:00000001FF\n".replace(" ", "")
    (tmp_path / "image.hex").write_text(image)
    (tmp_path / "packets.txt").write_text("7D 01 AE EA AA EE 7C 7E\n7D 10 6D 7E\n7D 10 6C 7E\n")
    (tmp_path / "wrong.txt").write_text("7D 10 6D 7E\n7D 1\n")
    with WireCapture(tmp_path / "line.xtwire") as capture:
        capture.write("rx", bytes.fromhex("7D 10 6D 7E"), 0)
    write_session(tmp_path / "session.mcap", {"left": 10**9, "right": 10**9}, n_frames=3)
    with PtyModule(link=tmp_path / "port"):
        yield tmp_path


def run(words: Sequence[str], capsys: pytest.CaptureFixture[str]) -> str:
    try:
        code = PROGRAMS[words[0]](words[1:])
    except SystemExit as end:
        code = int(end.code or 0)
    out, err = capsys.readouterr()
    printed = [line.rstrip() for line in out.splitlines()]
    if len(printed) > MOST_LINES:
        printed[MOST_LINES // 2 :] = [f"... and {len(printed) - MOST_LINES // 2} lines"]
    errors = err.splitlines()
    if errors and errors[0].startswith("usage: "):  # which --help shows
        del errors[:-1]
    printed += [f"! {line.rstrip()}" for line in errors]
    return "\n".join([*printed, f"[{code}]"])


def plain(text: str) -> str:
    """Return a text as every version of argparse prints it: but for quotes and line ends."""
    return " ".join(text.replace("'", "").replace("\n!", "\n").split())


def check_transcript(
    path: Path, capsys: pytest.CaptureFixture[str], masks: Mapping[str, str]
) -> list[str]:
    """Compare a transcript with what is printed now, some parts masked; return the latter."""
    expected = path.read_text("utf-8")
    commands = [line[2:] for line in expected.splitlines() if line.startswith("$ ")]
    assert commands, f"{path}: no command"
    assert " _" not in expected, "a name of ours tells a user nothing"
    printed = []
    for command in commands:
        text = run(shlex.split(command), capsys)
        for part, mask in masks.items():
            text = text.replace(part, mask)
        printed.append(f"$ {command}\n{text}\n")
    if UPDATE:
        path.write_text("\n".join(printed), "utf-8")
        return printed
    for command, now, before in zip(
        commands, printed, expected.removeprefix("$ ").split("\n$ "), strict=True
    ):
        assert plain(now) == plain(f"$ {before}"), f"{command}: see XETHRU_UPDATE_SNAPSHOTS above"
    return printed


@pytest.mark.parametrize(
    "path", sorted(HERE.glob("xethru*/*.txt")), ids=lambda path: f"{path.parent.name}-{path.stem}"
)
@pytest.mark.usefixtures("folder")
def test_every_command_prints_its_transcript(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    check_transcript(path, capsys, {})
