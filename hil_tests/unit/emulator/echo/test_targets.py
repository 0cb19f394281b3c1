"""Bodies, scintillation, floor and ceiling, and the antenna, against their closed forms."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from emulator.echo.paths import BEAM_EXPONENT
from emulator.echo.targets import Scintillation, Targets
from emulator.scene.scene import AntennaSpec, HeightsSpec, ScintillationSpec, TargetSpec
from hil_tests.unit.emulator.rooms import WAVELENGTH_M, WAVENUMBER, heard, radar_at, target, wall

FORWARD = radar_at(0.0, 0.0, 0.0)


# --- bodies


@pytest.mark.parametrize("yaw_deg", [0.0, 5.0, 20.0, 61.0, 90.0])
def test_two_points_interfere_as_a_complex_target_does(yaw_deg: float) -> None:
    apart_m, distance_m = 0.05, 9.0
    ends = [{"x_m": 0.0, "y_m": side * apart_m / 2} for side in (1, -1)]
    body = target(distance_m, 0.0, points=ends, yaw_deg=yaw_deg)
    alone = target(distance_m, 0.0)
    power = (
        abs(heard(FORWARD, targets=(body,)).field()) / abs(heard(FORWARD, targets=(alone,)).field())
    ) ** 2
    # Skolnik: the line through both points is at 90 degrees - yaw to the line of sight
    angle = math.radians(yaw_deg)
    expected = 2 * (1 + math.cos(4 * math.pi * apart_m * math.sin(angle) / WAVELENGTH_M))
    assert power == pytest.approx(expected, abs=0.02)


def test_points_turn_with_their_body_and_have_shares_and_phases() -> None:
    points = [{"x_m": 0.3, "y_m": 0.1, "share": 0.5, "phase_deg": 90.0}, {"x_m": 0.0, "y_m": 0.0}]
    body = target(2.0, 1.0, "rod", points=points, yaw_deg=90.0)
    echo = heard(FORWARD, targets=(body,))
    # turned by 90 degrees, (0.3, 0.1) is (-0.1, 0.3)
    near, far = math.hypot(2.0, 1.0), math.hypot(1.9, 1.3)
    np.testing.assert_allclose(echo.range_m, [near, far], atol=1e-12)
    cosines = np.array([2.0 / near, 1.9 / far])
    shares = np.array([1.0, 0.5])
    expected = 0.01 * shares * np.array([near, far]) ** -1.5 * cosines**BEAM_EXPONENT
    np.testing.assert_allclose(echo.amplitude, expected, rtol=1e-12)
    assert echo.phase_rad[1] - echo.phase_rad[0] == pytest.approx(math.pi / 2)


@pytest.mark.parametrize(
    "refused", [{"kind": "cylinder", "radius_m": 0.1}, {"kind": "rod", "wander": {"range_m": 0.01}}]
)
def test_cylinders_and_wandering_targets_have_no_points(refused: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match="points: "):
        TargetSpec.model_validate(
            {"name": "body", "x_m": 1.0, "y_m": 0.0, "points": [{"x_m": 0.0, "y_m": 0.0}]} | refused
        )


# --- scintillation


def factors(t_s: NDArray[np.float64], **spec: Any) -> NDArray[np.float64]:  # noqa: ANN401 - fields of the spec
    fade = Scintillation(ScintillationSpec.model_validate(spec), seed=3, target=1)
    return fade.factors(np.rint(t_s * 1e9).astype(np.int64))


INDEPENDENT_S: NDArray[np.float64] = np.arange(5000, dtype=np.float64) * 10


def test_the_level_of_a_lognormal_echo_is_gaussian() -> None:
    level_db = 20 * np.log10(factors(INDEPENDENT_S, law="lognormal", sigma_db=4.0))
    assert level_db.mean() == pytest.approx(0.0, abs=0.2)
    assert level_db.std() == pytest.approx(4.0, rel=0.04)
    assert (level_db > 8.0).mean() == pytest.approx(0.02275, abs=0.007)  # two deviations


def test_the_power_of_a_swerling_echo_is_exponential() -> None:
    power = factors(INDEPENDENT_S, law="rayleigh") ** 2
    assert power.mean() == pytest.approx(1.0, abs=0.05)
    for threshold in (0.1, 0.5, 1.0, 2.0, 4.0):
        assert (power > threshold).mean() == pytest.approx(math.exp(-threshold), abs=0.02)


@pytest.mark.parametrize("correlation_s", [0.5, 4.0])
def test_its_memory_is_the_correlation_time(correlation_s: float) -> None:
    starts: NDArray[np.float64] = np.arange(4000, dtype=np.float64) * 10 * correlation_s
    first, second = (
        np.log(factors(starts + lag_s, law="lognormal", correlation_s=correlation_s))
        for lag_s in (0.0, correlation_s)
    )
    assert np.corrcoef(first, second)[0, 1] == pytest.approx(math.exp(-1), abs=0.05)


def test_it_depends_on_scene_time_alone() -> None:
    fading = {"law": "rayleigh", "correlation_s": 0.7}
    specs = (target(1.0, 0.0, scintillation=fading), target(2.0, 0.0, name="steady"))
    t_ns = np.arange(40, dtype=np.int64) * 200_000_000
    (whole,) = Targets(specs, seed=0).scatterers(t_ns)
    parts = Targets(specs, seed=0)
    for block in reversed(np.split(np.arange(40), [1, 4, 20, 33])):
        (part,) = parts.scatterers(t_ns[block])
        assert part.strength.tobytes() == whole.strength[block].tobytes()
    assert (whole.strength[:, 1] == 0.01).all()
    assert len(np.unique(whole.strength[:, 0])) == 40
    other = Targets(specs, seed=1).scatterers(t_ns)[0]
    assert (other.strength[:, 0] != whole.strength[:, 0]).all()


# --- floor and ceiling


def test_a_point_is_received_by_its_images() -> None:
    heights = HeightsSpec(
        antenna_m=0.4, ceiling_m=2.0, floor_reflection=0.5, ceiling_reflection=0.3
    )
    echo = heard(FORWARD, targets=(target(2.0, 0.0),), heights=heights)
    legs = [(2.0, 1.0), (math.hypot(2.0, 0.8), 0.5), (math.hypot(2.0, 3.2), 0.3)]
    expected = {}
    for number, (out_m, out) in enumerate(legs):
        for back_m, back in legs[number:]:
            twice = 1 if out_m == back_m else 2
            elevation = (2.0 / out_m * 2.0 / back_m) ** (BEAM_EXPONENT / 2)
            strength = twice * 0.01 * out * back / (out_m * back_m) * elevation
            expected[(out_m + back_m) / 2] = strength
    np.testing.assert_allclose(echo.range_m, sorted(expected), rtol=1e-12)
    np.testing.assert_allclose(
        echo.amplitude, [expected[range_m] for range_m in sorted(expected)], rtol=1e-12
    )


def test_a_rod_and_the_floor_send_back_what_comes() -> None:
    """The oracle adds up a rod piece by piece; the ends of the sum are faded out."""
    distance_m, antenna_m = 2.0, 0.6
    heights = HeightsSpec(antenna_m=antenna_m, floor_reflection=1.0, ceiling_m=50.0)
    echo = heard(FORWARD, targets=(target(distance_m, 0.0, "rod"),), heights=heights)
    slant_m = math.hypot(distance_m, antenna_m)
    np.testing.assert_allclose(echo.range_m, [distance_m, slant_m], rtol=1e-12)
    assert echo.phase_rad[1] - echo.phase_rad[0] == pytest.approx(math.pi)

    def along_the_rod(z: NDArray[np.float64], mirrored: bool) -> complex:
        out_m = np.hypot(distance_m, z - antenna_m)
        back_m = np.hypot(distance_m, z + antenna_m) if mirrored else out_m
        window = np.exp(-(np.abs(z / 4.0) ** 8))
        waves = window * np.exp(-1j * WAVENUMBER * (out_m + back_m)) / (out_m * back_m)
        return complex(waves.sum() * (z[1] - z[0]))

    z = np.linspace(-8.0, 8.0, 400_001)
    direct = along_the_rod(z, mirrored=False)
    both_orders = 2 * along_the_rod(z[z >= 0], mirrored=True)
    beam = (distance_m / slant_m) ** BEAM_EXPONENT
    assert echo.amplitude[1] / echo.amplitude[0] == pytest.approx(
        beam * abs(both_orders / direct), rel=0.01
    )


def test_a_cylinder_and_the_ceiling() -> None:
    heights = HeightsSpec(antenna_m=0.5, ceiling_m=1.7, ceiling_reflection=0.4)
    echo = heard(FORWARD, targets=(target(2.25, 0.0, "cylinder", radius_m=0.25),), heights=heights)
    slant_m = math.hypot(2.0, 1.2)
    np.testing.assert_allclose(echo.range_m, [2.0, slant_m], rtol=1e-12)
    ratio = 0.4 * (2.0 / slant_m) ** (1 + BEAM_EXPONENT)
    assert echo.amplitude[1] / echo.amplitude[0] == pytest.approx(ratio, rel=1e-12)


def test_a_wall_shades_images_as_it_shades_the_target() -> None:
    heights = HeightsSpec(antenna_m=0.5, floor_reflection=0.5)
    glass = wall((1.0, -50.0), (1.0, 50.0), reflection=0.0, transmission=0.5)
    free = heard(FORWARD, targets=(target(2.0, 0.0, "rod"),), heights=heights)
    shaded = heard(FORWARD, targets=(target(2.0, 0.0, "rod"),), heights=heights, walls=(glass,))
    np.testing.assert_allclose(shaded.range_m, free.range_m)
    np.testing.assert_allclose(shaded.amplitude, 0.25 * free.amplitude, rtol=0.02)


def test_walls_and_a_floor_need_no_target() -> None:
    side = wall((-50.0, 1.0), (50.0, 1.0))
    floor = HeightsSpec(antenna_m=0.5, floor_reflection=0.5)
    bare = heard(FORWARD, walls=(side,))
    floored = heard(FORWARD, walls=(side,), heights=floor)
    np.testing.assert_array_equal(floored.range_m, bare.range_m)
    np.testing.assert_array_equal(floored.amplitude, bare.amplitude)


def test_the_antenna_is_below_the_ceiling() -> None:
    with pytest.raises(ValidationError, match="antenna_m: must be less"):
        HeightsSpec(antenna_m=2.0, ceiling_m=1.0)


# --- antenna


@pytest.mark.parametrize("angle_deg", [-50.0, -20.0, 0.0, 10.0, 70.0])
def test_ranges_grow_with_the_angle_off_boresight(angle_deg: float) -> None:
    radar = radar_at(0.0, 0.0, 0.0, antenna=AntennaSpec(sin2_m=0.01))
    angle = math.radians(angle_deg)
    echo = heard(radar, targets=(target(2 * math.cos(angle), 2 * math.sin(angle)),))
    expected = 2.0 + 0.01 * math.sin(angle) ** 2
    assert echo.range_m == pytest.approx([expected], abs=1e-12)


def test_ways_out_and_back_count_half_each() -> None:
    """The wall at y = 1 shows the target (2, 0) under 45 degrees."""
    plain = radar_at(0.0, 0.0, 0.0)
    bent = radar_at(0.0, 0.0, 0.0, antenna=AntennaSpec(sin2_m=0.02))
    world: dict[str, Any] = {
        "targets": (target(2.0, 0.0),),
        "walls": (wall((-50.0, 1.0), (50.0, 1.0)),),
    }
    before, after = heard(plain, **world), heard(bent, **world)
    ghosts = [2.0, 1 + math.sqrt(2), 2 * math.sqrt(2)]
    for range_m, legs in zip(ghosts, (0, 1, 2), strict=True):
        assert len(before.at(range_m)) == 1
        moved = after.at(range_m + 0.02 * 0.5 * legs / 2)
        np.testing.assert_allclose(moved, before.at(range_m), rtol=1e-12)
