"""How the view is laid out: map and numbers left, echoes in the middle, guide and links right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.app.rerun_recording import DEVICE_TIME, part, screen
from slam.app.rerun_sdk import rrb
from slam.app.session import SessionInfo
from slam.app.view_guide import is_world_known

_MAP_MARGIN_M = 0.6


def blueprint(info: SessionInfo) -> rrb.Blueprint:
    """Return the layout; the cursor keeps to the newest data: a file opens with its whole map."""
    names = [radar.name for radar in info.radars]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(_map_view(info), _numbers(info), row_shares=[5, 2]),
            _echoes(names),
            rrb.Vertical(_texts(), _links(), row_shares=[5, 2]),
            column_shares=[4, 3, 3],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=DEVICE_TIME, play_state="following"),
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
            origin=f"/radar/{part(name)}/bscan",
            view_fit="fill",
            scalar_mapping=mapping,
        )
        for name in names
    ]
    frames = [
        rrb.BarChartView(
            name=f"Frame {name}",
            origin=f"/radar/{part(name)}",
            contents=["$origin/frame", "$origin/detections"],
        )
        for name in names
    ]
    both = [
        rrb.Vertical(bscan, frame, name=name)
        for name, bscan, frame in zip(names, bscans, frames, strict=True)
    ]
    return rrb.Tabs(*both)


def _numbers(info: SessionInfo) -> rrb.Tabs:
    """Lay out the curves; in the world without known truth the first two stay empty."""
    origins = {
        "Position error": "/error",
        "NEES": "/consistency/nees",
        "NIS": "/consistency/nis",
        "Landmarks": "/landmarks",
    }
    views = [
        rrb.TimeSeriesView(name=name, origin=origin, axis_x=_whole_run())
        for name, origin in origins.items()
    ]
    return rrb.Tabs(*views, active_tab=0 if is_world_known(info) else len(views) - 1)


def _whole_run() -> rrb.TimeAxis:
    """Return an axis from the first to the newest moment; Rerun's own shows one minute."""
    everything = rrb.TimeRange(
        start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite()
    )
    return rrb.TimeAxis(view_range=everything)


def _texts() -> rrb.Tabs:
    return rrb.Tabs(
        rrb.TextDocumentView(name="What you see", origin="/about"),
        rrb.TextLogView(name="Log", origin="/link/log"),
        rrb.TextDocumentView(name="Radars", origin="/radars"),
    )


def _links() -> rrb.Tabs:
    return rrb.Tabs(
        rrb.StateTimelineView(name="Links", origin="/link/state", time_view=_whole_run()),
        rrb.TimeSeriesView(
            name="Lost frames, faults",
            origin="/link",
            contents=["$origin/lost/**", "$origin/faults/**"],
            axis_x=_whole_run(),
        ),
    )
