"""Pictures of a page as a browser shows it: `python -m hil_tests.browser PAGE.html OUT.png`."""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from hil_tests.patience import seconds

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_LIMIT_S = seconds(60)


def find_browser() -> str | None:
    """Return the first of Chromium and its kin that is installed."""
    return next((found for name in _NAMES if (found := shutil.which(name))), None)


def photograph(page: Path, out: Path, *, width: int = 1000, height: int = 1640) -> None:
    """Let a browser without network open a page and write what it shows as PNG.

    Raises
    ------
    FileNotFoundError
        No browser is installed.
    RuntimeError
        It made no picture; with its last words.
    """
    size, shot = f"--window-size={width},{height}", f"--screenshot={out.resolve()}"
    last_words = _run(page, "--hide-scrollbars", size, shot).stderr[-500:]
    if not out.is_file():
        raise RuntimeError(f"the browser made no picture: {last_words}")


def contents_of(page: Path) -> str:
    """Return a page after its scripts have run; raises as `photograph`."""
    # time goes as fast as the page allows, so that its frames are loaded
    return _run(page, "--virtual-time-budget=10000", "--dump-dom").stdout


def _run(page: Path, *options: str) -> subprocess.CompletedProcess[str]:
    browser = find_browser()
    if browser is None:
        raise FileNotFoundError(f"none of {', '.join(_NAMES)} is installed")
    with tempfile.TemporaryDirectory() as profile:
        command = [browser, "--headless", "--no-sandbox", "--disable-gpu", *options]
        command += ["--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={profile}"]
        run = subprocess.run(
            [*command, page.resolve().as_uri()],
            capture_output=True,
            text=True,
            timeout=_LIMIT_S,
            check=False,
        )
    if run.returncode:
        raise RuntimeError(f"{browser} ended with {run.returncode}: {run.stderr[-500:]}")
    return run


def squeeze(png: Path) -> None:
    """Cut a picture's colours to a palette: a third of the size, the same to the eye."""
    with Image.open(png) as full:
        few = full.convert("RGB").quantize(
            method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE
        )
    few.save(png, format="png", optimize=True)


if __name__ == "__main__":
    try:
        photograph(Path(sys.argv[1]), Path(sys.argv[2]))
    except (FileNotFoundError, RuntimeError) as error:
        sys.exit(f"{sys.argv[1]}: {error}")
    squeeze(Path(sys.argv[2]))
