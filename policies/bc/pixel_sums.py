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
def sum_pixels(labels: np.ndarray, directions: np.ndarray, out: np.ndarray) -> None:
    """Fill `out` with each label's number of pixels, sums of x, y, x^2, y^2, x y, and its reach in each direction.

    Args:
        labels: uint8 `(n, h, w)`.
        directions: int64 `(direction, 2)`.
        out: int64 zeros `(n, label, 6 + direction)`, without the background; labels beyond its size count as none.
    """
    count, height, width = labels.shape
    num_labels, num_directions = out.shape[1], len(directions)
    first = np.zeros(num_labels, np.int64)
    last = np.zeros(num_labels, np.int64)
    for i in range(count):
        for y in range(height):
            first[:] = -1
            for x in range(width):
                k = labels[i, y, x]
                if k == 0 or k > num_labels:
                    continue
                sums = out[i, k - 1]
                sums[0] += 1
                sums[1] += x
                sums[2] += y
                sums[3] += x * x
                sums[4] += y * y
                sums[5] += x * y
                if first[k - 1] < 0:
                    first[k - 1] = x
                last[k - 1] = x
            for k in range(num_labels):
                if first[k] < 0:
                    continue
                # The outline's outermost pixels are the ends of its rows.
                is_first_row = out[i, k, 2] == y * out[i, k, 0]
                for d in range(num_directions):
                    across = directions[d, 0]
                    end = across * (last[k] if across > 0 else first[k]) + directions[d, 1] * y
                    if is_first_row or end > out[i, k, 6 + d]:
                        out[i, k, 6 + d] = end
