"""The door to Rerun: whoever imports it pays half a second, so only views do, and late.

Rerun removes names every few weeks; `slam.app.rerun_*` are the only modules that use any.
"""

from __future__ import annotations

import os

import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning
from rerun.experimental import ViewerClient

# Rerun tells of a full disk or a closed viewer in lines of its own, from its own threads; we say it
# in one. It reads this once, while it is imported, which is why nobody imports it elsewhere.
os.environ.setdefault("RUST_LOG", "off")


__all__ = ["RerunWarning", "RrdReader", "ViewerClient", "rr", "rrb"]
