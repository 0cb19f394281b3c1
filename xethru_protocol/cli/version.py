"""The option ``--version`` of the three programs: they are of one package, so of one version."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from xethru_protocol.operating_system import STDOUT

_PACKAGE = "xethru-hil"


class _Show(argparse.Action):
    """Prints name and version, and ends the program; argparse's own would look it up every time."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[object] | None,
        option_string: str | None = None,
    ) -> None:
        from importlib import metadata

        try:
            version = metadata.version(_PACKAGE)
        except metadata.PackageNotFoundError:  # sources on PYTHONPATH
            parser.exit(
                1, f"{parser.prog}: {_PACKAGE} is not installed, so its version is unknown\n"
            )
        STDOUT.write(f"{_PACKAGE} {version}\n")
        if STDOUT.failure is not None:
            reason = STDOUT.failure.strerror
            parser.exit(1, f"{parser.prog}: cannot write the version: {reason}\n")
        parser.exit()


def add_version(parser: argparse.ArgumentParser) -> None:
    unnamed = argparse.SUPPRESS  # what is parsed has no version
    about = "show the version and exit"
    parser.add_argument("--version", action=_Show, nargs=0, dest=unnamed, help=about)
