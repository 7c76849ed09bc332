"""A part of the picture that a person names: sample clips put beside each other here."""

from dataclasses import replace

import numpy as np
import pytest
from sample_clips import with_frames

from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.scene.frames.crop import with_named_part
from v2p_data.scene.frames.prepare import PreparedClip
from v2p_data.video.captions import checked_entry
from v2p_data.video.clip import Clip


def side_by_side(clips: list[Clip]) -> Clip:
    """Return two clips in one; the right one is turned and darker, and the file is twice as large as the frames."""
    first, second = (
        c.frames[np.linspace(0, len(c.frames) - 1, 24).astype(int)] for c in clips[:2]
    )
    frames = np.concatenate([first, second[:, ::-1, ::-1] // 2], 2)
    h, w = frames.shape[1:3]
    return replace(with_frames(clips[0], frames), source_size_px=(2 * w, 2 * h), hints={})


def entry(crop: object) -> dict:
    return {"caption": "Lifting red box up", "objects": ["red box"], "hints": {"crop": crop}}


def test_a_person_says_which_part_counts_and_the_marks_stay_in_the_files_pixels(clips):
    clip = side_by_side(clips)
    w, h = clip.width_px, clip.height_px
    _, _, hints = checked_entry(entry([w, 0, w, 2 * h]), "here")
    box = [v / 2 for v in hints["crop"].get("box", [])]
    mark = {"frame": 0, "box": [w / 2 + 20.0, 30.0, w / 2 + 60.0, 70.0]}
    clip = replace(clip, hints={"crop": {"frame": 0, "box": box}, "red box": mark})

    one = with_named_part(clip)

    assert one.in_file_px == (w, 0, 2 * w, 2 * h)
    assert dict(one.hints) == {"red box": {"frame": 0, "box": [20, 30, 60, 70]}}
    np.testing.assert_array_equal(one.frames, clip.frames[:, :, w // 2 :])


@pytest.mark.parametrize("crop", [[0, 0, 30, 200], [-5, 0, 200, 200], [0, 0, 200], "left"])
def test_a_crop_that_is_no_part_of_a_picture_is_refused(crop):
    with pytest.raises(V2PError, match=r"\[x, y, width, height\]"):
        checked_entry(entry(crop), "captions.json, entry 'a.mp4'")


def test_marks_in_the_pixels_of_the_cropped_picture_are_refused(clips, segmentation_of):
    clip = side_by_side(clips)
    w = clip.width_px // 2
    crop = {"frame": 0, "box": [float(w), 0.0, 2.0 * w, float(clip.height_px)]}
    mark = {"frame": 0, "box": [20.0, 30.0, 60.0, 70.0]}

    with pytest.raises(ItemRejectedError, match="pixels of the whole file") as error:
        with_named_part(replace(clip, hints={"crop": crop, "red box": mark}))

    assert error.value.reason == "bad_hint"
    one = with_named_part(replace(clip, hints={"crop": crop}))
    working, segmentation = segmentation_of([[]] * 3)
    ready = PreparedClip(clip=one, working=working, segmentation=segmentation)
    with pytest.raises(V2PError, match="pixels of the whole file"):
        ready.with_hints({"red box": {"frame": 0, "box": [40, 60, 120, 140]}})
