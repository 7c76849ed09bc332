"""The clip: what every later stage knows of a video, held in memory."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypedDict

from jaxtyping import Float, Int, UInt8
from numpy import ndarray


class Hint(TypedDict, total=False):
    """What a person marked by hand about one object, in one frame."""

    frame: int
    """Frame number from 0; 0 when not said."""
    box: list[float]
    """`[x0, y0, x1, y1]` [px], right and down."""
    points: list[list[float]]
    """Points on the object, `[x, y]` [px]."""
    click: list[float]
    """One pixel of the object, `[x, y]` [px]: the program finds the outline around it."""
    stroke: list[list[float]]
    """A line drawn over the object, `[x, y]` [px] each: all of it is object."""
    size_m: list[float]
    """Length, width, height [m]."""
    name: str
    """What the object is, where the caption's words do not say it or say it badly: `mug`."""


@dataclass(frozen=True, kw_only=True)
class Crop:
    """Which part of the decoded pictures a clip's frames are."""

    box_px: tuple[int, int, int, int]
    """x0, y0, x1, y1 in the decoded pictures."""
    full_px: tuple[int, int]
    """Width and height of the decoded pictures."""

    def in_file(self, source_size_px: tuple[int, int]) -> tuple[float, float, float, float]:
        """Return the box in the file's pixels."""
        sx, sy = source_size_px[0] / self.full_px[0], source_size_px[1] / self.full_px[1]
        x0, y0, x1, y1 = self.box_px
        return x0 * sx, y0 * sy, x1 * sx, y1 * sy


@dataclass(frozen=True, kw_only=True)
class Clip:
    """One decoded video: upright RGB frames at an even spacing in time."""

    item: str
    """Identifier, unique in its folder: lower case letters, digits and underscores."""
    path: Path
    caption: str
    objects: tuple[str, ...]
    """Phrases for the objects, the manipulated one first where the person who wrote them did so."""
    hints: Mapping[str, Hint]
    """By object phrase. Frame numbers and pixels are those of `frames`, not of the file."""
    frames: UInt8[ndarray, "time h w 3"] = field(repr=False)
    fps: float
    """Frames per second of `frames`: frame i is what was seen i / fps seconds after the first."""
    total_frames: int
    """Frames that the file holds, before sampling."""
    source_fps: float
    """Frames per second of the file; its average where the rate varies."""
    source_frame: Int[ndarray, "time"] = field(repr=False)
    """The file's frame number behind each frame; a number repeats where the file pauses."""
    times_s: Float[ndarray, "time"] = field(repr=False)
    """When each frame was shown, from the first one [s]."""
    source_size_px: tuple[int, int]
    """Width and height as shown, before scaling."""
    to_filmed: Float[ndarray, "time 3 3"] | None = field(default=None, repr=False)
    """By frame: homography from its pixels to those that were filmed, where a swaying camera's frames were aligned."""
    crop: Crop | None = None
    """What is left of the pictures where black bars were cut off."""
    warnings: tuple[str, ...] = ()
    """Sentences for a person: what was odd about the file though it could be used."""

    @property
    def in_file_px(self) -> tuple[float, float, float, float]:
        """What the frames show: x0, y0, x1, y1 in the file's pixels."""
        if self.crop is None:
            return 0.0, 0.0, float(self.source_size_px[0]), float(self.source_size_px[1])
        return self.crop.in_file(self.source_size_px)

    @property
    def width_px(self) -> int:
        return self.frames.shape[2]

    @property
    def height_px(self) -> int:
        return self.frames.shape[1]

    @property
    def duration_s(self) -> float:
        return len(self.frames) / self.fps
