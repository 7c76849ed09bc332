"""Masks as a real segmenter gives them: too small, too large, lost for a while, with blobs under a wrong name.

The simulator's masks are perfect and a segmenter's are not. A fault begins at a frame, lasts for some, and
concerns one label; how many there are, of which kind, how long and how large is drawn once per episode and kept
with it, so that the clean masks are known to have been otherwise and the same faults can be made again.
"""

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import UInt8

from v2p_data.episodes.dataset.features import FPS
from v2p_data.sim.render.masks import BACKGROUND

Kind = Literal["erode", "dilate", "drop", "swap"]
REFERENCE_PX = 256
"""Lengths in pixels are meant at this image size and grow with it."""


@dataclass(frozen=True, kw_only=True)
class MaskNoiseConfig:
    """How often each fault begins, per second and label; 0 everywhere leaves masks as they were drawn."""

    erode_per_s: float = 0.0
    """The mask loses its border."""
    dilate_per_s: float = 0.0
    """The mask spills over what is around it."""
    drop_per_s: float = 0.0
    """The mask is lost: its pixels are background."""
    swap_per_s: float = 0.0
    """A round blob of the mask goes by another label that is in the picture, or by background."""
    border_px: tuple[int, int] = (1, 4)
    """Fewest and most pixels lost or spilt, at 256 x 256."""
    blob_radius_px: tuple[int, int] = (4, 20)
    """Of swapped blobs, at 256 x 256."""
    lasts_s: tuple[float, float] = (0.05, 0.5)
    """Shortest and longest time that a fault stays."""

    def __post_init__(self) -> None:
        rates = [getattr(self, f.name) for f in fields(self) if f.name.endswith("_per_s")]
        if min(rates) < 0:
            raise ValueError(f"mask faults per second must be 0 or more, got {min(rates)}")
        for low, high in (self.border_px, self.blob_radius_px, self.lasts_s):
            if not 0 < low <= high:
                raise ValueError(f"need 0 < lowest <= highest, got {low} and {high}")

    @property
    def is_off(self) -> bool:
        return not (self.erode_per_s or self.dilate_per_s or self.drop_per_s or self.swap_per_s)


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One fault of one episode."""

    kind: Kind
    label: int
    first_frame: int
    num_frames: int
    size_px: int = 0
    """Border width or blob radius, in pixels of these masks."""
    becomes: int = BACKGROUND
    """Label that a swapped blob goes by."""
    at: float = 0.0
    """Which of the label's pixels a blob is around: a share of them in reading order."""


def draw_faults(
    labels: UInt8[np.ndarray, "time h w"], cfg: MaskNoiseConfig, rng: np.random.Generator
) -> list[Fault]:
    """Return an episode's faults, in the order they are applied."""
    count, height, _ = labels.shape
    scale = height / REFERENCE_PX
    seen = [int(v) for v in np.unique(labels) if v != BACKGROUND]
    rates: dict[Kind, float] = {
        "erode": cfg.erode_per_s,
        "dilate": cfg.dilate_per_s,
        "swap": cfg.swap_per_s,
        "drop": cfg.drop_per_s,
    }
    faults: list[Fault] = []
    for kind, rate in rates.items():
        sizes = cfg.blob_radius_px if kind == "swap" else cfg.border_px
        for label in seen:
            others = [BACKGROUND, *(v for v in seen if v != label)]
            for _ in range(rng.poisson(rate * count / FPS)):
                size_px = max(1, round(int(rng.integers(*sizes, endpoint=True)) * scale))
                faults.append(
                    Fault(
                        kind=kind,
                        label=label,
                        first_frame=int(rng.integers(count)),
                        num_frames=max(1, round(rng.uniform(*cfg.lasts_s) * FPS)),
                        size_px=0 if kind == "drop" else size_px,
                        becomes=int(rng.choice(others)) if kind == "swap" else BACKGROUND,
                        at=round(float(rng.uniform()), 4) if kind == "swap" else 0.0,
                    )
                )
    return faults


def apply_faults(
    labels: UInt8[np.ndarray, "time h w"], faults: list[Fault]
) -> UInt8[np.ndarray, "time h w"]:
    """Return the masks with these faults; what is given stays as it is."""
    noisy = labels.copy()
    for fault in faults:
        for image in noisy[fault.first_frame : fault.first_frame + fault.num_frames]:
            _apply(image, fault)
    return noisy


def as_json(faults: list[Fault]) -> list[dict[str, Any]]:
    """Return faults for the episode's parameters."""
    return [asdict(f) for f in faults]


def _apply(image: np.ndarray, fault: Fault) -> None:
    mine = (image == fault.label).astype(np.uint8)
    if not mine.any():
        return
    if fault.kind == "drop":
        image[mine > 0] = BACKGROUND
    elif fault.kind == "erode":
        image[(mine > 0) & (cv2.erode(mine, _disc(fault.size_px)) == 0)] = BACKGROUND
    elif fault.kind == "dilate":
        image[cv2.dilate(mine, _disc(fault.size_px)) > 0] = fault.label
    else:
        rows, columns = np.nonzero(mine)
        k = min(int(fault.at * len(rows)), len(rows) - 1)
        blob = np.zeros_like(mine)
        cv2.circle(blob, (int(columns[k]), int(rows[k])), fault.size_px, 1, -1)
        image[(blob & mine) > 0] = fault.becomes


def _disc(radius_px: int) -> np.ndarray:
    side = 2 * radius_px + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
