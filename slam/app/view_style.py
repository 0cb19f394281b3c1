"""Colours and sizes that the Rerun view and its guide share; no viewer is needed to read them."""

from __future__ import annotations

Rgb = tuple[int, int, int]

TRUTH_RGB: Rgb = (150, 150, 150)
ODOMETRY_RGB: Rgb = (230, 130, 30)
ESTIMATE_RGB: Rgb = (60, 140, 240)
LANDMARK_RGB: Rgb = (230, 60, 110)
WALL_RGB: Rgb = (95, 95, 95)
WEDGE_RGB: Rgb = (70, 80, 95)
USED_RGB: Rgb = (90, 220, 130)
UNUSED_RGB: Rgb = (120, 110, 70)
FIX_RGB: Rgb = (240, 220, 70)
KEPT_RGB: Rgb = (90, 220, 130)
REJECTED_RGB: Rgb = (240, 80, 60)
BAND_RGB: Rgb = (130, 130, 130)
FAULT_RGB: Rgb = (240, 60, 60)

RADAR_RGB: tuple[Rgb, ...] = ((76, 175, 200), (240, 170, 60), (150, 120, 230), (120, 200, 100))
"""One per radar, in the order of the rig; used again from the first beyond the fourth."""

ARROW_M = 0.25
"""Length of the arrow that stands for the robot."""
