import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.export import write_scene
from v2p_data.scene.reconstruct import reconstruct
from v2p_data.scene.scene import Scene
from v2p_data.video.captions import find_videos
from v2p_data.video.decode import VideoConfig, read_clip

SIZE_M = (0.09, 0.07, 0.05)
"""Of the box that `conftest.make_clip` draws."""
SAMPLES = Path(__file__).parents[2] / "datasets" / "sample_videos"


def rebuild(clip, **settings):
    return reconstruct(clip, SceneConfig(**settings), np.random.default_rng(0))


@pytest.fixture(scope="module")
def pushed(draw):
    hints = {"blue box": {"size_m": list(SIZE_M)}}
    return rebuild(draw(hints=hints))


@pytest.fixture(scope="module")
def folder(pushed, tmp_path_factory):
    out = tmp_path_factory.mktemp("scene")
    write_scene(pushed, out)
    return out


def test_a_pushed_box_is_found_where_it_was_drawn(pushed):
    box = pushed.objects[0]
    move = box.T_world_objs[-1][:3, 3] - box.T_world_objs[0][:3, 3]

    assert box.name == "blue_box"
    np.testing.assert_allclose(np.sort(box.size_m), np.sort(SIZE_M), rtol=0.2)
    np.testing.assert_allclose(move, [0, 0.16, 0], atol=0.025)
    np.testing.assert_allclose(box.T_world_objs[0][:2, 3], 0, atol=1e-9)


def test_poses_between_lie_on_the_way(pushed):
    box = pushed.objects[0]
    y = box.T_world_objs[:, 1, 3]

    assert len(box.frames) > 4
    assert list(box.frames) == sorted(set(box.frames))
    assert (np.diff(y) > -0.02).all()
    assert np.abs(box.T_world_objs[:, 2, 3] - box.size_m[2] / 2).max() < 1e-6


def test_the_camera_sees_the_box_where_its_mask_is(pushed):
    box = pushed.objects[0]
    spot = pushed.camera.project(box.T_world_objs[0][None, :3, 3])[0]
    y, x = np.nonzero(box.masks[0])

    assert np.hypot(spot[0] - x.mean(), spot[1] - y.mean()) < 8


def test_a_lifted_box_ends_in_the_air(draw):
    clip = draw(move_left_m=0.0, lift_m=0.15, caption="Lifting blue box up")

    box = rebuild(clip).objects[0]

    rise = box.T_world_objs[-1][2, 3] - box.T_world_objs[0][2, 3]
    scale = np.cbrt(np.prod(box.size_m) / np.prod(SIZE_M))
    assert rise / scale == pytest.approx(0.15, rel=0.35)


def test_a_picture_in_which_nothing_moves_is_turned_away(draw):
    clip = draw()
    still = replace(clip, frames=np.repeat(clip.frames[:1], len(clip.frames), axis=0))

    with pytest.raises(ItemRejectedError) as caught:
        rebuild(still)

    assert caught.value.reason == "nothing_moves"
    assert caught.value.value < 0.003


def test_what_moves_without_a_hand_is_turned_away(draw):
    with pytest.raises(ItemRejectedError) as caught:
        rebuild(draw(with_hand=False))

    assert caught.value.reason == "no_hand"
    assert caught.value.value < 0.002


@pytest.mark.parametrize(
    "hints", [{}, {"blue box": {"frame": 35, "box": [90.0, 60.0, 200.0, 160.0]}}]
)
def test_what_comes_into_the_picture_later_is_turned_away_for_that(draw, hints):
    with pytest.raises(ItemRejectedError, match="not in the picture when it begins") as caught:
        rebuild(draw(comes_at=0.4, hints=hints))

    assert caught.value.reason == "not_there_at_first"
    assert caught.value.value < 0.0007


def test_a_camera_that_travels_is_turned_away(draw):
    with pytest.raises(ItemRejectedError) as caught:
        rebuild(draw(shake_px=40.0))

    assert caught.value.reason == "camera_moves"
    assert caught.value.value > 3


@pytest.mark.long
def test_a_camera_that_sways_shows_the_same_as_one_that_stands(draw, pushed):
    swayed = rebuild(draw(shake_px=14.0, hints={"blue box": {"size_m": list(SIZE_M)}}))

    still, swaying = (scene.objects[0].T_world_objs[-1][:3, 3] for scene in (pushed, swayed))
    assert swaying == pytest.approx(still, abs=0.02)
    assert "aligned" in " ".join(swayed.clip.warnings)


def test_a_caption_that_says_the_opposite_is_turned_away(draw):
    with pytest.raises(ItemRejectedError) as caught:
        rebuild(draw(caption="Pushing blue box from left to right"))

    assert caught.value.reason in ("motion_contradicts_caption", "object_not_found")


def test_an_object_that_is_not_there_is_not_found(draw):
    clip = draw(caption="Pushing blue box next to red mug", objects=("blue box", "red mug"))

    with pytest.raises(ItemRejectedError) as caught:
        rebuild(clip)

    assert caught.value.reason == "reference_not_found"


@pytest.mark.long
def test_what_the_caption_does_not_speak_of_is_left_out_rather_than_the_whole_scene(draw):
    clip = draw(objects=("blue box", "bowl"))
    clip.frames[:, 150:190, 40:80] = 30, 120, 40
    both = rebuild(clip, min_found=0.0, min_confidence=0.0)
    assert [thing.label for thing in both.objects] == ["blue box", "bowl"]

    scene = rebuild(clip, min_found=0.0, min_confidence=both.confidence + 0.001)
    spoken = replace(clip, caption="Pushing blue box from right to left next to bowl")

    assert [thing.label for thing in scene.objects] == ["blue box"]
    assert any("'bowl'" in warning and "left out" in warning for warning in scene.warnings)
    with pytest.raises(ItemRejectedError, match="the scene is sure to"):
        rebuild(spoken, min_found=0.0, min_confidence=0.99)


def test_a_box_around_the_object_leads_to_the_same_place(draw, pushed):
    x, y = np.nonzero(pushed.objects[0].masks[0])[::-1]
    box = [float(x.min()) - 2, float(y.min()) - 2, float(x.max()) + 3, float(y.max()) + 3]
    clip = draw(hints={"blue box": {"frame": 0, "box": box, "size_m": list(SIZE_M)}})

    hinted = rebuild(clip).objects[0]

    both = hinted.masks[0] & pushed.objects[0].masks[0]
    assert both.sum() / (hinted.masks[0] | pushed.objects[0].masks[0]).sum() > 0.8


@pytest.mark.long
def test_a_box_around_the_object_on_its_way_leads_to_the_same_place(draw, pushed):
    own = pushed.objects[0]
    frame = min(own.masks, key=lambda i: abs(i - 18))
    assert not (own.masks[frame] & own.masks[0]).sum() > 0.8 * own.masks[0].sum()
    x, y = np.nonzero(own.masks[frame])[::-1]
    box = [float(x.min()) - 2, float(y.min()) - 2, float(x.max()) + 3, float(y.max()) + 3]
    clip = draw(hints={"blue box": {"frame": frame, "box": box, "size_m": list(SIZE_M)}})

    hinted = rebuild(clip).objects[0]

    for end in (min(own.masks), max(own.masks)):
        both = hinted.masks[end] & own.masks[end]
        assert both.sum() / (hinted.masks[end] | own.masks[end]).sum() > 0.8
    np.testing.assert_allclose(
        hinted.T_world_objs[-1][:2, 3], own.T_world_objs[-1][:2, 3], atol=0.02
    )


def test_the_written_scene_is_read_back(folder, pushed):
    scene = Scene.load(folder)

    assert scene.kind == "push_left"
    assert scene.manipulated.name == "blue_box"
    np.testing.assert_allclose(scene.manipulated.size_m, pushed.objects[0].size_m)
    assert json.loads((folder / "scene.json").read_text())["objects"][0]["urdf"] == (
        "urdf/blue_box.urdf"
    )
    for name in ("overlay.mp4", "overlay_first.png", "overlay_last.png", "frame_first.jpg"):
        assert (folder / name).stat().st_size > 1000


def test_mujoco_loads_the_scene_and_the_box_stays_where_it_stands(folder):
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("first").id)
    start = data.qpos.copy()

    mujoco.mj_step(model, data, 200)

    np.testing.assert_allclose(data.qpos[:3], start[:3], atol=0.003)


@pytest.mark.slow
@pytest.mark.skipif(not SAMPLES.is_dir(), reason="the sample videos are not in this checkout")
@pytest.mark.parametrize("name", ["lift_red_box", "push_blue_box_left", "tip_green_carton"])
def test_a_sample_video_is_understood_as_its_truth_says(name):
    item = find_videos(SAMPLES / f"{name}.mp4")[0]
    truth = json.loads((SAMPLES / "truth" / f"{name}.json").read_text())
    poses = np.array(truth["object"]["poses_world"])

    scene = rebuild(read_clip(item, VideoConfig()))

    box = scene.objects[0]
    true_size = np.array(truth["object"]["size_m"])
    scale = float(np.cbrt(np.prod(box.size_m) / np.prod(true_size)))
    assert 0.75 < scale < 1.33  # one view shows no scale: it comes from usual sizes
    np.testing.assert_allclose(np.sort(box.size_m) / scale, np.sort(true_size), rtol=0.2)
    true_move = poses[-1, :3] - poses[0, :3]
    move = (box.T_world_objs[-1] - box.T_world_objs[0])[:3, 3] / scale
    np.testing.assert_allclose(move, true_move, atol=0.03)
    upright = abs(box.T_world_objs[-1][2, 2])
    assert upright < 0.1 if truth["kind"] == "tip_over" else upright > 0.95
