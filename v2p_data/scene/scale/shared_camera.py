"""Clips filmed from one stand share a camera: what all their scenes say of it is surer than what one says.

How large things are is the least sure of all that a scene says, since one view does not show scale
and every clip guesses it from other things. How much of the table the picture shows is what hands
and things tell; pitch and focal length are what outlines and the network tell. Each is put
together by itself, and the height follows.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from v2p_data.geometry.camera import Camera
from v2p_data.scene.scale.camera_height import robust_mean, table_width_m

FEWEST = 2
"""Clips, with fewer nothing is put together."""
_SUREST = 0.05
"""No clip says its scale surer than this, whatever its scene claims; an older scene claims nothing."""
_PITCH_SD_RAD, _FOCAL_SD = 0.07, 0.15
"""Standard deviation of one clip's pitch and of the logarithm of its focal length, on drawn clips."""
_COMMON = 0.05
"""Standard deviation of what all clips from one stand get wrong alike: the same picture misleads
the network in the same way."""
_FAR_OFF = 3.0
"""Standard deviations from which on a clip is likely to be from another stand, or misunderstood."""
_OTHER_SHAPE = 1.02
"""One camera's pictures have one ratio of width to height, up to rounding."""


@dataclass(frozen=True, kw_only=True)
class Filmed:
    """What one clip's scene says of its camera."""

    item: str
    table_width_m: float
    """How much of the table the picture shows from left to right at its middle."""
    width_sd: float
    """Standard deviation of its logarithm."""
    pitch_rad: float
    """How far the camera looks below the horizon."""
    focal_widths: float
    """Focal length over picture width."""
    aspect: float
    """Picture width over height."""


@dataclass(frozen=True, kw_only=True)
class SharedCamera:
    """The camera of several clips."""

    height_m: float
    pitch_rad: float
    fov_rad: float
    """Horizontal field of view."""
    spread: float
    """Standard deviation of the height's logarithm, and of the pitch [rad]."""
    factors: tuple[float, ...]
    """By how much each clip's own lengths are too large, if the camera is this."""
    strangers: tuple[str, ...]
    """Items of clips that seem to be filmed by another camera, or from elsewhere."""


def filmed(item: str, camera: Camera, scale_spread: float) -> Filmed:
    """Return what a clip's scene says of its camera; `scale_spread` is how sure that is of all lengths."""
    pitch = float(np.arcsin(np.clip(-camera.T_world_cam[2, 2], -1, 1)))
    focal = float(camera.K[0, 0]) / camera.width_px
    return Filmed(
        item=item,
        table_width_m=table_width_m(pitch, focal, float(camera.T_world_cam[2, 3])),
        width_sd=max(scale_spread, _SUREST),
        pitch_rad=pitch,
        focal_widths=focal,
        aspect=camera.width_px / camera.height_px,
    )


def shared_camera(clips: Sequence[Filmed]) -> SharedCamera:
    """Return the camera that all these clips have in common; one that is far from the others counts little.

    Raises:
        ValueError: there are fewer than two clips.
    """
    if len(clips) < FEWEST:
        raise ValueError(f"a shared camera takes at least {FEWEST} clips, got {len(clips)}")
    own = np.array([[np.log(c.table_width_m), c.pitch_rad, np.log(c.focal_widths)] for c in clips])
    spreads = np.array([[c.width_sd, _PITCH_SD_RAD, _FOCAL_SD] for c in clips])
    middle, sds = zip(*(_mean(own[:, k], spreads[:, k]) for k in range(3)), strict=True)
    width_m, pitch, focal = float(np.exp(middle[0])), middle[1], float(np.exp(middle[2]))
    aspect = float(np.median([c.aspect for c in clips]))
    off = np.abs(own - middle) / spreads
    strange = [
        clip.item
        for clip, far in zip(clips, off, strict=True)
        if far.max() > _FAR_OFF or max(clip.aspect / aspect, aspect / clip.aspect) > _OTHER_SHAPE
    ]
    return SharedCamera(
        height_m=width_m / table_width_m(pitch, focal, 1.0),
        pitch_rad=pitch,
        fov_rad=float(2 * np.arctan(0.5 / focal)),
        spread=float(np.hypot(_COMMON, sds[0])),
        factors=tuple(np.exp(own[:, 0] - middle[0]).tolist()),
        strangers=tuple(strange),
    )


def _mean(says: Float[np.ndarray, "n"], spread: Float[np.ndarray, "n"]) -> tuple[float, float]:
    everything = np.ones(len(says))
    return robust_mean(says, spread, everything, everything.astype(bool))
