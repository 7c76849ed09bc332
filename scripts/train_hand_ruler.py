"""Train the hand ruler (`v2p_data/scene/fitting/hand_scale.py`) on rendered hands, from nothing, on a CPU.

    python scripts/train_hand_ruler.py data --out DATA --scenes 1500 --jobs 2
    python scripts/train_hand_ruler.py train DATA --out v2p_data/scene/fitting/ruler.safetensors --minutes 30

`data` draws random scenes in moments at which a hand touches a thing at rest, each through twelve
cameras, and keeps the half metre around the hand's end. `train` shows windows that
are too large or too small by chance, prints how well the network says by how much on scenes that
it does not train on, and writes the weights every two minutes. Scenes are drawn from seeds of
their own (`hand network`), so that no clip of `bench_reconstruction.py` is among them.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt8

from drawn_clips.camera import View
from drawn_clips.clips import (
    LABEL_HAND,
    LABEL_THING,
    MOTION_KINDS,
    VideoSpec,
    motion_of,
    random_spec,
    render_views,
)
from drawn_clips.motion import Motion
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
from v2p_data.scene.fitting.hand_scale import (
    GUESS_SPREAD,
    REACH_M,
    TOUCHING_M,
    TOWARDS_ARM,
    WINDOW_M,
    HandScaleNetwork,
    planes_of,
    window,
)
from v2p_data.scene.frames.hand import gap_px, hand_end
from v2p_data.scene.scale.camera_height import table_width_m
from v2p_data.seeds import rng_for

KINDS = tuple(kind for kind in MOTION_KINDS if kind != "push_with")
"""A hand that pushes with something touches nothing that rests."""
CAMERAS = 12
KEPT_M, KEPT_PX = 0.52, 208
MOST_TRIES = CAMERAS + 4
PITCHES_RAD = (float(np.radians(20)), float(np.radians(62)))
AT_REST_M, SAME_HEIGHT_M, NEAR_M = 0.015, 0.01, 0.2
LEAST_PX, LEAST_SIDE_PX = 12, 40
HAND, THING, MOST_THINGS = 1, 2, 8
"""Labels in the files: hand, and any thing."""
MOST_OFF = 0.7
BATCH = 48
TAIL = 4.0
"""Degrees of freedom of the errors' t distribution."""


def make_scene(job: tuple[int, Path]) -> str:
    """Draw one scene through some cameras and write what training needs; return an error's words, or nothing."""
    nothing = "no hand is seen that touches the thing at rest"
    return drawn_scene(job, "hand network", _rows_of, nothing)


def _rows_of(number: int, rng: np.random.Generator) -> list[dict[str, np.ndarray]]:
    spec = random_spec(f"clip{number}", KINDS[number % len(KINDS)], rng)
    spec = resized_view(spec, rng)
    motion = motion_of(spec)
    moments = touching(motion)
    return views_of(spec, motion, moments, rng) if len(moments) else []


def touching(motion: Motion) -> Int[np.ndarray, "n"]:
    """Return the frames in which the hand is at what it moves, and that is still, or again, at rest on the table."""
    thing, hand = motion.T_world_things[0, :, :3, 3], motion.T_world_hand[:, :3, 3]
    at_rest = np.linalg.norm(thing - thing[0], axis=1) < AT_REST_M
    if abs(thing[-1, 2] - thing[0, 2]) < SAME_HEIGHT_M:
        at_rest |= np.linalg.norm(thing - thing[-1], axis=1) < AT_REST_M
    return np.flatnonzero(at_rest & (np.linalg.norm(hand - thing, axis=1) < NEAR_M))


def views_of(
    spec: VideoSpec, motion: Motion, moments: Int[np.ndarray, "n"], rng: np.random.Generator
) -> list[dict[str, np.ndarray]]:
    """Return what random cameras see around the hand's end, as far as the hand is seen to touch the thing."""
    frames = rng.choice(moments, MOST_TRIES).tolist()
    views = []
    for i in frames:
        hand, thing = motion.T_world_hand[i, :2, 3], motion.T_world_things[0, i, :2, 3]
        aim = 0.5 * (hand + thing) + rng.normal(0, 0.12, 2)
        views.append(view_towards(spec.view, aim, PITCHES_RAD, rng))
    pictures, labels = render_views(spec, frames, with_hand=True, views=views)
    rows = []
    for i, view, rgb, own in zip(frames, views, pictures, labels, strict=True):
        row = _view(view, motion.T_world_things[0, i, :3, 3], compressed(rgb, rng), own)
        if row is not None and len(rows) < CAMERAS:
            rows.append(row)
    return rows


def _view(
    view: View,
    thing: Float[np.ndarray, "3"],
    rgb: UInt8[np.ndarray, "h w 3"],
    labels: UInt8[np.ndarray, "h w"],
) -> dict[str, np.ndarray] | None:
    """Return the part of a picture around the hand's end; None where no hand is seen to touch the thing."""
    camera, (h, w) = view.camera(), labels.shape
    hand, outline = labels == LABEL_HAND, labels == LABEL_THING
    if not 0.004 < hand.mean() < 0.4 or outline.sum() < LEAST_PX:
        return None
    foot = camera.project((thing * [1, 1, 0])[None])[0]
    if not (0 < foot[0] < w and 0 < foot[1] < h):
        return None
    below, focal_widths = (foot[1] - h / 2) / w, float(camera.K[0, 0]) / w
    px_per_m = w / table_width_m(view.pitch_rad, focal_widths, view.height_m, below)
    end = hand_end(hand)
    if not KEPT_M * px_per_m > LEAST_SIDE_PX or end is None:
        return None
    reach_m = (foot - end.tip_px) / px_per_m
    if gap_px(hand, outline) > TOUCHING_M * px_per_m or np.linalg.norm(reach_m) > REACH_M:
        return None
    kinds = np.zeros(256, np.uint8)
    kinds[LABEL_HAND], kinds[LABEL_THING : LABEL_THING + MOST_THINGS] = HAND, THING
    step = KEPT_M * px_per_m / KEPT_PX
    if step > 1.3:
        rgb = cv2.GaussianBlur(rgb, (0, 0), 0.4 * step)
    M = np.column_stack([np.eye(2) * step, np.array(end.tip_px) - KEPT_PX * step / 2])
    size, back = (KEPT_PX, KEPT_PX), cv2.WARP_INVERSE_MAP
    return {
        "rgb": cv2.warpAffine(
            rgb, M, size, flags=cv2.INTER_LINEAR | back, borderMode=cv2.BORDER_REPLICATE
        ),
        "labels": cv2.warpAffine(
            kinds[labels], M, size, flags=cv2.INTER_NEAREST | back, borderMode=cv2.BORDER_CONSTANT
        ),
        "known": np.array([view.pitch_rad, below, *end.way, *reach_m], np.float32),
    }


def varied(
    scene: Scene, k: int, rng: np.random.Generator
) -> tuple[Float32[np.ndarray, "4 112 112"], Float32[np.ndarray, "4"], np.float32]:
    """Return a view of a scene through a window of random size, changed in ways that keep it true.

    The last value is the logarithm of true over pretended pixels per metre.
    """
    pitch, below, *pairs = (float(v) for v in scene["known"][k])
    way, reach_m = np.array(pairs[:2]), np.array(pairs[2:])
    off = float(np.clip(rng.normal(0, GUESS_SPREAD), -MOST_OFF, MOST_OFF))
    side_px = WINDOW_M / KEPT_M * KEPT_PX * np.exp(-off)
    centre = KEPT_PX / 2 + (TOWARDS_ARM * way + rng.normal(0, 0.05, 2)) * side_px
    rgb, hand = window(scene["rgb"][k], _badly_cut(scene["labels"][k], rng), centre, side_px)
    how = rng.integers(5)
    if how < 2:
        hand = (cv2.dilate, cv2.erode)[how](hand, np.ones((3, 3), np.uint8))
    hand = cv2.GaussianBlur(hand, (0, 0), float(rng.uniform(0.6, 2.0)))
    rgb = recoloured(rgb, rng)
    planes = planes_of(rgb, hand)
    noise = rng.standard_normal(planes[:3].shape, np.float32)
    planes[:3] += np.float32(rng.uniform(0, 0.03)) * noise
    offset = (reach_m + rng.normal(0, 0.012, 2)) / (WINDOW_M * np.exp(-off))
    if rng.random() < 0.5:
        planes, offset = planes[..., ::-1], offset * [-1, 1]
    known = np.array([pitch + rng.normal(0, 0.08), below, *offset], np.float32)
    return np.ascontiguousarray(planes), known, np.float32(off)


def _badly_cut(
    labels: UInt8[np.ndarray, "s s"], rng: np.random.Generator
) -> Float32[np.ndarray, "s s"]:
    """Return the hand as the scene network may see it: with a bit of a thing, or without a bit of itself."""
    hand = labels == HAND
    chance = rng.random()
    if chance < 0.25:
        where = (cv2.dilate(hand.astype(np.uint8), np.ones((5, 5))) > 0) & (labels == THING)
        return (hand | (disc_at(where, 4, 16, rng) & (labels == THING))).astype(np.float32)
    if chance < 0.4:
        return (hand & ~disc_at(hand, 4, 14, rng)).astype(np.float32)
    return hand.astype(np.float32)


def loss_of(said: Float[torch.Tensor, "n 2"], off: Float[torch.Tensor, "n"]) -> torch.Tensor:
    """Return the negative logarithm of the likelihood of Student's t."""
    log_sd = said[:, 1].clamp(-3.5, 0.5)
    away = (said[:, 0] - off) / log_sd.exp()
    return (log_sd + (TAIL + 1) / 2 * torch.log1p(away**2 / TAIL)).mean()


@torch.inference_mode()
def measure(net: HandScaleNetwork, held_out: list[Scene]) -> str:
    """Return how far the network is off on views of scenes held out, all changed the same way each time, in words."""
    net.eval()
    rng, off, stated = rng_for(0, "hand network", "held out"), [], []
    for scene in held_out:
        planes, known, truth = batch_of(
            varied, [(scene, k) for k in range(len(scene["known"]))], rng
        )
        said = net(planes, known)
        off += (said[:, 0] - truth).tolist()
        stated += said[:, 1].exp().tolist()
    net.train()
    sure = np.array(stated) < np.median(stated)
    return (
        f"off by {np.std(off):.3f} (standard deviation of the logarithm; {np.mean(off):+.3f} in "
        "the mean), the surer half "
        f"by {np.std(np.array(off)[sure]):.3f}, stated {np.mean(stated):.3f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add_commands(parser, "scene", 1500)
    args = parser.parse_args()
    if args.command == "data":
        numbers = range(args.start, args.start + args.scenes)
        draw_all(make_scene, numbers, args.out, args.jobs)
    else:
        learn(HandScaleNetwork, varied, loss_of, measure, BATCH, "hand network", args)


if __name__ == "__main__":
    main()
