"""Label files of Something-Something: what can be used is used, and the rest is named."""

import json

import pytest

from v2p_data.video.captions import read_footage

NEXT_TO = "Putting [something] next to [something]"


def footage(folder, **files):
    """Return what the folder says with these JSON files and a video 5.mp4 in it."""
    (folder / "5.mp4").write_bytes(b"x")
    for name, data in files.items():
        text = data if isinstance(data, str) else json.dumps(data)
        (folder / f"{name}.json").write_text(text)
    return read_footage(folder)


def said(folder, **label):
    """Return caption and objects that one label gives, and what is said of it."""
    found = footage(folder, train=[{"id": "5", **label}])
    (video,) = found.videos
    return video.caption, video.objects, found.notes


def test_an_entry_that_says_nothing_drops_no_other(tmp_path):
    (tmp_path / "6.mp4").write_bytes(b"x")
    labels = [{"id": "6"}, {"label": "x"}, "7", {"id": "5", "label": "lifting cup up"}]

    found = footage(tmp_path, train=labels)

    assert [v.caption for v in found.videos] == ["lifting cup up", "moving object"]
    (note,) = found.notes
    assert "train.json" in note
    assert "id '6' has neither a label nor a template" in note
    assert "entry 1 has no id, entry 2 has no id" in note


def test_brackets_in_a_placeholder_take_no_place_of_another(tmp_path):
    caption, objects, notes = said(tmp_path, template=NEXT_TO, placeholders=["box [red]", "can"])

    assert caption == "Putting box [red] next to can"
    assert objects == ("box [red]", "can")
    assert notes == ()


@pytest.mark.parametrize("label", [None, "putting cup next to cup"])
def test_equal_things_stay_two_things(tmp_path, label):
    caption, objects, _ = said(
        tmp_path, label=label, template=NEXT_TO, placeholders=["cup", "cup"]
    )

    assert caption.lower() == "putting cup next to other cup"
    assert objects == ("cup", "other cup")


def test_a_name_that_is_taken_is_not_given_twice(tmp_path):
    _, objects, _ = said(
        tmp_path, label="cup other cup cup", placeholders=["cup", "other cup", "cup"]
    )

    assert objects == ("cup", "other cup", "third cup")


def test_places_without_a_placeholder_lose_their_brackets_and_are_told(tmp_path):
    caption, objects, notes = said(tmp_path, template=NEXT_TO, placeholders=["cup"])

    assert caption == "Putting cup next to something"
    assert objects == ("cup", "object")
    assert "id '5' has 1 placeholders for 2 places" in notes[0]


def test_a_number_of_things_is_no_thing(tmp_path):
    caption, objects, _ = said(
        tmp_path, template="Stacking [number of] [something]", placeholders=["4", "cups"]
    )

    assert caption == "Stacking 4 cups"
    assert objects == ("cups",)


def test_placeholders_that_cannot_be_used_leave_the_label(tmp_path):
    caption, objects, notes = said(tmp_path, label="lifting red box up", placeholders=[""])

    assert (caption, objects) == ("lifting red box up", ("red box",))
    assert "id '5'" in notes[0]


def test_a_broken_file_beside_stops_nothing(tmp_path):
    found = footage(tmp_path, a_broken="{", train=[{"id": 5, "label": "lifting cup up"}])

    assert found.videos[0].caption == "lifting cup up"
    assert "a_broken.json, line 1" in found.notes[0]


def test_the_first_of_two_labels_counts(tmp_path):
    labels = [{"id": 5, "label": "lifting cup up"}, {"id": "5", "label": "throwing cup"}]

    assert footage(tmp_path, train=labels).videos[0].caption == "lifting cup up"
