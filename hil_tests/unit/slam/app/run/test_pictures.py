"""The 95 % contour against its closed form; colours as those who see two of them see them."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from hil_tests.unit.slam.app.sessions import session_info, snapshot
from slam.app.run.pictures import (
    ESTIMATE,
    LANDMARK,
    LINK_COLOURS,
    NARROW_IN,
    ODOMETRY,
    TRUTH,
    draw_map,
    ellipse_95,
    enlargement,
    label,
    picture,
    rotate_covariances,
    svg_of,
)
from slam.app.run.runner import RunRecord, States
from slam.app.run.summary import Summary
from slam.app.view import rerun_recording as view
from slam.library.evaluation import LandmarkScore


@given(st.floats(0.01, 2), st.floats(0.01, 2), st.floats(-3, 3))
def test_every_point_lies_at_the_chi_square_quantile(a: float, b: float, angle: float) -> None:
    cosine, sine = math.cos(angle), math.sin(angle)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    covariance = rotation @ np.diag([a**2, b**2]) @ rotation.T
    offsets = ellipse_95(np.array([3.0, -1.0]), covariance) - [3.0, -1.0]
    squared = np.sum(offsets * np.linalg.solve(covariance, offsets.T).T, axis=1)
    # chi-square table, 2 degrees of freedom, 95 %
    np.testing.assert_allclose(squared, 5.991464547, rtol=1e-6)


def test_a_tilted_covariance_gives_a_tilted_ellipse() -> None:
    outline = ellipse_95(np.zeros(2), np.array([[1.0, 0.9], [0.9, 1.0]]), n_points=400)
    farthest = outline[np.argmax(np.linalg.norm(outline, axis=1))]
    assert math.atan2(*farthest[::-1]) % math.pi == pytest.approx(math.pi / 4, abs=0.02)


def test_a_singular_covariance_is_a_line() -> None:
    outline = ellipse_95(np.zeros(2), np.diag([1.0, 0.0]))
    np.testing.assert_allclose(outline[:, 1], 0.0, atol=1e-12)


def test_a_quarter_turn_swaps_the_axes() -> None:
    turned = rotate_covariances(math.pi / 2, np.array([np.diag([4.0, 1.0])]))
    np.testing.assert_allclose(turned[0], np.diag([1.0, 4.0]), atol=1e-12)


def test_enlarged_ellipses_have_enlarged_half_axes() -> None:
    outline = ellipse_95(np.array([3.0, -1.0]), np.diag([4e-6, 1e-6]), enlarged=20)
    half_axes = np.ptp(outline, axis=0) / 2
    np.testing.assert_allclose(half_axes, 20 * 2.4477468 * np.array([2e-3, 1e-3]), rtol=1e-6)


@given(st.lists(st.floats(1e-4, 1.0), min_size=1, max_size=20), st.floats(1.0, 100.0))
def test_ellipses_are_as_large_as_the_map_allows(sigmas_m: list[float], size_m: float) -> None:
    half_axes_m = 2.4477468 * np.array(sigmas_m)
    covariances = np.array([np.diag([sigma**2, (sigma / 3) ** 2]) for sigma in sigmas_m])
    times = enlargement(covariances, size_m)
    steps = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000]
    assert times in steps

    def fits(factor: float) -> bool:
        middle, largest = np.median(half_axes_m), half_axes_m.max()
        return bool(factor * middle <= 0.03 * size_m and factor * largest <= 0.1 * size_m)

    assert times == 1 or fits(times * (1 - 1e-6))
    assert times == 1000 or not fits(steps[steps.index(times) + 1] * (1 + 1e-6))


def short_run() -> RunRecord:
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.5, 0.3]])
    covariance = np.diag([4e-6, 1e-6])
    last = replace(
        snapshot(2),
        estimate=poses[-1],
        pose_covariance=np.diag([4e-6, 1e-6, 1e-6]),
        landmark_covariances_m2=np.array([covariance, covariance]),
    )
    states = States(
        t_ns=np.arange(3),
        truth=np.full((3, 3), np.nan),
        odometry=poses,
        estimate=poses,
        pose_covariances=np.zeros((3, 3, 3)),
        nis=np.zeros(3),
        nis_dof=np.zeros(3, dtype=np.int32),
        lost=np.zeros(3, dtype=bool),
    )
    return RunRecord(states=states, last=last, n_frames=6, duration_ns=1, wall_s=1.0)


def test_a_lost_robot_did_not_drive_to_where_it_is_found_and_its_wheels_are_drawn_there() -> None:
    record = short_run()
    estimate = np.array([[7.0, 8.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.5, 0.3]])  # found at the second
    states = replace(record.states, estimate=estimate, lost=np.array([True, False, False]))
    assert states.driven_m == pytest.approx(math.hypot(1.0, 0.5))
    figure = Figure(layout="constrained")
    draw_map(figure, replace(session_info(), map_json="{}"), replace(record, states=states), None)
    (wheels,) = (each for each in figure.axes[0].lines if each.get_label() == "wheel odometry")
    np.testing.assert_allclose(np.asarray(wheels.get_xydata()), record.states.odometry[:, :2])


@pytest.mark.parametrize("width_in", [9.0, NARROW_IN])
def test_the_map_says_how_much_its_ellipses_are_enlarged(width_in: float) -> None:
    record = short_run()
    figure = Figure(figsize=(width_in, 6.0), layout="constrained")
    draw_map(figure, session_info(), record, None)
    axes, *beside = figure.axes  # in a wide one the legend, and the distances over time
    legend = beside[0].get_legend() if beside else figure.legends[0]
    assert bool(beside) is (width_in > NARROW_IN)
    assert legend is not None
    texts = [text.get_text() for text in legend.get_texts()]
    (text,) = (text for text in texts if text.startswith("95 % ellipse"))
    times = float(text.removeprefix("95 % ellipse, enlarged ").removesuffix(" x"))
    assert times > 1
    assert {"start", "last pose", "true landmark", "estimated landmark", "radar SLAM"} < set(texts)
    (ellipses,) = (c for c in axes.collections if isinstance(c, PolyCollection))
    outlines = [path.vertices for path in ellipses.get_paths()]
    assert len(outlines) == 3  # two landmarks and the robot
    for outline in outlines:
        half_axes = np.ptp(np.asarray(outline), axis=0) / 2
        np.testing.assert_allclose(half_axes, times * 2.4477468 * np.array([2e-3, 1e-3]), rtol=1e-4)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x [m]", "y [m]")


@pytest.mark.parametrize(
    ("seed", "simulated", "title"),
    [
        (7, True, "made_up, preset paper, seed 7 (simulated): ATE 1.0 mm, 0.10 of odometry's 10"),
        (None, False, "made_up, preset paper: ATE 1.0 mm, 0.10 of odometry's 10.0 mm"),
    ],
)
def test_the_map_of_a_real_drive_with_truth_has_no_seed(
    seed: int | None, simulated: bool, title: str
) -> None:
    summary = Summary(
        scene="made_up",
        preset="paper",
        seed=seed,
        frames=6,
        duration_s=1.0,
        realtime_factor=1.0,
        ate_rmse_m=0.001,
        ate_icp_rmse_m=0.001,
        odometry_ate_rmse_m=0.01,
        final_error_m=0.001,
        landmarks=LandmarkScore(
            true=2, observable=2, estimated=2, precision=1.0, recall=1.0, duplicates=0, rmse_m=0.0
        ),
        nees_pose=(),
        nis_mean=None,
    )
    figure = Figure(layout="constrained")
    info = replace(session_info(), seed=seed, simulated=simulated)
    draw_map(figure, info, short_run(), summary)
    assert figure.axes[0].get_title(loc="left").startswith(title)


# Machado, Oliveira, Fernandes: A physiologically-based model for simulation of color vision
# deficiency, 2009: linear RGB, severity 1.
_VISION = {
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
_XYZ = [
    [0.4124564, 0.3575761, 0.1804375],
    [0.2126729, 0.7151522, 0.0721750],
    [0.0193339, 0.1191920, 0.9503041],
]
_WHITE = [0.95047, 1.0, 1.08883]


def lab(rgb: Sequence[int], vision: str) -> np.ndarray:
    """Return CIE L*a*b* of an sRGB colour as somebody sees it."""
    srgb = np.array(rgb) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.array(_VISION[vision]) @ linear, 0.0, 1.0)
    x, y, z = np.cbrt(np.array(_XYZ) @ seen / _WHITE)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def numbers(colour: str) -> tuple[int, ...]:
    return tuple(bytes.fromhex(colour.removeprefix("#")))


@pytest.mark.parametrize("vision", list(_VISION))
@pytest.mark.parametrize(
    "colours",
    [
        [numbers(colour) for colour in (TRUTH, ODOMETRY, ESTIMATE, LANDMARK)],
        [numbers(colour) for colour in LINK_COLOURS.values()],
        [view.TRUTH_RGB, view.ODOMETRY_RGB, view.ESTIMATE_RGB, view.LANDMARK_RGB],
        [view.USED_RGB, view.UNUSED_RGB, view.ESTIMATE_RGB],
        [view.FIX_RGB, view.KEPT_RGB, view.REJECTED_RGB],
    ],
    ids=["map", "links", "paths of the view", "arcs of the view", "points of the view"],
)
def test_colours_differ_for_those_who_see_two(colours: list[tuple[int, ...]], vision: str) -> None:
    for one, other in itertools.combinations(colours, 2):
        # 2.3 can just be seen; lines of a pixel need much more
        assert np.linalg.norm(lab(one, vision) - lab(other, vision)) > 15, (one, other)


def test_a_picture_is_the_same_file_each_time(tmp_path: Path) -> None:
    for name in ("one.png", "two.png"):
        with picture(tmp_path / name, width_in=2, height_in=2) as figure:
            figure.subplots().plot([0, 1, 2], [1, 0, 1], color="#1f6fd0")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


def test_the_names_of_equal_axes_lie_inside_of_the_picture() -> None:
    """Equal axes get more tick labels, "-1.0" for "-1", when they have been laid out."""
    drawn: list[Axes] = []

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot(figure.add_gridspec(2, 2, width_ratios=(2.6, 1.0))[:, 0])
        axes.set_aspect("equal", adjustable="datalim")
        axes.plot([-1.1, 3.2], [-1.0, 2.9])
        label(axes, "a map", "x [m]", "y [m]", pad=36)
        drawn.append(axes)

    svg_of(draw, height_in=6.6)
    (axes,) = drawn
    assert axes.yaxis.label.get_window_extent().x0 >= 0.0
