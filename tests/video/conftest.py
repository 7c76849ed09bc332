"""Small videos, written frame by frame."""

from fractions import Fraction

import av
import numpy as np
import pytest


@pytest.fixture
def film(tmp_path):
    """Return a function that writes a video and returns its path."""

    def write(
        name="clip.mp4",
        frames=None,
        *,
        codec="libx264",
        pix_fmt="yuv420p",
        fps=30,
        pts_ms=None,
        options=None,
        aspect=None,
        container_options=None,
    ):
        frames = square_moves(20) if frames is None else frames
        path = tmp_path / name
        with av.open(str(path), "w", options=container_options or {}) as out:
            stream = out.add_stream(codec, rate=fps, options=options or {})
            stream.height, stream.width = frames[0].shape[:2]
            stream.pix_fmt = pix_fmt
            stream.codec_context.thread_count = 1
            if aspect:
                stream.codec_context.sample_aspect_ratio = Fraction(aspect)
            if pts_ms is not None:
                stream.codec_context.time_base = Fraction(1, 1000)
                stream.time_base = Fraction(1, 1000)
            for i, pixels in enumerate(frames):
                layout = {2: "gray", 3: "rgb24"}[pixels.ndim]
                if pixels.ndim == 3 and pixels.shape[2] == 4:
                    layout = "rgba"
                frame = av.VideoFrame.from_ndarray(pixels, format=layout)
                if pts_ms is not None:
                    frame.pts, frame.time_base = pts_ms[i], Fraction(1, 1000)
                out.mux(stream.encode(frame))
            out.mux(stream.encode(None))
        return path

    return write


def square_moves(count, height=96, width=128):
    """A red square goes from left to right over grey; frame i has it at 4 * i."""
    frames = []
    for i in range(count):
        pixels = np.full((height, width, 3), 120, np.uint8)
        pixels[32:64, 4 * i % (width - 32) : 4 * i % (width - 32) + 32] = (200, 30, 30)
        frames.append(pixels)
    return frames
