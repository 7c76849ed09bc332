"""What a folder and its captions become, and what is said when they cannot be used."""

import json

import pytest

from v2p_data.errors import V2PError
from v2p_data.video.captions import find_videos, unique_items


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
    hint = {"frame": 3, "box": [10, 20, 30, 40], "points": [[15, 25]], "size_m": [0.1, 0.1, 0.2]}
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
    with pytest.raises(V2PError, match=r"holds no videos; known endings are \.mp4 \.mov"):
        find_videos(tmp_path)
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(V2PError, match="is no video"):
        find_videos(tmp_path / "a.txt")


def test_identifiers_are_plain_and_never_the_same_twice():
    stems = ["Café au lait!", "cafe-au-lait", "cafe_au_lait_2", "日本", "", "x" * 200]

    items = unique_items(stems)

    assert items[:3] == ["cafe_au_lait", "cafe_au_lait_2", "cafe_au_lait_2_2"]
    assert items[3:5] == ["video", "video_2"]
    assert len(items[5]) == 80
