"""Pictures become H.264 and are put end to end: each episode is a stream of its own that any other can follow.

Masks are exact. A label goes straight to the luma that its grey has, chroma is constant, crf 0 loses nothing;
what comes out is decoded again and compared before it is used. The stream is what
LeRobot's own encoder makes of the same pictures with the same settings, less the way through PNG files.
"""

import io
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from v2p_data.episodes.dataset.features import FPS
from v2p_data.sim.render.masks import PALETTE

KEY_EVERY = 2
"""A frame is read by decoding two at most; a policy that looks at two frames on end reads two or three."""
MASK_CRF, RGB_CRF = 0, 18
"""0 loses nothing; 18 is more than enough for pictures that people and networks look at."""
PIX_FMT = "yuv420p"
CHROMA = 128
_GREYS = np.asarray(PALETTE)
LUMA = np.zeros(256, np.uint8)
LUMA[: len(PALETTE)] = np.round(16 + _GREYS * 219 / 255)
"""Limited-range luma of each label's grey. Every decoder's way back to RGB ends at that grey again."""


@dataclass(frozen=True, kw_only=True)
class Encoded:
    """One episode of one camera, an MP4 in memory."""

    mp4: bytes
    num_frames: int


def encode_masks(labels: UInt8[np.ndarray, "time h w"]) -> Encoded:
    """Return label images as lossless video of their greys.

    Raises:
        ValueError: a label has no grey, or height or width is odd.
        RuntimeError: what was encoded does not decode to the same labels.
    """
    count, height, width = labels.shape
    if labels.size and labels.max() >= len(PALETTE):
        raise ValueError(f"label {labels.max()} has no grey; labels go up to {len(PALETTE) - 1}")
    if height % 2 or width % 2:
        raise ValueError(f"video needs even height and width, got {height} x {width}")
    # One buffer for all frames: PyAV copies what it is given.
    plane = np.full((height * 3 // 2, width), CHROMA, np.uint8)

    def frames() -> Iterable[np.ndarray]:
        for image in labels:
            np.take(LUMA, image, out=plane[:height])
            yield plane

    mp4 = _encode(frames(), width, height, PIX_FMT, MASK_CRF)
    _check_masks(mp4, labels)
    return Encoded(mp4=mp4, num_frames=count)


def encode_rgb(pictures: UInt8[np.ndarray, "time h w 3"]) -> Encoded:
    """Return pictures as video that looks the same but is not equal."""
    count, height, width, _ = pictures.shape
    mp4 = _encode(pictures, width, height, "rgb24", RGB_CRF)
    return Encoded(mp4=mp4, num_frames=count)


def decode_rgb(mp4: bytes) -> UInt8[np.ndarray, "time h w 3"]:
    """Return all pictures of a video."""
    with _av().open(io.BytesIO(mp4)) as video:
        return np.stack([f.to_ndarray(format="rgb24") for f in video.decode(video=0)])


def join(parts: Iterable[Encoded], path: Path) -> None:
    """Write streams one after the other, packet by packet, as one file that is whole or absent.

    The parts are looked at once, in order, so that they need not be in memory together.

    Raises:
        RuntimeError: the streams need different decoders.
    """
    av = _av()
    temporary = path.with_name(path.name + ".tmp")
    frames = 0
    with av.open(str(temporary), "w", format="mp4", options={"movflags": "faststart"}) as made:
        into: Any = None
        extradata = b""
        for part in parts:
            with av.open(io.BytesIO(part.mp4)) as video:
                stream = video.streams.video[0]
                if into is None:
                    into = made.add_stream_from_template(stream, opaque=True)
                    into.time_base = stream.time_base
                    extradata = bytes(stream.codec_context.extradata or b"")
                elif bytes(stream.codec_context.extradata or b"") != extradata:
                    raise RuntimeError(f"a stream for {path} needs another decoder than the first")
                shift = round(frames / (FPS * stream.time_base))
                for packet in video.demux(stream):
                    if packet.dts is None:
                        continue
                    packet.pts += shift
                    packet.dts += shift
                    packet.stream = into
                    made.mux(packet)
            frames += part.num_frames
    with temporary.open("rb") as written:
        os.fsync(written.fileno())
    temporary.replace(path)


def cut(path: Path, spans: Iterable[tuple[int, int]]) -> Iterator[Encoded]:
    """Yield some spans of frames `[first, last)` of a file that `join` wrote, each as a stream of its own.

    Raises:
        ValueError: a span does not begin with a key frame, or its frames do not follow each other.
    """
    av = _av()
    with av.open(str(path)) as video:
        stream = video.streams.video[0]
        tick = 1 / (FPS * stream.time_base)
        packets = [p for p in video.demux(stream) if p.dts is not None]
        times = [p.pts for p in packets]
        for first, last in spans:
            wanted = [round(k * tick) for k in range(first, last)]
            if times[first:last] != wanted or not packets[first].is_keyframe:
                raise ValueError(f"has no key frame for frame {first}, or none for each after it")
            buffer = io.BytesIO()
            with av.open(buffer, "w", format="mp4") as made:
                into = made.add_stream_from_template(stream, opaque=True)
                into.time_base = stream.time_base
                for packet in packets[first:last]:
                    packet.pts -= wanted[0]
                    packet.dts -= wanted[0]
                    packet.stream = into
                    made.mux(packet)
            yield Encoded(mp4=buffer.getvalue(), num_frames=last - first)


def decoder_of(part: Encoded) -> bytes:
    """Return what sets up the decoder of a stream."""
    with _av().open(io.BytesIO(part.mp4)) as video:
        return bytes(video.streams.video[0].codec_context.extradata or b"")


def _av() -> Any:
    # LeRobot's module is this room's door to video; it takes seconds to import.
    from lerobot.datasets.video_utils import av

    av.logging.set_libav_level(
        av.logging.ERROR
    )  # LeRobot resets it, and x264 tells its whole life
    return av


def encoder_config(crf: int) -> Any:
    """Return these settings in LeRobot's words, for its metadata."""
    from lerobot.configs.video import RGBEncoderConfig

    return RGBEncoderConfig(vcodec="h264", crf=crf, pix_fmt=PIX_FMT, g=KEY_EVERY)


def _encode(
    frames: Iterable[np.ndarray], width: int, height: int, pix_fmt: str, crf: int
) -> bytes:
    av = _av()
    buffer = io.BytesIO()
    # One thread: the same episode gives the same bytes anywhere, and episodes are what runs in parallel.
    options = {"crf": str(crf), "g": str(KEY_EVERY), "threads": "1"}
    with av.open(buffer, "w", format="mp4") as made:
        stream = made.add_stream("h264", FPS, options=options)
        stream.pix_fmt, stream.width, stream.height = PIX_FMT, width, height
        for image in frames:
            made.mux(stream.encode(av.VideoFrame.from_ndarray(image, format=pix_fmt)))
        made.mux(stream.encode())
    return buffer.getvalue()


def _check_masks(mp4: bytes, labels: np.ndarray) -> None:
    height = labels.shape[1]
    count = 0
    with _av().open(io.BytesIO(mp4)) as video:
        for count, frame in enumerate(video.decode(video=0), start=1):
            planes = frame.to_ndarray()
            if count > len(labels):
                break
            same = np.array_equal(planes[:height], LUMA[labels[count - 1]])
            if not same or (planes[height:] != CHROMA).any():
                raise RuntimeError(f"frame {count - 1} does not come back as it was encoded")
    if count != len(labels):
        raise RuntimeError(f"{len(labels)} frames were encoded and {count} came back")
