"""Clutter filters against their formulas, scipy and numpy's SVD; stream and batch alike."""

import numpy as np
import pytest
import scipy.signal
from numpy.typing import NDArray

from xethru_protocol.processing.clutter import METHODS, ClutterFilter, Method, remove_clutter

WINDOW = 16


@pytest.fixture
def frames() -> NDArray[np.complex64]:
    rng = np.random.default_rng(5)
    still = 3 * rng.normal(size=(2, 12))
    noise = rng.normal(size=(2, 60, 12))
    return np.asarray(still[0] + 1j * still[1] + noise[0] + 1j * noise[1], dtype=np.complex64)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kind", ["complex64", "float32"])
def test_stream_and_batch_give_the_same_numbers(
    frames: NDArray[np.complex64], method: Method, kind: str
) -> None:
    given = frames if kind == "complex64" else frames.real.astype(np.float32)
    whole = remove_clutter(given, method, window=WINDOW)
    one = ClutterFilter(method, window=WINDOW)
    singly = np.array([one.update(frame) for frame in given])
    parts = ClutterFilter(method, window=WINDOW)
    in_parts = np.concatenate([parts.update(part) for part in np.split(given, [1, 20, 47])])
    assert whole.dtype == singly.dtype == np.dtype(kind)
    np.testing.assert_allclose(singly, whole, atol=1e-6)
    np.testing.assert_allclose(in_parts, whole, atol=1e-6)


def test_mean_is_that_of_the_newest_frames(frames: NDArray[np.complex64]) -> None:
    filtered = remove_clutter(frames, "mean", window=WINDOW)
    for t in (0, 3, 15, 16, 40, 59):
        expected = frames[t] - frames[max(t - WINDOW + 1, 0) : t + 1].mean(axis=0)
        np.testing.assert_allclose(filtered[t], expected, atol=2e-6)


def test_exponential_is_a_first_order_high_pass(frames: NDArray[np.complex64]) -> None:
    alpha = 0.1
    given = frames.astype(np.complex128)
    start = scipy.signal.lfilter_zi([alpha], [1, alpha - 1])[:, np.newaxis] * given[:1]
    mean, _ = scipy.signal.lfilter([alpha], [1, alpha - 1], given, axis=0, zi=start)
    filtered = remove_clutter(frames, "exponential", alpha=alpha)
    np.testing.assert_allclose(filtered, given - mean, atol=2e-6)


@pytest.mark.parametrize("components", [1, 3])
def test_svd_takes_the_greatest_components_away(
    frames: NDArray[np.complex64], components: int
) -> None:
    filtered = remove_clutter(frames, "svd", window=WINDOW, components=components)
    for t in (WINDOW - 1, 20, 59):
        left, values, right = np.linalg.svd(frames[t - WINDOW + 1 : t + 1].astype(np.complex128))
        values[:components] = 0
        expected = (left[:, : len(values)] * values) @ right[: len(values)]
        np.testing.assert_allclose(filtered[t], expected[-1], atol=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_what_stands_still_goes_and_a_moving_echo_stays(method: Method) -> None:
    t = np.arange(400) / 17
    frames = np.tile(5 * np.exp(1j * np.arange(30.0)), (len(t), 1))
    frames[:, 12] += 0.1 * np.exp(2j * np.pi * 1.0 * t)
    filtered = remove_clutter(frames.astype(np.complex64), method)[200:]
    still = np.delete(filtered, 12, axis=1)
    assert np.abs(still).max() < 0.02
    assert np.abs(filtered[:, 12]).mean() == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize("method", ["mean", "svd"])
def test_a_damaged_frame_is_forgotten(frames: NDArray[np.complex64], method: Method) -> None:
    damaged = frames.copy()
    damaged[2] = np.nan
    filtered = remove_clutter(damaged, method, window=WINDOW)
    assert np.isnan(filtered[2]).all()
    np.testing.assert_allclose(
        filtered[-10:], remove_clutter(frames, method, window=WINDOW)[-10:], atol=1e-6
    )


def test_an_average_begins_anew_behind_a_damaged_frame(frames: NDArray[np.complex64]) -> None:
    damaged = frames.copy()
    damaged[2] = np.nan
    filtered = remove_clutter(damaged, "exponential", alpha=0.1)
    assert np.isnan(filtered[2]).all()
    np.testing.assert_allclose(
        filtered[3:], remove_clutter(frames[3:], "exponential", alpha=0.1), atol=1e-6
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
def test_svd_takes_a_damaged_frame_for_zero(frames: NDArray[np.complex64], value: float) -> None:
    damaged, zero = frames.astype(np.complex128), frames.astype(np.complex128)
    damaged[20, 3], zero[20] = value, 0
    filtered = remove_clutter(damaged, "svd", window=WINDOW)
    assert np.isnan(filtered[20]).all()
    rest = np.arange(len(frames)) != 20
    expected = remove_clutter(zero, "svd", window=WINDOW)
    np.testing.assert_allclose(filtered[rest], expected[rest], atol=1e-12)


def test_other_frames_need_a_reset(frames: NDArray[np.complex64]) -> None:
    one = ClutterFilter("mean")
    one.update(frames)
    with pytest.raises(ValueError, match="reset"):
        one.update(frames[:, :5])
    one.reset()
    assert one.update(frames[:, :5]).shape == (60, 5)


@pytest.mark.parametrize(
    "wrong", [{"method": "median"}, {"window": 1}, {"alpha": 0.0}, {"components": 64}]
)
def test_what_makes_no_filter_raises(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ClutterFilter(**wrong)  # type: ignore[arg-type]  # wrong on purpose
