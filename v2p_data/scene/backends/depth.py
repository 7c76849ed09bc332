"""Pictures become metric depth, and depth becomes the table plane: the camera's height and pitch.

A metric Depth Anything comes with transformers; any other model answers as a worker.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from v2p_data.errors import V2PError
from v2p_data.scene.backends.checkpoint import load_checkpoint
from v2p_data.scene.backends.config import DEFAULT_MODELS, DepthConfig
from v2p_data.scene.backends.worker import WorkerRequest, run_worker

_SAMPLES = 20_000
_HYPOTHESES = 400


@dataclass(frozen=True, kw_only=True)
class Depth:
    """How far every pixel is along the camera's axis."""

    depth_m: Float[np.ndarray, "n h w"]
    """Along the optical axis, not along the ray; NaN where the model gives none."""
    fov_rad: Float[np.ndarray, "n"] | None
    """Horizontal field of view per picture, where a worker gives it."""
    metric: bool
    """Whether the unit is the metre; if not, depth is right up to one factor."""


@dataclass(frozen=True, kw_only=True)
class TablePlane:
    """The table as the camera sees it (OpenCV axes: x right, y down, z forward)."""

    normal_cam: Float[np.ndarray, "3"]
    """Unit, up from the table."""
    height_m: float
    """Height of the camera over the table."""
    inlier_share: float
    """Share of the usable pixels that lie on it."""
    pitch_rad: float
    """How far the camera looks down below the horizon."""


def predict_depth(
    images: Sequence[UInt8[np.ndarray, "h w 3"]] | UInt8[np.ndarray, "n h w 3"], cfg: DepthConfig
) -> Depth:
    """Return the depth of every picture; all have one size.

    Raises:
        V2PError: the model cannot be loaded, gives relative depth only, or its worker fails.

    Source: Yang et al. 2024 (Depth Anything V2), arXiv:2406.09414.
    """
    if cfg.backend == "worker":
        return _by_worker(images, cfg)
    checkpoint = load_checkpoint(cfg.backend, cfg.model, cfg.device, cfg.dtype)
    if checkpoint.model.config.depth_estimation_type != "metric":
        raise V2PError(
            f"checkpoint '{checkpoint.name}' gives relative depth, which fixes no size; take a metric one, such as "
            f"'{DEFAULT_MODELS['depth_anything']}'"
        )
    depths: list[np.ndarray] = []
    for start in range(0, len(images), cfg.batch_size):
        batch = list(images[start : start + cfg.batch_size])
        inputs = checkpoint.processor(images=batch, return_tensors="pt").to(
            checkpoint.model.device
        )
        with torch.inference_mode():
            out = checkpoint.model(pixel_values=inputs["pixel_values"].to(checkpoint.model.dtype))
        out.predicted_depth = out.predicted_depth.float()
        sizes = [image.shape[:2] for image in batch]
        done = checkpoint.processor.post_process_depth_estimation(out, target_sizes=sizes)
        depths += [one["predicted_depth"].cpu().numpy() for one in done]
    return _checked(np.stack(depths), None, metric=True)


def table_from_depth(
    depth_m: Float[np.ndarray, "h w"],
    K: Float[np.ndarray, "3 3"],
    not_table: Bool[np.ndarray, "h w"] | None = None,
    *,
    rng: np.random.Generator,
    tolerance: float = 0.015,
    max_roll_rad: float = 0.35,
) -> TablePlane | None:
    """Return the plane that most pixels lie on among those a table can be, or None where there is none.

    A table's normal points up in the picture to within `max_roll_rad`, and the camera is above it. A pixel lies on the
    plane when its depth is off by less than `tolerance` of itself: depth models err in proportion. Three pixels make a
    plane (RANSAC); the best plane is then fitted to all that lie on it. Pixel centres are at integers plus one half.

    Source: Fischler & Bolles 1981.
    """
    w = depth_m.shape[1]
    usable = np.isfinite(depth_m) & (depth_m > 0)
    if not_table is not None:
        usable &= ~not_table
    spots = np.flatnonzero(usable)
    if len(spots) < 3:
        return None
    if len(spots) > _SAMPLES:
        spots = rng.choice(spots, _SAMPLES, replace=False)
    v, u = np.divmod(spots, w)
    rays = np.stack([u + 0.5, v + 0.5, np.ones(len(u))], axis=1) @ np.linalg.inv(K).T
    inverse = 1 / depth_m.ravel()[spots]
    # On the plane n . X = -height with X = depth * ray, the inverse depth is linear in the ray: ray . (n / -height).
    slopes = _hypotheses(rays, inverse, max_roll_rad, rng)
    if not len(slopes):
        return None
    # |depth - plane's depth| / depth = |1 - inverse / plane's inverse|
    predicted = slopes @ rays.T
    near = np.abs(inverse - predicted) < tolerance * np.abs(predicted)
    best = int(near.sum(1).argmax())
    on_plane = near[best]
    slope = slopes[best]
    for _ in range(5):
        weight = 1 / inverse[on_plane]  # relative, not absolute, errors of the depth count
        fitted, *_ = np.linalg.lstsq(
            rays[on_plane] * weight[:, None], inverse[on_plane] * weight, rcond=None
        )
        predicted = rays @ fitted
        again = np.abs(inverse - predicted) < tolerance * np.abs(predicted)
        if again.sum() < on_plane.sum() or not _may_be_table(fitted, max_roll_rad):
            break
        slope, on_plane = fitted, again
    height = 1 / float(np.linalg.norm(slope))
    normal = -slope * height
    return TablePlane(
        normal_cam=normal,
        height_m=height,
        inlier_share=float(on_plane.mean()),
        pitch_rad=float(np.arcsin(np.clip(-normal[2], -1, 1))),
    )


def _hypotheses(
    rays: Float[np.ndarray, "n 3"],
    inverse: Float[np.ndarray, "n"],
    max_roll_rad: float,
    rng: np.random.Generator,
) -> Float[np.ndarray, "k 3"]:
    """Return the planes through three pixels each that a table can be, as inverse depth per ray."""
    triples = rng.integers(0, len(rays), (_HYPOTHESES, 3))
    solvable = np.abs(np.linalg.det(rays[triples])) > 1e-9
    if not solvable.any():
        return np.zeros((0, 3))
    slopes = np.linalg.solve(rays[triples][solvable], inverse[triples][solvable][..., None])
    slopes = slopes[..., 0]
    return slopes[[_may_be_table(slope, max_roll_rad) for slope in slopes]]


def _may_be_table(slope: Float[np.ndarray, "3"], max_roll_rad: float) -> bool:
    """Return whether the plane with this inverse depth per ray lies below the camera and is not a wall."""
    size = float(np.linalg.norm(slope))
    if not np.isfinite(size) or size < 1e-6:
        return False
    x, y, z = -slope / size
    looks_down = np.arcsin(np.clip(-z, -1, 1))
    # Straight from above (to 6 degrees) roll means nothing; a wall faced squarely looks the same.
    level = abs(np.arctan2(-x, -y)) < max_roll_rad or np.hypot(x, y) < 0.1
    return bool(looks_down > 0.05 and level)


def _by_worker(images: Sequence[np.ndarray] | np.ndarray, cfg: DepthConfig) -> Depth:
    request = WorkerRequest(kind="depth", arrays={"images": np.stack(list(images))})
    answer = run_worker(cfg.worker, request, cfg.worker_timeout_s)
    fov = answer.arrays.get("fov_rad")
    return _checked(
        answer.arrays["depth_m"].astype(np.float64),
        None if fov is None else fov.astype(np.float64),
        metric=bool(answer.fields["metric"]),
    )


def _checked(depth: np.ndarray, fov: np.ndarray | None, *, metric: bool) -> Depth:
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan).astype(np.float64)
    if fov is not None and not ((fov > 0) & (fov < np.pi)).all():
        fov = None  # no camera sees half the world in a flat picture
    return Depth(depth_m=depth, fov_rad=fov, metric=metric)
