"""Changed copies of real clips: does the reconstruction of a clip survive what other cameras and editors do to it?

Thresholds were set on the few real clips at hand. A mirrored, rolled or recompressed copy shows the same scene in pixels that
nobody looked at, so the share that stays accepted and right says how closely the thresholds fit those clips. It is no
replacement for clips of other people. Captions and drawn boxes are changed with the pictures.

    python scripts/change_clips.py CLIPS --change mirror --out outputs/mirrored
    python scripts/judge_real_clips.py outputs/mirrored
"""

import argparse
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from jaxtyping import Float, UInt8

from drawn_clips.handheld import SWAY_HZ
from judge_real_clips import DRAWN
from v2p_data.seeds import rng_for
from v2p_data.video.captions import CAPTIONS_FILE, find_videos

Image = UInt8[np.ndarray, "h w 3"]
Homography = Float[np.ndarray, "3 3"]
_ROLL_DEG, _TRIMMED = 4.0, 0.92
_ZOOMED = 1.12
"""Enlargement that keeps the picture's border out of sight when it is rolled or shaken."""
_GAMMA, _TINT = 1.5, np.array([1.0, 0.95, 0.82])
"""A dimmer lamp of warmer light."""
_SMALL_PX, _SMALL_CRF, _CRF = 360, 33, 18
"""Width and quality of a clip that a messenger sent on; quality of the others (constant rate factor of H.264)."""
_SHAKE_PX, _WAVES = 8.0, 8
"""Root mean square of the sway [px of a picture 320 px wide]."""
_WIDTH_PX = 320


@dataclass(frozen=True, kw_only=True)
class Change:
    """What is done to every frame."""

    warp: Callable[[np.random.Generator], Callable[[float, tuple[int, int]], Homography]]
    """From randomness, the homography by second and (width, height)."""
    paint: Callable[[Image], Image] = lambda image: image
    width_px: int | None = None
    crf: int = _CRF
    mirrors: bool = False


def _about(size: tuple[int, int], turn_rad: float, by: float) -> Homography:
    """Return the homography that turns and enlarges about the picture's middle."""
    w, h = size
    affine = cv2.getRotationMatrix2D((w / 2, h / 2), float(np.degrees(turn_rad)), by)
    return np.vstack([affine, [0.0, 0.0, 1.0]])


def _still(warp: Callable[[tuple[int, int]], Homography]):  # noqa: ANN202
    return lambda _rng: lambda _second, size: warp(size)


def _mirrored(size: tuple[int, int]) -> Homography:
    return np.array([[-1.0, 0.0, size[0] - 1], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def _shaken(rng: np.random.Generator) -> Callable[[float, tuple[int, int]], Homography]:
    """Return the sway of a hand-held camera: its power falls with the square of the frequency."""
    hz = np.geomspace(*SWAY_HZ, _WAVES)
    gain = rng.normal(1, 0.3, (2, _WAVES)) / np.sqrt(hz)
    gain *= _SHAKE_PX * np.sqrt(2) / np.linalg.norm(gain, axis=1, keepdims=True)
    phase = rng.uniform(0, 2 * np.pi, (2, _WAVES))

    def at(second: float, size: tuple[int, int]) -> Homography:
        moved = (gain * (np.sin(2 * np.pi * hz * second + phase) - np.sin(phase))).sum(1)
        shift = np.eye(3)
        shift[:2, 2] = moved * size[0] / _WIDTH_PX
        return shift @ _about(size, 0.0, _ZOOMED)

    return at


def _dim(image: Image) -> Image:
    return (255 * (image / 255) ** _GAMMA * _TINT).astype(np.uint8)


def _nothing(_size: tuple[int, int]) -> Homography:
    return np.eye(3)


CHANGES = {
    "none": Change(warp=_still(_nothing)),
    "mirror": Change(warp=_still(_mirrored), mirrors=True),
    "roll": Change(warp=_still(lambda size: _about(size, np.radians(_ROLL_DEG), _ZOOMED))),
    "trim": Change(warp=_still(lambda size: _about(size, 0.0, 1 / _TRIMMED))),
    "dim": Change(warp=_still(_nothing), paint=_dim),
    "small": Change(warp=_still(_nothing), width_px=_SMALL_PX, crf=_SMALL_CRF),
    "shake": Change(warp=_shaken),
}


def main() -> None:
    """Read the command line and write the changed clips, their captions and boxes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("videos", type=Path, help="folder of the clips")
    parser.add_argument("--change", choices=CHANGES, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--drawn", type=Path, help="the boxes drawn by hand; CLIPS/boxes.json where there is one"
    )
    args = parser.parse_args()
    beside = args.videos / "boxes.json"
    drawn = json.loads((args.drawn or (beside if beside.is_file() else DRAWN)).read_text())
    change = CHANGES[args.change]
    args.out.mkdir(parents=True, exist_ok=True)
    captions: dict[str, Any] = {}
    boxes: dict[str, Any] = {}
    for video in find_videos(args.videos):
        name = f"{video.path.stem}.mp4"
        there = drawn.get(video.path.name)
        if there is None:
            continue
        rng = rng_for(args.seed, "changed clip", args.change, name)
        warps, size, out_size = rewrite(video.path, args.out / name, change, rng)
        words = mirrored_words if change.mirrors else str
        captions[name] = {
            "caption": words(video.caption),
            "objects": [words(phrase) for phrase in video.objects],
        }
        boxes[name] = {
            "rating": there.get("rating", 0),
            "objects": {
                words(phrase): {
                    end: moved_box(thing[end], warp, size, out_size)
                    for end, warp in zip(("first", "last"), warps, strict=True)
                }
                for phrase, thing in there["objects"].items()
            },
        }
    (args.out / CAPTIONS_FILE).write_text(json.dumps(captions, indent=1) + "\n")
    (args.out / "boxes.json").write_text(json.dumps(boxes, indent=1) + "\n")
    print(f"{len(boxes)} clips in {args.out}")


def rewrite(
    source: Path, target: Path, change: Change, rng: np.random.Generator
) -> tuple[tuple[Homography, Homography], tuple[int, int], tuple[int, int]]:
    """Write a changed copy of a clip.

    Returns:
        The homographies of the first and last frame, the clip's (width, height), and that of the copy.
    """
    with av.open(str(source)) as file:
        rate = file.streams.video[0].average_rate or Fraction(30)
        frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    h, w = frames[0].shape[:2]
    way = change.warp(rng)
    out_w = min(w, change.width_px or w)
    out_size = (2 * (out_w // 2), 2 * (round(h * out_w / w) // 2))
    warps = [way(k / float(rate), (w, h)) for k in range(len(frames))]
    with av.open(str(target), "w") as file:
        stream = file.add_stream("libx264", rate=rate)
        stream.width, stream.height, stream.pix_fmt = *out_size, "yuv420p"
        stream.options = {"crf": str(change.crf), "preset": "veryfast"}
        for image, warp in zip(frames, warps, strict=True):
            if not np.array_equal(warp, np.eye(3)):
                image = cv2.warpPerspective(image, warp, (w, h), borderMode=cv2.BORDER_REPLICATE)
            image = cv2.resize(change.paint(image), out_size, interpolation=cv2.INTER_AREA)
            file.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        file.mux(stream.encode())
    return (warps[0], warps[-1]), (w, h), out_size


def moved_box(
    box: list[float] | None, warp: Homography, size: tuple[int, int], out_size: tuple[int, int]
) -> list[float] | None:
    """Return a box in the copy's pixels, within its picture; None where there is none or nothing of it is left."""
    if box is None:
        return None
    x0, y0, x1, y1 = box
    corners = np.array([[[x0, y0]], [[x1, y0]], [[x0, y1]], [[x1, y1]]], float)
    by = np.array(out_size) / np.array(size)
    spots = cv2.perspectiveTransform(corners, warp)[:, 0] * by
    low, high = np.clip(spots.min(0), 0, out_size), np.clip(spots.max(0), 0, out_size)
    return None if (high - low).min() < 1 else [round(float(v), 1) for v in (*low, *high)]


def mirrored_words(text: str) -> str:
    """Return a caption with left and right exchanged."""
    other = {"left": "right", "right": "left"}
    return re.sub(r"\b(left|right)\b", lambda word: other[word[0].lower()], text, flags=re.I)


if __name__ == "__main__":
    main()
