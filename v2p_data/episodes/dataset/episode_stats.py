"""Statistics of an episode, as LeRobot computes them, without looking at every pixel five times, and of all rows.

LeRobot averages the quantiles of episodes, and most rows may lie outside of such averages; those
of all rows are taken here.

LeRobot makes a histogram of all pixels' values, which takes most of the time of its `save_episode`. Pictures
of bytes hold 256 values at most, so counting them once gives the same histogram. Mean and deviation are exact here;
LeRobot sums millions of numbers in 32 bits.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float, UInt8

from v2p_data.episodes.dataset.tables import DATA_GLOB
from v2p_data.sim.render.masks import PALETTE

Stats = dict[str, np.ndarray]
VALUES = 256
BINS = 5000
"""Of LeRobot's histograms (`RunningQuantileStats`)."""
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
"""Names and shares of the quantiles that LeRobot keeps."""
NUMBERS = ("float", "int", "uint", "bool")
"""What the names of the types begin with that have statistics."""
_GREYS = np.asarray(PALETTE)


def number_stats(columns: dict[str, Any], features: dict[str, Any]) -> dict[str, Stats]:
    """Return LeRobot's statistics of an episode's numbers, by LeRobot's own function."""
    from lerobot.datasets.compute_stats import compute_episode_stats

    return compute_episode_stats(columns, features)


def rows_stats(root: Path, features: dict[str, Any]) -> Iterator[tuple[str, Stats]]:
    """Yield the exact statistics of every column of numbers, from all rows of a dataset, one column after the other."""
    files = sorted(root.glob(DATA_GLOB))
    for key, feature in features.items():
        if str(feature["dtype"]).startswith(NUMBERS):
            parts = [_values(pq.read_table(path, columns=[key]).column(key)) for path in files]
            found = exact_stats(np.concatenate(parts))
            shape = feature["shape"] if len(feature["shape"]) > 1 else [-1]
            yield key, {n: v if n == "count" else v.reshape(shape) for n, v in found.items()}


def exact_stats(values: Float[np.ndarray, "row entry"]) -> Stats:
    """Return minimum, maximum, mean, deviation, quantiles and count of some rows."""
    found = {name: getattr(values, name)(0) for name in ("min", "max", "mean", "std")}
    quantiles = np.quantile(values, list(QUANTILES.values()), axis=0)
    return (
        found | {"count": np.array([len(values)])} | dict(zip(QUANTILES, quantiles, strict=True))
    )


def _values(column: pa.ChunkedArray) -> Float[np.ndarray, "row entry"]:
    rows, flat = len(column), column.combine_chunks()
    while isinstance(flat, pa.ExtensionArray | pa.FixedSizeListArray | pa.ListArray):
        flat = flat.storage if isinstance(flat, pa.ExtensionArray) else flat.flatten()
    values = np.asarray(flat.to_numpy(zero_copy_only=False), np.float64)
    return values.reshape(rows, -1) if rows else values.reshape(0, 1)


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
    """Return the pixels that LeRobot looks at: some frames of long episodes, some rows and columns."""
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
    for name, q in QUANTILES.items():
        found[name] = np.array(
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
