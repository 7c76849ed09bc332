"""Every container that we promise to read, and what becomes of files that are no good."""

import contextlib
import struct
from itertools import pairwise
from typing import Any

import av
import av.filter
import numpy as np
import pytest
from odd_files import (
    EIGHT_WAYS,
    put_cover_first,
    set_edit,
    set_matrix,
    squares,
)

from v2p_data.errors import ItemRejectedError
from v2p_data.video.captions import VideoItem
from v2p_data.video.decode import VideoConfig, read_clip


def item(path, **extra):
    return VideoItem(item="clip", path=path, caption="Pushing red box", **extra)


def reason_for(path, **cfg):
    with pytest.raises(ItemRejectedError) as error:
        read_clip(item(path), VideoConfig(**cfg))
    assert path.name in error.value.detail
    return error.value.reason


def flat(value, count=10, height=96, width=128):
    return [np.full((height, width, 3), value, np.uint8) for _ in range(count)]


@pytest.mark.parametrize(
    ("name", "codec", "pix_fmt"),
    [
        ("a.mp4", "libx264", "yuv420p"),
        ("a.mov", "mpeg4", "yuv420p"),
        ("a.avi", "mjpeg", "yuvj420p"),
        ("a.webm", "libvpx-vp9", "yuv420p"),
        ("a.mkv", "ffv1", "yuv444p"),
        ("a.gif", "gif", "rgb8"),
        ("b.mp4", "libx265", "yuv420p10le"),
        ("b.mkv", "ffv1", "gray"),
        ("a.m4v", "mpeg4", "yuv420p"),
        ("a.mpg", "mpeg1video", "yuv420p"),
        ("a.ts", "libx264", "yuv420p"),
        ("A.MTS", "mpeg2video", "yuv420p"),
        ("a.3gp", "mpeg4", "yuv420p"),
        ("a.wmv", "wmv2", "yuv420p"),
        ("a.flv", "flv", "yuv420p"),
        ("a.ogv", "libvpx", "yuv420p"),
        ("really_matroska.mp4.mkv", "ffv1", "bgra"),
    ],
)
def test_every_container_gives_the_same_moving_square(film, name, codec, pix_fmt, capfd):
    options = {"libx265": {"x265-params": "log-level=none"}}.get(codec, {})
    path = film(name, squares(20), codec=codec, pix_fmt=pix_fmt, fps=25, options=options)
    capfd.readouterr()

    clip = read_clip(item(path))

    assert clip.frames.shape == (20, 96, 128, 3)
    assert clip.total_frames == 20
    assert clip.fps == pytest.approx(25, rel=0.01)
    red = clip.frames[..., 0].astype(int) - clip.frames[..., 2]
    for i in (0, 10, 19):
        if pix_fmt == "gray":
            # luma of (200, 30, 30) is 81, that of the ground 120
            columns = np.flatnonzero(clip.frames[i, 48, :, 0] < 100)
        else:
            columns = np.flatnonzero(red[i, 48] > 80)
        assert abs(columns[0] - 4 * i) <= 2
        assert abs(columns[-1] - (4 * i + 31)) <= 2
    assert np.abs(clip.frames[:, 5, 5].astype(int) - 120).max() <= (
        40 if codec == "gif" else 4  # rgb8 has four blues
    )
    assert capfd.readouterr().err == ""


def test_a_long_clip_is_thinned_evenly_and_keeps_real_time(film):
    frames = [np.full((96, 128, 3), i % 240, np.uint8) for i in range(400)]
    path = film("long.mkv", frames, codec="ffv1", pix_fmt="yuv444p", fps=50)

    clip = read_clip(item(path), VideoConfig(max_frames=100))

    assert clip.frames.base is None  # no more is kept than what is shown
    assert len(clip.frames) == 100
    assert clip.total_frames == 400
    # 400 frames last from 0 to 7.98 s; 100 of them stand 7.98 / 99 s apart, give or take the end that thinning may lose
    assert clip.fps == pytest.approx(99 / 7.98, rel=0.02)
    assert clip.source_fps == pytest.approx(50, rel=0.01)
    assert np.abs(clip.source_frame / 50 - clip.times_s).max() < 2.01 / 50
    shown = clip.frames[:, 48, 64, 0].astype(int)
    assert np.abs(shown - clip.source_frame % 240).max() <= 2


def test_where_the_rate_varies_time_decides(film):
    # ten frames at 10 fps, a pause of a second, ten frames at 10 fps
    pts = [100 * i for i in range(10)] + [1900 + 100 * i for i in range(10)]
    path = film("vfr.mkv", squares(20), codec="ffv1", pix_fmt="yuv444p", pts_ms=pts)

    clip = read_clip(item(path))

    # 0 to 2.8 s at 10 frames per second
    assert len(clip.frames) == 29
    assert clip.fps == pytest.approx(10, rel=0.01)
    assert clip.source_frame[[0, 9, 14, 18, 19, 28]].tolist() == [0, 9, 9, 9, 10, 19]


@pytest.mark.parametrize("gap_ms", [1700, 3000, 8000])
def test_a_gap_of_seconds_is_no_stillness_and_is_named(film, gap_ms):
    pts = [40 * i + gap_ms * (i >= 20) for i in range(40)]
    path = film("gap.mkv", squares(40), codec="ffv1", pix_fmt="yuv444p", pts_ms=pts)

    clip = read_clip(item(path))

    assert clip.source_frame.tolist() == list(range(40))
    assert clip.fps == pytest.approx(25, rel=0.01)
    # picture 19 comes at 0.76 s
    said = f"gap.mkv has no picture for {gap_ms / 1000:.1f} s in all, in 1 places, the last after 0.8 s"
    assert [said in w for w in clip.warnings] == [True]


@pytest.mark.parametrize(
    ("name", "codec"),
    [
        ("a.ts", "libx265"),
        ("a.mkv", "libx265"),
        ("a.mp4", "libx265"),
        ("b.ts", "libx264"),
        ("a.mov", "mpeg4"),
        ("a.webm", "libvpx-vp9"),
        ("a.flv", "flv"),
        ("a.mpg", "mpeg2video"),
    ],
)
def test_pictures_before_the_first_whole_one_are_left_out_and_named(film, tmp_path, name, codec):
    keys = "log-level=none:keyint=20:min-keyint=20:scenecut=0"
    options = {"x265-params": keys} if codec == "libx265" else {"g": "20"}
    whole = film(name, squares(60), codec=codec, options=options)
    path, none = tmp_path / f"late{whole.suffix}", tmp_path / f"none{whole.suffix}"
    for copy, packets in ((path, slice(7, None)), (none, slice(7, 18))):
        with av.open(str(whole)) as source, av.open(str(copy), "w") as out:
            stream = out.add_stream_from_template(source.streams.video[0])
            for packet in [p for p in source.demux(video=0) if p.size][packets]:
                packet.stream = stream
                out.mux(packet)

    clip = read_clip(item(path))

    # frame 20 has the square at column 80
    assert clip.total_frames == 40
    assert np.flatnonzero(clip.frames[0, 48, :, 0] > 160)[0] == pytest.approx(80, abs=2)
    assert ["begins between two key pictures" in w for w in clip.warnings] == [True]
    assert reason_for(none) in ("unreadable", "truncated", "no_video_stream")


RED = (191, 98, 98)
"""255 times (0.5, 0.1, 0.1), light of BT.709, to the power of 1 / 2.4."""


@pytest.mark.parametrize(
    ("matrix", "primaries", "transfer", "signal", "shown"),
    [
        # BT.2408, table 1: reference white and a grey card of 26 cd/m2 of 203; 255 (26 / 203) ** (1 / 2.4) = 108
        (9, 9, 16, (0.58, 0.58, 0.58), (255, 255, 255)),
        (9, 9, 16, (0.38, 0.38, 0.38), (108, 108, 108)),
        (9, 2, 16, (0.38, 0.38, 0.38), (108, 108, 108)),
        (9, 9, 18, (0.75, 0.75, 0.75), (255, 255, 255)),
        (9, 9, 18, (0.38, 0.38, 0.38), (108, 108, 108)),
        # 0.627 * 0.5 + 0.329 * 0.1 + 0.043 * 0.1 = 0.351 and so on, to the power of 1 / 2.4
        (9, 9, 14, (0.647, 0.424, 0.393), RED),
        (1, 12, 1, (0.703, 0.404, 0.394), RED),
        # 203 * (0.351, 0.128, 0.107) cd/m2, by the PQ curve of BT.2100
        (9, 9, 16, (0.474, 0.380, 0.364), RED),
        (9, 1, 14, (0.8, 0.3, 0.1), (204, 77, 26)),
        (1, 1, 1, (0.8, 0.3, 0.1), (204, 77, 26)),
        (5, 1, 6, (0.8, 0.3, 0.1), (204, 77, 26)),
        (7, 7, 7, (0.8, 0.3, 0.1), (204, 77, 26)),
        (2, 2, 2, (0.8, 0.3, 0.1), (204, 77, 26)),
    ],
)
@pytest.mark.parametrize("color_range", [1, 2], ids=["16 to 235", "0 to 255"])
def test_colours_are_those_of_a_plain_screen(
    tmp_path, matrix, primaries, transfer, signal, shown, color_range
):
    weights = {1: (0.2126, 0.0722), 9: (0.2627, 0.0593), 7: (0.212, 0.087)}
    red, blue = weights.get(matrix, (0.299, 0.114))
    luma = np.dot(signal, [red, 1 - red - blue, blue])
    chroma = (signal[2] - luma) / (2 - 2 * blue), (signal[0] - luma) / (2 - 2 * red)
    low, steps, colour_steps = (16, 219, 224) if color_range == 1 else (0, 255, 255)
    planes = [low + steps * luma, *(128 + colour_steps * c for c in chroma)]
    pixels = np.broadcast_to(np.rint(256 * np.array(planes))[:, None, None], (3, 96, 128))
    path = tmp_path / "clip.mkv"
    with av.open(str(path), "w") as out:
        stream: Any = out.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv444p16le"
        said = stream.codec_context
        said.colorspace, said.color_primaries = matrix, primaries
        said.color_trc, said.color_range = transfer, color_range
        for _ in range(10):
            frame = av.VideoFrame(128, 96, "yuv444p16le")
            for plane, values in zip(frame.planes, pixels.astype("<u2"), strict=True):
                plane.update(np.ascontiguousarray(values))
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))

    clip = read_clip(item(path))

    assert clip.frames[5, 40, 60].tolist() == pytest.approx(shown, abs=3)
    converted = transfer in (16, 18) or primaries in (9, 12)
    assert ["converted to BT.709" in w for w in clip.warnings] == [True] * converted


def test_large_pictures_are_scaled_to_even_sizes(film):
    path = film("large.mp4", squares(10, height=402, width=1000))

    clip = read_clip(item(path), VideoConfig(max_side_px=320))

    # 402 * 320 / 1000 = 128.6
    assert clip.frames.shape[1:3] == (128, 320)
    assert clip.source_size_px == (1000, 402)


def test_pixels_that_are_not_square_are_made_square(film):
    path = film("wide.mp4", squares(10), aspect="2/1")

    assert read_clip(item(path)).frames.shape[1:3] == (96, 256)


def corners(pixels):
    """Return which of red, green, blue and white is seen top left, top right, bottom left and bottom right."""
    seen = ""
    for y in (0.25, 0.75):
        for x in (0.25, 0.75):
            red, green, blue = pixels[int(y * len(pixels)), int(x * pixels.shape[1])] > 128
            seen += "W" if red and green and blue else "R" if red else "G" if green else "B"
    return seen


@pytest.mark.parametrize(
    ("way", "seen"),
    [
        ("upright", "RGBW"),
        ("mirrored", "GRWB"),
        ("upside_down", "WBGR"),
        ("mirrored_upside_down", "BWRG"),
        ("right", "BRWG"),
        ("left", "GWRB"),
        ("transposed", "RBGW"),
        ("transposed_upside_down", "WGBR"),
    ],
)
def test_a_video_is_shown_as_its_matrix_says(film, way, seen):
    stored = np.full((96, 128, 3), 250, np.uint8)
    stored[:48, :64], stored[:48, 64:], stored[48:, :64] = (250, 0, 0), (0, 250, 0), (0, 0, 250)
    path = set_matrix(film("turned.mp4", [stored] * 10), *EIGHT_WAYS[way])

    clip = read_clip(item(path))

    assert corners(clip.frames[0]) == seen
    size = (96, 128) if way in ("right", "left") or way.startswith("transposed") else (128, 96)
    assert clip.source_size_px == size
    assert clip.frames.shape[1:3] == size[::-1]


@pytest.mark.parametrize("matrix", [(0.8, 0.6, -0.6, 0.8), (1, 0, 1, 1), (1, 0, 1, 0)])
def test_a_video_that_is_to_lean_is_refused(film, matrix):
    assert reason_for(set_matrix(film("leaning.mp4"), *matrix)) == "odd_angle"


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "first.mp4"])
def test_a_cover_picture_is_not_the_film(film, name):
    path = film(name, cover=True)
    if name == "first.mp4":
        put_cover_first(path)
        with av.open(str(path)) as container:
            assert container.streams.video[0].width == 96

    clip = read_clip(item(path))

    assert clip.frames.shape == (20, 96, 128, 3)
    assert np.abs(clip.frames[0, 5, 5].astype(int) - 120).max() <= 4


def test_a_file_with_two_films_says_which_is_read(film):
    clip = read_clip(item(film("two.mp4", second=squares(20, 192, 256))))

    assert clip.frames.shape[1:3] == (96, 128)
    assert "two.mp4 holds 2 films; the one of 128 x 96 px" in clip.warnings[0]


@pytest.mark.parametrize("name", ["a.mp4", "a.mov", "a.mkv", "a.avi"])
def test_sound_that_outlasts_the_picture_is_no_missing_picture(film, name):
    codec = "mpeg4" if name.endswith("avi") else "libx264"

    clip = read_clip(item(film(name, codec=codec, sound_s=5)))

    assert (clip.total_frames, clip.warnings) == (20, ())


@pytest.mark.parametrize("gop", ["1", "12", "250"])
def test_an_edit_list_cuts_the_film(film, gop):
    """Trimmed without encoding: frames before the cut are decoded, where others need them, and never shown."""
    path = set_edit(film("trimmed.mp4", squares(60), options={"g": gop}), 0.5, 1.0)

    clip = read_clip(item(path))

    assert (clip.total_frames, clip.warnings) == (30, ())
    red = clip.frames[..., 0].astype(int) - clip.frames[..., 2] > 80
    # frame 15 of the file has the square at column 60, frame 44 at 176 - 96 = 80
    assert [np.flatnonzero(red[i, 48])[0] for i in (0, 29)] == pytest.approx([60, 80], abs=2)


def test_a_last_picture_that_stays_for_long_is_no_missing_end(film):
    pts = [*(33 * i for i in range(30)), 5000]
    path = film("recording.mkv", squares(31), codec="ffv1", pix_fmt="yuv444p", pts_ms=pts)

    (said,) = read_clip(item(path)).warnings
    assert "no picture for 4.0 s" in said


def test_what_is_transparent_is_white(film):
    rgba = np.zeros((96, 128, 4), np.uint8)
    rgba[:, :64] = (10, 200, 10, 255)
    rgba[:, 64:96, 3] = 128
    path = film("alpha.mkv", [rgba] * 10, codec="ffv1", pix_fmt="bgra")

    frame = read_clip(item(path)).frames[0]

    assert frame[50, 20].tolist() == [10, 200, 10]
    # black at 128 of 255 over white leaves 127
    assert frame[50, 80].tolist() == [127, 127, 127]
    assert frame[50, 120].tolist() == [255, 255, 255]


def gif(disposal, background):
    """Return a GIF with a grey picture, then nine red squares, each 8 px further right; colour 2 is blue.

    The pixels stand in it uncompressed: codes of 8 bits, with a code that clears the table (0x80) every 100.
    """
    pictures = [(0, 0, np.zeros((96, 128), np.uint8))]
    pictures += [(8 * i, 32, np.ones((32, 32), np.uint8)) for i in range(1, 10)]
    table = bytes([120, 120, 120, 200, 30, 30, 30, 30, 200]).ljust(384, b"\0")
    out = b"GIF89a" + struct.pack("<HHBBB", 128, 96, 0xF6, background, 0) + table
    for number, (x, y, colours) in enumerate(pictures):
        way = disposal if number else 1
        out += b"\x21\xf9\x04" + struct.pack("<BHB", way << 2, 4, 0) + b"\0"
        out += b"\x2c" + struct.pack("<HHHHB", x, y, *colours.shape[::-1], 0) + b"\x07"
        flat = colours.tobytes()
        codes = b"".join(b"\x80" + flat[k : k + 100] for k in range(0, len(flat), 100)) + b"\x81"
        parts = [codes[k : k + 255] for k in range(0, len(codes), 255)]
        out += b"".join(bytes([len(part)]) + part for part in parts) + b"\0"
    return out + b";"


def joined(film, tmp_path, *films):
    """Return transport streams one after the other in one file: each begins at time 0 again."""
    path = tmp_path / "joined.ts"
    parts = [film(f"{i}.ts", frames) for i, frames in enumerate(films)]
    path.write_bytes(b"".join(part.read_bytes() for part in parts))
    return path


def test_a_picture_that_changes_its_size_keeps_that_of_its_beginning(film, tmp_path):
    path = joined(film, tmp_path, flat(60), flat(120, 10, 192, 256), flat(180, 10, 72, 96))

    clip = read_clip(item(path))

    assert clip.frames.shape == (30, 96, 128, 3)
    assert clip.fps == pytest.approx(30)
    assert [clip.frames[i].mean().round(-1) for i in (0, 15, -1)] == [60, 120, 180]


def test_a_picture_that_changes_its_shape_is_cut_there(film, tmp_path):
    path = joined(film, tmp_path, flat(60), flat(120, 10, 128, 96))

    # ten pictures at 30 per second come before
    with pytest.raises(
        ItemRejectedError, match=r"joined\.ts .* at 0\.33 s, from 128 x 96 to 96"
    ) as error:
        read_clip(item(path))

    assert (error.value.reason, error.value.value) == ("picture_turns", pytest.approx(1 / 3))


def test_a_picture_that_is_turned_on_the_way_is_cut_there(film, tmp_path):
    path = tmp_path / "turned.ts"
    # ITU-T H.264, D.1.27: not cancelled, no flips, 90 of 360 degrees as 0x4000 of 0x10000, once, no extension
    bits = "0" + "00" + f"{0x4000:016b}" + "1" + "0" + "1000"
    turn = b"\0\0\1\6\x2f\3" + int(bits, 2).to_bytes(3) + b"\x80"
    with (
        av.open(str(film("plain.ts", options={"bf": "0"}))) as plain,
        av.open(str(path), "w") as out,
    ):
        stream = out.add_stream_from_template(plain.streams.video[0])
        for i, packet in enumerate(p for p in plain.demux(video=0) if p.size):
            new = av.Packet((turn if i >= 10 else b"") + bytes(packet))
            new.stream, new.pts, new.dts = stream, packet.pts, packet.dts
            new.time_base, new.is_keyframe = packet.time_base, packet.is_keyframe
            out.mux(new)

    assert reason_for(path) == "picture_turns"


def interlaced(frames):
    """Return pictures whose every second row is that of the next one."""
    is_odd = np.arange(len(frames[0]))[:, None, None] % 2 == 1
    return [np.where(is_odd, b, a) for a, b in pairwise(frames)]


@pytest.mark.parametrize("codec", ["libx264", "mpeg2video", "ffv1"])
def test_an_interlaced_film_is_refused_and_the_advised_filter_helps(film, codec):
    path = film("camcorder.mkv", interlaced(squares(24)), codec=codec, fps=25)

    with pytest.raises(ItemRejectedError, match=r"camcorder\.mkv is .*-vf bwdif") as error:
        read_clip(item(path))

    assert (error.value.reason, error.value.detail.count("\n")) == ("interlaced", 0)
    graph: Any = av.filter.Graph()
    whole = []
    with av.open(str(path)) as container:
        source = graph.add_buffer(template=container.streams.video[0])
        graph.link_nodes(source, graph.add("bwdif"), graph.add("buffersink")).configure()
        for frame in [*container.decode(video=0), None]:
            graph.push(frame)
            with contextlib.suppress(EOFError, BlockingIOError):
                while True:
                    whole.append(graph.pull().to_ndarray(format="rgb24"))
    assert len(read_clip(item(film("whole.mp4", whole))).frames) >= 40


@pytest.mark.parametrize("rows", [1, 2], ids=["one row", "two rows"])
def test_a_striped_thing_that_moves_is_not_taken_for_interlaced(film, rows):
    frames = squares(24)
    for i, pixels in enumerate(frames):
        stripes = pixels[32:64, 4 * i % 96 : 4 * i % 96 + 32]
        stripes[np.arange(32) // rows % 2 == 0] = (60, 10, 10)

    assert len(read_clip(item(film("stripes.mkv", frames, codec="ffv1"))).frames) == 24


STEPS = [40 * i for i in range(40)]


def set_times(path, times_ms):
    """Write the times of an FLV's pictures (Video File Format 10.1, E.4.1), which libav's writer would refuse."""
    data, at, times = bytearray(path.read_bytes()), 13, iter(times_ms)
    while at < len(data):
        kind, size = data[at], int.from_bytes(data[at + 1 : at + 4])
        if kind == 9 and (time_ms := next(times, None)) is not None:
            data[at + 4 : at + 7] = time_ms.to_bytes(3)
        at += 11 + size + 4
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("times_ms", "jump"),
    [
        (STEPS[:20] + [t + 60_000 for t in STEPS[20:]], 60),
        ([t + 100_000 * (i == 20) for i, t in enumerate(STEPS)], 100),
        (STEPS[:20] + STEPS[:20], 0),
        (STEPS[:10] + STEPS[:30], 0),
        (STEPS[:20] + [STEPS[19]] * 20, 0),
        ([t - 400 * (i >= 20) for i, t in enumerate(STEPS)], 0),
        ([t - 40 * (i % 2) for i, t in enumerate(STEPS)], 0),
    ],
    ids=["a minute on", "one far off", "from 0", "early from 0", "stands", "back", "twice each"],
)
def test_pictures_follow_one_another_where_the_clock_does_not(film, times_ms, jump):
    path = set_times(film("clock.flv", squares(40, 96, 256), codec="flv", fps=25), times_ms)

    clip = read_clip(item(path))

    assert clip.source_frame.tolist() == list(range(40))
    assert clip.fps == pytest.approx(25, rel=0.03)
    assert [f"no picture for {jump}.0 s in all" in w for w in clip.warnings] == [True] * (jump > 0)


@pytest.mark.parametrize("name", ["a.mkv", "a.webm", "a.mp4", "a.ts"])
def test_a_film_whose_clock_begins_late_is_no_long_film(film, name):
    codec = "libvpx" if name.endswith("webm") else "libx264"
    path = film(name, codec=codec, pts_ms=[3_600_000 + 40 * i for i in range(20)])

    clip = read_clip(item(path))

    assert (len(clip.frames), clip.warnings) == (20, ())
    assert clip.fps == pytest.approx(25, rel=0.01)


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.avi", "a.ts", "a.flv"])
def test_a_film_without_a_picture_has_a_reason(tmp_path, name):
    path = tmp_path / name
    with av.open(str(path), "w") as out:
        stream: Any = out.add_stream("mpeg4" if name != "a.flv" else "flv", rate=30)
        stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv420p"
        out.start_encoding()

    assert reason_for(path) in ("no_video_stream", "unreadable", "too_few_frames", "empty_file")


def test_hints_follow_scaling_and_sampling(film):
    path = film("large.mkv", squares(40, height=400, width=800), codec="ffv1", pix_fmt="yuv444p")
    hints = {
        "red box": {
            "frame": 39,
            "box": [80.0, 40.0, 160.0, 120.0],
            "points": [[400.0, 200.0]],
            "size_m": [0.1, 0.1, 0.1],
            "name": "matchbox",
        }
    }

    clip = read_clip(item(path, hints=hints), VideoConfig(max_side_px=400, max_frames=20))

    assert clip.hints["red box"] == {
        "frame": 19,
        "box": [40.0, 20.0, 80.0, 60.0],
        "points": [[200.0, 100.0]],
        "size_m": [0.1, 0.1, 0.1],
        "name": "matchbox",
    }


@pytest.mark.parametrize(
    ("hint", "said"),
    [
        ({"frame": 0, "box": [600.0, 40.0, 900.0, 120.0]}, "which is 800 x 400 px"),
        ({"frame": 0, "points": [[10.0, 401.0]]}, "lies outside of the picture"),
        ({"frame": 40, "box": [80.0, 40.0, 160.0, 120.0]}, "the video's frames are 0 to 39"),
    ],
    ids=["box", "point", "frame"],
)
def test_a_mark_that_the_video_does_not_have_is_a_bad_hint(film, hint, said):
    path = film("large.mkv", squares(40, height=400, width=800), codec="ffv1", pix_fmt="yuv444p")
    marked = item(path, hints={"red box": hint})

    with pytest.raises(ItemRejectedError, match=f"large.mkv, hint 'red box': .*{said}") as error:
        read_clip(marked, VideoConfig(max_side_px=400, max_frames=20))

    assert error.value.reason == "bad_hint"


def test_text_named_mp4_is_unreadable(tmp_path, capfd):
    path = tmp_path / "letter.mp4"
    path.write_text("Dear video,\n" * 100)

    assert reason_for(path) == "unreadable"
    assert reason_for(tmp_path / "missing.mp4") == "unreadable"
    assert capfd.readouterr().err == ""


def test_an_empty_file_has_its_own_reason(tmp_path):
    path = tmp_path / "empty.mp4"
    path.touch()

    with pytest.raises(ItemRejectedError, match=r"empty\.mp4 holds not one byte") as error:
        read_clip(item(path))

    assert error.value.reason == "empty_file"


@pytest.mark.parametrize(
    "playlist", ["#EXTM3U\n#EXTINF:1,\nfilm.mp4\n", "ffconcat version 1.0\nfile film.mp4\n"]
)
def test_a_playlist_opens_no_other_file(film, tmp_path, playlist):
    film("film.mp4")
    path = tmp_path / "list.mp4"
    path.write_text(playlist)

    assert reason_for(path) == "unreadable"


def test_a_file_cut_before_its_index_is_truncated(film):
    path = film()
    path.write_bytes(path.read_bytes()[:-200])

    assert reason_for(path) == "truncated"


def test_a_file_cut_in_the_middle_keeps_its_beginning_and_says_so(film):
    path = film("cut.mp4", squares(60), container_options={"movflags": "faststart"})
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 7 // 10])

    clip = read_clip(item(path))

    assert 8 <= clip.total_frames < 48
    assert f"{clip.total_frames} of about 60 frames" in clip.warnings[0]


def test_a_file_cut_near_its_beginning_is_truncated(film):
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, (96, 128, 3), np.uint8) for _ in range(60)]
    path = film("cut.mp4", noise, container_options={"movflags": "faststart"})
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 15])

    assert reason_for(path) == "truncated"


def test_sound_alone_holds_no_pictures(tmp_path):
    path = tmp_path / "song.mp4"
    with av.open(str(path), "w") as out:
        stream = out.add_stream("aac", rate=44100, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 44100), np.float32), "fltp", "mono")
        frame.sample_rate = 44100
        out.mux(stream.encode(frame))
        out.mux(stream.encode(None))

    assert reason_for(path) == "no_video_stream"


def test_too_few_too_small_too_long_and_too_large_are_told_apart(film):
    assert reason_for(film("few.mp4", squares(7))) == "too_few_frames"
    assert reason_for(film("small.mp4", flat(9, height=32))) == "too_small"
    assert reason_for(film("long.mp4"), max_duration_s=0.5) == "too_long"
    assert reason_for(film("large.mp4"), max_side_file_px=100) == "too_large"
    assert len(read_clip(item(film("enough.mp4", squares(8)))).frames) == 8


def test_one_picture_and_one_pixel_have_their_own_reasons(film):
    with pytest.raises(ItemRejectedError) as single:
        read_clip(item(film("single.mkv", squares(1), codec="ffv1", pix_fmt="bgra")))
    with pytest.raises(ItemRejectedError) as dot:
        read_clip(item(film("dot.mkv", flat(9, 10, 1, 1), codec="ffv1", pix_fmt="bgra")))

    assert (single.value.reason, single.value.value) == ("too_few_frames", 1)
    assert (dot.value.reason, dot.value.value) == ("too_small", 1)


def test_too_many_pixels_are_refused_before_a_picture_is_decoded(film):
    path = film("wide.mp4", squares(10))
    # 128 x 96 is 0.0123 megapixels
    assert reason_for(path, max_file_mpx=0.0122) == "too_large"
    assert len(read_clip(item(path), VideoConfig(max_file_mpx=0.0123)).frames) == 10


def test_decoding_gives_up_in_time(film):
    assert reason_for(film(), max_decode_s=1e-6) in ("too_slow", "unreadable")


def test_a_still_clip_is_a_clip(film):
    clip = read_clip(item(film("still.mp4", flat(99))))

    assert clip.frames.std() < 1
    assert clip.warnings == ()
