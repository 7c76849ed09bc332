"""What a folder and its captions become, and what is said when they cannot be used."""

import json
import os
import re
import unicodedata

import pytest
from odd_captions import ALMOST, PLAIN, READ, REFUSED, SAID, UNREAD
from pydantic import TypeAdapter

from v2p_data.errors import V2PError
from v2p_data.scene.schema import Words
from v2p_data.video.captions import (
    find_videos,
    item_of,
    read_footage,
)
from v2p_data.video.checked import words
from v2p_data.video.hints import check_hints
from v2p_data.video.save_hints import save_hint


@pytest.fixture
def folder(tmp_path):
    """Three files that look like videos; nothing here decodes them."""
    for name in ("b.mp4", "a.MOV", "push_left_to_right__red_box.webm"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "notes.txt").write_text("no video")
    (tmp_path / "._b.mp4").write_bytes(b"what macOS leaves behind")
    (tmp_path / "folder.mp4").mkdir()
    return tmp_path


def write(folder, data, name="captions.json"):
    (folder / name).write_text(data if isinstance(data, str) else json.dumps(data))


def test_videos_are_found_by_ending_in_any_case_and_sorted(folder):
    names = [v.path.name for v in find_videos(folder)]

    assert names == ["a.MOV", "b.mp4", "push_left_to_right__red_box.webm"]


def test_one_file_gives_one_video_with_its_caption(folder):
    write(folder, {"b.mp4": "Lifting red box up"})

    (video,) = find_videos(folder / "b.mp4")

    assert (video.item, video.caption, video.objects) == ("b", "Lifting red box up", ("red box",))


def test_without_captions_the_file_name_speaks(folder):
    video = find_videos(folder)[2]

    assert video.caption == "push left to right red box"
    assert video.objects == ("red box",)


def test_a_camera_file_name_says_only_that_something_moves(tmp_path):
    (tmp_path / "IMG_1234.mp4").write_bytes(b"x")

    assert find_videos(tmp_path)[0].caption == "moving object"


def test_captions_json_gives_caption_objects_and_hints(folder):
    hint = {
        "frame": 3,
        "box": [10, 20, 30, 40],
        "points": [[15, 25]],
        "size_m": [0.1, 0.1, 0.2],
        "name": "mug",
    }
    entry = {
        "caption": "Pushing cup next to can",
        "objects": ["cup", "red can"],
        "hints": {"cup": hint},
    }
    write(folder, {"b.mp4": entry})

    video = find_videos(folder)[1]

    assert video.objects == ("cup", "red can")
    assert video.hints == {"cup": hint}


def test_labels_of_something_something_are_found_by_id(tmp_path):
    (tmp_path / "78687.webm").write_bytes(b"x")
    label = {
        "id": "78687",
        "label": "pushing blue cup from left to right",
        "template": "Pushing [something] from left to right",
        "placeholders": ["blue cup"],
    }
    elsewhere = {**label, "id": "1"}
    write(tmp_path, [elsewhere, label], "train.json")
    write(tmp_path, {"Pushing [something] from left to right": "93"}, "labels.json")

    (video,) = find_videos(tmp_path)

    assert video.caption == "pushing blue cup from left to right"
    assert video.objects == ("blue cup",)


def test_a_label_without_text_is_filled_from_its_template(tmp_path):
    (tmp_path / "5.mp4").write_bytes(b"x")
    template = "Putting [something] next to [something else]"
    write(tmp_path, [{"id": 5, "template": template, "placeholders": ["cup", "can"]}], "val.json")

    assert find_videos(tmp_path)[0].caption == "Putting cup next to can"


@pytest.mark.parametrize(
    ("captions", "said"),
    [
        ({"c.mp4": "Lifting cup up"}, "'c.mp4', which is not in the folder"),
        ({"B.mp4": "Lifting cup up"}, "Did you mean 'b.mp4'"),
        ('{"b.mp4": "x",\n  "a.MOV" "y"}', "captions.json, line 2"),
        ('{"b.mp4": "up", "b.mp4": "down"}', "two entries for 'b.mp4'"),
        ("[" * 100_000, "nested too deeply"),
        ([], "must hold an object"),
        ({"b.mp4": "  "}, "is empty"),
        ({"b.mp4": {"objects": ["cup"]}}, "'caption' must be text, not a null"),
        ({"b.mp4": 3}, "not a number"),
        ({"b.mp4": {"caption": "Lifting cup up", "object": ["cup"]}}, "Did you mean 'objects'"),
        ({"b.mp4": {"caption": "Lifting cup up", "objects": "cup"}}, "must be a list"),
        ({"b.mp4": {"caption": "Lifting cup up", "objects": ["cup", ""]}}, "is empty"),
        ({"b.mp4": {"caption": "Lifting cup up", "objects": ["cup", "cup"]}}, "twice"),
    ],
)
def test_captions_that_cannot_be_used_are_named(folder, captions, said):
    write(folder, captions)

    with pytest.raises(V2PError) as error:
        find_videos(folder)

    assert said in str(error.value)


@pytest.mark.parametrize(
    ("hint", "said"),
    [
        ({"cap": {"box": [0, 0, 9, 9]}}, "Did you mean 'cup'"),
        ({"cup": {"box": [9, 0, 0, 9]}}, "x0 < x1"),
        ({"cup": {"box": [0, 0, 9]}}, "4 numbers"),
        ({"cup": {"box": [0, 0, True, 9]}}, "4 numbers"),
        ({"cup": {"points": []}}, "list of [x, y]"),
        ({"cup": {"points": [[1, 2, 3]]}}, "2 numbers"),
        ({"cup": {"size_m": [80, 80, 95]}}, "in metres"),
        ({"cup": {"size_m": [0.08, 0.08, 0.001]}}, "from 0.002 to 1.5"),
        ({"cup": {"size_m": [0.08, 0.08, 1.6]}}, "from 0.002 to 1.5"),
        ({"cup": {"name": ""}}, "'name' is empty"),
        ({"cup": {"name": 3}}, "'name' must be text"),
        ({"cup": {"name": "mug " * 16}}, "in a word or two"),
        ({"cup": {"frame": -1, "box": [0, 0, 9, 9]}}, "from 0"),
        ({"cup": {"frame": 2}}, "says nothing"),
        ({"cup": {"bbox": [0, 0, 9, 9]}}, "Did you mean 'box'"),
    ],
)
def test_hints_that_cannot_be_used_are_named(folder, hint, said):
    write(folder, {"b.mp4": {"caption": "Lifting cup up", "objects": ["cup"], "hints": hint}})

    with pytest.raises(V2PError) as error:
        find_videos(folder)

    assert said in str(error.value)
    assert "entry 'b.mp4'" in str(error.value)


def test_text_that_is_not_utf8_is_named(folder):
    (folder / "captions.json").write_bytes(b'{"b.mp4": "caf\xe9"}')

    with pytest.raises(V2PError, match="UTF-8"):
        find_videos(folder)


def test_no_folder_and_no_videos_are_said_plainly(tmp_path):
    with pytest.raises(V2PError, match="no folder or video"):
        find_videos(tmp_path / "nowhere")
    with pytest.raises(V2PError, match=r"holds no videos; known endings are \.mp4 \.m4v"):
        find_videos(tmp_path)
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(V2PError, match="is no video"):
        find_videos(tmp_path / "a.txt")


@pytest.mark.parametrize(
    ("name", "item"),
    [
        ("lift_red_box.mp4", "lift_red_box"),
        ("place_into__egg_pan__ftf.mp4", "place_into__egg_pan__ftf"),
        ("x" * 80 + ".mp4", "x" * 80),
        ("Café au lait!.mp4", "café_au_lait-"),
        ("日本の箱.mp4", "日本の箱-"),
        ("हिन्दी कप.mov", "हिन्दी_कप-"),
        ("🟥🟥.mp4", "video-"),
        (".mp4.mp4", "mp4-"),
        ("IMG 1234.MOV", "img_1234-"),
        ("clip-0123456789.mp4", "clip_0123456789-"),
        ("x" * 90 + ".mp4", "x" * 80 + "-"),
        ("日" * 84 + ".mp4", "日" * 26 + "-"),
    ],
)
def test_a_plain_name_is_the_identifier_and_another_keeps_its_letters_before_a_digest(name, item):
    assert item_of(name) == item or re.fullmatch(re.escape(item) + "[0-9a-f]{10}", item_of(name))


def test_a_clip_that_is_added_changes_no_others_identifier(tmp_path):
    names = [
        *(
            "clip.mp4",
            "clip.mov",
            "clip.avi",
            "clip.mkv",
            "clip.MP4",
            "CLIP.mp4",
            "clip .mp4",
            "_clip.mp4",
        ),
        *("日本.mp4", "日本語.mp4", "🟥.mp4", "🟦.mp4", "Café.mp4", "Cafe\u0301.mp4", "cafe.mp4"),
        *("x" * 90 + ".mp4", "x" * 91 + ".mp4", "x" * 80 + ".mp4"),
        f"{item_of('CLIP.mp4')}.mp4",
        os.fsdecode(b"\xff.mp4"),
    ]
    before: dict[str, str] = {}

    for name in names:
        (tmp_path / name).write_bytes(b"")
        items = {v.path.name: v.item for v in find_videos(tmp_path)}
        assert before.items() <= items.items()
        assert find_videos(tmp_path / name)[0].item == items[name]
        before = items

    assert len(set(before.values())) == len(names)


@pytest.mark.parametrize(
    ("hint", "said"),
    [
        ({"frame": 12, "box": [0, 0, 9, 9]}, "no frame 12; the video's frames are 0 to 11"),
        ({"frame": 0, "box": [60, 0, 66, 9]}, "outside of the picture, which is 64 x 48 px"),
        ({"frame": 0, "box": [0, 0, 9, 50]}, "outside of the picture, which is 64 x 48 px"),
        ({"frame": 0, "points": [[3, 3], [-1, 3]]}, "the point [-1, 3] lies outside"),
    ],
)
def test_marks_outside_of_the_video_are_named(hint, said):
    with pytest.raises(V2PError) as error:
        check_hints({"cup": hint}, (64, 48), 12, "b.mp4")

    assert said in str(error.value)
    assert str(error.value).startswith("b.mp4, hint 'cup'")


def test_marks_at_the_border_of_the_picture_are_in_it():
    hints = {"cup": {"frame": 11, "box": [0, 0, 64.4, 48], "points": [[64, 48]]}}
    check_hints(hints, (64, 48), 12, "b.mp4")


def save(folder, name, phrase, hint):
    """Save a hint for the video of this name, and return all hints that it has then."""
    (video,) = [v for v in find_videos(folder) if v.path.name == name]
    return save_hint(video, phrase, hint, keeps_old=True)


CUP = {"caption": "Pushing cup next to can", "objects": ["cup", "red can"]}


def test_hints_are_added_and_nothing_else_changes(folder):
    can = {"frame": 2, "box": [1, 2, 3, 4]}
    write(folder, {"a.MOV": "Lifting   box up", "b.mp4": {**CUP, "hints": {"red can": can}}})

    hints = save(folder, "b.mp4", "cup", {"name": "mug"})

    assert json.loads((folder / "captions.json").read_text()) == {
        "a.MOV": "Lifting   box up",
        "b.mp4": {**CUP, "hints": {"red can": can, "cup": {"name": "mug"}}},
    }
    assert hints == {"red can": can, "cup": {"frame": 0, "name": "mug"}}
    assert find_videos(folder)[1].hints == hints


def test_the_first_hint_of_a_folder_without_captions_keeps_what_the_file_names_say(folder):
    before = find_videos(folder)
    hint = {"frame": 0, "box": [1, 2, 3, 4]}

    save(folder, "push_left_to_right__red_box.webm", "red box", hint)

    after = find_videos(folder)
    assert [(v.caption, v.objects) for v in after] == [(v.caption, v.objects) for v in before]
    assert after[2].hints == {"red box": hint}
    assert not list(folder.glob("*.bak*"))


def test_the_old_caption_file_is_kept_beside_the_new_one_each_time(folder):
    write(folder, {"b.mp4": CUP})
    first = (folder / "captions.json").read_bytes()

    for name in ("mug", "beaker"):
        save(folder, "b.mp4", "cup", {"name": name})

    assert (folder / "captions.json.bak").read_bytes() == first
    assert "mug" in (folder / "captions.json.bak2").read_text()
    assert find_videos(folder)[1].hints["cup"]["name"] == "beaker"


@pytest.mark.parametrize(
    ("phrase", "hint", "said"),
    [
        ("cap", {"name": "x"}, "Did you mean 'cup'"),
        ("cup", {"box": [9, 0, 0, 9]}, "x0 < x1"),
        ("cup", {}, "says nothing"),
    ],
)
def test_hints_that_cannot_be_used_are_named_and_change_nothing(folder, phrase, hint, said):
    write(folder, {"b.mp4": CUP})
    before = (folder / "captions.json").read_bytes()

    with pytest.raises(V2PError) as error:
        save(folder, "b.mp4", phrase, hint)

    assert said in str(error.value)
    assert (folder / "captions.json").read_bytes() == before


@pytest.mark.parametrize(("on_disk", "in_file"), [("NFD", "NFC"), ("NFC", "NFD")])
def test_names_are_the_same_however_accents_are_encoded(tmp_path, on_disk, in_file):
    stem, caption = "café", "Lifting café sign up"
    name = unicodedata.normalize(on_disk, f"{stem}.mp4")
    (tmp_path / name).write_bytes(b"x")
    entry = {"caption": unicodedata.normalize(in_file, caption), "objects": [f"{stem} sign"]}
    entry["hints"] = {unicodedata.normalize(in_file, f"{stem} sign"): {"name": "card"}}
    write(tmp_path, {unicodedata.normalize(in_file, f"{stem}.mp4"): entry})

    (video,) = find_videos(tmp_path)

    assert video.path.name == name
    assert (video.caption, video.objects) == (caption, (f"{stem} sign",))
    assert video.hints["café sign"]["name"] == "card"


def test_hints_for_a_name_in_another_form_go_to_its_only_entry(tmp_path):
    composed, apart = (unicodedata.normalize(form, "café.mp4") for form in ("NFC", "NFD"))
    (tmp_path / apart).write_bytes(b"x")
    write(tmp_path, {composed: CUP})

    save(tmp_path, apart, "cup", {"name": "mug"})

    assert list(json.loads((tmp_path / "captions.json").read_text())) == [apart]
    assert find_videos(tmp_path)[0].hints["cup"]["name"] == "mug"


def test_files_and_folders_that_are_passed_over_are_named_in_one_line(folder):
    (folder / "take.webp").write_bytes(b"x")
    (folder / "more").mkdir()
    (folder / "more/c.mp4").write_bytes(b"x")
    (folder / "empty").mkdir()
    write(folder, {"b.mp4": "Lifting cup up"})

    notes = read_footage(folder).notes

    assert notes == (
        f"4 in {folder} passed over, no videos: folder.mp4/, more/, notes.txt, take.webp",
    )
    assert read_footage(folder / "b.mp4").notes == ()


def test_many_files_that_are_passed_over_are_counted(folder):
    for k in range(20):
        (folder / f"{k:02d}.jpg").write_bytes(b"x")

    (note,) = read_footage(folder).notes

    assert "22 in" in note
    assert note.endswith("00.jpg, 01.jpg, 02.jpg, 03.jpg, 04.jpg, 05.jpg and 16 more")


def test_videos_one_folder_deeper_are_pointed_to(tmp_path):
    (tmp_path / "takes").mkdir()
    (tmp_path / "takes/a.mp4").write_bytes(b"x")

    with pytest.raises(V2PError, match="holds no videos, its folders takes/ do"):
        find_videos(tmp_path)


def test_boxes_are_said_as_they_were_read(folder):
    hint = {"box": [10, 20, 80, 95.5]}
    write(folder, {"b.mp4": {**CUP, "hints": {"cup": hint}}})

    (_, note) = read_footage(folder).notes

    assert note == "boxes read as x0, y0, x1, y1 in pixels: b.mp4 'cup' 70 x 75.5 px at (10, 20)"


@pytest.mark.parametrize(
    ("box", "said"),
    [
        ([0.2, 0.3, 0.5, 0.6], "looks like fractions of the picture; a box is x0, y0, x1, y1 in"),
        ([0, 0, 1, 1], "looks like fractions"),
        ([80, 60, 30, 20], "is x, y, width, height, write [80.0, 60.0, 110.0, 80.0]"),
        ([80, 20, 30, 60], "is x, y, width, height, write [80.0, 20.0, 110.0, 80.0]"),
    ],
)
def test_a_box_in_another_form_is_told_from_one_in_pixels(folder, box, said):
    write(folder, {"b.mp4": {**CUP, "hints": {"cup": {"box": box}}}})

    with pytest.raises(V2PError) as error:
        find_videos(folder)

    assert said in str(error.value)


def test_points_in_fractions_are_refused(folder):
    write(folder, {"b.mp4": {**CUP, "hints": {"cup": {"points": [[0.4, 0.5], [1, 0.2]]}}}})

    with pytest.raises(V2PError, match="look like fractions"):
        find_videos(folder)


@pytest.mark.parametrize(("file", "content"), REFUSED.values(), ids=REFUSED)
def test_a_caption_file_that_cannot_be_read_is_refused_in_one_sentence(tmp_path, file, content):
    (tmp_path / PLAIN).write_bytes(b"x")
    (tmp_path / file).write_bytes(content)

    with pytest.raises(V2PError) as error:
        read_footage(tmp_path)

    said = str(error.value)
    assert said.startswith(str(tmp_path / file))
    assert said.isprintable()
    assert len(said) < 600


@pytest.mark.parametrize(("file", "content", "caption"), READ.values(), ids=READ)
def test_a_caption_file_as_people_write_it_gives_what_a_scene_may_hold(
    tmp_path, file, content, caption
):
    (tmp_path / PLAIN).write_bytes(b"x")
    (tmp_path / file).write_bytes(content)

    footage = read_footage(tmp_path)

    (video,) = footage.videos
    assert video.caption == caption
    assert footage.notes == ()
    for text in (video.caption, *video.objects):
        assert TypeAdapter(Words).validate_python(text) == text


@pytest.mark.parametrize(("file", "content"), ALMOST.items(), ids=ALMOST)
def test_a_caption_file_almost_rightly_named_is_read_and_named(tmp_path, file, content):
    (tmp_path / PLAIN).write_bytes(b"x")
    (tmp_path / file).write_bytes(content)
    (tmp_path / "captions.json.bak").write_bytes(b"ours")

    footage = read_footage(tmp_path)

    assert [v.caption for v in footage.videos] == [SAID]
    assert footage.notes == (f"captions are read from {file} in {tmp_path}",)
    write(tmp_path, {PLAIN: "Lifting cup up"})
    assert [v.caption for v in find_videos(tmp_path)] == ["Lifting cup up"]


@pytest.mark.parametrize("file", UNREAD)
def test_a_file_that_looks_like_captions_and_is_not_read_is_named(tmp_path, file):
    (tmp_path / PLAIN).write_bytes(b"x")
    (tmp_path / "metadata.csv").write_text("frame,exposure\n0,3\n")
    (tmp_path / file).write_text("{}")

    note, passed = read_footage(tmp_path).notes

    assert file in note
    assert note.endswith("a caption file is called captions.json or captions.csv")
    assert passed.endswith("passed over, no videos: metadata.csv")


def test_every_character_that_a_caption_keeps_may_stand_in_a_scene():
    kept = TypeAdapter(Words)

    codes = [*range(0x2100), *range(0x2100, 0x110000, 499)]
    for start in range(0, len(codes), 500):
        letters = "".join(f"a{chr(k)}b" for k in codes[start : start + 500])
        kept.validate_python(words(letters, "a caption"))


def test_the_object_has_the_word_where_the_table_says_otherwise(folder):
    write(folder, "b.mp4,Lifting cup up\na.MOV,Lifting can up\n", "captions.csv")
    write(folder, {"b.mp4": "Lifting red box up"})

    assert [v.caption for v in find_videos(folder)][:2] == ["Lifting can up", "Lifting red box up"]


def test_hints_for_a_video_of_the_table_keep_its_caption(folder):
    write(folder, "b.mp4,Lifting cup up\n", "captions.csv")

    save(folder, "b.mp4", "cup", {"name": "mug"})

    video = find_videos(folder)[1]
    assert (video.caption, video.hints["cup"]["name"]) == ("Lifting cup up", "mug")
