"""Every block of README and `docs/` does what it shows, with an emulated module as the reader's.

The blocks of a page are taken in order, in one empty folder. `/dev/ttyACM0` and
`tcp://192.168.0.7:3000` stand for an emulated module, which is also at `ports/radar_1`; `out/demo`
is a short recorded run.

- ``python`` with ``>>>`` is a doctest; with tests, it is run by pytest on ``emu:lab``, one process
  for several blocks; with a file's name as the comment on its first line, it is saved under that
  name; else it is executed. The names of a page's blocks are shared.
- ``console``: each ``$`` line is run by a shell and must end with 0; `xethru` and `uwb-slam` alone
  on a line run in this process, which has loaded what they import. Of a command that runs until
  Ctrl-C the lines that are shown must come, and it goes on until the page ends. What installs, make
  and the suite of an installed package are not run.
- What a console block shows below a command is compared with its stdout, or, if that is empty, with
  its stderr. ``...`` stands for anything. White space counts as one blank. A whole number below 30,
  or of more than 8 digits, must be the same; every other number, which the machine's speed may
  change, must be within a half of it.
- ``toml`` is parsed, and is a rig file if it has radars.
- Behind ``<!-- not run: reason -->`` nothing is run: Python is compiled, and of commands the words
  are parsed, so that each option, extra and target of make exists.
- A block of another language is text: the output of no command, or another program's file.
"""

import contextlib
import doctest
import io
import os
import re
import shlex
import signal
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest

from emulator import cli as emulator_cli
from hil_tests.device.emulator_process import Served, emulator
from hil_tests.paths import REPOSITORY
from hil_tests.patience import seconds
from hil_tests.system.documentation.markdown_blocks import Block, Prompt, blocks_of, prompts_of
from hil_tests.system.recorded_session import record_session
from slam.app import cli as slam_cli
from slam.app.cli import main as slam_main
from slam.app.rig.rig_files import load_rig
from xethru_protocol.cli import arguments as xethru_cli
from xethru_protocol.cli import main as xethru_main

README = REPOSITORY / "README.md"
DOCS = REPOSITORY / "docs"
PAGES = [README, *sorted(DOCS.glob("*.md"))]
DEFAULT = {"README"}  # in the default suite; the others are rare
TEXT = {"text", "bibtex", "mermaid", "yaml", "ini", "lua"}

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not README.exists(), reason="documents are in the source tree"),
]

_UNTIL_CTRL_C = re.compile(
    r"xethru-emulator (serve|play|proxy)\b|xethru (stream|view|vital) (?!.*--count)"
)
_ONLY_PARSED = re.compile(r"(pip|make|sudo)\b|pytest --pyargs")
_NUMBER = r"\d+(?:\.\d+)?"
_HERE = re.compile(r"uwb-slam|xethru (?!legacy)")
_SHELL = set("|&<>$`*?~")


@pytest.fixture(scope="module")
def module(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Serve the module that the pages talk to."""
    folder = tmp_path_factory.mktemp("served")
    serve = ("serve", "--bare", "--serial", "100000000000")
    with emulator(*serve, "--link-dir", folder, "--tcp", "0") as served:
        yield served


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record the run that the pages find in `out/demo`."""
    folder = tmp_path_factory.mktemp("session")
    record_session(folder / "session.mcap", "robust")
    return folder / "session.mcap"


class Reader:
    """Does what a page says, in a folder of its own."""

    def __init__(self, folder: Path, module: Served) -> None:
        self.names: dict[str, Any] = {"__name__": "__main__"}
        self._tests: list[str] = []
        self._folder = folder
        (port,), (tcp_port,) = module.paths, module.tcp_ports
        self._places = {
            "/dev/ttyACM0": port,
            "tcp://192.168.0.7:3000": f"tcp://127.0.0.1:{tcp_port}",
        }
        programs = Path(sys.executable).parent
        self._environment = {
            **os.environ,
            "PATH": f"{programs}:{os.environ['PATH']}",
            "PYTHONPATH": str(REPOSITORY),
            "XDG_RUNTIME_DIR": str(folder),
        }
        self._running = contextlib.ExitStack()

    def close(self) -> None:
        self._running.close()

    def take(self, block: Block) -> None:
        """Run a block, or check what can be checked of one that is not run."""
        if block.language == "python":
            (self._compile if block.not_run else self._run_python)(block)
        elif block.language == "console":
            for prompt in prompts_of(block):
                (check_words if block.not_run else self._run_command)(prompt)
        elif block.language == "toml":
            self._check_toml(block)

    def _compile(self, block: Block) -> Any:  # noqa: ANN401 - a code object
        return compile("\n" * (block.line - 1) + self._here(block.text), str(block.page), "exec")

    def _run_python(self, block: Block) -> None:
        named = re.match(r"# (\w+\.py)\n", block.text)
        if ">>> " in block.text:
            parser, runner = doctest.DocTestParser(), doctest.DocTestRunner()
            test = parser.get_doctest(block.text, self.names, str(block), None, block.line)
            printed: list[str] = []
            runner.run(test, out=printed.append, clear_globs=False)
            assert not runner.failures, "".join(printed)
            self.names.update(test.globs)
        elif named or re.search(r"^(async )?def test_", block.text, re.MULTILINE):
            name = named[1] if named else "test_mine.py"
            if name in self._tests or not name.startswith("test_"):
                self.run_tests()
            (self._folder / name).write_text(self._here(block.text))
            if name.startswith("test_"):
                self._tests.append(name)
        else:
            exec(self._compile(block), self.names)
            plt.close("all")

    def run_tests(self) -> None:
        """Run the tests that were saved since the last time, all by one pytest."""
        names, self._tests = self._tests, []
        if names:
            words = (*(sys.executable, "-m", "pytest", "-q"), *names, "--radar", "emu:lab")
            self._ends(shlex.join(words), "...passed in...")

    def _check_toml(self, block: Block) -> None:
        if "radars" in tomllib.loads(block.text):
            file = self._folder / "rig.toml"
            file.write_text(block.text)
            load_rig(str(file))

    def _run_command(self, prompt: Prompt) -> None:
        check_words(prompt)
        if not _ONLY_PARSED.match(prompt.command):
            self.run_tests()
        if _UNTIL_CTRL_C.match(prompt.command):
            self._begins(prompt)
        elif not _ONLY_PARSED.match(prompt.command):
            self._ends(prompt.command, prompt.shown)

    def _ends(self, command: str, shown: str) -> None:
        if _HERE.match(command) and not set(command) & _SHELL:
            self._ends_here(command, shown)
            return
        with self._started(command, stderr=subprocess.PIPE) as process:
            printed, errors = process.communicate(timeout=seconds(20))
        if process.returncode == 0 and shown.strip():
            check_output(command, self._here(shown), printed or errors)
        assert process.returncode == 0, f"{command}\n{printed}\n{errors}"

    def _ends_here(self, command: str, shown: str) -> None:
        """Run a command in this process, where all that it imports is loaded already."""
        printed, errors = io.StringIO(), io.StringIO()
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("XDG_RUNTIME_DIR", str(self._folder))
            with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(errors):
                program, *words = shlex.split(self._for_shell(command), comments=True)
                code = (slam_main if program == "uwb-slam" else xethru_main)(words)
        if code == 0 and shown.strip():
            check_output(command, self._here(shown), printed.getvalue() or errors.getvalue())
        assert code == 0, f"{command}\n{printed.getvalue()}\n{errors.getvalue()}"

    def _begins(self, prompt: Prompt) -> None:
        process = self._running.enter_context(self._started(prompt.command))
        assert process.stdout is not None
        n_lines = max(1, len(prompt.shown.splitlines()))
        printed = "".join(process.stdout.readline() for _ in range(n_lines))
        assert printed, f"{prompt.command}: ended with {process.wait()}"
        check_output(prompt.command, self._here(prompt.shown) or "...", printed)

    @contextlib.contextmanager
    def _started(
        self, command: str, stderr: int = subprocess.DEVNULL
    ) -> Iterator[subprocess.Popen[str]]:
        process = subprocess.Popen(
            ["bash", "-c", self._for_shell(command)],
            cwd=self._folder,
            env=self._environment,
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
            start_new_session=True,
        )
        assert process.stdout is not None
        try:
            with process.stdout:
                yield process
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)
            process.wait(seconds(10))
            if process.stderr is not None:
                process.stderr.close()

    def _here(self, text: str, quoted: Callable[[str], str] = str) -> str:
        for place, emulated in self._places.items():
            text = text.replace(place, quoted(emulated))
        return text

    def _for_shell(self, command: str) -> str:
        return self._here(command, shlex.quote)  # the temporary folder may have blanks in its path


def check_output(command: str, shown: str, printed: str) -> None:
    """AssertionError unless what was printed is what a page shows; see the docstring above."""
    normal = " ".join(shown.split())
    parts = re.split(rf"(\.\.\.|{_NUMBER})", normal)
    pattern = "".join(
        re.escape(part) if n % 2 == 0 else ".*?" if part == "..." else f"({_NUMBER})"
        for n, part in enumerate(parts)
    )
    found = re.fullmatch(pattern, " ".join(printed.split()))
    assert found, f"{command}\nprinted\n{printed}\nand the page shows\n{shown}"
    wanted = [part for part in parts[1::2] if part != "..."]
    for number, text in zip(found.groups(), wanted, strict=True):
        assert _is_alike(number, text), f"{command}: {number} in place of {text} in\n{printed}"


def _is_alike(number: str, wanted: str) -> bool:
    is_exact = "." not in wanted and (len(wanted) > 8 or int(wanted) < 30)
    return number == wanted if is_exact else abs(float(number) / float(wanted) - 1) <= 0.5


def check_words(prompt: Prompt) -> None:
    """AssertionError if a command of ours, make, pip or pytest does not know its arguments."""
    for name, *words in prompt.programs():
        if name == "xethru":
            _parsed(xethru_cli.parse, words)
        elif name == "xethru-emulator":
            _parsed(emulator_cli._parse, words)
        elif name == "uwb-slam":
            _parsed(slam_cli._parser().parse_args, words)
        elif name == "make":
            targets = [word for word in words if not word.startswith(".") and "=" not in word]
            makefile = (REPOSITORY / "Makefile").read_text()
            assert all(f"\n{target}:" in makefile for target in targets), words
        elif name == "pip":
            extras = re.findall(r"\[([\w,-]+)\]", " ".join(words))
            assert {part for extra in extras for part in extra.split(",")} <= _extras(), words
        elif name == "pytest":
            options = {word.partition("=")[0] for word in words if word.startswith("--")}
            assert sorted(options - _pytest_options()) == []


def _parsed(parse: Any, words: list[str]) -> None:  # noqa: ANN401 - three parsers
    try:
        parse(words)
    except SystemExit as end:
        if end.code:
            raise AssertionError(f"wrong usage: {words}") from end


def _extras() -> set[str]:
    project: Mapping[str, Any] = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    return set(project["project"]["optional-dependencies"])


@cache
def _pytest_options() -> set[str]:
    command = [sys.executable, "-m", "pytest", "--help"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return set(re.findall(r"--[\w-]+", shown))


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=page.stem, marks=() if page.stem in DEFAULT else pytest.mark.rare)
        for page in PAGES
    ],
)
def test_every_block_does_what_it_shows(
    page: Path,
    module: Served,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    blocks = blocks_of(page)
    mpl.use("Agg")
    # A test of this process may have imported it; its import is what a page shows.
    monkeypatch.delitem(sys.modules, "xethru_protocol.legacy", raising=False)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ports").mkdir()
    if "--link-dir ports" not in "".join(block.text for block in blocks if not block.not_run):
        (tmp_path / "ports" / "radar_1").symlink_to(module.paths[0])
    if "out/demo" in "".join(block.text for block in blocks if not block.not_run):
        (tmp_path / "out" / "demo").mkdir(parents=True)
        recorded = request.getfixturevalue("session").read_bytes()
        (tmp_path / "out" / "demo" / "session.mcap").write_bytes(recorded)
    with contextlib.closing(Reader(tmp_path, module)) as reader:
        for block in blocks:
            try:
                reader.take(block)
            except BaseException as error:
                error.add_note(f"in {block}")
                raise
        reader.run_tests()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_fence_is_read_and_names_a_language_that_has_a_rule(page: Path) -> None:
    blocks = blocks_of(page)
    fences = re.findall(r"^ *```", page.read_text("utf-8"), re.MULTILINE)
    assert 2 * len(blocks) == len(fences)
    known = {"python", "console", "toml"} | TEXT
    assert [str(block) for block in blocks if block.language not in known] == []


def test_most_blocks_are_run() -> None:
    """``pytest -rP`` shows which are not, and why."""
    programs = [
        block
        for page in PAGES
        for block in blocks_of(page)
        if block.language in {"python", "console"}
    ]
    left_out = [block for block in programs if block.not_run]
    sys.stdout.writelines(f"{block}: {block.not_run}\n" for block in left_out)
    assert 0 < len(left_out) < len(programs) / 2


@pytest.mark.parametrize(
    ("shown", "printed", "is_alike"),
    [
        ("34 messages in 2.0 s, 0 lost\n", "31 messages in  2.1 s, 0 lost", True),
        ("34 messages in 2.0 s, 0 lost\n", "34 messages in 2.0 s, 1 lost", False),
        ("34 messages in 2.0 s, 0 lost\n", "70 messages in 2.0 s, 0 lost", False),
        ("serial 100000000000\n", "serial 100000000001", False),
        ("one\n...\nthree\n", "one\n2\nthree", True),
        ("one\n...\nthree\n", "one\n2\nfour", False),
    ],
)
def test_output_is_compared_with_what_a_page_shows(
    shown: str, printed: str, is_alike: bool
) -> None:
    with contextlib.nullcontext() if is_alike else pytest.raises(AssertionError):
        check_output("command", shown, printed)
