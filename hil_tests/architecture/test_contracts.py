"""The import contracts of pyproject.toml cover every module, and heavy libraries load late."""

import subprocess
import sys
import tomllib

import pytest

from hil_tests.paths import REPOSITORY

HEAVY = ("joblib", "matplotlib", "mcap", "pydantic", "rerun", "rosbags", "scipy", "sklearn")

pytestmark = pytest.mark.skipif(
    not (REPOSITORY / "pyproject.toml").exists(),
    reason="contracts live in the source tree; run from a clone",
)


def contract(contract_id: str) -> dict[str, list[str]]:
    settings = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    contracts = settings["tool"]["importlinter"]["contracts"]
    found: dict[str, list[str]] = next(c for c in contracts if c["id"] == contract_id)
    return found


def test_the_slam_core_contract_names_every_module_of_the_core() -> None:
    modules = {
        f"slam.{path.stem}"
        for path in (REPOSITORY / "slam").iterdir()
        if path.suffix == ".py" or (path / "__init__.py").exists()
    } - {"slam.__init__", "slam.app"}
    assert set(contract("slam-core")["source_modules"]) == modules


# What may touch ports, files, sockets or clocks; everything else is pure.
INPUT_AND_OUTPUT = {
    "xethru_protocol": {
        "async_driver",
        "async_transport",
        "cli",
        "driver",
        "ports",
        "recordings",
        "transport",
    },
    "emulator": {
        "cli",
        "cli_faults",
        "control_socket",
        "device_ports",
        "fault_bench",
        "link",
        "link_folder",
        "odometry_feed",
        "path_lock",
        "playback",
        "plug",
        "port_watch",
        "proxy",
        "run_directory",
        "scene",
        "server",
        "serving",
        "shared_device",
        "state_store",
        "stop",
        "tcp_link",
    },
}


def test_the_sans_io_contract_names_every_pure_module() -> None:
    pure = {
        f"{package}.{path.stem}"
        for package, impure in INPUT_AND_OUTPUT.items()
        for path in (REPOSITORY / package).iterdir()
        if path.suffix == ".py" or (path / "__init__.py").exists()
        if path.stem not in impure | {"__init__"}
    }
    assert set(contract("sans-io")["source_modules"]) == pure


def loaded_heavy_modules(*python_arguments: str) -> set[str]:
    """Run Python and return which heavy packages it loaded."""
    script = "import sys, json\nprint(json.dumps(sorted({m.split('.')[0] for m in sys.modules})))"
    result = subprocess.run(
        [sys.executable, *python_arguments[:-1], python_arguments[-1] + "\n" + script],
        check=True,
        capture_output=True,
        text=True,
    )
    names = result.stdout.strip().splitlines()[-1]
    return {name for name in HEAVY if f'"{name}"' in names}


def test_importing_the_protocol_loads_no_heavy_library() -> None:
    assert loaded_heavy_modules("-c", "import xethru_protocol") == set()


@pytest.mark.parametrize(
    ("module", "command"),
    [
        ("xethru_protocol.cli", ""),
        *(
            ("xethru_protocol.cli", command)
            for command in ("stream", "doctor", "record", "dump", "convert")
        ),
        ("emulator.cli", ""),
        ("emulator.cli", "serve"),
        ("emulator.cli", "play"),
        ("slam.app.cli", ""),
        *(
            ("slam.app.cli", command)
            for command in (
                *("demo", "run", "replay", "view", "report", "evaluate", "repair", "convert"),
                *("calibrate", "sweep", "experiment"),
            )
        ),
    ],
)
def test_help_of_every_command_loads_no_heavy_library(module: str, command: str) -> None:
    arguments = [command, "--help"] if command else ["--help"]
    code = (
        f"from {module} import main\n"
        "try:\n"
        f"    main({arguments!r})\n"
        "except SystemExit as exit:\n"
        "    assert exit.code in (0, None), exit.code"
    )
    assert loaded_heavy_modules("-c", code) == set()
