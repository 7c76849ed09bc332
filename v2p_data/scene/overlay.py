"""What was understood, drawn over the video: outlines, shapes, axes, the table's grid, names and confidence."""

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation, Slerp

from v2p_data.geometry.camera import Camera
from v2p_data.geometry.mesh import outline_points
from v2p_data.scene.reconstruct import Estimate, Reconstruction

WIDTH_PX = 640
_COLOURS = [(255, 0, 200), (0, 220, 255), (255, 190, 0), (120, 255, 0), (255, 120, 80)]
_AXES = [(255, 60, 60), (60, 230, 60), (80, 120, 255)]
_BOX_EDGES = [(i, j) for i in range(8) for j in range(i) if bin(i ^ j).count("1") == 1]


def write_overlay(reconstruction: Reconstruction, folder: Path) -> None:
    """Write `overlay.mp4` (H.264), `overlay_first.png` and `overlay_last.png`."""
    clip = reconstruction.clip
    h, w = clip.frames.shape[1:3]
    scale = min(1.0, WIDTH_PX / w)
    size = (int(w * scale) // 2 * 2, int(h * scale) // 2 * 2)
    last = reconstruction.objects[0].frames[-1]
    with av.open(str(folder / "overlay.mp4"), "w") as container:
        rate = Fraction(clip.fps).limit_denominator(1000)
        stream = container.add_stream(
            "libx264", rate=rate, options={"crf": "26", "preset": "veryfast"}
        )
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        for i in range(len(clip.frames)):
            picture = draw(reconstruction, i, size)
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
    """Return one frame of the clip with the scene drawn over it."""
    image = cv2.resize(reconstruction.clip.frames[frame], size, interpolation=cv2.INTER_AREA)
    camera = _resized(reconstruction.camera, size)
    _draw_grid(image, camera)
    for number, thing in enumerate(reconstruction.objects):
        colour = _COLOURS[number % len(_COLOURS)]
        mask = _mask_at(reconstruction, thing, frame)
        if mask is not None:
            large = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_LINEAR)
            outline, _ = cv2.findContours(large, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(image, outline, -1, colour, 1, cv2.LINE_AA)
        T = _pose_at(thing, frame)
        _draw_shape(image, camera, thing, T, colour)
    _draw_title(image, reconstruction, frame)
    return image


def _draw_grid(image: UInt8[np.ndarray, "h w 3"], camera: Camera) -> None:
    layer = image.copy()
    for i in range(-4, 5):
        for ends in (((-0.4, 0.1 * i), (0.4, 0.1 * i)), ((0.1 * i, -0.4), (0.1 * i, 0.4))):
            start, end = (np.array([*xy, 0.0]) for xy in ends)
            line = np.linspace(start, end, 20)
            _polyline(layer, camera.project(line), (255, 255, 255) if i else (255, 255, 80), 1)
    cv2.addWeighted(layer, 0.35, image, 0.65, 0, dst=image)


def _draw_shape(
    image: UInt8[np.ndarray, "h w 3"],
    camera: Camera,
    thing: Estimate,
    T: Float[np.ndarray, "4 4"],
    colour: tuple[int, int, int],
) -> None:
    points = outline_points(thing.noun.form, thing.size_m, thing.noun.taper)
    pixels = camera.project(points @ T[:3, :3].T + T[:3, 3])
    if thing.noun.form == "box":
        for i, j in _BOX_EDGES:
            _polyline(image, pixels[[i, j]], colour, 2)
    elif thing.noun.form == "cylinder":
        for ring in (pixels[:20], pixels[20:]):
            _polyline(image, np.concatenate([ring, ring[:1]]), colour, 2)
        for i in (0, 5, 10, 15):
            _polyline(image, pixels[[i, i + 20]], colour, 1)
    elif np.isfinite(pixels).all():
        hull = cv2.convexHull(pixels.astype(np.float32))[:, 0]
        _polyline(image, np.concatenate([hull, hull[:1]]), colour, 2)
    reach = 0.6 * max(thing.size_m)
    axes = T[:3, 3] + np.vstack([np.zeros(3), reach * T[:3, :3].T])
    ends = camera.project(axes)
    for axis in range(3):
        _polyline(image, ends[[0, axis + 1]], _AXES[axis], 2)
    if np.isfinite(pixels).all():
        x, y = int(pixels[:, 0].min()), int(pixels[:, 1].min()) - 6
        text = f"{thing.name} {'x'.join(f'{100 * s:.0f}' for s in thing.size_m)} cm"
        _text(image, text, (max(2, x), max(28, y)), colour)


def _draw_title(image: UInt8[np.ndarray, "h w 3"], scene: Reconstruction, frame: int) -> None:
    thing = scene.objects[0]
    T = _pose_at(thing, frame)
    x, y, z = 100 * T[:3, 3]
    title = f"{scene.kind}  confidence {scene.confidence:.2f}  frame {frame}"
    _text(image, title, (6, 16), (255, 255, 255))
    _text(
        image,
        f"{thing.name} at {x:+.0f} {y:+.0f} {z:+.0f} cm",
        (6, image.shape[0] - 8),
        (255, 255, 255),
    )


def _mask_at(scene: Reconstruction, thing: Estimate, frame: int) -> np.ndarray | None:
    if frame in thing.masks:
        return thing.masks[frame]
    if thing is not scene.objects[0]:
        return thing.masks[0]
    i = int(np.abs(np.array(scene.footage_frames) - frame).argmin())
    return scene.track.masks[i] if scene.track.quality[i] > 0.4 else None


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
    image: np.ndarray, pixels: Float[np.ndarray, "n 2"], colour: tuple[int, int, int], width: int
) -> None:
    keep = np.isfinite(pixels).all(1) & (np.abs(pixels) < 4000).all(1)
    if keep.all():
        cv2.polylines(image, [(pixels * 8).astype(np.int32)], False, colour, width, cv2.LINE_AA, 3)


def _text(image: np.ndarray, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    for thickness, shade in ((3, (0, 0, 0)), (1, colour)):
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, shade, thickness, cv2.LINE_AA)
