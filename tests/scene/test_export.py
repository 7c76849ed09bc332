# pyright: reportAttributeAccessIssue=false
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from v2p_data.errors import V2PError
from v2p_data.geometry.mesh import lathe, lathe_parts, mesh_for, parts_for
from v2p_data.geometry.pose import transform
from v2p_data.scene.data_types import Estimate, Reconstruction
from v2p_data.scene.export import write_scene
from v2p_data.scene.fitting.silhouette import camera_above
from v2p_data.scene.scale.nouns import noun_for
from v2p_data.scene.scene import Scene, SceneObject, least_turn, read_masks, write_masks
from v2p_data.video.clip import Clip, Crop

FRAMES = (0, 3, 5)
BOTTLE = np.array([(0.03, -0.1), (0.035, -0.09), (0.035, 0.03), (0.014, 0.07), (0.014, 0.1)])
BOWL = np.array([(0.03, -0.03), (0.06, -0.02), (0.075, 0.0), (0.08, 0.03)])


def estimate(name: str, *, at: float, last: np.ndarray | None = None, **given) -> Estimate:
    noun = noun_for(name)
    size = given.pop("size_m", noun.size_m)
    given = {
        "shape": "mesh",
        "mesh": mesh_for(noun.form, size, hollow=noun.hollow),
        "parts": parts_for(noun.form, size, hollow=noun.hollow),
        **given,
    }
    first = transform(np.eye(3), np.array([0.0, at, size[2] / 2]))
    poses = np.stack([first, first, first if last is None else last])
    mask = np.zeros((24, 32), bool)
    mask[4:9, 3:11] = True
    return Estimate(
        name=name,
        label=name,
        role="manipulated" if at == 0 else "reference",
        noun=noun,
        size_m=size,
        rgba=(0.2, 0.3, 0.9, 1.0),
        frames=FRAMES,
        T_world_objs=poses,
        confidences=(0.9, 0.5, 0.8),
        masks={0: mask, 3: np.roll(mask, 4, axis=1), 5: np.roll(mask, 7, axis=1)},
        source={"size": "usual"},
        mass_kg=noun.mass_kg,
        **given,
    )


def reconstruction() -> Reconstruction:
    lifted = transform(
        Rotation.from_euler("z", 30, degrees=True).as_matrix(), np.array([0.1, -0.05, 0.25])
    )
    bottle, bowl = lathe(BOTTLE), lathe(BOWL, 0.004)
    return Reconstruction(
        clip=Clip(
            item="drawn",
            path=Path("drawn.mp4"),
            caption="Lifting bottle up",
            objects=("bottle", "bowl", "box", "tray"),
            hints={},
            frames=np.full((6, 48, 64, 3), 120, np.uint8),
            fps=12.0,
            total_frames=6,
            source_fps=12.0,
            source_frame=np.arange(6),
            times_s=np.arange(6) / 12.0,
            source_size_px=(64, 48),
        ),
        kind="lift_up",
        objects=(
            estimate(
                "bottle",
                at=0.0,
                last=lifted,
                size_m=(0.07, 0.07, 0.2),
                mesh=bottle,
                parts=lathe_parts(BOTTLE),
                symmetry="round",
                observed=("full", "no_depth", "no_depth"),
            ),
            estimate(
                "bowl",
                at=0.3,
                size_m=(0.16, 0.16, 0.06),
                mesh=bowl,
                parts=lathe_parts(BOWL, 0.004),
                symmetry="round",
            ),
            estimate("box", at=0.6, symmetry="box", shape="box"),
            estimate("tray", at=-0.4),
        ),
        camera=camera_above((48, 64), 0.61, 1.01, 0.5),
        confidence=0.8,
        warnings=(),
        stages={"mesh": (0.61234, "the neck is hidden"), "pose": (0.9, "")},
        scale_spread=0.123,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("scene")
    write_scene(reconstruction(), out)
    return out


@pytest.fixture(scope="module")
def scene(folder) -> Scene:
    return Scene.load(folder)


@contextmanager
def mujoco_warnings() -> Iterator[list[str]]:
    said: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(said.append)
    try:
        yield said
    finally:
        mujoco.set_mju_user_warning(before)


def test_the_file_says_what_a_task_needs_to_know(folder):
    data = json.loads((folder / "scene.json").read_text())
    bottle = data["objects"][0]

    assert data["table"] == {"normal": [0.0, 0.0, 1.0], "offset_m": 0.0}
    assert data["gravity_m_s2"] == [0.0, 0.0, -9.81]
    assert data["confidences"]["mesh"] == {"value": 0.6123, "reason": "the neck is hidden"}
    assert bottle["observed"] == ["full", "no_depth", "no_depth"]
    assert bottle["symmetry"] == "round"
    # It went from (0, 0, 0.1) to (0.1, -0.05, 0.25); how a round thing turns about its axis is not seen.
    np.testing.assert_allclose(
        bottle["first_to_last"]["translation_m"], [0.1, -0.05, 0.15], atol=1e-6
    )
    np.testing.assert_allclose(bottle["first_to_last"]["rotation_vector_rad"], 0, atol=1e-6)
    assert len(data["camera"]["K"]) == 3


def test_a_scene_is_the_same_after_writing_and_reading(folder, scene, tmp_path):
    scene.save(tmp_path)

    again = Scene.load(tmp_path)

    assert again.objects == scene.objects
    assert again.confidences == scene.confidences
    assert (tmp_path / "scene.json").read_text() == (folder / "scene.json").read_text()


def test_a_scene_of_an_older_version_is_refused_in_one_sentence(folder, tmp_path):
    data = json.loads((folder / "scene.json").read_text())
    (tmp_path / "scene.json").write_text(json.dumps(data | {"schema": 1}))

    with pytest.raises(V2PError, match="written by another version; remake it with 'v2p scene'"):
        Scene.load(tmp_path)


def test_masks_come_back_as_they_were(scene):
    given = reconstruction().objects[0].masks

    masks = scene.masks("bottle")

    assert sorted(masks) == [0, 3, 5]
    for frame, mask in masks.items():
        np.testing.assert_array_equal(mask, given[frame])


def test_an_object_that_was_never_seen_has_an_empty_mask_track(tmp_path):
    write_masks(tmp_path / "none.npz", {})

    assert read_masks(tmp_path / "none.npz") == {}


def test_what_is_no_mask_track_is_named(scene, tmp_path):
    (tmp_path / "torn.npz").write_bytes(b"PK\x03\x04 torn")

    with pytest.raises(V2PError, match="no mask track"):
        read_masks(tmp_path / "torn.npz")
    with pytest.raises(V2PError, match="has no object 'spoon'"):
        scene.masks("spoon")


def test_every_mesh_file_is_closed_and_of_the_size_that_is_said(folder, scene):
    for thing in scene.objects:
        obj, ply = (trimesh.load_mesh(folder / file) for file in (thing.mesh, thing.mesh_ply))
        parts = [trimesh.load_mesh(folder / file) for file in thing.parts]

        assert obj.is_watertight
        assert obj.volume > 0
        np.testing.assert_allclose(obj.extents, thing.size_m, rtol=0.01)
        assert ply.volume == pytest.approx(obj.volume, rel=1e-4)
        assert all(part.is_convex for part in parts)
        assert sum(part.volume for part in parts) == pytest.approx(obj.volume, rel=0.08)


def test_mujoco_loads_every_file_without_a_warning(folder, scene):
    files = [folder / "scene.xml"]
    files += [folder / file for thing in scene.objects for file in (thing.urdf, thing.mjcf)]

    with mujoco_warnings() as said:
        for file in files:
            spec = mujoco.MjSpec.from_file(str(file))
            model = spec.compile()
            data = mujoco.MjData(model)
            mujoco.mj_step(model, data, 5)
            assert np.isfinite(data.qpos).all()

    assert said == []


def test_models_weigh_and_slide_as_the_scene_says(folder, scene):
    together = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    for thing in scene.objects:
        models = [mujoco.MjModel.from_xml_path(str(folder / f)) for f in (thing.mjcf, thing.urdf)]

        for model in (together, *models):
            body = model.body(thing.name)
            assert body.mass[0] == pytest.approx(thing.mass_kg, rel=1e-4)
            assert body.inertia.max() < thing.mass_kg * max(thing.size_m) ** 2
    assert together.geom("table").friction[0] < min(thing.friction for thing in scene.objects)


def test_a_ball_dropped_into_the_bowl_stays_in_it(folder, scene):
    bowl = scene.object("bowl")
    spec = mujoco.MjSpec.from_file(str(folder / bowl.mjcf))
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1], pos=[0, 0, -bowl.size_m[2] / 2]
    )
    ball = spec.worldbody.add_body(name="ball", pos=[0.02, 0.0, 0.06])
    ball.add_freejoint()
    ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.015, 0, 0], mass=0.01)
    model = spec.compile()
    data = mujoco.MjData(model)

    mujoco.mj_step(model, data, 500)

    x, y, z = data.body("ball").xpos
    assert np.hypot(x, y) < 0.06
    assert z == pytest.approx(
        -0.03 + 0.004 + 0.015, abs=0.004
    )  # on the floor, which is one wall thick


@pytest.mark.parametrize(
    ("symmetry", "turn", "left"),
    [
        ("none", [0, 0, np.pi / 2], np.pi / 2),
        ("box", [0, 0, np.pi - 0.1], 0.1),
        ("box", [0, np.pi / 2, 0], np.pi / 2),
        ("round", [0, 0, 2.0], 0.0),
        ("round", [0, np.pi / 2, 0], np.pi / 2),
        ("sphere", [0.3, 2.0, 1.0], 0.0),
    ],
)
def test_a_symmetric_thing_has_turned_no_further_than_can_be_seen(symmetry, turn, left):
    first = Rotation.from_euler("z", 40, degrees=True)
    last = first * Rotation.from_rotvec(turn)

    assert least_turn(first, last, symmetry).magnitude() == pytest.approx(left, abs=1e-6)


def test_an_object_that_was_made_by_hand_has_a_motion_but_no_masks(scene):
    cube = SceneObject(
        name="cube",
        label="cube",
        role="manipulated",
        shape="box",
        size_m=(0.05, 0.05, 0.05),
        mass_kg=0.1,
        friction=0.5,
        poses_world=((0.0, 0.0, 0.025, 1.0, 0.0, 0.0, 0.0), (0.1, 0.0, 0.025, 1.0, 0.0, 0.0, 0.0)),
    )

    assert cube.motion.translation_m == (0.1, 0.0, 0.0)
    with pytest.raises(V2PError, match="not made from a video"):
        replace(scene, objects=(cube,)).masks("cube")


def test_a_moving_camera_has_a_pose_per_frame_and_a_still_one_does_not_say_it(
    folder, scene, tmp_path
):
    assert "T_world_cams" not in json.loads((folder / "scene.json").read_text())["camera"]
    made = reconstruction()
    shift = np.eye(3)[None].repeat(len(made.clip.frames), 0)
    shift[1:, 0, 2] = 4.0  # pixels to the right, as when the camera turns to the left

    moved = replace(made, clip=replace(made.clip, to_filmed=shift))
    (tmp_path / "moved").mkdir()
    write_scene(moved, tmp_path / "moved")
    read = Scene.load(tmp_path / "moved")

    assert read.T_world_cams is not None
    np.testing.assert_allclose(read.T_world_cams[0], scene.camera.T_world_cam, atol=2e-6)
    assert not np.allclose(read.T_world_cams[1], scene.camera.T_world_cam, atol=1e-3)


def test_a_pose_per_frame_is_demanded_for_all_frames(folder, tmp_path):
    data = json.loads((folder / "scene.json").read_text())
    data["camera"]["T_world_cams"] = [data["camera"]["T_world_cam"]]
    (tmp_path / "scene.json").write_text(json.dumps(data))

    with pytest.raises(V2PError, match="has 1 poses, but the clip has"):
        Scene.load(tmp_path)


def test_a_scene_without_its_black_bars_says_what_part_of_the_file_it_shows(scene, tmp_path):
    made = reconstruction()
    h, w = made.clip.frames.shape[1:3]
    crop = Crop(box_px=(0, 10, w, h + 10), full_px=(w, h + 20))
    (tmp_path / "cut").mkdir()
    write_scene(replace(made, clip=replace(made.clip, crop=crop)), tmp_path / "cut")

    read = Scene.load(tmp_path / "cut")

    assert scene.crop_px is None
    assert read.crop_px is not None
    sw, sh = made.clip.source_size_px
    np.testing.assert_allclose(
        read.crop_px, (0, 10 * sh / (h + 20), sw, (h + 10) * sh / (h + 20)), atol=0.01
    )
