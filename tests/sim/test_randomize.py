import json
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from mujoco.batch import Batch

from v2p_data.errors import ItemRejectedError
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.seeds import rng_for
from v2p_data.sim.env import ranges
from v2p_data.sim.env.cpu_physics import CpuPhysics
from v2p_data.sim.env.layout import OBJECT_HIGH_M, OBJECT_LOW_M, PUSH_ROOM_M
from v2p_data.sim.env.physics import SimConfig
from v2p_data.sim.env.randomize import Randomizer
from v2p_data.sim.env.ranges import RandomizationConfig
from v2p_data.sim.model.world import build_world
from v2p_data.sim.robot.robot import FINE, FINGER_TRAVEL_M, QUAT_DOWN, ServoConfig

NUM_ENVS = 48


def worlds_of(
    scene: Scene, cfg: RandomizationConfig | None = None
) -> tuple[Randomizer, Batch, np.ndarray]:
    """Return drawn worlds with the objects placed and the arm at a start pose."""
    world = build_world(scene, FINE)
    physics = CpuPhysics(world, SimConfig(), 1.0, NUM_ENVS, 2)
    batch = physics.batch
    batch.reset(stage=0)
    randomizer = Randomizer(world, physics, cfg or RandomizationConfig(), rng_for(0, "bank"))
    rng, ids = rng_for(0, "test"), np.arange(NUM_ENVS)
    randomizer.draw(ids, rng)
    poses = randomizer.place(ids, rng)
    qpos, ctrl = batch.bind("qpos"), batch.bind("ctrl")
    arm, tool, _ = randomizer.start_arm(NUM_ENVS, rng)
    qpos[:, :7], qpos[:, 7:9] = arm, FINGER_TRAVEL_M
    ctrl[:] = np.concatenate(
        [tool, np.tile(QUAT_DOWN, (NUM_ENVS, 1)), np.full((NUM_ENVS, 1), FINGER_TRAVEL_M)], axis=1
    )
    for k, obj in enumerate(world.objects):
        qpos[:, obj.qpos_adr : obj.qpos_adr + 7] = poses[:, k]
    return randomizer, batch, poses


@pytest.mark.parametrize(
    ("shape", "size", "hollow"),
    [
        ("box", (0.03, 0.06, 0.05), False),
        ("cylinder", (0.05, 0.05, 0.09), False),
        ("cylinder", (0.12, 0.12, 0.06), True),
        ("box", (0.12, 0.09, 0.06), True),
        ("mesh", (0.05, 0.07, 0.04), False),
    ],
    ids=["box", "cylinder", "bowl", "crate", "mesh"],
)
def test_objects_of_any_drawn_size_start_at_rest(
    shape: str,
    size: tuple[float, float, float],
    hollow: bool,
    make_object: Callable[..., SceneObject],
    make_scene: Callable[..., Scene],
    tmp_path: Path,
):
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "block.obj")
    thing = make_object(
        "thing", shape, size, hollow=hollow, mesh="block.obj" if shape == "mesh" else ""
    )
    randomizer, batch, poses = worlds_of(make_scene(thing, folder=tmp_path))
    adr = randomizer.world.objects[0].qpos_adr

    batch.step(nstep=100)

    moved = batch.bind("qpos")[:, adr : adr + 3] - poses[:, 0, :3]
    assert np.abs(moved[:, :2]).max() < 1e-3
    assert np.abs(moved[:, 2]).max() < 1e-3  # the gap of 0.5 mm closes, no more
    assert np.ptp(poses[:, 0, 2]) > 1e-3  # sizes did differ


@pytest.mark.parametrize(
    ("shape", "size"),
    [
        ("box", (0.10, 0.081, 0.05)),
        ("cylinder", (0.082, 0.082, 0.09)),
        ("sphere", (0.08, 0.08, 0.08)),
        ("mesh", (0.08, 0.12, 0.04)),
    ],
)
def test_no_object_is_drawn_wider_than_the_gripper_that_must_take_it(
    shape: str,
    size: tuple[float, float, float],
    make_object: Callable[..., SceneObject],
    make_scene: Callable[..., Scene],
    tmp_path: Path,
):
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "block.obj")
    thing = make_object("thing", shape, size, mesh="block.obj" if shape == "mesh" else "")
    lifted, pushed = (
        worlds_of(make_scene(thing, kind=kind, folder=tmp_path))[0].size_m[:, 0, :2].min(1)
        for kind in ("lift_up", "push_left")
    )

    assert lifted.max() < 2 * FINGER_TRAVEL_M < pushed.max()
    assert lifted.min() < 0.93 * min(size[:2])


def test_a_drawn_box_has_the_inertia_of_a_solid_box(
    make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
):
    randomizer, batch, _ = worlds_of(make_scene(make_object("cube", size_m=(0.03, 0.05, 0.07))))

    body = randomizer.world.objects[0].body_id
    x, y, z = randomizer.size_m[:, 0].T
    mass = randomizer.mass_kg[:, 0]
    expected = (mass / 12)[:, None] * np.stack([y**2 + z**2, x**2 + z**2, x**2 + y**2], axis=1)
    np.testing.assert_allclose(batch.expand("body_inertia")[:, body], expected, rtol=1e-9)
    np.testing.assert_allclose(batch.expand("body_mass")[:, body], mass)


@pytest.mark.parametrize("hollow", [False, True], ids=["solid", "hollow"])
def test_constants_that_depend_on_mass_agree_with_mujocos_own(
    hollow: bool, make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
):
    thing = make_object("thing", "box", (0.09, 0.12, 0.06), hollow=hollow)
    randomizer, batch, _ = worlds_of(make_scene(thing, kind="generic"))
    obj = randomizer.world.objects[0]

    model = batch.get_model(3)
    ours = {
        "body": model.body_invweight0[obj.body_id].copy(),
        "dof": model.dof_invweight0[obj.dof_adr : obj.dof_adr + 6].copy(),
        "subtree": model.body_subtreemass[obj.body_id],
    }
    mujoco.mj_setConst(model, mujoco.MjData(model))

    tolerance = 0.05 if hollow else 1e-6  # a container's centre of mass is off its origin
    np.testing.assert_allclose(ours["body"], model.body_invweight0[obj.body_id], rtol=tolerance)
    np.testing.assert_allclose(
        ours["dof"], model.dof_invweight0[obj.dof_adr : obj.dof_adr + 6], rtol=tolerance
    )
    assert ours["subtree"] == pytest.approx(model.body_subtreemass[obj.body_id])


def test_objects_never_overlap_and_stay_in_reach(
    make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
):
    scene = make_scene(
        make_object("cube"),
        make_object("can", "cylinder", (0.06, 0.06, 0.1), role="reference", pos=(0.05, 0.1, 0.05)),
        make_object("block", "box", (0.05, 0.09, 0.04), role="reference", pos=(0.02, -0.1, 0.02)),
    )

    randomizer, _, poses = worlds_of(scene)

    radius = np.linalg.norm(randomizer.size_m[:, :, :2], axis=2) / 2
    radius[:, 1] = randomizer.size_m[:, 1, 0] / 2
    for a, b in ((0, 1), (0, 2), (1, 2)):
        gap = (
            np.linalg.norm(poses[:, a, :2] - poses[:, b, :2], axis=1) - radius[:, a] - radius[:, b]
        )
        assert gap.min() > 0
    assert (poses[:, :, :2] >= np.array(OBJECT_LOW_M) - 1e-9).all()
    assert (poses[:, :, :2] <= np.array(OBJECT_HIGH_M) + 1e-9).all()


def test_a_reference_object_stays_on_its_side(
    make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
):
    left = make_object("can", "cylinder", (0.05, 0.05, 0.1), role="reference", pos=(0, 0.15, 0.05))

    _, _, poses = worlds_of(make_scene(make_object("cube"), left))

    offset = poses[:, 1, :2] - poses[:, 0, :2]
    angle = np.arctan2(offset[:, 1], offset[:, 0])
    assert np.abs(angle - np.pi / 2).max() < 3 * RandomizationConfig().layout_angle_rad


@pytest.mark.parametrize(("kind", "side"), [("push_left", 1.0), ("push_right", -1.0)])
def test_push_tasks_leave_room_on_the_side_they_push_to(
    kind: str,
    side: float,
    make_object: Callable[..., SceneObject],
    make_scene: Callable[..., Scene],
):
    _, _, poses = worlds_of(make_scene(make_object("cube"), kind=kind))

    goal = poses[:, 0, 1] + side * PUSH_ROOM_M
    assert (side * goal).max() <= OBJECT_HIGH_M[1] + 1e-9
    assert np.ptp(poses[:, 0, 1]) > 0.1


def test_without_randomisation_the_layout_is_the_videos(
    make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
):
    scene = make_scene(
        make_object("cube"),
        make_object(
            "can", "cylinder", (0.05, 0.05, 0.1), role="reference", pos=(0.06, 0.12, 0.05)
        ),
    )

    randomizer, _, poses = worlds_of(scene, ranges.none())

    assert np.ptp(poses, axis=0).max() == 0
    np.testing.assert_allclose(poses[0, 1, :2] - poses[0, 0, :2], (0.06, 0.12), atol=1e-9)
    np.testing.assert_allclose(randomizer.size_m[5, 0], (0.04, 0.04, 0.04))


@pytest.mark.parametrize("cover_first", [False, True])
def test_a_covered_object_starts_under_its_cover(
    cover_first: bool, make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
):
    if (
        cover_first
    ):  # the manipulated object of an uncovering is the cover, even where nobody said so
        things = (
            make_object("cup", "box", (0.08, 0.08, 0.1)),
            make_object(size_m=(0.025, 0.025, 0.04), role="reference"),
        )
    else:
        things = (make_object(), make_object("cup", "box", (0.11, 0.11, 0.1), role="cover"))

    randomizer, batch, poses = worlds_of(make_scene(*things, kind="uncover"))
    batch.step(nstep=100)

    np.testing.assert_allclose(poses[:, 0, :2], poses[:, 1, :2])
    adr = [o.qpos_adr for o in randomizer.world.objects]
    heights = batch.bind("qpos")[:, [a + 2 for a in adr]]
    assert np.abs(heights - poses[:, :, 2]).max() < 1e-3


def test_an_object_too_large_for_its_cover_is_rejected(
    make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
):
    cup = make_object("cup", "cylinder", (0.06, 0.06, 0.05), role="cover", hollow=True)

    with pytest.raises(ItemRejectedError, match="under 'cup'") as caught:
        worlds_of(make_scene(make_object("cube"), cup, kind="uncover"))

    assert caught.value.reason == "does_not_fit_under_cover"


def test_objects_without_room_are_rejected_by_name(
    make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
):
    plates = [
        make_object(f"plate{k}", "box", (0.34, 0.34, 0.02), pos=(0.0, 0.4 * k, 0.01))
        for k in range(4)
    ]

    with pytest.raises(ItemRejectedError, match="plate3") as caught:
        worlds_of(make_scene(*plates, kind="generic"))

    assert caught.value.reason == "no_room"


def test_what_was_drawn_can_be_written_as_json_and_differs_between_worlds(
    make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
):
    randomizer, batch, _ = worlds_of(make_scene(make_object("cube")))

    first, second = (json.loads(json.dumps(randomizer.drawn(i))) for i in (0, 1))

    assert first != second
    assert 10 <= first["action_delay_ms"] <= 20
    delays = batch.expand("actuator_delay")
    assert delays[0] == pytest.approx(first["action_delay_ms"] / 1e3, abs=1e-6)


def test_a_delay_longer_than_the_delay_line_is_refused():
    with pytest.raises(ValueError, match=r"delay_s is .*; 0 to 0.02 can"):
        RandomizationConfig(delay_s=(0.0, 0.05))


def tool_y(randomizer: Randomizer, batch: Batch) -> np.ndarray:
    robot = randomizer.world.robot
    qpos, qvel = batch.bind("qpos"), batch.bind("qvel")
    return robot.tool_state(qpos[:, robot.arm], qvel[:, robot.arm_dofs]).pos[:, 1].copy()


def test_the_tool_lags_by_damping_over_stiffness(
    make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
):
    cfg = RandomizationConfig(delay_s=(0.0, 0.0), servo_gain_scale=(0.8, 1.2))
    randomizer, batch, _ = worlds_of(make_scene(make_object("cube")), cfg)
    ctrl, speed = batch.bind("ctrl"), 0.1

    for _ in range(120):
        ctrl[:, 1] += speed * FINE.timestep_s
        batch.step(nstep=1)

    stiffness, damping = randomizer.servo_gain.T
    expected_s = damping * ServoConfig().position_kv / (stiffness * ServoConfig().position_kp)
    assert np.ptp(expected_s) > 0.015
    lag_s = (ctrl[:, 1] - tool_y(randomizer, batch)) / speed
    # The joints' own damping, 1 N m s, adds 1 to 2 ms.
    np.testing.assert_allclose(lag_s - 0.00125, expected_s, atol=0.00125)
    assert (lag_s > expected_s).all()
