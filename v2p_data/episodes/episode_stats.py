"""Statistics of an episode, as LeRobot computes them, without looking at every pixel five times.

LeRobot makes a histogram of all pixels' values, which takes most of the time of its `save_episode`. Pictures
of bytes hold 256 values at most, so counting them once gives the same histogram. Mean and deviation are exact here;
LeRobot sums millions of numbers in 32 bits.
"""

from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from v2p_data.sim.masks import PALETTE

Stats = dict[str, np.ndarray]
VALUES = 256
BINS = 5000
"""Of LeRobot's histograms (`RunningQuantileStats`)."""
_GREYS = np.asarray(PALETTE)


def number_stats(columns: dict[str, Any], features: dict[str, Any]) -> dict[str, Stats]:
    """Return LeRobot's statistics of an episode's numbers, by LeRobot's own function."""
    from lerobot.datasets.compute_stats import compute_episode_stats

    return compute_episode_stats(columns, features)


def mask_stats(labels: UInt8[np.ndarray, "time h w"]) -> Stats:
    """Return the statistics of the greys of label images, in [0, 1], `(3, 1, 1)` each but the count."""
    seen = _looked_at(labels)
    counts = np.zeros(VALUES)
    counts[_GREYS] = _counted(seen)[: len(_GREYS)]
    return _picture_stats(np.tile(counts, (3, 1)), len(seen))


def rgb_stats(pictures: UInt8[np.ndarray, "time h w 3"]) -> Stats:
    """Return the statistics of pictures, in [0, 1], `(3, 1, 1)` each but the count."""
    seen = [_looked_at(pictures[..., channel]) for channel in range(3)]
    return _picture_stats(np.stack([_counted(s) for s in seen]), len(seen[0]))


def _looked_at(images: np.ndarray) -> np.ndarray:
    """Return the pixels that LeRobot looks at: of long episodes some frames, of large pictures some rows and columns."""
    from lerobot.datasets.compute_stats import auto_downsample_height_width, sample_indices

    chosen = sample_indices(len(images))
    few = images if len(chosen) == len(images) else images[chosen]
    return auto_downsample_height_width(few)


def _counted(images: np.ndarray) -> Float[np.ndarray, "256"]:
    counts = np.zeros(VALUES)
    for image in images:  # OpenCV counts in 32-bit floats, exact up to 2^24 pixels
        counts += cv2.calcHist([np.ascontiguousarray(image)], [0], None, [VALUES], [0, VALUES])[
            :, 0
        ]
    return counts


def _picture_stats(counts: Float[np.ndarray, "3 256"], num_frames: int) -> Stats:
    from lerobot.datasets.compute_stats import DEFAULT_QUANTILES

    values = np.arange(VALUES, dtype=np.float64)
    total = counts.sum(1)
    mean = counts @ values / total
    low = np.array([np.flatnonzero(c)[0] for c in counts], np.float64)
    high = np.array([np.flatnonzero(c)[-1] for c in counts], np.float64)
    found = {
        "min": low,
        "max": high,
        "mean": mean,
        "std": np.sqrt(np.maximum(counts @ values**2 / total - mean**2, 0)),
    }
    for q in DEFAULT_QUANTILES:
        found[f"q{int(q * 100):02d}"] = np.array(
            [_quantile(c, a, b, q) for c, a, b in zip(counts, low, high, strict=True)]
        )
    return {name: (v / 255).reshape(3, 1, 1) for name, v in found.items()} | {
        "count": np.array([num_frames])
    }


def _quantile(counts: np.ndarray, low: float, high: float, q: float) -> float:
    """Return LeRobot's estimate: in bins between the extremes, evenly spread within the one that `q` falls into."""
    edges = np.linspace(low, high, BINS + 1)
    in_bin, _ = np.histogram(np.arange(VALUES, dtype=np.float64), bins=edges, weights=counts)
    up_to = np.cumsum(in_bin)
    k = int(np.searchsorted(up_to, q * counts.sum()))
    if k in (0, BINS):
        return float(edges[k])
    share = (q * counts.sum() - up_to[k - 1]) / in_bin[k] if in_bin[k] else 0.0
    return float(edges[k] + share * (edges[k + 1] - edges[k]))
