"""Sums over the pixels of each label in one pass, compiled: what the moments of a mask are made of."""

# pyright: basic
# numba reads this function as its own language.

from collections.abc import Callable
from typing import Any, no_type_check

import numba
import numpy as np


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    try:
        return numba.njit(cache=True, nogil=True)(function)
    except RuntimeError:  # there is no folder for the machine code
        return numba.njit(nogil=True)(function)


@_compiled
@no_type_check
def sum_pixels(labels: np.ndarray, out: np.ndarray) -> None:
    """Fill `out` with each label's number of pixels, sums of x, y, x^2, y^2, x y, and lowest and highest x and y.

    Args:
        labels: uint8 `(n, h, w)`.
        out: int64 zeros `(n, label, 10)`, without the background; labels beyond its size count as none.
    """
    count, height, width = labels.shape
    num_labels = out.shape[1]
    for i in range(count):
        for y in range(height):
            for x in range(width):
                k = labels[i, y, x]
                if k == 0 or k > num_labels:
                    continue
                sums = out[i, k - 1]
                if sums[0] == 0:
                    sums[6] = x
                    sums[7] = x
                    sums[8] = y
                sums[0] += 1
                sums[1] += x
                sums[2] += y
                sums[3] += x * x
                sums[4] += y * y
                sums[5] += x * y
                sums[6] = min(sums[6], x)
                sums[7] = max(sums[7], x)
                sums[9] = y
