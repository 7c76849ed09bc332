"""A camera in a hand: where it is at every moment of a drawn clip.

The motion is a sum of sines, so that it is also known between two frames, while the shutter is open. Sway lies
below 2 Hz and its power falls with the square of the frequency, as that of a standing body does. Tremor of the
hand lies at 6 to 12 Hz. A pan or a slow walk goes one way during the whole clip.
"""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Float

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.pose import transform

SWAY_HZ = (0.1, 2.0)
TREMOR_HZ = (6.0, 12.0)
_SWAY_WAVES = 10
_TREMOR_WAVES = 6
_ROLL = 0.4
"""Sway about the optical axis beside that about the other two."""
_FORWARD = 0.5
"""Sway along the optical axis beside that across."""
_WIDTH_PX = 320


@dataclass(frozen=True, kw_only=True)
class Handheld:
    """How a hand moves the camera."""

    peak_px: float = 12.0
    """How far the table's middle gets from its first place by sway and pan, in a picture 320 px wide."""
    pan: float = 0.0
    """Share of the motion that goes one way during the whole clip, 0 to 1."""
    turning: float = 0.8
    """Share of the motion that comes from turning the camera, 0 to 1; the rest moves it."""
    zoom: float = 0.0
    """How far the lens zooms in (above 0) or out over the clip, of 1."""
    tremor_rad: float = 0.0008
    """Root mean square of the tremor about each axis; 0.05 degrees."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.peak_px <= 0:
            raise ValueError(f"peak_px must be above 0, got {self.peak_px}")
        for name in ("pan", "turning"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must lie in 0..1, got {getattr(self, name)}")
        if not -0.5 < self.zoom < 0.5:
            raise ValueError(f"zoom must lie in -0.5..0.5, got {self.zoom}")


@dataclass(frozen=True, kw_only=True)
class HandheldCamera:
    """A camera's way through one clip."""

    first: Camera
    seconds: float
    zoom: float
    waves_hz: Float[np.ndarray, "wave"] = field(repr=False)
    amplitude: Float[np.ndarray, "6 wave"] = field(repr=False)
    """Of the rotation about the camera's x, y, z [rad], then of its place along them [m]."""
    phase_rad: Float[np.ndarray, "6 wave"] = field(repr=False)
    drift: Float[np.ndarray, "6"] = field(repr=False)
    """What is added over the whole clip, in the same order."""

    def at(self, second: float) -> Camera:
        """Return the camera at this moment, counted from the first frame."""
        share = second / self.seconds
        moved = self._waves(second) - self._waves(0.0) + share * self.drift
        rotation, _ = cv2.Rodrigues(moved[:3])
        K = self.first.K.copy()
        K[[0, 1], [0, 1]] *= 1 + self.zoom * share
        T = self.first.T_world_cam @ transform(np.asarray(rotation, np.float64), moved[3:])
        return replace(self.first, K=K, T_world_cam=T)

    def _waves(self, second: float) -> Float[np.ndarray, "6"]:
        turn = 2 * np.pi * self.waves_hz * second + self.phase_rad
        return (self.amplitude * np.sin(turn)).sum(1)


def random_handheld(rng: np.random.Generator) -> Handheld:
    """Return a hand's motion of 4 to 40 px; a third of the clips pan or walk as well, a quarter zoom by up to 10 %."""
    return Handheld(
        peak_px=float(np.exp(rng.uniform(np.log(4.0), np.log(40.0)))),
        pan=float(rng.choice([0.0, rng.uniform(0.3, 0.9)], p=[0.65, 0.35])),
        turning=float(rng.uniform(0.5, 0.95)),
        zoom=float(rng.choice([0.0, rng.uniform(-0.1, 0.1)], p=[0.75, 0.25])),
        seed=int(rng.integers(2**31)),
    )


def handheld_camera(first: Camera, hand: Handheld, seconds: float) -> HandheldCamera:
    """Return the way of a camera that begins at `first`.

    Args:
        first: the camera at the first frame.
        hand: how it is moved.
        seconds: from the first frame to the last.
    """
    rng = np.random.default_rng(hand.seed)
    slow = np.exp(
        np.linspace(np.log(SWAY_HZ[0]), np.log(SWAY_HZ[1]), _SWAY_WAVES)
        + rng.uniform(-0.1, 0.1, _SWAY_WAVES)
    )
    axes = np.array([1, 1, _ROLL, 0, 0, 0]) * hand.turning
    axes += np.array([0, 0, 0, 1, 1, _FORWARD]) * (1 - hand.turning) * _distance_m(first)
    # equal steps of the logarithm: amplitudes by the root of the frequency give power by its square
    sway = axes[:, None] * rng.normal(1, 0.3, (6, _SWAY_WAVES)) / np.sqrt(slow)
    drift = axes * rng.normal(0, 1, 6) * np.sqrt((1 / slow).sum())
    way = HandheldCamera(
        first=first, seconds=seconds, zoom=0.0, waves_hz=slow, amplitude=(1 - hand.pan) * sway,
        phase_rad=rng.uniform(0, 2 * np.pi, (6, _SWAY_WAVES)), drift=hand.pan * drift,
    )  # fmt: skip
    for _ in range(5):  # perspective bends the scale a little
        by = hand.peak_px / _peak_px(way)
        way = replace(way, amplitude=way.amplitude * by, drift=way.drift * by)
    tremor = rng.normal(0, 1, (6, _TREMOR_WAVES)) * np.array([1, 1, 1, 0, 0, 0])[:, None]
    tremor *= hand.tremor_rad * np.sqrt(2 / _TREMOR_WAVES)
    return replace(
        way,
        zoom=hand.zoom,
        waves_hz=np.concatenate([slow, rng.uniform(*TREMOR_HZ, _TREMOR_WAVES)]),
        amplitude=np.concatenate([way.amplitude, tremor], axis=1),
        phase_rad=np.concatenate(
            [way.phase_rad, rng.uniform(0, 2 * np.pi, (6, _TREMOR_WAVES))], axis=1
        ),
    )


def table_homography(first: Camera, other: Camera) -> Float[np.ndarray, "3 3"]:
    """Return what takes the table's pixels (z = 0 of the world) of one camera to those of another."""
    to_first, to_other = (
        c.K @ np.linalg.inv(c.T_world_cam)[:3][:, [0, 1, 3]] for c in (first, other)
    )
    H = to_other @ np.linalg.inv(to_first)
    return H / H[2, 2]


def _middle(camera: Camera) -> Float[np.ndarray, "1 2"]:
    return np.array([[camera.width_px / 2, 0.6 * camera.height_px]])


def _distance_m(camera: Camera) -> float:
    """Return how far away the table is in the picture's middle."""
    there = camera.on_plane(_middle(camera))[0]
    return float(np.linalg.norm(there - camera.T_world_cam[:3, 3]))


def _peak_px(way: HandheldCamera) -> float:
    middle = _middle(way.first)
    moves = [
        table_homography(way.first, way.at(second)) for second in np.linspace(0, way.seconds, 100)
    ]
    there = np.stack([cv2.perspectiveTransform(middle[None], H)[0, 0] for H in moves])
    far = float(np.linalg.norm(there - middle, axis=1).max())
    return far * _WIDTH_PX / way.first.width_px
