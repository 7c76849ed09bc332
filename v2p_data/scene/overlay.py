"""What was understood, drawn over the video: masks, shapes, axes, sizes, the table's grid and how sure it is.

The picture stays free of writing but for a name at each object; the words stand in a band above and in one line per
object below. Axes are red, green and blue for the object's own x, y and z; the grid on the table has 10 cm fields.
"""

import unicodedata
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, Float, UInt8
from scipy.spatial.transform import Rotation, Slerp

from v2p_data.geometry.camera import Camera
from v2p_data.scene.data_types import Estimate, Reconstruction

LONG_SIDE_PX = 640
"""Longer side of the picture; smaller videos are enlarged, or the words would not fit."""
GRID_M = 0.1
_HEAD_PX = 24
_ROW_PX = 20
_FAR_PX = 4000
"""Farther outside of the picture OpenCV's coordinates overflow."""
_MASK_GAP = 4
"""Clip frames over which the mask of a neighbouring frame still stands for this one."""
_SHARP_RAD = 0.7
"""Between the faces at a rim; the facets of a round wall meet at less."""
_MAX_EDGES = 400
_COLOURS = [(255, 60, 200), (0, 210, 255), (255, 190, 0), (120, 240, 40), (255, 125, 80)]
_AXES = [(255, 70, 70), (60, 220, 60), (90, 140, 255)]
_INK, _GROUND = (238, 238, 234), (26, 29, 33)

Colour = tuple[int, int, int]
Box = tuple[int, int, int, int]
"""`x0, y0, x1, y1` [px]."""


def write_overlay(reconstruction: Reconstruction, folder: Path) -> None:
    """Write `overlay.mp4` (H.264), `overlay_first.png` and `overlay_last.png`."""
    clip = reconstruction.clip
    h, w = clip.frames.shape[1:3]
    scale = LONG_SIDE_PX / max(w, h)
    size = (round(w * scale / 2) * 2, round(h * scale / 2) * 2)
    last = reconstruction.objects[0].frames[-1]
    with av.open(str(folder / "overlay.mp4"), "w") as container:
        rate = Fraction(clip.fps).limit_denominator(1000)
        stream = container.add_stream(
            "libx264", rate=rate, options={"crf": "26", "preset": "veryfast"}
        )
        stream.pix_fmt = "yuv420p"
        for i in range(len(clip.frames)):
            picture = draw(reconstruction, i, size)
            stream.width, stream.height = picture.shape[1], picture.shape[0]
            for packet in stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")):
                container.mux(packet)
            for name, frame in (("first", 0), ("last", last)):
                if i == frame:
                    cv2.imwrite(str(folder / f"overlay_{name}.png"), picture[..., ::-1])
        for packet in stream.encode():
            container.mux(packet)


def draw(
    reconstruction: Reconstruction, frame: int, size: tuple[int, int]
) -> UInt8[np.ndarray, "h w 3"]:
    """Return one frame of the clip with the scene drawn over it.

    Args:
        reconstruction: what was understood.
        frame: clip frame, from 0.
        size: width and height of the picture [px], even numbers; the bands of words come on top of its height.
    """
    whole = reconstruction.clip.frames[frame]
    how = cv2.INTER_AREA if size[0] < whole.shape[1] else cv2.INTER_CUBIC
    image = np.asarray(cv2.resize(whole, size, interpolation=how), np.uint8)
    camera = _resized(reconstruction.camera, size)
    _draw_grid(image, camera)
    things = [
        (thing, _COLOURS[number % len(_COLOURS)])
        for number, thing in enumerate(reconstruction.objects)
    ]
    # The manipulated object last: it passes in front of the others more often than behind them.
    for thing, colour in things[::-1]:
        mask = _mask_at(thing, frame)
        if mask is not None and mask.any():
            _draw_mask(image, mask, colour)
    shown = [
        (thing, colour, _draw_shape(image, camera, thing, _pose_at(thing, frame), colour))
        for thing, colour in things[::-1]
        if _has_pose(thing, frame)
    ]
    taken: list[Box] = []
    for thing, colour, extent in shown[::-1]:
        if extent is not None:
            words, above = thing.name.replace("_", " "), thing is reconstruction.objects[0]
            taken.append(_draw_label(image, words, extent, colour, taken, above=above))
    head = _band(size[0], _HEAD_PX)
    title = f"{reconstruction.kind.replace('_', ' ')}   confidence {reconstruction.confidence:.2f}"
    _row(
        head,
        title,
        f"frame {frame + 1} of {len(reconstruction.clip.frames)}, grid {100 * GRID_M:.0f} cm",
        None,
    )
    rows = [_object_row(size[0], thing, frame, colour) for thing, colour in things]
    foot = np.concatenate(rows)
    return np.concatenate([head, image, foot])


def _draw_grid(image: UInt8[np.ndarray, "h w 3"], camera: Camera) -> None:
    layer = image.copy()
    for i in range(-4, 5):
        for ends in (((-0.4, 0.1 * i), (0.4, 0.1 * i)), ((0.1 * i, -0.4), (0.1 * i, 0.4))):
            start, end = (np.array([*xy, 0.0]) for xy in ends)
            line = np.linspace(start, end, 41)
            _polyline(layer, camera.project(line), (255, 255, 255) if i else (255, 255, 80), 1)
    cv2.addWeighted(layer, 0.4, image, 0.6, 0, dst=image)


def _draw_mask(
    image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "mh mw"], colour: Colour
) -> None:
    """Fill the mask so that what it covers can still be seen, and draw its border."""
    h, w = image.shape[:2]
    smooth = cv2.resize(mask.astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR)
    large = smooth > 0.5
    image[large] = (0.68 * image[large] + 0.32 * np.array(colour)).astype(np.uint8)
    outline, _ = cv2.findContours(large.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, outline, -1, (0, 0, 0), 3, cv2.LINE_AA)
    cv2.drawContours(image, outline, -1, colour, 1, cv2.LINE_AA)


def _draw_shape(
    image: UInt8[np.ndarray, "h w 3"],
    camera: Camera,
    thing: Estimate,
    T: Float[np.ndarray, "4 4"],
    colour: Colour,
) -> Box | None:
    """Draw shape and axes; return where in the picture the shape is, None if it is out of sight."""
    pixels = camera.project(np.asarray(thing.mesh.vertices) @ T[:3, :3].T + T[:3, 3])
    _draw_mesh(image, thing.mesh, pixels, colour)
    reach = max(0.02, 0.6 * max(thing.size_m))
    ends = camera.project(T[:3, 3] + np.vstack([np.zeros(3), reach * T[:3, :3].T]))
    for axis, shade in enumerate(_AXES):
        _polyline(image, ends[[0, axis + 1]], (0, 0, 0), 4)
        _polyline(image, ends[[0, axis + 1]], shade, 2)
    if not np.isfinite(pixels).all():
        return None
    low, high = pixels.min(0), pixels.max(0)
    if (high < 0).any() or (low > (image.shape[1], image.shape[0])).any():
        return None
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _draw_mesh(
    image: UInt8[np.ndarray, "h w 3"],
    mesh: trimesh.Trimesh,
    pixels: Float[np.ndarray, "n 2"],
    colour: Colour,
) -> None:
    """Draw the outer outline, and thinly the sharpest edges: rims and corners."""
    angles = mesh.face_adjacency_angles
    sharp = np.asarray(mesh.face_adjacency_edges)[angles > _SHARP_RAD]
    most = np.argsort(-angles[angles > _SHARP_RAD], kind="stable")[:_MAX_EDGES]
    for edge in sharp[most]:
        _polyline(image, pixels[edge], colour, 1)
    if np.isfinite(pixels).all():
        hull = cv2.convexHull(pixels.astype(np.float32))[:, 0]
        _polyline(image, np.concatenate([hull, hull[:1]]), colour, 2)


def _draw_label(
    image: UInt8[np.ndarray, "h w 3"],
    words: str,
    extent: Box,
    colour: Colour,
    taken: list[Box],
    *,
    above: bool,
) -> Box:
    """Write a name above or below an object, clear of the border and of other names; return where it stands."""
    h, w = image.shape[:2]
    words = _fitting(words, w - 12)
    width, high = _text_size(words)[0] + 8, 18
    x0 = int(np.clip((extent[0] + extent[2]) // 2 - width // 2, 0, max(0, w - width)))
    y0 = int(np.clip(extent[1] - high - 6 if above else extent[3] + 6, 0, h - high))
    for a0, b0, a1, b1 in sorted(taken, key=lambda box: box[1]):
        if x0 < a1 and a0 < x0 + width and y0 < b1 and b0 < y0 + high:
            y0 = min(h - high, b1 + 2)
    box = image[y0 : y0 + high, x0 : x0 + width]
    box[:] = (0.3 * box + 0.7 * np.array(_GROUND)).astype(np.uint8)
    _text(image, words, (x0 + 4, y0 + 13), colour)
    return x0, y0, x0 + width, y0 + high


def _object_row(width: int, thing: Estimate, frame: int, colour: Colour) -> np.ndarray:
    row = _band(width, _ROW_PX)
    sides = " x ".join(f"{100 * side:.1f}" for side in thing.size_m)
    x, y, z = 100 * _pose_at(thing, frame)[:3, 3]
    sure = float(np.interp(frame, thing.frames, thing.confidences))
    name = thing.name.replace("_", " ")
    nearest = int(np.abs(np.array(thing.frames) - frame).argmin())
    unseen = thing.observed[nearest : nearest + 1] == ("no_depth",)
    where = (
        f"at {x:+.0f} {y:+.0f} {z:+.0f} cm{', depth unseen' if unseen else ''}, pose {sure:.2f}"
    )
    there = _has_pose(thing, frame)
    _row(row, f"{name}  {sides} cm", where if there else "no pose in this frame", colour)
    return row


def _band(width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
    return np.full((height, width, 3), _GROUND, np.uint8)


def _row(band: UInt8[np.ndarray, "h w 3"], left: str, right: str, colour: Colour | None) -> None:
    """Write a line of words; where both do not fit, the right one gives way."""
    height, width = band.shape[:2]
    at, base = 8, height // 2 + 5
    if colour is not None:
        cv2.rectangle(band, (8, height // 2 - 5), (18, height // 2 + 5), colour, cv2.FILLED)
        at = 26
    left = _fitting(left, width - at - 8)
    _text(band, left, (at, base), _INK)
    needed = _text_size(right)[0]
    if at + _text_size(left)[0] + 16 + needed <= width - 8:
        _text(band, right, (width - 8 - needed, base), (170, 176, 182))


def _has_pose(thing: Estimate, frame: int) -> bool:
    """Return whether it is known where a thing is: a tool in a hand is nowhere before it comes and once it is gone."""
    if thing.observed[:1] != ("no_depth",):
        return True
    return thing.frames[0] - _MASK_GAP <= frame <= thing.frames[-1] + _MASK_GAP


def _mask_at(thing: Estimate, frame: int) -> Bool[np.ndarray, "h w"] | None:
    """Return the object's outline at a frame or one close by, None where it was not followed."""
    nearest = min(thing.masks, key=lambda other: abs(other - frame), default=None)
    if nearest is None or abs(nearest - frame) > _MASK_GAP:
        return None
    return thing.masks[nearest]


def _pose_at(thing: Estimate, frame: int) -> Float[np.ndarray, "4 4"]:
    frames = np.array(thing.frames, float)
    if len(frames) < 2 or frame <= frames[0]:
        return thing.T_world_objs[0]
    if frame >= frames[-1]:
        return thing.T_world_objs[-1]
    T = np.eye(4)
    turns = Slerp(frames, Rotation.from_matrix(thing.T_world_objs[:, :3, :3]))
    T[:3, :3] = turns(frame).as_matrix()
    T[:3, 3] = [np.interp(frame, frames, thing.T_world_objs[:, k, 3]) for k in range(3)]
    return T


def _resized(camera: Camera, size: tuple[int, int]) -> Camera:
    K = np.diag([size[0] / camera.width_px, size[1] / camera.height_px, 1.0]) @ camera.K
    return Camera(width_px=size[0], height_px=size[1], K=K, T_world_cam=camera.T_world_cam)


def _polyline(
    image: np.ndarray, pixels: Float[np.ndarray, "n 2"], colour: Colour, width: int
) -> None:
    """Draw the parts of a line that can be seen; pixel centres are at one half, OpenCV's at whole numbers."""
    keep = np.asarray(np.isfinite(pixels).all(1) & (np.abs(pixels) < _FAR_PX).all(1))
    for run in np.split(np.arange(len(pixels)), np.flatnonzero(np.diff(keep.astype(int))) + 1):
        if keep[run[0]] and len(run) > 1:
            fixed = np.round((pixels[run] - 0.5) * 8).astype(np.int32)
            cv2.polylines(image, [fixed], False, colour, width, cv2.LINE_AA, 3)


def _text_size(words: str) -> tuple[int, int]:
    (width, height), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, 0.42, 1)
    return width, height


def _fitting(words: str, width_px: int) -> str:
    """Return the words as far as they fit, in the letters that OpenCV can draw."""
    plain = unicodedata.normalize("NFKD", words).encode("ascii", "ignore").decode()
    if _text_size(plain)[0] <= width_px:
        return plain
    while plain and _text_size(plain + "...")[0] > width_px:
        plain = plain[:-1]
    return plain + "..."


def _text(image: np.ndarray, text: str, at: tuple[int, int], colour: Colour) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, 1, cv2.LINE_AA)
