"""Folders of odd and damaged videos, captions, labels and boxes, as other people's are.

Each is made anew, by PyAV and by hand.

`odd_folders()` gives pairs of a name and a function that fills an empty folder. Whatever reads such a folder ends in
clips, or in a `V2PError` whose sentence names the file.
"""

import json
import struct
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import odd_captions
from av.stream import Disposition

Fill = Callable[[Path], object]
PLAIN = "lift_red_box.mp4"
UNIT = 65536
"""One, in the 16.16 fixed point of an mp4's matrices."""
EIGHT_WAYS = {
    "upright": (1, 0, 0, 1),
    "mirrored": (-1, 0, 0, 1),
    "upside_down": (-1, 0, 0, -1),
    "mirrored_upside_down": (1, 0, 0, -1),
    "right": (0, 1, -1, 0),
    "left": (0, -1, 1, 0),
    "transposed": (0, 1, 1, 0),
    "transposed_upside_down": (0, -1, -1, 0),
}
"""a, b, c, d of the matrix: a stored pixel (x, y) is shown at (a x + c y, b x + d y), shifted into view."""


def squares(count: int, height: int = 96, width: int = 128) -> list[np.ndarray]:
    """Return pictures of a red square that goes from left to right over grey; frame i has it at 4 * i."""
    pictures = []
    for i in range(count):
        pixels = np.full((height, width, 3), 120, np.uint8)
        pixels[32:64, 4 * i % (width - 32) : 4 * i % (width - 32) + 32] = (200, 30, 30)
        pictures.append(pixels)
    return pictures


def write_film(
    path: Path,
    frames: Sequence[np.ndarray] | None = None,
    *,
    codec: str = "libx264",
    pix_fmt: str = "yuv420p",
    fps: int = 30,
    pts_ms: Sequence[int] | None = None,
    options: dict[str, str] | None = None,
    aspect: str | None = None,
    container_options: dict[str, str] | None = None,
    sound_s: float = 0.0,
    cover: bool = False,
    second: Sequence[np.ndarray] | None = None,
) -> Path:
    """Write a video frame by frame, beside it a sound, a cover picture before it, or another film after it."""
    frames = squares(20) if frames is None else frames
    with av.open(str(path), "w", options=container_options or {}) as out:
        picture: Any = out.add_stream("mjpeg", rate=1) if cover else None
        if picture is not None:
            picture.width, picture.height, picture.pix_fmt = 96, 96, "yuvj420p"
            picture.disposition = Disposition.attached_pic.value
        stream: Any = out.add_stream(codec, rate=fps, options=options or {})
        _shape(stream, frames[0], pix_fmt)
        if aspect:
            stream.codec_context.sample_aspect_ratio = Fraction(aspect)
        if pts_ms is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
            stream.time_base = Fraction(1, 1000)
        other: Any = out.add_stream(codec, rate=fps) if second is not None else None
        if other is not None and second is not None:
            _shape(other, second[0], pix_fmt)
        sound: Any = out.add_stream("aac", rate=8000, layout="mono") if sound_s else None
        if picture is not None:
            green = np.full((96, 96, 3), (0, 255, 0), np.uint8)
            out.mux(picture.encode(av.VideoFrame.from_ndarray(green).reformat(format="yuvj420p")))
        for i, pixels in enumerate(frames):
            layout = {2: "gray", 3: "rgb24"}[pixels.ndim]
            if pixels.ndim == 3 and pixels.shape[2] == 4:
                layout = "rgba"
            frame = av.VideoFrame.from_ndarray(pixels, format=layout)
            if pts_ms is not None:
                frame.pts, frame.time_base = pts_ms[i], Fraction(1, 1000)
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
        if other is not None:
            for pixels in second or ():
                out.mux(other.encode(av.VideoFrame.from_ndarray(pixels)))
            out.mux(other.encode(None))
        if sound is not None:
            for at in range(0, int(8000 * sound_s), 1024):
                silence = av.AudioFrame.from_ndarray(
                    np.zeros((1, 1024), np.float32), "fltp", "mono"
                )
                silence.sample_rate, silence.pts = 8000, at
                out.mux(sound.encode(silence))
            out.mux(sound.encode(None))
    return path


def _shape(stream: Any, picture: np.ndarray, pix_fmt: str) -> None:
    stream.height, stream.width = picture.shape[:2]
    stream.pix_fmt = pix_fmt
    stream.codec_context.thread_count = 1


def set_matrix(path: Path, a: float, b: float, c: float, d: float) -> Path:
    """Write the matrix of the first track's header (ISO 14496-12, 8.3.2)."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 40
    values = [a, b, 0, c, d, 0, 0, 0]
    data[at : at + 32] = struct.pack(">8i", *(round(v * UNIT) for v in values))
    path.write_bytes(data)
    return path


def set_edit(path: Path, first_s: float, seconds: float) -> Path:
    """Cut the film without encoding it anew: its edit list (ISO 14496-12, 8.6.6) plays a part of it."""
    data = bytearray(path.read_bytes())
    at = data.index(b"elst") + 8
    mdhd = data.index(b"mdhd") + 4 + 12
    rate = struct.unpack(">I", data[mdhd : mdhd + 4])[0]
    _, start = struct.unpack(">Ii", data[at + 4 : at + 12])
    data[at + 4 : at + 12] = struct.pack(
        ">Ii", round(1000 * seconds), start + round(rate * first_s)
    )
    path.write_bytes(data)
    return path


def put_cover_first(path: Path) -> Path:
    """Move the description of an mp4, which holds its cover, before its tracks, so that a reader meets it first."""
    data = path.read_bytes()
    trak, udta = data.index(b"trak") - 4, data.index(b"udta") - 4
    (size,) = struct.unpack(">I", data[udta : udta + 4])
    path.write_bytes(
        data[:trak] + data[udta : udta + size] + data[trak:udta] + data[udta + size :]
    )
    return path


def odd_folders() -> Iterator[tuple[str, Fill]]:
    """Yield a name and a function that fills an empty folder, for every oddity."""
    yield from _odd_films()
    yield from _odd_bytes()
    for name, content in _odd_captions().items():
        yield f"captions_{name}", _with_json("captions.json", content)
    for name, (file, content) in odd_captions.REFUSED.items():
        yield f"captions_{name}", lambda folder, f=file, c=content: _refused(folder, f, c)
    for name, content in _odd_labels().items():
        yield f"labels_{name}", _with_json("labels.json", content)
    for name, hint in _odd_boxes().items():
        entry = {
            "caption": "Lifting red box up",
            "objects": ["red box"],
            "hints": {"red box": hint},
        }
        yield f"boxes_{name}", _with_json("captions.json", {PLAIN: entry})
    yield from _odd_names()


def _refused(folder: Path, file: str, content: bytes) -> None:
    (folder / PLAIN).touch()  # never opened
    (folder / file).write_bytes(content)


def _with_json(file: str, content: Any) -> Fill:
    def fill(folder: Path) -> None:
        write_film(folder / PLAIN)
        data = content if isinstance(content, bytes) else json.dumps(content).encode()
        (folder / file).write_bytes(data)

    return fill


def _odd_films() -> Iterator[tuple[str, Fill]]:
    for name, matrix in EIGHT_WAYS.items():
        yield f"film_{name}", lambda folder, m=matrix: set_matrix(write_film(folder / PLAIN), *m)
    yield (
        "film_leaning",
        lambda folder: set_matrix(write_film(folder / PLAIN), 0.8, 0.6, -0.6, 0.8),
    )
    yield "film_slanted", lambda folder: set_matrix(write_film(folder / PLAIN), 1, 0, 1, 1)
    yield "film_flat_matrix", lambda folder: set_matrix(write_film(folder / PLAIN), 0, 0, 0, 0)
    yield "film_one_axis", lambda folder: set_matrix(write_film(folder / PLAIN), 1, 0, 1, 0)
    for suffix in ("mp4", "mkv"):
        yield f"cover_{suffix}", lambda folder, s=suffix: write_film(folder / f"a.{s}", cover=True)
    yield "cover_first", lambda folder: put_cover_first(write_film(folder / PLAIN, cover=True))
    yield "cover_only", lambda folder: write_film(folder / "a.mkv", squares(1))
    yield "two_films", lambda folder: write_film(folder / PLAIN, second=squares(20, 192, 256))
    for suffix in ("mp4", "mkv", "mov"):
        yield (
            f"sound_outlasts_{suffix}",
            lambda folder, s=suffix: write_film(folder / f"a.{s}", sound_s=3),
        )
    yield "trimmed", lambda folder: set_edit(write_film(folder / PLAIN, squares(60)), 0.5, 1)
    yield "trimmed_to_nothing", lambda folder: set_edit(write_film(folder / PLAIN), 0.5, 0.01)
    yield "trimmed_beyond_its_end", lambda folder: set_edit(write_film(folder / PLAIN), 99, 1)
    fragments = {"movflags": "frag_keyframe+empty_moov+delay_moov"}
    yield (
        "trimmed_fragments",
        lambda folder: set_edit(
            write_film(folder / PLAIN, squares(60), container_options=fragments), 0.5, 0
        ),
    )
    pause = [100 * i for i in range(19)] + [9000]
    yield (
        "pause",
        lambda folder: write_film(folder / "a.mkv", codec="ffv1", pix_fmt="yuv444p", pts_ms=pause),
    )
    yield "one_frame_a_second", lambda folder: write_film(folder / PLAIN, fps=1)
    yield "thousand_frames_a_second", lambda folder: write_film(folder / PLAIN, fps=1000)


def _odd_bytes() -> Iterator[tuple[str, Fill]]:
    def changed(change: Callable[[bytes], bytes]) -> Fill:
        def fill(folder: Path) -> None:
            path = write_film(folder / PLAIN)
            path.write_bytes(change(path.read_bytes()))

        return fill

    yield "empty", lambda folder: (folder / PLAIN).touch()
    yield "text", lambda folder: (folder / "letter.TS").write_text("let x = 1;\n" * 200)
    yield "cut_in_half", changed(lambda data: data[: len(data) // 2])
    yield "cut_last_byte", changed(lambda data: data[:-1])
    yield "zeros_in_the_middle", changed(lambda d: d[:500] + bytes(500) + d[1000:])
    yield "twice", changed(lambda data: data + data)
    yield "no_index", changed(lambda data: data.replace(b"moov", b"free"))
    yield "unknown_codec", changed(lambda data: data.replace(b"avc1", b"xxxx"))
    yield "endless", changed(lambda data: data.replace(b"stts", b"stts\0\0\0\0\0\0\0\1"))
    yield (
        "picture",
        lambda folder: (folder / PLAIN).write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(1000)),
    )
    yield "broken_link", lambda folder: (folder / PLAIN).symlink_to(folder / "nowhere.mp4")
    yield "folder_named_mp4", lambda folder: (folder / PLAIN).mkdir()
    yield "nothing", lambda folder: None


def _odd_captions() -> dict[str, Any]:
    return {
        "no_json": b"{",
        "nothing": b"",
        "byte_order_mark": b"\xef\xbb\xbf" + json.dumps({PLAIN: "Lifting red box up"}).encode(),
        "utf16": json.dumps({PLAIN: "Lifting red box up"}).encode("utf-16"),
        "latin1": '{"lift_red_box.mp4": "caf\xe9"}'.encode("latin-1"),
        "deep": b"[" * 100_000,
        "huge_number": b'{"lift_red_box.mp4": ' + b"9" * 5000 + b"}",
        "list": [],
        "null": {PLAIN: None},
        "half_a_character": b'{"lift_red_box.mp4": "Lifting red box \\ud83d up"}',
        "half_a_character_as_name": b'{"\\ud83d.mp4": "Lifting red box up"}',
        "control_characters": {PLAIN: "Lifting\x00red\x07box\x1b[31m up"},
        "right_to_left": {PLAIN: "\u0631\u0641\u0639 \u0627\u0644\u0635\u0646\u062f\u0648\u0642"},
        "no_letters": {PLAIN: "... !"},
        "a_book": {PLAIN: "Lifting red box up, " * 20_000},
        "as_long_as_allowed": {PLAIN: ("from left to right so that " * 80)[:1990]},
        "brackets": {PLAIN: "Lifting [red box] up"},
        "another_file": {"other.mp4": "Lifting red box up"},
        "path": {f"videos/{PLAIN}": "Lifting red box up"},
        "objects_of_numbers": {PLAIN: {"caption": "Lifting red box up", "objects": [1]}},
        "hint_for_nothing": {PLAIN: {"caption": "Lifting up", "hints": {"": {"frame": 0}}}},
    }


def _odd_labels() -> dict[str, Any]:
    stem = Path(PLAIN).stem
    slots = "Putting [something] next to [something]"
    return {
        "one_without_label": [{"id": 7}, {"id": stem, "label": "lifting red box up"}],
        "none_with_label": [{"id": stem}, {"id": 8}],
        "without_id": [{"label": "lifting"}, {"id": stem, "label": "lifting red box up"}],
        "odd_ids": [
            {"id": None, "label": "x"},
            {"id": [1], "label": "x"},
            {"id": 1.5, "label": "x"},
        ],
        "too_few": [{"id": stem, "template": slots, "placeholders": ["red box"]}],
        "too_many": [{"id": stem, "template": slots, "placeholders": ["a", "b", "c"]}],
        "none": [{"id": stem, "template": slots}],
        "brackets": [{"id": stem, "template": slots, "placeholders": ["box [red]", "can"]}],
        "equal": [{"id": stem, "template": slots, "placeholders": ["cup", "cup"]}],
        "three_equal": [
            {"id": stem, "label": "cup Cup CUP", "placeholders": ["cup", "Cup", "CUP"]}
        ],
        "empty_words": [{"id": stem, "label": "lifting red box", "placeholders": [""]}],
        "placeholders_of_text": [{"id": stem, "label": "lifting red box", "placeholders": "box"}],
        "label_of_numbers": [{"id": stem, "label": 3, "placeholders": ["box"]}],
        "backslashes": [{"id": stem, "template": slots, "placeholders": ["\\1", "\\g<0>x"]}],
        "no_json": b"[{",
        "nothing": b"",
        "unrelated": {"a": 1},
        "numbers": [1, 2, 3],
        "deep": b"[" * 100_000,
    }


def _odd_boxes() -> dict[str, Any]:
    return {
        "fractions": {"box": [0.2, 0.3, 0.5, 0.6]},
        "whole_picture_as_fractions": {"box": [0, 0, 1, 1]},
        "x_y_width_height": {"box": [80, 32, 32, 30]},
        "thousandths": {"box": [200, 300, 500, 900]},
        "turned_round": {"box": [60, 60, 20, 20]},
        "outside": {"box": [120, 80, 300, 200]},
        "negative": {"box": [-5, 10, 20, 30]},
        "no_area": {"box": [20, 20, 20, 20]},
        "infinite": {"box": [0, 0, float("inf"), 9]},
        "not_a_number": {"box": [0, 0, float("nan"), 9]},
        "text": {"box": ["0", "0", "9", "9"]},
        "nested": {"box": [[0, 0], [9, 9]]},
        "object": {"box": {"x": 1, "y": 2, "w": 3, "h": 4}},
        "point_fractions": {"points": [[0.25, 0.5]]},
        "point_outside": {"points": [[400, 3]]},
        "late_frame": {"frame": 99, "box": [10, 10, 50, 50]},
        "whole_picture": {"box": [0, 0, 128, 96]},
        "size_in_mm": {"size_m": [60, 60, 120]},
    }


def _odd_names() -> Iterator[tuple[str, Fill]]:
    composed = unicodedata.normalize("NFC", "café_lift.mp4")
    apart = unicodedata.normalize("NFD", composed)

    def other_form(folder: Path) -> None:
        write_film(folder / apart)
        (folder / "captions.json").write_text(json.dumps({composed: "Lifting red box up"}))

    def both_forms(folder: Path) -> None:
        write_film(folder / apart)
        words = {composed: "Lifting red box up", apart: "Lifting red box"}
        (folder / "captions.json").write_text(json.dumps(words))

    yield "name_in_another_normal_form", other_form
    yield "name_in_both_normal_forms", both_forms
    for name in ("CLIP.MP4", "clip.M4V", "a b\tc.mp4", "x" * 200 + ".mp4", "-o.mp4", "日本.mov"):
        yield f"name_{ascii(name)[:20]}", lambda folder, n=name: write_film(folder / n)
