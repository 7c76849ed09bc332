"""What is made worse, step by step, until a policy fails in the twin: masks, latency, camera, servo gain, friction."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import UInt8

from v2p_data.deployment.view import allowing_for_place
from v2p_data.seeds import rng_for
from v2p_data.sim.render.masks import BACKGROUND, FIRST_OBJECT, ROBOT
from v2p_data.twin.arm import TwinArm
from v2p_data.twin.parameters import TwinParameters, changed, nominal

Labels = UInt8[np.ndarray, "h w"]
SWAPPED_BLOBS = 2
"""Round parts of a mask that go by the robot's label, in each picture."""


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """One quantity and the values it takes."""

    title: str
    unit: str
    values: tuple[float, ...]
    parameters: Callable[[float], TwinParameters] | None = None
    """The twin with a value; None where the masks are changed instead."""
    fault: Callable[[Labels, float, np.random.Generator], Labels] | None = None
    """Masks with a value."""


def eroded(labels: Labels, px: float, rng: np.random.Generator) -> Labels:
    """Return labels whose objects have lost so many pixels [px at 256] of their border; negative ones spill over."""
    del rng
    out = labels.copy()
    radius = round(abs(px) * labels.shape[0] / 256)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    for label in np.unique(labels[labels >= FIRST_OBJECT]):
        mask = (labels == label).astype(np.uint8)
        if px > 0:
            out[(mask > 0) & (cv2.erode(mask, kernel) == 0)] = BACKGROUND
        else:
            out[(cv2.dilate(mask, kernel) > 0) & (labels == BACKGROUND)] = label
    return out


def dilated(labels: Labels, px: float, rng: np.random.Generator) -> Labels:
    """Return labels whose objects spill over the background by so many pixels [px at 256]."""
    return eroded(labels, -px, rng)


def dropped(labels: Labels, share: float, rng: np.random.Generator) -> Labels:
    """Return labels without objects in a share of the pictures."""
    return np.where((labels >= FIRST_OBJECT) & (rng.uniform() < share), BACKGROUND, labels).astype(
        np.uint8
    )


def swapped(labels: Labels, radius_px: float, rng: np.random.Generator) -> Labels:
    """Return labels with round parts of each object [px at 256] that go by the robot's label; none of radius 0."""
    out = labels.copy()
    if not radius_px:
        return out
    for label in np.unique(labels[labels >= FIRST_OBJECT]):
        rows, columns = np.nonzero(labels == label)
        for k in rng.integers(len(rows), size=SWAPPED_BLOBS):
            blob = np.zeros_like(labels)
            radius = round(radius_px * labels.shape[0] / 256)
            cv2.circle(blob, (int(columns[k]), int(rows[k])), radius, 1, -1)
            out[(blob > 0) & (labels == label)] = ROBOT
    return out


def _scaled(*names: str) -> Callable[[float], TwinParameters]:
    """Return the twin with these errors multiplied."""

    def of(scale: float) -> TwinParameters:
        twin = nominal()
        return replace(
            twin, **{name: tuple(scale * v for v in getattr(twin, name)) for name in names}
        )

    return of


def _single(name: str) -> Callable[[float], TwinParameters]:
    return lambda value: changed({name: value})


def _slippery(scale: float) -> TwinParameters:
    """Return the twin with other friction; of two surfaces in contact the rougher one counts."""
    twin = nominal()
    return changed(
        {
            "pad_friction": scale * twin.pad_friction,
            "object_friction_scale": scale * twin.object_friction_scale,
        }
    )


SWEEPS: dict[str, Sweep] = {
    "erosion": Sweep(title="mask erosion", unit="px", values=(0, 1, 2, 4, 6, 8), fault=eroded),
    "dilation": Sweep(
        title="mask dilation", unit="px", values=(0, 2, 4, 8, 12, 16), fault=dilated
    ),
    "dropout": Sweep(
        title="pictures without object masks",
        unit="share",
        values=(0, 0.2, 0.4, 0.6, 0.8, 1.0),
        fault=dropped,
    ),
    "swap": Sweep(title="swapped blobs", unit="px", values=(0, 2, 4, 8, 12, 16), fault=swapped),
    "latency": Sweep(
        title="command latency",
        unit="s",
        values=(0, 0.05, 0.1, 0.2, 0.3, 0.5),
        parameters=_single("command_latency_s"),
    ),
    "placement": Sweep(
        title="camera placement, known\n(times 11 mm and 19 mrad)",
        unit="times",
        values=(0, 1, 4, 8, 12, 16),
        parameters=_scaled("placement_m", "placement_rad"),
    ),
    "calibration": Sweep(
        title="calibration error\n(times 1.7 mm and 4.1 mrad)",
        unit="times",
        values=(0, 1, 2, 4, 8, 12),
        parameters=_scaled("calibration_m", "calibration_rad"),
    ),
    "gain": Sweep(
        title="gain from tool error to speed",
        unit="1/s",
        values=(16, 8, 4, 2, 1, 0.5),
        parameters=_single("reference_gain_hz"),
    ),
    "friction": Sweep(
        title="friction of pads and objects",
        unit="times",
        values=(1, 0.8, 0.6, 0.4, 0.2, 0.1),
        parameters=_slippery,
    ),
}


@dataclass
class FaultyLook:
    """Gives labels with a fault, and notes how much of the object's mask is left (IoU with the true mask)."""

    sweep: str
    value: float
    seed: int

    def __post_init__(self) -> None:
        self.overlaps: list[float] = []

    def __call__(self, arm: TwinArm) -> Callable[[], Labels]:
        """Return what gives the labels of an arm."""
        clean = allowing_for_place(arm)
        fault = SWEEPS[self.sweep].fault
        rng = rng_for(self.seed, "sim_to_sim", self.sweep, str(self.value))
        assert fault is not None

        def labels() -> Labels:
            true = clean()
            bad = fault(true, self.value, rng)
            both = ((true == FIRST_OBJECT) & (bad == FIRST_OBJECT)).sum()
            either = ((true == FIRST_OBJECT) | (bad == FIRST_OBJECT)).sum()
            self.overlaps.append(float(both / either) if either else 1.0)
            return bad

        return labels
