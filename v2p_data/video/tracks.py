"""Which stream of a video file is the film, how much of it there should be, and which way up it is shown."""

import math
import re
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av.container
import numpy as np
from av.stream import Disposition
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from jaxtyping import Float, UInt8

from v2p_data.errors import ItemRejectedError

_PICTURES = Disposition.attached_pic | Disposition.still_image | Disposition.timed_thumbnails
"""Covers and previews: a player does not play them."""
_LARGEST_TILT_RAD = math.radians(2)
"""Matrices are written with rounded numbers; a film that is meant to lean leans by more."""


@dataclass(frozen=True, kw_only=True)
class Promise:
    """What a container says of its film; 0 where it says nothing."""

    frames: int
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Orientation:
    """How a stored picture becomes the shown one: first its axes are swapped, then it is mirrored."""

    swaps_axes: bool = False
    flips_x: bool = False
    """Left and right change places."""
    flips_y: bool = False

    def shown(self, pixels: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
        """Return the picture as a player shows it."""
        pixels = pixels.swapaxes(0, 1) if self.swaps_axes else pixels
        pixels = pixels[:, ::-1] if self.flips_x else pixels
        pixels = pixels[::-1] if self.flips_y else pixels
        return np.ascontiguousarray(pixels)


def film_stream(
    container: "av.container.InputContainer", path: Path
) -> tuple[VideoStream, tuple[str, ...]]:
    """Return the stream that a player plays, and a sentence where there is a choice.

    Raises:
        ItemRejectedError: `no_video_stream` or `unreadable`.
    """
    streams = container.streams.video
    if not streams:
        raise ItemRejectedError("no_video_stream", f"{path.name} holds no pictures")
    films = [s for s in streams if not s.disposition & _PICTURES]
    if not films:
        raise ItemRejectedError(
            "no_video_stream", f"{path.name} holds a cover picture and no film; export it again"
        )
    # a damaged file can give streams without a decoder, whatever the types say
    known = [s for s in films if s.codec_context is not None]
    if not known:
        raise ItemRejectedError("unreadable", f"{path.name} holds pictures of an unknown kind")
    moving = [s for s in known if s.frames != 1] or known
    best = container.streams.best("video")  # libav's choice, by what it decoded to probe the file
    film = next((s for s in moving if best is not None and s.index == best.index), moving[0])
    if len(moving) == 1:
        return film, ()
    return film, (
        f"{path.name} holds {len(moving)} films; the one of {film.codec_context.width} x "
        f"{film.codec_context.height} px, stream {film.index}, is read",
    )


def promise_of(
    container: "av.container.InputContainer", film: VideoStream, rate: Fraction
) -> Promise:
    """Return how much of the film there should be, as its edit list cuts it; sound may last longer."""
    seconds = 0.0
    # Matroska notes when a film ends, whenever it begins
    late_s = max(0.0, float((film.start_time or 0) * (film.time_base or 0)))
    late_s = late_s if "matroska" in container.format.name else 0.0
    if film.duration and film.time_base:
        # Fragmented files: frames before time zero are not shown, but the container still counts them.
        seconds = float((film.duration + min(0, film.start_time or 0)) * film.time_base)
    if seconds <= 0:
        seconds = _tagged_s(film.metadata) - late_s
    if seconds <= 0 and len(container.streams) == 1:
        seconds = (container.duration or 0) / av.time_base - late_s
    frames = round(seconds * rate)
    if film.frames:  # those that an edit list leaves out are counted too
        frames = min(max(1, frames), film.frames) if seconds > 0 else film.frames
    # damaged files promise anything
    return Promise(frames=frames if 0 < frames < 1e6 else 0, seconds=max(0.0, seconds))


def is_before_start(container: "av.container.InputContainer", frame: VideoFrame) -> bool:
    """Tell whether an edit list leaves a frame out that the decoder had to be given."""
    in_mp4 = "mp4" in container.format.name.split(",")
    return in_mp4 and frame.time is not None and frame.time < -1e-3


def orientation_of(frame: VideoFrame, path: Path) -> Orientation:
    """Return how the frame's display matrix says that it is shown.

    Raises:
        ItemRejectedError: `odd_angle`.
    """
    axes = shown_axes(frame)
    if axes is None:
        return Orientation()
    nearest = np.round(axes)
    tilt = np.abs(axes - nearest).max()
    if tilt > math.sin(_LARGEST_TILT_RAD) or abs(np.linalg.det(nearest)) < 0.5:
        degrees = math.degrees(math.atan2(axes[1, 0], axes[0, 0]))
        raise ItemRejectedError(
            "odd_angle",
            f"{path.name} is marked to be shown turned by {degrees:.0f} degrees or slanted; turns by 90, 180 and "
            "270 degrees and mirrors are read: export it upright",
            degrees,
        )
    return Orientation(
        swaps_axes=bool(nearest[0, 0] == 0),
        flips_x=bool(nearest[0].sum() < 0),
        flips_y=bool(nearest[1].sum() < 0),
    )


def shown_axes(frame: VideoFrame) -> Float[np.ndarray, "2 2"] | None:
    """Return where the stored picture's axes, right and down, point to when shown: unit columns; None without a matrix.

    Source: ISO 14496-12, 8.3.2; libavutil/display.h.
    """
    try:
        data = bytes(frame.side_data["DISPLAYMATRIX"])  # pyright: ignore
    except KeyError:
        return None
    except (
        ValueError
    ):  # beside side data that PyAV has no name for, such as the eye of a spatial video
        return turned_axes(float(frame.rotation))
    matrix = np.frombuffer(data, np.int32)[:9].reshape(3, 3)[:2, :2].T.astype(float)
    lengths = np.linalg.norm(matrix, axis=0)
    return matrix / lengths if lengths.all() else None


def turned_axes(rotation_deg: float) -> Float[np.ndarray, "2 2"]:
    """Return where the axes right and down of a picture point to that is turned counter-clockwise."""
    angle = math.radians(rotation_deg)
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, sin], [-sin, cos]])


def _tagged_s(metadata: dict[str, str]) -> float:
    """Return the duration that Matroska's writers note beside a stream; 0 where there is none."""
    for key, value in metadata.items():
        if key.upper().startswith("DURATION") and (
            found := re.fullmatch(r"(\d+):(\d\d):(\d\d(?:\.\d+)?)", value.strip())
        ):
            hours, minutes, seconds = found.groups()
            return 3600 * int(hours) + 60 * int(minutes) + float(seconds)
    return 0.0
