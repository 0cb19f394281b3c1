"""How the view is laid out: map left, echoes and numbers in the middle, guide and links right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.app.rerun_recording import DEVICE_TIME, screen
from slam.app.rerun_sdk import rrb
from slam.app.session import SessionInfo

_MAP_MARGIN_M = 0.6
_TRAIL_S = 20.0
"""How long trilaterated points stay on the map."""


def blueprint(info: SessionInfo, *, is_followed: bool) -> rrb.Blueprint:
    """Return the layout; `is_followed` lets the cursor keep to the newest data."""
    names = [radar.name for radar in info.radars]
    return rrb.Blueprint(
        rrb.Horizontal(
            _map_view(info),
            rrb.Vertical(_echoes(names), _numbers(), row_shares=[5, 3]),
            rrb.Vertical(_texts(), _links(), row_shares=[5, 3]),
            column_shares=[4, 4, 3],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="collapsed",
            timeline=DEVICE_TIME,
            play_state="following" if is_followed else "paused",
        ),
        auto_views=False,
    )


def _map_view(info: SessionInfo) -> rrb.Spatial2DView:
    known = [line for line in (info.true_landmarks_m, *info.outlines_m) if len(line)]
    bounds = None
    if known:
        corners = screen(np.concatenate(known))
        low, high = corners.min(axis=0) - _MAP_MARGIN_M, corners.max(axis=0) + _MAP_MARGIN_M
        bounds = rrb.VisualBounds2D(
            x_range=[float(low[0]), float(high[0])], y_range=[float(low[1]), float(high[1])]
        )
    return rrb.Spatial2DView(name="Map", origin="/map", visual_bounds=bounds)


def _echoes(names: Sequence[str]) -> rrb.Tabs:
    mapping = rrb.TensorScalarMapping(colormap="viridis")
    bscans = [
        rrb.TensorView(
            name=f"B-scan {name}",
            origin=f"/radar/{name}/bscan",
            view_fit="fill",
            scalar_mapping=mapping,
        )
        for name in names
    ]
    frames = [
        rrb.BarChartView(
            name=f"Frame {name}",
            origin=f"/radar/{name}",
            contents=["$origin/frame", "$origin/detections"],
        )
        for name in names
    ]
    both = [
        rrb.Vertical(bscan, frame, name=name)
        for name, bscan, frame in zip(names, bscans, frames, strict=True)
    ]
    return rrb.Tabs(*both)


def _numbers() -> rrb.Tabs:
    return rrb.Tabs(
        rrb.TimeSeriesView(name="Position error", origin="/error"),
        rrb.TimeSeriesView(name="NIS", origin="/consistency/nis"),
        rrb.TimeSeriesView(name="NEES", origin="/consistency/nees"),
        rrb.TimeSeriesView(name="Landmarks", origin="/landmarks"),
    )


def _texts() -> rrb.Tabs:
    return rrb.Tabs(
        rrb.TextDocumentView(name="What you see", origin="/about"),
        rrb.TextLogView(name="Log", origin="/link/log"),
        rrb.TextDocumentView(name="Radars", origin="/radars"),
    )


def _links() -> rrb.Tabs:
    return rrb.Tabs(
        rrb.StateTimelineView(name="Links", origin="/link/state"),
        rrb.TimeSeriesView(
            name="Lost frames, faults",
            origin="/link",
            contents=["$origin/lost/**", "$origin/faults/**"],
        ),
    )
