"""Train the box network (`v2p_data/scene/fitting/cuboid_network.py`) on rendered boxes, from nothing, on a CPU.

    python scripts/train_box_network.py data --out DATA --scenes 1500 --jobs 2
    python scripts/train_box_network.py train DATA --out v2p_data/scene/fitting/boxes.safetensors --minutes 30

`data` draws random scenes with boxes in them - boxes, books, bins -, each through some cameras,
and keeps what a camera that looks straight at a box would see of it. `train` shows windows that
are a little off, prints how well the network says which way the boxes are turned in scenes that it
does not train on, and writes the weights every two minutes. Scenes are drawn from seeds of their
own (`box network`), so that no clip of `bench_reconstruction.py` is among them.
"""

import argparse
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8

from drawn_clips.camera import View
from drawn_clips.clips import (
    LABEL_THING,
    MOTION_KINDS,
    VideoSpec,
    motion_of,
    random_spec,
    render_views,
)
from drawn_clips.props import Prop
from training import (
    Scene,
    add_commands,
    batch_of,
    compressed,
    disc_at,
    draw_all,
    drawn_scene,
    learn,
    recoloured,
    resized_view,
    view_towards,
)
from v2p_data.geometry.camera import Camera
from v2p_data.geometry.mesh import outline_points
from v2p_data.geometry.pose import apply, transform
from v2p_data.scene.fitting.cuboid_network import (
    INPUT_PX,
    LOG_SD,
    TAIL,
    WINDOW_SHARE,
    CuboidNetwork,
    aim_at,
    planes_of,
)
from v2p_data.scene.frames.mask_ops import bounding_box, is_cut
from v2p_data.scene.frames.working_clip import WIDTH_PX
from v2p_data.seeds import rng_for

BOXES = ("box", "book", "bin")
ALONG = ("duck", "bottle")
"""Kinds of things: boxes, and those that have a front and sides as a box has, bottles where they are oval."""
CAMERAS = 14
SPECS, SPECS_ALONG = 4, 16
"""Drawn for each scene; the one with most boxes is kept, or with most ducks and oval bottles."""
KEPT_PX, KEPT_SHARE = 112, 2.0
"""What is kept of a picture: so many pixels, for so many longer sides of the outline."""
PITCHES_RAD = (float(np.radians(18)), float(np.radians(64)))
MOST_HEADING_RAD = float(np.radians(50))
"""Cameras of clips look along +x, and many things there stand along it too."""
LEAST_SIDES_PX = (5, 10)
"""Shorter and longer side of what is seen of a box, at working size."""
LEAST_SHOWN, SHARE_OF_BOX = 0.6, 0.7
"""Of its whole outline, and what share of its box's outline that of a duck or a bottle is."""
UPRIGHT = 0.9995
BATCH = 64
MOST_KAPPA = 60.0
LONG = 0.25
"""Logarithm of one side over the other from which on one is the longer."""


@dataclass(frozen=True, kw_only=True)
class Turned(View):
    """A camera that stands elsewhere around a point of the table."""

    heading_rad: float = 0.0
    about_m: tuple[float, float] = (0.0, 0.0)

    def camera(self) -> Camera:
        """Return the camera that this describes."""
        c, s = np.cos(self.heading_rad), np.sin(self.heading_rad)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
        middle = np.array([*self.about_m, 0.0])
        camera = super().camera()
        T = transform(turn, middle - turn @ middle) @ camera.T_world_cam
        return replace(camera, T_world_cam=T)


def make_scene(along: bool, job: tuple[int, Path]) -> str:
    """Draw one scene through some cameras and write what training needs; return an error's words, or nothing.

    With `along`, one with ducks or oval bottles.
    """
    return drawn_scene(job, "box network", partial(_rows_of, along), "no box is seen")


def _rows_of(along: bool, number: int, rng: np.random.Generator) -> list[dict[str, np.ndarray]]:
    kind = MOTION_KINDS[number % len(MOTION_KINDS)]
    specs = [
        random_spec(f"clip{number}", kind, rng, int(rng.integers(2, 6)))
        for _ in range(SPECS_ALONG if along else SPECS)
    ]
    spec = max(specs, key=lambda spec: (along * _count_along(spec), len(_boxes(spec))))
    spec = resized_view(spec, rng)
    return views_of(spec, rng) if _boxes(spec) else []


def _boxes(spec: VideoSpec) -> list[int]:
    return [
        k
        for k, actor in enumerate(spec.story.actors)
        if actor.prop.kind in BOXES or _is_along(actor.prop)
    ]


def _is_along(prop: Prop) -> bool:
    return prop.kind in ALONG and prop.symmetry == "none"


def _count_along(spec: VideoSpec) -> int:
    return sum(_is_along(actor.prop) for actor in spec.story.actors)


def views_of(spec: VideoSpec, rng: np.random.Generator) -> list[dict[str, np.ndarray]]:
    """Return what random cameras see of the boxes that rest."""
    boxes, motion = _boxes(spec), motion_of(spec)
    frames = rng.choice(len(motion.gesture), CAMERAS).tolist()
    views = []
    for i in frames:
        aim = motion.T_world_things[rng.choice(boxes), i, :2, 3] + rng.normal(0, 0.12, 2)
        view = view_towards(spec.view, aim, PITCHES_RAD, rng)
        heading = float(rng.uniform(-MOST_HEADING_RAD, MOST_HEADING_RAD))
        views.append(Turned(**_values(view), heading_rad=heading, about_m=(aim[0], aim[1])))
    pictures, labels = render_views(spec, frames, with_hand=True, views=views)
    rows = []
    for i, view, rgb, own in zip(frames, views, pictures, labels, strict=True):
        rgb = compressed(rgb, rng)
        for k in boxes:
            T, actor = motion.T_world_things[k, i], spec.story.actors[k]
            share = SHARE_OF_BOX if _is_along(actor.prop) else 1.0
            row = _row(view.camera(), T, actor.extents_m, rgb, own == LABEL_THING + k, share)
            if row is not None:
                rows.append(row)
    return rows


def _values(view: View) -> dict[str, float]:
    return {field.name: getattr(view, field.name) for field in fields(view)}


def _row(
    camera: Camera,
    T: Float[np.ndarray, "4 4"],
    extents: Float[np.ndarray, "3"],
    rgb: UInt8[np.ndarray, "h w 3"],
    outline: Bool[np.ndarray, "h w"],
    share: float = 1.0,
) -> dict[str, np.ndarray] | None:
    """Return what a camera that looks straight at a box sees, and how that is turned.

    None where little of it is seen.
    """
    up = int(np.abs(T[2, :3]).argmax())
    if abs(T[2, up]) < UPRIGHT:
        return None
    zoom = WIDTH_PX / camera.width_px
    size = (WIDTH_PX, max(8, round(camera.height_px * zoom)))
    mask = cv2.resize(outline.astype(np.float32), size, interpolation=cv2.INTER_AREA) >= 0.5
    if not mask.any() or is_cut(mask):
        return None
    K = camera.K * np.array([[zoom], [zoom], [1]])
    small = replace(camera, K=K, width_px=size[0], height_px=size[1])
    corners = apply(T, outline_points("box", tuple(extents.tolist())))
    whole = cv2.contourArea(cv2.convexHull(small.project(corners).astype(np.float32)))
    sides_px = bounding_box(mask)[2:]
    too_small = min(sides_px) < LEAST_SIDES_PX[0] or max(sides_px) < LEAST_SIDES_PX[1]
    if too_small or mask.sum() < LEAST_SHOWN * share * whole:
        return None
    rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    aim = aim_at(mask, small, KEPT_PX, KEPT_SHARE)
    kept, edge = (KEPT_PX, KEPT_PX), cv2.BORDER_REPLICATE
    a, b = (k for k in range(3) if k != up)
    ratio = np.log(extents[a] / extents[b])
    height = np.log(extents[up] / np.sqrt(extents[a] * extents[b]))
    yaw = np.arctan2(T[1, a], T[0, a]) - aim.azimuth_rad
    return {
        "rgb": cv2.warpPerspective(rgb, aim.H, kept, flags=cv2.INTER_LINEAR, borderMode=edge),
        "mask": cv2.warpPerspective(mask * np.uint8(255), aim.H, kept, flags=cv2.INTER_LINEAR),
        "known": np.array([aim.below_rad, np.log(aim.extent)], np.float32),
        "truth": np.array([yaw, ratio, height], np.float32),
    }


def varied(
    scene: Scene, k: int, rng: np.random.Generator
) -> tuple[Float32[np.ndarray, "6 80 80"], Float32[np.ndarray, "2"], Float32[np.ndarray, "3"]]:
    """Return a view of a box with its outline badly cut, in a window a little off, and in other colours.

    The last are the yaw [rad] of a side, the logarithms of that side over the other, and of the height over their mean.
    """
    whole = scene["mask"][k] > 127
    outline = _badly_cut(whole, rng)
    x, y, w, h = bounding_box(outline if outline.any() else whole)
    side = max(w, h) * WINDOW_SHARE * np.exp(rng.normal(0, 0.05))
    middle = np.array([x + w / 2, y + h / 2]) + rng.normal(0, 0.02, 2) * side
    c, s = np.cos(roll := rng.normal(0, 0.02)), np.sin(roll)
    turn = side / INPUT_PX * np.array([[c, -s], [s, c]])
    M = np.column_stack([turn, middle - turn @ [INPUT_PX / 2, INPUT_PX / 2]])
    size, flags = (INPUT_PX, INPUT_PX), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    soft = cv2.GaussianBlur(outline.astype(np.float32), (0, 0), float(rng.uniform(0.5, 1.5)))
    rgb = cv2.warpAffine(scene["rgb"][k], M, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    planes = planes_of(recoloured(rgb, rng), cv2.warpAffine(soft, M, size, flags=flags))
    noise = rng.standard_normal(planes[:3].shape, np.float32)
    planes[:3] += np.float32(rng.uniform(0, 0.04)) * noise
    yaw, ratio, height = scene["truth"][k].tolist()
    if rng.random() < 0.5:
        planes[:4], yaw = planes[:4, :, ::-1].copy(), -yaw
    below, extent = scene["known"][k].tolist()
    known = np.array([below + rng.normal(0, 0.07), extent], np.float32)
    return planes, known, np.array([yaw, ratio, height], np.float32)


def _badly_cut(mask: Bool[np.ndarray, "s s"], rng: np.random.Generator) -> Bool[np.ndarray, "s s"]:
    """Return an outline as segmentation may give it: with a bit too much, or too little, thinner or thicker."""
    chance, how = rng.random(), rng.random()
    thick = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    if chance < 0.15:
        mask = mask & ~disc_at(mask, 5, 16, rng)
    elif chance < 0.3:
        mask = mask | disc_at(thick & ~mask, 3, 12, rng)
    elif chance < 0.5:
        mask = _without_a_side(mask, rng)
    elif chance < 0.6:
        mask = _with_a_shadow(mask, rng)
    if how < 0.5:
        kernel = np.ones((3, 3) if rng.random() < 0.67 else (5, 5), np.uint8)
        mask = (cv2.dilate if how < 0.25 else cv2.erode)(mask.astype(np.uint8), kernel) > 0
    return mask


def _without_a_side(
    mask: Bool[np.ndarray, "s s"], rng: np.random.Generator
) -> Bool[np.ndarray, "s s"]:
    """Return an outline without up to two fifths of it at one side: a face in the shade, or what a hand hid."""
    spots = np.argwhere(mask)
    way = rng.normal(size=2)
    along = spots @ (way / np.linalg.norm(way))
    low, high = along.min(), along.max()
    out = mask.copy()
    out[tuple(spots[along < low + rng.uniform(0.05, 0.4) * (high - low)].T)] = False
    return out


def _with_a_shadow(
    mask: Bool[np.ndarray, "s s"], rng: np.random.Generator
) -> Bool[np.ndarray, "s s"]:
    """Return an outline with as much again beside it as a shadow that was taken for a part of it."""
    _, _, w, h = bounding_box(mask)
    dx, dy = rng.uniform(-0.25, 0.25) * w, rng.uniform(0, 0.15) * h
    M = np.array([[1, 0, dx], [0, 1, dy]])
    return mask | (cv2.warpAffine(mask.astype(np.uint8), M, mask.shape[::-1]) > 0)


def loss_of(said: Float[torch.Tensor, "n 7"], truth: Float[torch.Tensor, "n 3"]) -> torch.Tensor:
    """Return the negative logarithm of the likelihood: von Mises for the yaw, Student's t for the ratios."""
    yaw, ratio, height = truth.T
    kappa = said[:, :2].norm(dim=1).clamp(min=1e-4)
    less = (MOST_KAPPA / kappa).clamp(max=1)
    along = said[:, 0] * torch.cos(4 * yaw) + said[:, 1] * torch.sin(4 * yaw)
    kappa = kappa * less
    turn = torch.log(torch.special.i0e(kappa)) + kappa - along * less
    sd, u, v = said[:, 4].clamp(*LOG_SD), ratio * torch.cos(2 * yaw), ratio * torch.sin(2 * yaw)
    off = ((said[:, 2] - u) ** 2 + (said[:, 3] - v) ** 2) * torch.exp(-2 * sd)
    sides = 2 * sd + (TAIL + 2) / 2 * torch.log1p(off / TAIL)
    sd, off = said[:, 6].clamp(*LOG_SD), said[:, 5] - height
    high = sd + (TAIL + 1) / 2 * torch.log1p(off**2 * torch.exp(-2 * sd) / TAIL)
    return (turn + sides + high).mean()


@torch.inference_mode()
def measure(net: CuboidNetwork, held_out: list[Scene]) -> str:
    """Return how far the network is off on views of scenes held out, all changed the same way each time, in words."""
    net.eval()
    rng, said, truth = rng_for(0, "box network", "held out"), [], []
    for scene in held_out:
        planes, known, own = batch_of(
            varied, [(scene, k) for k in range(len(scene["known"]))], rng
        )
        said.append(net(planes, known))
        truth.append(own)
    net.train()
    told, (yaw, ratio, height) = torch.cat(said), torch.cat(truth).T
    off = _degrees(torch.atan2(told[:, 1], told[:, 0]) - 4 * yaw) / 4
    long = ratio.abs() > LONG
    sign = ratio.sign()
    way = _degrees(torch.atan2(told[:, 3] * sign, told[:, 2] * sign) - 2 * yaw)[long] / 2
    sides = torch.hypot(told[:, 2] - ratio * (2 * yaw).cos(), told[:, 3] - ratio * (2 * yaw).sin())
    return (
        f"{len(yaw)} boxes: yaw up to a quarter turn off by {off.median():.1f} deg (median), by more than 15 in "
        f"{(off > 15).float().mean():.1%}; the long side taken for the short in "
        f"{(way > 45).float().mean():.1%} of {len(way)}; "
        f"sides off by {sides.median():.3f}, height by {(told[:, 5] - height).abs().median():.3f} "
        "(median of the logarithm)"
    )


def _degrees(angle: torch.Tensor) -> torch.Tensor:
    return torch.rad2deg(torch.remainder(angle + np.pi, 2 * np.pi) - np.pi).abs()


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    _, data = add_commands(parser, "scene", 500)
    data.add_argument("--along", action="store_true", help="scenes with ducks and oval bottles")
    args = parser.parse_args()
    if args.command == "data":
        numbers = range(args.start, args.start + args.scenes)
        draw_all(partial(make_scene, args.along), numbers, args.out, args.jobs)
    else:
        learn(CuboidNetwork, varied, loss_of, measure, BATCH, "box network", args)


if __name__ == "__main__":
    main()
