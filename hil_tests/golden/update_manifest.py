"""Write the hash of every listed file into fixtures/MANIFEST.toml: `python -m` this, then commit.

Files that are not listed, and rows without a file, are left for `test_manifest` to tell of.
"""

import hashlib
import re
from pathlib import Path

from hil_tests.paths import FIXTURES


def with_hashes(manifest: str, folder: Path) -> str:
    def row(found: re.Match[str]) -> str:
        path = folder / found["path"]
        if not path.is_file():
            return found[0]
        return found["before"] + hashlib.sha256(path.read_bytes()).hexdigest() + '"'

    pattern = r'(?P<before>path = "(?P<path>[^"]+)"\n(?:[a-z]+ = .*\n)*?sha256 = ")[0-9a-f]*"'
    return re.sub(pattern, row, manifest)


if __name__ == "__main__":
    listing = FIXTURES / "MANIFEST.toml"
    listing.write_text(with_hashes(listing.read_text(), FIXTURES))
