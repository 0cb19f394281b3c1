"""Functions that numba compiles when they are first called."""

import numpy as np
from numpy.typing import NDArray

from slam.front_end.numba_compilation import compile_kernels, kernel


@kernel("f8(f8[::1], i8)")
def _power(values: NDArray[np.float64], exponent: int) -> float:
    total = 0.0
    for value in values:
        total += value**exponent
    return total


@kernel("f8(f8[::1])")
def squares_and_cubes(values: NDArray[np.float64]) -> float:
    """Call another one, with numbers that are constants."""
    return _power(values, 2) + _power(values, 3)


def test_a_kernel_calls_another_and_is_compiled_once() -> None:
    values = np.array([1.0, 2.0, 3.0])
    assert squares_and_cubes(values) == 14.0 + 36.0
    compile_kernels()
    assert squares_and_cubes(2 * values) == 4 * 14.0 + 8 * 36.0
    assert _power.compiled() is _power.compiled()  # type: ignore[attr-defined]  # of the decorator
    assert len(_power.compiled().signatures) == 1  # type: ignore[attr-defined]  # the same
    assert squares_and_cubes.__doc__ == "Call another one, with numbers that are constants."
