"""Clips of several pictures: sample clips put beside each other here, with hands where a model would see them."""

from dataclasses import replace

import numpy as np
import pytest
from sample_clips import with_frames

from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.scene.frames.hand_track import HandTrack
from v2p_data.scene.frames.one_pane import FindHands, as_a_person_cropped, with_one_pane
from v2p_data.scene.frames.prepare import PreparedClip
from v2p_data.scene.frames.working_clip import WorkingClip, working_clip_of
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


def hands_in(bright: bool) -> FindHands:
    """Return a model that finds hands in every frame of the brighter picture, or of the darker one."""

    def find(clip: Clip, working: WorkingClip) -> HandTrack:
        seen = (clip.frames.mean() > 90) == bright
        at = np.arange(len(working.rgb)) if seen else np.zeros(0, int)
        return HandTrack(
            at=at,
            px=np.zeros((len(at), 21, 2)),
            metres=np.zeros((len(at), 21, 3)),
            num_sampled=len(working.rgb),
        )

    return find


def no_hands(clip: Clip, working: WorkingClip) -> HandTrack:
    empty = np.zeros((0, 21, 2)), np.zeros((0, 21, 3))
    return HandTrack(at=np.zeros(0, int), px=empty[0], metres=empty[1], num_sampled=9)


@pytest.mark.parametrize("bright", [True, False])
def test_the_picture_with_the_hand_is_taken_and_told(clips, bright):
    clip = side_by_side(clips)
    w = clip.width_px

    one = with_one_pane(clip, working_clip_of(clip), hands_in(bright))

    x0, _, x1, _ = one.in_file_px
    assert (x0, x1) == pytest.approx((0, w) if bright else (w, 2 * w), abs=8)
    assert '"crop"' in one.warnings[-1]
    assert one.width_px == pytest.approx(w / 2, abs=4)


def test_our_own_network_finds_the_hand_where_no_model_is_set_up(clips):
    clip = side_by_side(clips)
    still = clip.frames.copy()
    half = clip.width_px // 2
    rng = np.random.default_rng(0)
    # a machine in grey moves in the other picture, over more pixels than the hand
    still[:, :, half:] = still[:1, :, half:]
    for i, frame in enumerate(still):
        frame[20 + 3 * i : 90 + 3 * i, half + 30 : half + 130] = 60 + rng.integers(0, 20)
    clip = replace(clip, frames=still)

    one = with_one_pane(clip, working_clip_of(clip), lambda clip, working: None)

    assert one.in_file_px[:2] == (0.0, 0.0)
    assert one.in_file_px[2] == pytest.approx(clip.width_px, abs=8)


def test_pictures_without_a_hand_are_rejected_with_the_parts_that_a_person_may_name(clips):
    clip = side_by_side(clips)

    with pytest.raises(ItemRejectedError, match=r"\[0, 0, \d+, \d+\].*captions.json") as error:
        with_one_pane(clip, working_clip_of(clip), no_hands)

    assert (error.value.reason, error.value.value) == ("split_screen", 0.0)


def test_a_clip_of_one_picture_stays_as_it_is(clips):
    for clip in (with_frames(clip, clip.frames[::4]) for clip in clips):
        assert with_one_pane(clip, working_clip_of(clip), hands_in(True)) is clip


def entry(crop: object) -> dict:
    return {"caption": "Lifting red box up", "objects": ["red box"], "hints": {"crop": crop}}


def test_a_person_says_which_part_counts_and_the_marks_stay_in_the_files_pixels(clips):
    clip = side_by_side(clips)
    w, h = clip.width_px, clip.height_px
    _, _, hints = checked_entry(entry([w, 0, w, 2 * h]), "here")
    box = [v / 2 for v in hints["crop"].get("box", [])]
    mark = {"frame": 0, "box": [w / 2 + 20.0, 30.0, w / 2 + 60.0, 70.0]}
    clip = replace(clip, hints={"crop": {"frame": 0, "box": box}, "red box": mark})

    one = as_a_person_cropped(clip)

    assert one is not None
    assert one.in_file_px == (w, 0, 2 * w, 2 * h)
    assert dict(one.hints) == {"red box": {"frame": 0, "box": [20, 30, 60, 70]}}
    np.testing.assert_array_equal(one.frames, clip.frames[:, :, w // 2 :])


@pytest.mark.parametrize("crop", [[0, 0, 30, 200], [-5, 0, 200, 200], [0, 0, 200], "left"])
def test_a_crop_that_is_no_part_of_a_picture_is_refused(crop):
    with pytest.raises(V2PError, match=r"\[x, y, width, height\]"):
        checked_entry(entry(crop), "captions.json, entry 'a.mp4'")


def test_marks_in_the_pixels_of_the_cropped_picture_are_refused(clips):
    clip = side_by_side(clips)
    w = clip.width_px // 2
    crop = {"frame": 0, "box": [float(w), 0.0, 2.0 * w, float(clip.height_px)]}
    mark = {"frame": 0, "box": [20.0, 30.0, 60.0, 70.0]}

    with pytest.raises(ItemRejectedError, match="pixels of the whole file") as error:
        as_a_person_cropped(replace(clip, hints={"crop": crop, "red box": mark}))

    assert error.value.reason == "bad_hint"
    one = as_a_person_cropped(replace(clip, hints={"crop": crop}))
    assert one is not None
    ready = PreparedClip(clip=one, working=working_clip_of(one), segmentation=None)
    with pytest.raises(V2PError, match="pixels of the whole file"):
        ready.with_hints({"red box": {"frame": 0, "box": [40, 60, 120, 140]}})
