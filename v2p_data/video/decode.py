"""A video file becomes a clip: the only place that decodes video.

Reads whatever libav reads from a local file of a known container, one frame at a time. What comes
out is RGB, turned and mirrored the way a player shows it, scaled down, and evenly spaced in time.
Bytes that are no usable video end in an `ItemRejectedError`, never in a crash or an endless loop.
"""

import logging
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import av
import av.container
import av.error
import av.logging
import numpy as np
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from jaxtyping import Bool, Int, UInt8

from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.video.captions import VideoItem
from v2p_data.video.clip import Clip
from v2p_data.video.colours import Colours
from v2p_data.video.hints import check_hints, hints_in_clip
from v2p_data.video.tracks import (
    Orientation,
    Promise,
    film_stream,
    is_before_start,
    orientation_of,
    promise_of,
)

log = logging.getLogger(__name__)

_CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,avi,matroska,webm,gif,mpegts,mpeg,asf,flv,ogg"
"""What may be behind a known ending. Playlists are not among them: they name further files."""
_TRUNCATED = 0.8
"""Below this share of the promised frames a file counts as cut off."""
_UNEVEN = 1.5
"""A gap longer than this many usual gaps makes a file one with varying frame rate."""
_JUMP_S = 1.5
"""No picture of a motion stays for longer: pictures are missing, or the clock jumped."""
_COMBED = 0.2
"""Of the pixels that change, the share that stands out from the rows above and below alike. At most 0.13 in 36 clips as
they were filmed, at least 0.3 in the same clips with every second row from the next picture."""
_AS_WOVEN = 0.6
"""Share of the pixels that would stand out if a picture had the other rows of its neighbour: at most 0.21 in clips as
filmed, at least 2.8 in interlaced ones."""
_LEAST_COMBED = 200
"""Pixels, below which a share says nothing."""
_OTHER_SHAPE = 1.1
"""Width over height changes by less where a stream only changes its size, in whole blocks."""


@dataclass(frozen=True, kw_only=True)
class VideoConfig:
    """How videos are decoded."""

    max_side_px: int = 640
    """Longer sides are scaled down to this; nothing is scaled up."""
    max_frames: int = 150
    """A longer clip is thinned out evenly to this many frames."""
    min_frames: int = 8
    """With fewer frames no motion can be read."""
    min_side_px: int = 64
    """Smaller pictures show too little."""
    max_side_file_px: int = 8192
    """Longer sides are refused before memory is asked for."""
    max_file_mpx: float = 36.0
    """So are more megapixels: 8192 x 4320 is the most that H.264 knows, and a decoder holds several pictures."""
    max_duration_s: float = 120.0
    """A clip shows one motion; longer recordings are to be cut."""
    max_decode_s: float = 120.0
    """A file that takes more processor time to decode is given up: the longest clip in its own time. What else
    the machine does has no say in it."""

    def __post_init__(self) -> None:
        if not 64 <= self.max_side_px <= 4096:
            raise ValueError(f"max_side_px must lie in 64..4096, got {self.max_side_px}")
        if not 2 <= self.min_frames <= self.max_frames:
            raise ValueError(
                f"need 2 <= min_frames <= max_frames, got {self.min_frames} and {self.max_frames}"
            )
        if not 16 <= self.min_side_px <= self.max_side_px:
            raise ValueError(
                f"need 16 <= min_side_px <= max_side_px, got {self.min_side_px} and {self.max_side_px}"
            )
        if min(self.max_duration_s, self.max_decode_s, self.max_file_mpx) <= 0:
            raise ValueError(
                f"max_duration_s, max_decode_s and max_file_mpx must be positive, "
                f"got {self.max_duration_s}, {self.max_decode_s} and {self.max_file_mpx}"
            )


def read_clip(item: VideoItem, cfg: VideoConfig = VideoConfig()) -> Clip:
    """Decode one video.

    Raises:
        ItemRejectedError: `empty_file`, `unreadable`, `truncated`, `no_video_stream`, `odd_angle`, `too_few_frames`,
            `picture_turns`, `interlaced`, `too_small`, `too_large`, `too_long` or `too_slow`; `bad_hint` where a hint
            marks what the video does not have.
    """
    film = _decode(item.path, cfg)
    total = film.seen
    name = item.path.name
    warnings = _demand_usable(film, name, cfg)
    try:
        check_hints(item.hints, film.shown_px, total, name)
    except V2PError as error:
        raise ItemRejectedError("bad_hint", str(error)) from error
    for warning in warnings:
        log.warning("%s", warning)

    chosen, fps = _even(film.times_s, film.duration_s, total, cfg.max_frames)
    source_frame = np.array([film.numbers[i] for i in chosen])
    frames = film.take(chosen)
    return Clip(
        item=item.item,
        path=item.path,
        caption=item.caption,
        objects=item.objects,
        hints=hints_in_clip(
            item.hints, (frames.shape[2], frames.shape[1]), film.shown_px, source_frame
        ),
        frames=frames,
        fps=fps,
        total_frames=total,
        source_fps=(total - 1) / film.duration_s,
        source_frame=source_frame,
        times_s=np.arange(len(frames)) / fps,
        source_size_px=film.shown_px,
        warnings=tuple(warnings),
    )


@dataclass
class _Film:
    """What one pass over a file gathers: at most `2 * max_frames` pictures, all in one piece of memory."""

    promise: Promise
    notes: tuple[str, ...]
    """Sentences for a person about the choice of the stream and its colours."""
    seen: int = 0
    begins_s: float = math.inf
    """When the first packet so far is shown that no edit list hides."""
    headless_s: float = 0.0
    """How long the file lasts before its first whole picture."""
    broken: int = 0
    """Packets that could not be decoded."""
    pixels: UInt8[np.ndarray, "room h w 3"] = field(
        default_factory=lambda: np.empty((0, 0, 0, 3), np.uint8)
    )
    """The kept pictures, then room for more."""
    numbers: list[int] = field(default_factory=list[int])
    """The file's frame number of each kept picture."""
    times_s: list[float] = field(default_factory=list[float])
    """When each kept picture is shown, from the first one."""
    duration_s: float = 0.0
    """From the first frame to the last."""
    jumps: int = 0
    jumped_s: float = 0.0
    """How long there was no picture; left out of the times."""
    jump_at_s: float = 0.0
    """When the last of the jumps began."""
    shown_px: tuple[int, int] = (0, 0)
    changed_px: int = 0
    """Pixels in some columns of all kept pictures that differ from the picture before."""
    combed_px: int = 0
    """Those among them that stand out from the rows above and below alike."""
    woven_px: tuple[int, int] = (0, 0)
    """The same with the odd rows of the picture before, and with its even rows."""
    brightness: Int[np.ndarray, "h some"] = field(
        default_factory=lambda: np.empty((0, 0), np.int16)
    )
    """Some columns of the last kept picture, as stored."""

    @property
    def is_cut(self) -> bool:
        """Whether the end is missing: too few frames for the film's rate, and too early a last one.

        A last picture may be shown for long, and the rate may vary, so neither is enough by itself.
        """
        few = self.seen < _TRUNCATED * self.promise.frames
        early = (
            self.headless_s + self.duration_s + self.jumped_s < _TRUNCATED * self.promise.seconds
        )
        return few and (early or not self.promise.seconds)

    @property
    def is_interlaced(self) -> bool:
        least = max(_LEAST_COMBED, _COMBED * self.changed_px, _AS_WOVEN * min(self.woven_px))
        return self.combed_px > least

    def keep(self, pixels: UInt8[np.ndarray, "h w 3"], time_s: float, most: int) -> None:
        """Add the picture seen last; there is room for `most`."""
        if not self.numbers:
            self.pixels = np.empty((most, *pixels.shape), np.uint8)
        self.pixels[len(self.numbers)] = pixels
        self.numbers.append(self.seen - 1)
        self.times_s.append(time_s)

    def compare(self, frame: VideoFrame) -> None:
        """Look for combs, the mark of two moments in one picture, in what changed since the last kept one."""
        if frame.format.is_rgb:  # of a screen; what a GIF mixes of few colours looks alike
            return
        columns = slice(None, None, max(1, frame.width // 256))
        before = self.brightness
        now = frame.reformat(format="gray").to_ndarray()[:, columns].astype(np.int16)
        self.brightness = now
        if now.shape == before.shape:
            changed = np.abs(now - before)[1:-1] > 20
            is_odd = np.arange(len(now))[:, None] % 2 == 1
            woven = [np.where(is_odd, *pair) for pair in ((before, now), (now, before))]
            one, other = (int((changed & _combs(rows)).sum()) for rows in woven)
            self.changed_px += int(changed.sum())
            self.combed_px += int((changed & _combs(now)).sum())
            self.woven_px = self.woven_px[0] + one, self.woven_px[1] + other

    def halve(self) -> None:
        """Keep every other picture."""
        self.numbers, self.times_s = self.numbers[::2], self.times_s[::2]
        for i in range(len(self.numbers)):
            self.pixels[i] = self.pixels[2 * i]

    def take(self, chosen: Int[np.ndarray, "time"]) -> UInt8[np.ndarray, "time h w 3"]:
        """Return the chosen pictures, and give the others' memory back; afterwards none is kept."""
        if (chosen < np.arange(len(chosen))).any():  # a pause: some are shown several times
            return self.pixels[chosen]
        for i, at in enumerate(chosen):
            self.pixels[i] = self.pixels[at]
        taken, self.pixels = self.pixels, self.pixels[:0].copy()
        taken.resize((len(chosen), *taken.shape[1:]), refcheck=False)
        return taken


def _combs(brightness: Int[np.ndarray, "h w"]) -> Bool[np.ndarray, "inner w"]:
    """Return which pixels differ from the rows above and below alike; the first and the last row are left out."""
    above, below = brightness[1:-1] - brightness[:-2], brightness[1:-1] - brightness[2:]
    return (np.minimum(np.abs(above), np.abs(below)) > 15) & ((above > 0) == (below > 0))


def _demand_usable(film: _Film, name: str, cfg: VideoConfig) -> list[str]:
    """Return what a person should know of a film; refuse one whose pictures do not show a motion."""
    total = film.seen
    warnings = [*film.notes]
    if film.is_cut:
        detail = f"{name} is cut off: {total} of about {film.promise.frames} frames can be decoded"
        if total < cfg.min_frames:
            raise ItemRejectedError("truncated", f"{detail}; copy it again", float(total))
        warnings.append(f"{detail}; the rest of the motion is missing")
    elif film.headless_s and total >= cfg.min_frames:
        warnings.append(
            f"{name} begins between two key pictures: its first {film.headless_s:.2f} s hold no whole picture and are "
            "left out"
        )
    elif film.broken and total >= cfg.min_frames:
        warnings.append(f"{name} has {film.broken} damaged places; frames there may be missing")
    if film.jumps:
        warnings.append(
            f"{name} has no picture for {film.jumped_s:.1f} s in all, in {film.jumps} places, the last after "
            f"{film.jump_at_s:.1f} s; what moved meanwhile is not seen, and its pictures are taken to follow one "
            "another"
        )
    if total < cfg.min_frames:
        if film.broken:
            raise ItemRejectedError(
                "unreadable",
                f"{name} is damaged: only {total} frames can be decoded; copy it again, from a key picture on",
                float(total),
            )
        raise ItemRejectedError(
            "too_few_frames",
            f"{name} has {total} frames; at least {cfg.min_frames} are needed to see a motion",
            float(total),
        )
    if len(film.numbers) < cfg.min_frames:
        raise ItemRejectedError(
            "unreadable",
            f"{name} holds pictures that cannot be shown: {len(film.numbers)} of {total} can",
            float(len(film.numbers)),
        )
    if film.is_interlaced:
        share = film.combed_px / film.changed_px
        raise ItemRejectedError(
            "interlaced",
            f"{name} is interlaced: every second row shows another moment in {share:.0%} of the "
            "picture that changes; make whole "
            f"pictures of it: ffmpeg -i {name} -vf bwdif whole.mp4",
            share,
        )
    return warnings


def _decode(path: Path, cfg: VideoConfig) -> _Film:
    level = av.logging.get_level()
    # libav would write its remarks on damaged files to the terminal; what matters is in our own sentences
    av.logging.set_level(av.logging.PANIC)
    try:
        container = _opened(path, cfg)
        try:
            return _film_of(container, path, cfg)
        finally:
            container.close()
    finally:
        av.logging.set_level(level)


def _opened(path: Path, cfg: VideoConfig) -> "av.container.InputContainer":
    if path.is_file() and path.stat().st_size == 0:
        raise ItemRejectedError(
            "empty_file", f"{path.name} holds not one byte; copy it again", 0.0
        )
    try:
        return av.open(
            f"file:{path.resolve()}",
            mode="r",
            container_options={
                "format_whitelist": _CONTAINERS,
                "protocol_whitelist": "file",
            },
            timeout=(cfg.max_decode_s, cfg.max_decode_s),
            metadata_errors="ignore",
        )
    except (av.error.FFmpegError, OSError, ValueError) as error:
        if _is_cut_mp4(path):
            raise ItemRejectedError(
                "truncated",
                f"{path.name} is cut off: its index, which stands at the end, is missing; copy it again",
            ) from error
        raise ItemRejectedError(
            "unreadable", f"{path.name} is no video that can be read ({_said(error)})"
        ) from error


def _film_of(container: "av.container.InputContainer", path: Path, cfg: VideoConfig) -> _Film:
    stream, notes = film_stream(container, path)
    _check_size(path, stream.codec_context.width, stream.codec_context.height, cfg, low=False)
    # threads would reorder what a damaged file gives
    stream.codec_context.thread_count = 1
    stream.codec_context.options = {"max_pixels": str(round(cfg.max_file_mpx * 1e6))}
    rate = stream.average_rate or stream.guessed_rate or Fraction(30)
    promise = promise_of(container, stream, rate)
    _check_duration(path, promise.seconds, cfg)
    film = _Film(promise=promise, notes=notes)
    step = 0.0
    picture: _Picture | None = None
    for seen_s, frame in _timed_frames(container, stream, float(rate) or 30.0, film, cfg, path):
        _check_duration(path, seen_s, cfg)
        if picture is None:
            picture = _Picture.of(path, frame, stream, cfg)
            film.shown_px = picture.shown_px
            film.notes += (f"{path.name} {picture.colours.note}",) if picture.colours.note else ()
        picture.check_shape(path, frame, seen_s)
        if film.times_s and seen_s - film.times_s[-1] < 0.75 * step:
            del frame
            continue
        try:
            pixels = picture.rgb(frame)
            film.compare(frame)
        except (av.error.FFmpegError, ValueError, MemoryError):
            film.broken += 1
            continue
        finally:
            del frame
        film.keep(pixels, seen_s, 2 * cfg.max_frames)
        if len(film.numbers) >= 2 * cfg.max_frames:
            film.halve()
            step = 2 * step if step else 2 * seen_s / (2 * cfg.max_frames - 1)
    return film


def _timed_frames(
    container: "av.container.InputContainer",
    stream: VideoStream,
    rate: float,
    film: _Film,
    cfg: VideoConfig,
    path: Path,
) -> Iterator[tuple[float, VideoFrame]]:
    """Yield every frame with its time from the first; count them, and the packets that fail, in `film`."""
    deadline = time.thread_time() + cfg.max_decode_s
    start: float | None = None
    last, gap, begun = 0.0, 1 / rate, False
    for packet in _packets(container, stream, film):
        if time.thread_time() > deadline:
            raise ItemRejectedError(
                "too_slow",
                f"{path.name} takes more than {cfg.max_decode_s:g} s of processor time to decode; make it smaller",
                float(film.seen),
            )
        try:
            frames = packet.decode()
        except (av.error.FFmpegError, ValueError, MemoryError):
            film.broken += 1
            continue
        begun = begun or (packet.is_keyframe and packet.is_discard)  # an edit list hides it
        # a picture of 8K takes 50 to 100 MB: none is held while the next one is decoded
        while frames:
            frame = frames.pop(0)
            if not isinstance(frame, VideoFrame):
                continue
            begun = begun or bool(frame.key_frame)
            if is_before_start(container, frame):
                continue
            if not begun:
                film.broken += 1
                continue
            if start is None:
                start = frame.time or 0.0
                film.headless_s = max(0.0, start - film.begins_s)
            else:
                shown = last if frame.time is None else frame.time - start
                if shown <= last:  # no time, the same one again, or an earlier one
                    last += gap
                elif shown - last > _JUMP_S + gap:
                    film.jumps += 1
                    film.jumped_s += shown - last - gap
                    film.jump_at_s = last
                    start += shown - last - gap
                    last += gap
                else:  # a jump makes the container's mean rate too low
                    last, gap = shown, min(1 / rate, shown - last)
            film.seen += 1
            film.duration_s = last
            yield last, frame
            del frame


def _packets(
    container: "av.container.InputContainer", stream: VideoStream, film: _Film
) -> Iterator["av.Packet"]:
    try:
        for packet in container.demux(stream):
            if packet.pts is not None:
                film.begins_s = min(film.begins_s, max(0.0, float(packet.pts * packet.time_base)))
            yield packet
    except (av.error.FFmpegError, ValueError, MemoryError):
        film.broken += 1


@dataclass(frozen=True, kw_only=True)
class _Picture:
    """How the frames of one file become pictures of one size."""

    stored_px: tuple[int, int]
    width_px: int
    height_px: int
    orientation: Orientation
    """Applied after scaling."""
    colours: Colours
    shown_px: tuple[int, int]

    @staticmethod
    def of(path: Path, frame: VideoFrame, stream: VideoStream, cfg: VideoConfig) -> "_Picture":
        aspect = float(stream.sample_aspect_ratio or 1)
        aspect = aspect if 0.25 <= aspect <= 4 else 1.0
        width, height = frame.width * aspect, float(frame.height)
        _check_size(path, round(width), round(height), cfg)
        scale = min(1.0, cfg.max_side_px / max(width, height))
        orientation = orientation_of(frame, path)
        shown = round(width), round(height)
        return _Picture(
            stored_px=(frame.width, frame.height),
            width_px=max(2, 2 * round(width * scale / 2)),
            height_px=max(2, 2 * round(height * scale / 2)),
            orientation=orientation,
            colours=Colours.of(frame, stream),
            shown_px=(shown[1], shown[0]) if orientation.swaps_axes else shown,
        )

    def check_shape(self, path: Path, frame: VideoFrame, time_s: float) -> None:
        """Refuse a frame that would be stretched, or shown turned in another way than the first one."""
        width, height = self.stored_px
        change = (frame.width * height) / (frame.height * width)
        if (
            not 1 / _OTHER_SHAPE < change < _OTHER_SHAPE
            or orientation_of(frame, path) != self.orientation
        ):
            raise ItemRejectedError(
                "picture_turns",
                f"{path.name} changes the shape or the turn of its picture at {time_s:.2f} s, from {width} x {height} "
                f"to {frame.width} x {frame.height} px as stored; cut it there",
                time_s,
            )

    def rgb(self, frame: VideoFrame) -> UInt8[np.ndarray, "h w 3"]:
        """Return the frame as a player shows it; what is transparent is white."""
        alpha = frame.format.name == "pal8" or any(c.is_alpha for c in frame.format.components)
        same = (frame.width, frame.height) == (self.width_px, self.height_px)
        # without scaling, the exact values; else the mean of the pixels that fall together
        scaled = frame.reformat(
            width=self.width_px,
            height=self.height_px,
            format="rgba" if alpha else "rgb24" if self.colours.is_plain else "rgb48le",
            interpolation="BICUBIC" if same else "AREA",
            **self.colours.reformat,
        ).to_ndarray()
        if not alpha and not self.colours.is_plain:
            scaled = self.colours.on_screen(scaled)
        if alpha:
            opacity = scaled[..., 3:].astype(np.uint16)
            white = 255 * (255 - opacity)
            scaled = ((scaled[..., :3] * opacity + white + 127) // 255).astype(np.uint8)
        return self.orientation.shown(scaled)


def _even(
    times_s: list[float], duration_s: float, total: int, max_frames: int
) -> tuple[Int[np.ndarray, "time"], float]:
    """Return which pictures to take, and at what rate, so that they are evenly spaced in time."""
    times = np.asarray(times_s)
    gaps = np.diff(times)
    usual = float(np.median(gaps))
    end = float(times[-1])
    if len(times) == total and float(gaps.max()) < _UNEVEN * usual and total <= max_frames:
        return np.arange(total), (total - 1) / end
    count = min(max_frames, max(2, round(end / usual) + 1))
    due = np.linspace(0.0, end, count)
    # a player shows a picture until the next one is due
    chosen = np.searchsorted(times, due + usual / 2, side="right") - 1
    return chosen.clip(0, len(times) - 1), (count - 1) / end


def _check_size(path: Path, width: int, height: int, cfg: VideoConfig, low: bool = True) -> None:
    if low and min(width, height) < cfg.min_side_px:
        raise ItemRejectedError(
            "too_small",
            f"{path.name} is {width} x {height} px; each side needs {cfg.min_side_px}",
            float(min(width, height)),
        )
    if width * height > 1e6 * cfg.max_file_mpx:
        raise ItemRejectedError(
            "too_large",
            f"{path.name} has pictures of {width * height / 1e6:.0f} megapixels; at most "
            f"{cfg.max_file_mpx:g} are read",
            float(width * height / 1e6),
        )
    if max(width, height) > cfg.max_side_file_px:
        raise ItemRejectedError(
            "too_large",
            f"{path.name} is {width} x {height} px; at most {cfg.max_side_file_px} are read",
            float(max(width, height)),
        )


def _check_duration(path: Path, seconds: float, cfg: VideoConfig) -> None:
    if seconds > cfg.max_duration_s:
        raise ItemRejectedError(
            "too_long",
            f"{path.name} is {seconds:.0f} s long; cut it to one motion of at most "
            f"{cfg.max_duration_s:g} s",
            seconds,
        )


def _is_cut_mp4(path: Path) -> bool:
    """Tell whether the file begins like an mp4 or mov but lacks the index."""
    try:
        with path.open("rb") as file:
            if file.read(8)[4:] != b"ftyp":
                return False
            size = path.stat().st_size
            at, boxes = 0, 0
            while at + 8 <= size and boxes < 1000:
                file.seek(at)
                head = file.read(16)
                length, kind = int.from_bytes(head[:4], "big"), head[4:8]
                if kind == b"moov":
                    return at + length > size
                length = int.from_bytes(head[8:16], "big") if length == 1 else length
                if length < 8:
                    return False
                at, boxes = at + length, boxes + 1
            return True
    except OSError:
        return False


def _said(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error) or type(error).__name__
