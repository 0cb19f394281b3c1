"""``pymoduleconnector`` on our driver, for scripts of the vendor's library ModuleConnector.

Importing this package makes ``import pymoduleconnector`` find the same names here, in this process
only; `remove` gives the name back. ``xethru legacy SCRIPT.py`` does both around a script, which
needs no change then. ``docs/legacy.md`` says what differs.
"""

import importlib.util
import sys
from types import ModuleType
from typing import Any

from xethru_protocol.legacy import data, module_connector, registers
from xethru_protocol.legacy.connection import close_all
from xethru_protocol.legacy.data import AllDataTypes, DataType
from xethru_protocol.legacy.module_connector import (
    Bootloader,
    ModuleConnector,
    auto,
    auto_open,
    create_auto,
    create_mc,
)
from xethru_protocol.legacy.recordings import (
    DataPlayer,
    DataReader,
    DataRecord,
    DataRecorder,
    PreferredSplitSize,
    RecordingOptions,
)

__all__ = [
    "AllDataTypes",
    "Bootloader",
    "DataPlayer",
    "DataReader",
    "DataRecord",
    "DataRecorder",
    "DataType",
    "ModuleConnector",
    "PreferredSplitSize",
    "RecordingOptions",
    "auto",
    "auto_open",
    "close_all",
    "create_auto",
    "create_mc",
    "install",
    "remove",
]

_NAME = "pymoduleconnector"
_VERSION = "1.6.3"  # the release of ModuleConnector whose names these are


def _modules() -> dict[str, dict[str, Any]]:
    """Return what each module of the vendor's package holds, by its name behind the package's."""
    own = {name: globals()[name] for name in __all__ if name not in {"install", "remove"}}
    for name in ("auto", "auto_open", "create_auto", "close_all"):
        del own[name]
    numbers = data.numbers()
    wrapper: dict[str, Any] = {
        **numbers,
        **data.CLASSES,
        **dict(data.pointer_functions()),
        **{f"{kind}Vector": data.Vector for kind in ("ui", "i", "Double", "Float", "s", "uc", "v")},
        "AllDataTypes": AllDataTypes,
        "InvalidDataType": data.InvalidDataType,
        "DataType": DataType,
        "DataRecord": DataRecord,
        "PreferredSplitSize": PreferredSplitSize,
        "RecordingOptions": RecordingOptions,
        "Bootloader": Bootloader,
        "PythonModuleConnector": ModuleConnector,
        "PyDataRecorder": DataRecorder,
        "PyDataReader": DataReader,
        "PyDataPlayer": DataPlayer,
        "PyXEP": module_connector.XEP,
        "PyX4M200": module_connector.X4M200Interface,
        "PyX4M210": module_connector.X4M210Interface,
        "PyX4M300": module_connector.X4M300Interface,
    }
    ids = {name: value for name, value in numbers.items() if name.startswith("XT")}
    return {
        "": own,
        ".moduleconnector": {
            name: own[name]
            for name in (
                *("Bootloader", "DataPlayer", "DataReader", "DataRecorder"),
                *("ModuleConnector", "create_mc"),
            )
        },
        ".moduleconnectorwrapper": wrapper,
        ".ids": ids,
        ".version": {"version": _VERSION},
        ".extras": {},
        ".extras.auto": {"auto": auto, "auto_open": auto_open, "create_auto": create_auto},
        ".extras.x4_regmap_autogen": {"X4": registers.X4, "RegmapError": registers.RegmapError},
        ".extras.regmap": {"RegmapError": registers.RegmapError},
    }


_hidden: dict[str, ModuleType] = {}


def install() -> None:
    """Let ``import pymoduleconnector`` find our names; a package installed under it is hidden."""
    if _is_ours():
        return
    _hidden.update(_taken())
    for name in _hidden:
        del sys.modules[name]
    for suffix, names in _modules().items():
        module = ModuleType(f"{_NAME}{suffix}", "As of ModuleConnector, by xethru_protocol.legacy.")
        vars(module).update(names)
        module.__spec__ = importlib.util.spec_from_loader(module.__name__, None, is_package=True)
        module.__path__ = []
        sys.modules[module.__name__] = module
        parent, _, child = module.__name__.rpartition(".")
        if parent:
            setattr(sys.modules[parent], child, module)


def remove() -> None:
    """Give the name ``pymoduleconnector`` back."""
    if _is_ours():
        for name in _taken():
            del sys.modules[name]
        sys.modules.update(_hidden)
        _hidden.clear()


def _taken() -> dict[str, ModuleType]:
    return {
        name: module
        for name, module in sys.modules.items()
        if name == _NAME or name.startswith(f"{_NAME}.")
    }


def _is_ours() -> bool:
    found = sys.modules.get(_NAME)
    return found is not None and vars(found).get("ModuleConnector") is ModuleConnector


install()
