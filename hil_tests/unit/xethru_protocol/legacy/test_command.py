"""``xethru legacy`` behaves as ``python SCRIPT ARGS`` does."""

import io
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from hil_tests.unit.xethru_protocol.pty_module import PtyModule
from xethru_protocol import legacy
from xethru_protocol.cli import main
from xethru_protocol.transport import open_line

Script = Callable[..., int]


@pytest.fixture
def script(tmp_path: Path) -> Script:
    """Return a function that runs a text as a script, with arguments."""

    def run(text: str, *arguments: str) -> int:
        path = tmp_path / "old.py"
        path.write_text(text)
        try:
            return main(["legacy", str(path), *arguments])
        except SystemExit as end:
            return end.code if isinstance(end.code, int) else 1

    return run


def test_arguments_and_names_are_those_of_python(
    script: Script, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "beside.py").write_text("word = 'found'")
    text = (
        "import sys, beside\n"
        "print(sys.argv, __name__, __file__, beside.word)\n"
        "print(sys.modules['__main__'].__dict__ is globals())"
    )
    before = sys.argv, sys.path[:], sys.modules["__main__"]
    assert script(text, "-d", "port", "--help") == 0
    path = str(tmp_path / "old.py")
    shown = f"{[path, '-d', 'port', '--help']} __main__ {path} found\nTrue\n"
    assert capsys.readouterr().out == shown
    assert (sys.argv, sys.path, sys.modules["__main__"]) == before


def test_exit_code_is_the_scripts(script: Script) -> None:
    assert script("import sys; sys.exit(3)") == 3
    assert script("raise SystemExit('text')") == 1
    assert script("pass") == 0


@pytest.mark.parametrize("name", ["BaseException", "GeneratorExit"])
def test_an_exception_of_any_kind_shows_the_scripts_lines_only(
    script: Script, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    assert script(f"raise {name}('text')") == 1
    shown = capsys.readouterr().err
    assert shown.rstrip().endswith(f"{name}: text")
    assert shown.count("  File ") == 1


def test_a_script_nested_too_deeply_is_one_line(
    script: Script, capsys: pytest.CaptureFixture[str]
) -> None:
    assert script("-" * 200_000 + "1") == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_a_reader_that_has_ended_ends_the_script(
    script: Script, capsys: pytest.CaptureFixture[str]
) -> None:
    assert script("raise BrokenPipeError") == 0
    assert capsys.readouterr().err == ""


def test_a_script_reads_standard_input(
    script: Script, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("/dev/ttyACM0\n"))
    assert script("print(input())") == 0
    assert capsys.readouterr().out == "/dev/ttyACM0\n"


def test_interrupt_ends_with_130_unless_the_script_catches_it(
    script: Script, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "import os, signal\n{}os.kill(os.getpid(), signal.SIGINT)\nwhile True: pass"
    assert script(text.format("")) == 130
    caught = "try:\n import os, signal\n os.kill(os.getpid(), signal.SIGINT)\n while True: pass\n"
    assert script(f"{caught}except KeyboardInterrupt: print('caught')") == 0
    assert capsys.readouterr() == ("caught\n", "")


def test_sigterm_ends_with_143_and_nothing_else(
    script: Script, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "import os, signal\nos.kill(os.getpid(), signal.SIGTERM)\nwhile True: pass"
    assert script(text) == 143
    assert capsys.readouterr() == ("", "")


def test_a_traceback_shows_the_script_alone(
    script: Script, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (
        "from pymoduleconnector import ModuleConnector\n"
        "def start():\n"
        "    return ModuleConnector('/dev/no-such-port')\n"
        "start()\n"
    )
    assert script(text) == 1
    shown = capsys.readouterr().err
    assert [line for line in shown.splitlines() if line.startswith("  File")] == [
        line
        for line in shown.splitlines()
        if line.startswith("  File") and line.endswith(("line 4, in <module>", "line 3, in start"))
    ]
    assert shown.count("  File") == 2
    assert "there is no port /dev/no-such-port; 'xethru list'" in shown.splitlines()[-1]


def test_scripts_catch_errors_of_modules_as_runtime_errors(
    script: Script, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (
        "import pymoduleconnector\n"
        "try: pymoduleconnector.ModuleConnector('/dev/no-such-port')\n"
        "except RuntimeError: print('not there')"
    )
    assert script(text) == 0
    assert capsys.readouterr().out == "not there\n"


@pytest.mark.parametrize(
    ("text", "place"),
    [("import sys\nprint 'text'\n", "line 2"), ("if 1:\n        x = 1\n\ty = 2\n", "line 3")],
)
def test_a_syntax_error_is_named_with_what_converts_python_2(
    text: str, place: str, script: Script, capsys: pytest.CaptureFixture[str]
) -> None:
    assert script(text) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert f"old.py, {place}" in line
    assert "2to3" in line
    assert "futurize" in line


def test_what_is_no_script_gets_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "zero.py").write_bytes(b"\0")
    for name, reason in (("gone.py", "No such file"), ("", "directory"), ("zero.py", "null bytes")):
        assert main(["legacy", str(tmp_path / name)]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert reason in line, line


def test_the_name_is_given_back(script: Script, monkeypatch: pytest.MonkeyPatch) -> None:
    legacy.remove()
    installed, part = ModuleType("pymoduleconnector"), ModuleType("pymoduleconnector.ids")
    monkeypatch.setitem(sys.modules, "pymoduleconnector", installed)
    monkeypatch.setitem(sys.modules, "pymoduleconnector.ids", part)
    assert script("from pymoduleconnector.ids import XTID_SM_RUN; assert XTID_SM_RUN == 1") == 0
    assert sys.modules["pymoduleconnector"] is installed
    assert sys.modules["pymoduleconnector.ids"] is part
    assert not any(name.startswith("pymoduleconnector.extras") for name in sys.modules)


def test_a_port_that_a_script_leaves_open_is_closed(script: Script, module: PtyModule) -> None:
    """The same port can be opened once more, which a port in use cannot."""
    text = (
        "import sys, pymoduleconnector\n"
        "mc = pymoduleconnector.ModuleConnector(sys.argv[1])\n"
        "xep = mc.get_xep()\n"
        "sys.kept = xep\n"
        "print(hex(xep.ping()))"
    )
    assert script(text, module.path) == 0
    open_line(module.path).close()
    del sys.kept  # type: ignore[attr-defined]  # set by the script


def test_threads_of_a_script_are_waited_for(
    script: Script, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (
        "import threading, time\n"
        "def work():\n"
        "    time.sleep(0.1)\n"
        "    import pymoduleconnector\n"
        "    print(pymoduleconnector.AllDataTypes)\n"
        "threading.Thread(target=work).start()\n"
    )
    assert script(text) == 0
    assert capsys.readouterr().out == f"{0xFFFFFFFF}\n"
