"""The only module that imports Rerun; that takes half a second, and names vanish often."""

from __future__ import annotations

import os

import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning
from rerun.experimental import ViewerClient

# Rerun reports a full disk or a closed viewer in lines of its own, from its own threads; we report
# it in one.
os.environ.setdefault("RUST_LOG", "off")


__all__ = ["RerunWarning", "RrdReader", "ViewerClient", "rr", "rrb"]
