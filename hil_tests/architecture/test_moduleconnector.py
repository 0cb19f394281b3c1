"""`docs/moduleconnector.md` is true: every name of ours in it exists and can be called so.

And it is complete: with XETHRU_MODULECONNECTOR, the folder `include` of a ModuleConnector, every
method that its headers declare has a row.
"""

import ast
import builtins
import importlib
import inspect
import os
import re
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import pytest

import emulator.cli
import xethru_protocol
from hil_tests.paths import REPOSITORY
from hil_tests.unit.xethru_protocol.scripted import PlainModule, ScriptedTransport
from xethru_protocol import X4M300, cli, recordings
from xethru_protocol.driver import board, files, firmware, link, matching, profiles
from xethru_protocol.recordings import formats
from xethru_protocol.wire import codec, codes, messages

DOCUMENT = REPOSITORY / "docs" / "moduleconnector.md"

pytestmark = pytest.mark.skipif(not DOCUMENT.exists(), reason="docs are in the source tree")

# Header, and the section of the document that has its methods.
HEADERS = {
    "ModuleConnector": "ModuleConnector, auto",
    "X4M300": "X4M300, X4M200, X4M210",
    "X4M200": "X4M300, X4M200, X4M210",
    "X4M210": "X4M300, X4M200, X4M210",
    "XEP": "XEP",
    "Transport": "Transport",
    "Bootloader": "Bootloader",
    "Data": "Data",
    "DataRecorder": "DataRecorder, RecordingOptions, PreferredSplitSize",
    "RecordingOptions": "DataRecorder, RecordingOptions, PreferredSplitSize",
    "PreferredSplitSize": "DataRecorder, RecordingOptions, PreferredSplitSize",
    "DataReader": "DataReader, DataRecord",
    "DataPlayer": "DataPlayer",
}
# Methods that the headers of ModuleConnector 1 declare, by section.
DECLARED = {
    "ModuleConnector, auto": 17,
    "X4M300, X4M200, X4M210": 69,
    "XEP": 80,
    "Transport": 8,
    "Bootloader": 3,
    "Data": 38,
    "DataRecorder, RecordingOptions, PreferredSplitSize": 33,
    "DataReader, DataRecord": 23,
    "DataPlayer": 15,
}
EXAMPLES = "Its examples"
COMMANDS = ("xethru ", "xethru-emulator ")


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A line of a table of the document."""

    section: str
    theirs: tuple[str, ...]
    ours: tuple[str, ...]


def rows() -> Iterator[Row]:
    section = ""
    for line in DOCUMENT.read_text("utf-8").splitlines():
        if line.startswith("## "):
            section = line.removeprefix("## ")
        if line.startswith("| ") and section in {*HEADERS.values(), EXAMPLES}:
            theirs, ours, *_ = (
                tuple(re.findall(r"`([^`]+)`", cell)) for cell in line.strip("|").split(" | ")
            )
            yield Row(section=section, theirs=theirs, ours=ours)


@pytest.fixture(scope="module")
def radar() -> X4M300:
    return X4M300(ScriptedTransport(PlainModule()))


@dataclass(frozen=True, slots=True)
class Instance:
    """Some object of a class."""

    cls: type


NAMES: dict[str, object] = {
    **vars(builtins),
    **vars(codes),
    **vars(messages),
    **{name: getattr(recordings, name) for name in recordings.__all__},
    **{name: getattr(xethru_protocol, name) for name in xethru_protocol.__all__},
    "importlib": importlib,
    "encode": codec.encode,
    "message_name": formats.message_name,
    "samples": None,
    "FileName": files.FileName,
    "FirmwareImage": firmware.FirmwareImage,
    "PinControl": board.PinControl,
    "ProtocolRecord": matching.ProtocolRecord,
    "ZoneLimits": profiles.ZoneLimits,
}
INSTANCES = {"recorder": recordings.Recorder, "reader": recordings.RecordingReader}


class Checker:
    """Follows an expression as far as its types are known, and raises where it cannot be right."""

    def __init__(self, radar: X4M300) -> None:
        self._radar = radar

    def check(self, code: str) -> None:
        (statement,) = ast.parse(code).body
        if isinstance(statement, ast.Assign):
            (target,) = statement.targets
            assert isinstance(target, ast.Attribute)
            part = self._of(target.value)
            assert isinstance(part, Instance)
            assert inspect.isdatadescriptor(inspect.getattr_static(part.cls, target.attr)), code
        else:
            assert isinstance(statement, ast.Expr)
            self._of(statement.value)

    def _of(self, node: ast.expr) -> object:
        match node:
            case ast.Name(id="radar"):
                return self._radar
            case ast.Name(id=name):
                return Instance(INSTANCES[name]) if name in INSTANCES else NAMES[name]
            case ast.Attribute(value=value, attr=name):
                return self._member(self._of(value), name)
            case ast.Call():
                return self._called(node)
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.expr):
                self._of(child)
        return None

    def _member(self, owner: object, name: str) -> object:
        if owner is None:
            return None
        if isinstance(owner, ModuleType) and not hasattr(owner, name):
            return importlib.import_module(f"{owner.__name__}.{name}")
        if isinstance(owner, ModuleType | type):
            return getattr(owner, name)
        found = inspect.getattr_static(owner.cls if isinstance(owner, Instance) else owner, name, 0)
        if isinstance(found, link.Method):
            found = found.__get__(None, X4M300)
        if found == 0:  # set by a method
            cls = owner.cls if isinstance(owner, Instance) else type(owner)
            assert re.search(rf"self\.{name}\b[^\n]*=", inspect.getsource(cls)), name
            return None
        if isinstance(found, property):
            return self._result(found.fget, ())
        return Instance(type(found)) if isinstance(found, link.Part) else _function(found)

    def _called(self, node: ast.Call) -> object:
        function = self._of(node.func)
        arguments = [self._of(argument) for argument in node.args]
        named = {keyword.arg or "": self._of(keyword.value) for keyword in node.keywords}
        if function is None or function is print or function is list:
            return None
        assert callable(function)
        unbound = "self" in getattr(getattr(function, "__code__", None), "co_varnames", ())
        inspect.signature(function).bind(*([None] if unbound else []), *arguments, **named)
        if isinstance(function, type):
            return Instance(function)
        return self._result(function, arguments)

    def _result(self, function: object, arguments: typing.Sequence[object]) -> object:
        result = typing.get_type_hints(function).get("return")
        if isinstance(result, typing.TypeVar):
            return next((Instance(each) for each in arguments if isinstance(each, type)), None)
        return Instance(result) if inspect.isclass(result) else None


def _function(found: object) -> object:
    return found if inspect.isfunction(found) else None


def test_every_name_of_ours_exists(radar: X4M300, capsys: pytest.CaptureFixture[str]) -> None:
    checker = Checker(radar)
    table = list(rows())
    assert len(table) > 150
    for row in table:
        for code in row.ours:
            if code.startswith(COMMANDS):
                _check_command(code, capsys)
            else:
                try:
                    checker.check(code)
                except (AssertionError, AttributeError, ImportError, KeyError, TypeError) as error:
                    pytest.fail(f"{row.theirs} is not {code}: {type(error).__name__} {error}")


def _check_command(code: str, capsys: pytest.CaptureFixture[str]) -> None:
    program, command, *rest = code.split()
    run = {"xethru": cli.main, "xethru-emulator": emulator.cli.main}[program]
    with pytest.raises(SystemExit) as end:
        run([command, "--help"])
    assert end.value.code == 0
    shown = capsys.readouterr().out
    wanted = rest[1:2] if command == "ctl" else [word for word in rest if word.startswith("--")]
    assert [word for word in wanted if not re.search(rf"{word}\b", shown)] == [], code


def test_the_checker_finds_what_is_wrong(radar: X4M300) -> None:
    checker = Checker(radar)
    for code in (
        "radar.x5.iterations",
        "radar.x4.iteration",
        "radar.x4.iteration = 8",
        "radar.pings()",
        "radar.ping(1, 2)",
        "radar.set_mode(mood=1)",
        "radar.info().colour",
        "radar.read_message(PresenceSingle).wealth",
        "SensorMode.XTID_SM_SLEEP",
        "X4M300.open()",
    ):
        with pytest.raises((AssertionError, AttributeError, KeyError, TypeError)):
            checker.check(code)


def test_nothing_is_left_to_request_alone() -> None:
    """A row without counterpart says why; only raw packets are for `request`."""
    for row in rows():
        if row.section not in {"Transport", "ModuleConnector, auto"}:
            assert not all(".request(" in code for code in row.ours) or not row.ours, row.theirs
    without = {name for row in rows() if not row.ours for name in row.theirs}
    assert without == {
        *("get_x2", "get_x2m200", "get_not_supported", "get_fb_data_recorder"),
        *("get_radar_engine", "get_laptop_presence_app"),
    }


def test_no_row_got_lost() -> None:
    for section, count in DECLARED.items():
        names = {name for row in rows() if row.section == section for name in row.theirs}
        assert len(names) >= count, section


def test_every_method_of_the_headers_has_a_row() -> None:
    folder = os.environ.get("XETHRU_MODULECONNECTOR")
    if not folder:
        pytest.skip("XETHRU_MODULECONNECTOR does not name the folder of its headers")
    listed: dict[str, set[str]] = {}
    for row in rows():
        listed.setdefault(row.section, set()).update(row.theirs)
    listed["Data"] |= listed[HEADERS["DataReader"]]  # Data.hpp declares DataRecord
    missing = {
        f"{header}.{name}"
        for header, section in HEADERS.items()
        for name in declared(Path(folder, f"{header}.hpp").read_text("utf-8"), header)
        if name not in listed.get(section, set())
    }
    assert missing == set()


def declared(text: str, header: str) -> set[str]:
    """Return the methods of a header; of Data.hpp, which has plain structs, its types too."""
    text = re.sub(r"/\*.*?\*/|//[^\n]*", "", text, flags=re.DOTALL)
    types = set(re.findall(r"\b(?:class|struct)\s+(\w+)\s*\n?\s*\{", text))
    public = re.sub(r"private:.*?\n\};", "", text, flags=re.DOTALL)
    methods = set(re.findall(r"[\w>&*]\s+[&*]?\s*(\w+)\s*\([^;{]*?\)\s*(?:const)?\s*[;{]", public))
    no_methods = {*types, *types_named(text), "function", "operator", "if", "return"}
    return (methods - no_methods) | (types if header == "Data" else set())


def types_named(text: str) -> set[str]:
    return set(re.findall(r"\b(?:class|struct|typedef)\s+(\w+)", text))
