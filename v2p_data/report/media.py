"""Pictures and films as data URIs, small enough to live inside a page.

The only module of this room that encodes: JPEG and PNG by OpenCV, H.264 by PyAV.
"""

import base64
import io
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

JPEG_QUALITY = 84
H264_CRF = "26"
"""Constant rate factor: 18 looks lossless, 28 is visibly soft."""


@dataclass(frozen=True, kw_only=True)
class PageConfig:
    """How much goes into a page."""

    max_media_bytes: int = 22_000_000
    """Pictures and films together; with its text the page stays below 25 MB and opens on a phone."""
    max_shown_items: int = 40
    """Videos shown at length; the table lists all."""
    episodes_per_task: int = 2
    """Sample episodes; the first and the last are the most different random draws at hand."""
    max_rollouts_per_task: int = 2
    film_width_px: int = 480
    sheet_width_px: int = 1400
    max_film_frames: int = 160
    mesh_size_px: int = 150


@dataclass(frozen=True, kw_only=True)
class Medium:
    """A picture or a film with the words that stand for it."""

    uri: str
    alt: str
    is_film: bool = False


@dataclass(kw_only=True)
class MediaBudget:
    """Counts what has been embedded and refuses what would make the page too large to open."""

    max_bytes: int
    used_bytes: int = 0
    left_out: list[str] = field(default_factory=list[str])
    """Names of the media that did not fit."""

    def admit(
        self, uri: str | None, name: str, alt: str, *, is_film: bool = False
    ) -> Medium | None:
        """Return the medium if it fits, else None, and remember its name."""
        if uri is None:
            return None
        if self.used_bytes + len(uri) > self.max_bytes:
            self.left_out.append(name)
            return None
        self.used_bytes += len(uri)
        return Medium(uri=uri, alt=alt, is_film=is_film)


def picture_uri(path: Path, max_width_px: int) -> str | None:
    """Return a picture file as a JPEG, made narrower if need be; None if it cannot be read."""
    if not path.is_file():
        return None
    data = np.frombuffer(path.read_bytes(), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if image is None:
        return None
    return jpeg_uri(np.asarray(image[..., ::-1], np.uint8), max_width_px)


def jpeg_uri(image: UInt8[np.ndarray, "h w 3"], max_width_px: int) -> str:
    """Return an RGB image as a JPEG."""
    return _uri("image/jpeg", jpeg_bytes(image, max_width_px))


def jpeg_bytes(image: UInt8[np.ndarray, "h w 3"], max_width_px: int) -> bytes:
    """Return an RGB image as a JPEG file."""
    small = _narrower(image, max_width_px)
    _, data = cv2.imencode(
        ".jpg", np.ascontiguousarray(small[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    )
    return data.tobytes()


def png_uri(image: UInt8[np.ndarray, "h w c"]) -> str:
    """Return an RGB or RGBA image as a PNG."""
    return _uri("image/png", png_bytes(image))


def png_bytes(image: UInt8[np.ndarray, "h w c"]) -> bytes:
    """Return an RGB or RGBA image as a PNG file."""
    order = [2, 1, 0, 3][: image.shape[2]]
    _, data = cv2.imencode(".png", np.ascontiguousarray(image[..., order]))
    return data.tobytes()


def film_uri(path: Path, max_width_px: int, max_frames: int) -> str | None:
    """Return a video file as H.264, which every browser plays; None if it cannot be read.

    Frames are dropped evenly to reach `max_frames`; the film keeps its duration.
    """
    if not path.is_file():
        return None
    try:
        fps = _frame_rate(path)
        stride = max(1, -(-sum(1 for _ in _decoded(path)) // max_frames))
        frames = [
            _narrower(frame.to_ndarray(format="rgb24"), max_width_px)
            for k, frame in enumerate(_decoded(path))
            if k % stride == 0
        ]
    except (av.FFmpegError, OSError, IndexError):
        return None
    return frames_uri(np.stack(frames), fps / stride) if frames else None


def frames_uri(frames: UInt8[np.ndarray, "time h w 3"], fps: float) -> str:
    """Return RGB frames as an H.264 film."""
    return _uri("video/mp4", _film(frames, fps))


def write_film(path: Path, frames: UInt8[np.ndarray, "time h w 3"], fps: float) -> None:
    """Write RGB frames as an H.264 film."""
    path.write_bytes(_film(frames, fps))


def _film(frames: UInt8[np.ndarray, "time h w 3"], fps: float) -> bytes:
    """Return RGB frames as an mp4 file. Odd sizes lose one row or column: H.264 halves its colours."""
    _, h, w, _ = frames.shape
    frames = frames[:, : h - h % 2, : w - w % 2]
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream(
            "libx264",
            Fraction(fps).limit_denominator(1000),
            {"crf": H264_CRF, "preset": "veryfast"},
        )
        stream.width, stream.height, stream.pix_fmt = frames.shape[2], frames.shape[1], "yuv420p"
        stream.codec_context.thread_count = 1
        for image in frames:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return buffer.getvalue()


def draw_mesh(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "m 3"],
    rgb: tuple[float, float, float],
    size_px: int = 160,
) -> UInt8[np.ndarray, "h w 4"]:
    """Return a shaded drawing on a transparent ground, seen obliquely from above, +z up.

    Painter's algorithm: far faces first. It needs no graphics driver, and both sides of a face are painted,
    so that the inside of a bowl shows.
    """
    turn, tilt = np.radians(35.0), np.radians(30.0)
    right = np.array([np.cos(turn), np.sin(turn), 0.0])
    ahead = np.array([-np.sin(turn) * np.cos(tilt), np.cos(turn) * np.cos(tilt), -np.sin(tilt)])
    up = np.cross(right, ahead)
    light = np.array([-0.35, -0.5, 0.8]) / np.linalg.norm([-0.35, -0.5, 0.8])
    scale = 4 * size_px
    """Drawn four times larger, then averaged, against jagged edges."""

    flat = np.stack([vertices @ right, -(vertices @ up)], axis=1)
    low, high = flat.min(0), flat.max(0)
    flat = (flat - (low + high) / 2) / max(float((high - low).max()), 1e-9) * 0.88 + 0.5
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    normals *= -np.sign(normals @ ahead)[:, None]
    shade = 0.45 + 0.55 * np.clip(normals @ light, 0, 1)
    image = np.zeros((scale, scale, 4), np.uint8)
    for i in np.argsort(-(corners @ ahead).mean(1)):
        colour = (*(255 * np.clip(shade[i] * np.asarray(rgb), 0, 1)), 255.0)
        polygon = np.round(flat[faces[i]] * scale).astype(np.int32)
        cv2.fillConvexPoly(image, polygon, colour)
    small = cv2.resize(
        image.astype(np.float32) * (image[..., 3:] / 255),
        (size_px, size_px),
        interpolation=cv2.INTER_AREA,
    )
    alpha = np.maximum(small[..., 3:], 1e-6) / 255
    small[..., :3] /= alpha
    return np.clip(small, 0, 255).astype(np.uint8)


def _frame_rate(path: Path) -> float:
    container = av.open(str(path))
    try:
        return float(container.streams.video[0].average_rate or 20)
    finally:
        container.close()


def _decoded(path: Path) -> Iterator[av.VideoFrame]:
    with av.open(str(path)) as container:
        yield from container.decode(container.streams.video[0])


def _narrower(image: np.ndarray, max_width_px: int) -> np.ndarray:
    h, w = image.shape[:2]
    if w <= max_width_px:
        return image
    size = (max_width_px, max(1, round(h * max_width_px / w)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
