"""Another arm than the built-in one: a small one with six joints, written here, its angles in degrees."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from v2p_data.craft_data import task_digest
from v2p_data.errors import V2PError
from v2p_data.pipeline.runner import Stage
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.sim.env import ranges
from v2p_data.sim.env.actions import steps_to, targets_of
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.sim.model.world import World, build_world
from v2p_data.sim.render.masks import BACKGROUND, FIRST_OBJECT, ROBOT, MaskRenderer, geom_labels
from v2p_data.sim.robot.arms import FRANKA_MJCF, RobotConfig, robot_from_json, robot_to_json
from v2p_data.sim.robot.robot import (
    COARSE,
    FINE,
    HOME_QPOS,
    ServoConfig,
    tool_state,
)
from v2p_data.stages import EngineConfig, SimulatorConfig, task_stage
from v2p_data.task.task import Task, TaskBundle

ARM = """
<mujoco model="six">
  <compiler angle="degree"/>
  <default>
    <default class="limb"><geom type="capsule" size="0.04" mass="1.5"/><joint range="-200 200"/></default>
    <default class="finger"><joint type="slide" range="0 0.04"/><geom type="box" size="0.011 0.006 0.03" mass="0.03"/></default>
  </default>
  <worldbody>
    <body name="column" childclass="limb">
      <geom fromto="0 0 0 0 0 0.3"/>
      <body name="turret" pos="0 0 0.35"><joint name="pan" axis="0 0 1"/><geom fromto="0 0 0 0 0 0.01"/>
        <body name="upper"><joint name="shoulder" axis="0 1 0"/><geom fromto="0 0 0 0 0 0.4"/>
          <body name="lower" pos="0 0 0.4"><joint name="elbow" axis="0 1 0"/><geom fromto="0 0 0 0 0 0.3"/>
            <body name="roll" pos="0 0 0.4"><joint name="roll" axis="0 0 1"/><geom fromto="0 0 -0.05 0 0 0"/>
              <body name="pitch"><joint name="pitch" axis="0 1 0"/><geom fromto="0 0 0 0 0 0.02"/>
                <body name="hand"><joint name="twist" axis="0 0 1" range="-360 360"/>
                  <geom name="palm" type="box" size="0.03 0.05 0.03" pos="0 0 0.06" mass="0.5"/>
                  <site name="grip" pos="0 0 0.145"/>
                  <body name="left" pos="0 0 0.12" childclass="finger"><joint name="slide_left" axis="0 1 0"/>
                    <geom name="pad_l" pos="0 0.006 0.01"/></body>
                  <body name="right" pos="0 0 0.12" childclass="finger"><joint name="slide_right" axis="0 -1 0"/>
                    <geom name="pad_r" pos="0 -0.006 0.01"/></body>
                </body></body></body></body></body></body></body>
  </worldbody>
  <actuator><motor joint="pan" gear="50"/><position joint="slide_left" kp="100"/></actuator>
  <sensor><jointpos joint="pan"/></sensor>
  <keyframe><key qpos="0 0 0 0 0 0 0 0"/></keyframe>
</mujoco>
"""
SIX = RobotConfig(
    eef_site="grip",
    fingers=("slide_left", "slide_right"),
    pads=("pad_l", "pad_r"),
    home_qpos=(0.0, 0.58, 1.78, 0.0, 0.78, np.pi),
)
CALM = SimConfig(fine=True, randomization=ranges.none())


@pytest.fixture
def six(tmp_path: Path) -> RobotConfig:
    path = tmp_path / "six.xml"
    path.write_text(ARM)
    return replace(SIX, path=path)


@pytest.fixture
def franka(tmp_path: Path) -> RobotConfig:
    """The built-in arm, read from a file as if it were a stranger's."""
    path = tmp_path / "franka.xml"
    path.write_text(FRANKA_MJCF)
    return RobotConfig(
        path=path,
        eef_site="tcp",
        fingers=("finger_left", "finger_right"),
        pads=("pad_left", "pad_right"),
        home_qpos=HOME_QPOS,
    )


@pytest.fixture
def world_of(make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]):
    def build(robot: RobotConfig) -> World:
        return build_world(make_scene(make_object()), FINE, robot=robot)

    return build


@pytest.fixture
def env_with(make_bundle: Callable[..., TaskBundle], lift_task: type[Task]):
    def make(robot: RobotConfig, cfg: SimConfig = CALM, num_envs: int = 8) -> BatchEnv:
        return BatchEnv(
            make_bundle(),
            replace(cfg, robot=robot),
            num_envs=num_envs,
            seed=0,
            num_threads=1,
            task=lift_task,
        )

    return make


def tilt_deg(env: BatchEnv) -> np.ndarray:
    """Angle between the gripper and straight down, per world."""
    return np.degrees(np.arccos(np.clip(-env._sim.tool.rotation[:, 2, 2], -1, 1)))


# --- kinematics --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "placed", [{}, {"base_pos_m": (0.1, -0.2, 0.05), "base_yaw_rad": 0.7}], ids=["origin", "moved"]
)
def test_the_tools_state_is_that_of_mujocos_site(
    placed: dict, six: RobotConfig, world_of: Callable[..., World]
):
    world = world_of(replace(six, **placed))
    model, robot = world.model, world.robot
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    data.qpos[robot.arm] = rng.uniform(-1, 1, 6)
    data.qvel[robot.arm_dofs] = rng.uniform(-1, 1, 6)
    mujoco.mj_forward(model, data)
    site = model.site("robot/v2p_tcp").id
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, site, velocity, 0)

    tool = robot.tool_state(data.qpos[None, robot.arm], data.qvel[None, robot.arm_dofs])

    np.testing.assert_allclose(tool.pos[0], data.site_xpos[site], atol=1e-9)
    np.testing.assert_allclose(tool.rotation[0].ravel(), data.site_xmat[site], atol=1e-9)
    np.testing.assert_allclose(tool.vel_linear[0], velocity[3:], atol=1e-9)
    np.testing.assert_allclose(tool.vel_angular[0], velocity[:3], atol=1e-9)


def test_the_built_in_arm_read_from_a_file_has_its_closed_form_kinematics(
    franka: RobotConfig, world_of: Callable[..., World]
):
    rng = np.random.default_rng(1)
    qpos, qvel = rng.uniform(-1, 1, (16, 7)) + HOME_QPOS, rng.uniform(-1, 1, (16, 7))

    ours, closed = world_of(franka).robot.tool_state(qpos, qvel), tool_state(qpos, qvel)

    np.testing.assert_allclose(ours.pos, closed.pos, atol=1e-9)
    np.testing.assert_allclose(ours.rotation, closed.rotation, atol=1e-9)
    np.testing.assert_allclose(ours.vel_linear, closed.vel_linear, atol=1e-9)
    np.testing.assert_allclose(ours.vel_angular, closed.vel_angular, atol=1e-9)
    same = np.abs((ours.quat_wxyz * closed.quat_wxyz).sum(1))
    np.testing.assert_allclose(same, 1.0, atol=1e-9)


def test_joint_angles_for_a_tool_pose_lead_back_to_it(six: RobotConfig, world_of):
    robot = world_of(six).robot
    rng = np.random.default_rng(2)
    pos = rng.uniform([0.38, -0.25, 0.05], [0.6, 0.25, 0.35], (32, 3))
    yaw = rng.uniform(-1, 1, 32)

    tool = robot.tool_state(robot.qpos_for(pos, yaw), np.zeros((32, 6)))

    np.testing.assert_allclose(tool.pos, pos, atol=1e-6)
    np.testing.assert_allclose(tool.rotation[:, 2, 2], -1, atol=1e-6)
    np.testing.assert_allclose(tool.rotation[:, 0, 0], np.cos(yaw), atol=1e-5)


# --- driving -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["six", "franka"])
def test_a_held_target_is_reached_to_a_tenth_of_a_millimetre_and_degree(
    name: str, request: pytest.FixtureRequest, env_with: Callable[..., BatchEnv]
):
    env = env_with(request.getfixturevalue(name))
    aim = np.zeros((8, 7))
    aim[:, :3] = 0.5, -0.5, 0.3

    for k in range(40):
        env.step(aim if k < 10 else np.zeros((8, 7)))

    assert np.linalg.norm(env._sim.tool.pos - env._sim.target_pos, axis=1).max() < 1e-4
    assert tilt_deg(env).max() < 0.1


def test_a_moving_target_is_followed_with_the_servos_lag(six: RobotConfig, env_with):
    env = env_with(six)
    aside = np.zeros((8, 7))
    aside[:, 1] = 0.5  # 1.5 cm per 50 ms: 0.3 m/s

    lags, tilts = [], []
    for _ in range(16):
        env.step(aside)
        lags.append(float(np.linalg.norm(env._sim.target_pos - env._sim.tool.pos, axis=1).max()))
        tilts.append(float(tilt_deg(env).max()))

    servo = ServoConfig()
    expected = 0.3 * servo.position_kv / servo.position_kp  # 15 mm behind
    assert lags[-1] == pytest.approx(expected, abs=0.006)
    assert max(lags) < 0.03
    assert max(tilts) < 2.0


@pytest.mark.parametrize("name", ["six", "franka"])
def test_a_scripted_grasp_lifts_the_cube(
    name: str, request: pytest.FixtureRequest, env_with: Callable[..., BatchEnv]
):
    cfg = SimConfig(fine=True)  # under randomisation
    env = env_with(request.getfixturevalue(name), cfg, num_envs=16)

    for k in range(70):
        states = {key: value.numpy() for key, value in env.states().items()}
        way = states["cube_pos"] - states["eef_pos"]
        action = np.zeros((16, 7))
        over = np.linalg.norm(way[:, :2], axis=1) < 0.015
        action[:, :2] = way[:, :2] / cfg.position_step_m
        action[:, 2] = np.where(over, way[:, 2], 0) / cfg.position_step_m
        x, y = states["cube_quat"][:, 0], states["cube_quat"][:, 3]
        yaw = 2 * np.arctan2(y, x)
        hand = Rotation.from_quat(states["eef_quat"], scalar_first=True).as_matrix()
        turn = (yaw - np.arctan2(hand[:, 1, 0], hand[:, 0, 0]) + np.pi / 4) % (np.pi / 2)
        action[:, 5] = (turn - np.pi / 4) / cfg.rotation_step_rad
        action[:, 6] = -1.0 if k < 35 else 1.0
        if k >= 45:
            action[:, :2], action[:, 2], action[:, 5] = 0, 0.5, 0
        env.step(action)

    states = env.states()
    lifted = (states["cube_pos"][:, 2] > states["cube_start_pos"][:, 2] + 0.1).numpy()
    assert lifted.mean() >= 0.9
    assert states["cube_grasped"].numpy()[lifted].all()


def test_observations_actions_and_states_are_laid_out_as_with_the_built_in_arm(
    six: RobotConfig, env_with: Callable[..., BatchEnv]
):
    ours, built_in = env_with(six), env_with(RobotConfig())

    assert ours.obs_dim == built_in.obs_dim
    assert ours.observe().shape == built_in.observe().shape
    assert {k: v.shape for k, v in ours.states().items()} == {
        k: v.shape for k, v in built_in.states().items()
    }
    np.testing.assert_allclose(ours.robot_state(), built_in.robot_state(), atol=1e-4)
    assert ours._sim.ctrl.shape == built_in._sim.ctrl.shape


def test_the_gripper_reports_its_own_opening(six: RobotConfig, env_with: Callable[..., BatchEnv]):
    env = env_with(six)

    assert env.states()["gripper_width"].numpy() == pytest.approx(0.08)
    assert env.robot_state()[:, 6] == pytest.approx(1.0)


def test_what_is_wedged_between_this_grippers_open_fingers_is_not_grasped(
    six: RobotConfig, env_with: Callable[..., BatchEnv]
):
    env = env_with(six, num_envs=3)
    opening = np.array([0.08, 0.0794, 0.0786])  # it opens by 80 mm; the built-in one by 85 mm
    env._sim.qpos[:, env.world.robot.fingers] = opening[:, None] / 2
    env._touches[:] = 1.0

    env._fill(np.arange(3), env._sim.look_at(np.arange(3)))

    assert env.states()["cube_grasped"].tolist() == [0.0, 0.0, 1.0]


def test_only_wrist_and_gripper_collide_and_nothing_of_the_files_own_drives(
    six: RobotConfig, world_of: Callable[..., World]
):
    model = world_of(six).model

    colliding = {
        model.body(model.geom_bodyid[g]).name
        for g in range(model.ngeom)
        if model.geom_contype[g] == 2
    }
    assert colliding == {f"robot/{b}" for b in ("roll", "pitch", "hand", "left", "right")}
    drivers = [model.actuator(k).name for k in range(len(model.actuator_trntype))]
    assert drivers == [f"servo_{what}" for what in ("x", "y", "z", "rotation", "gripper")]
    assert model.nkey == 0


def test_an_arm_that_stands_elsewhere_works_in_the_same_place(
    six: RobotConfig, env_with: Callable[..., BatchEnv]
):
    moved = replace(six, base_pos_m=(0.1, -0.15, 0.05), base_yaw_rad=0.5)

    ours, there = env_with(six), env_with(moved)

    np.testing.assert_allclose(ours._sim.tool.pos, there._sim.tool.pos, atol=1e-5)


# --- bad files ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"eef_site": "gripp"}, "has no site 'gripp', which eef_site names. Did you mean 'grip'?"),
        ({"fingers": ("slide_left", "slid")}, "has no joint 'slid', which fingers names"),
        ({"fingers": ("", "")}, "has no joint '', which fingers names"),
        ({"fingers": ("twist", "slide_right")}, "finger joint 'twist'"),
        ({"pads": ("pad_l", "pad_x")}, "has no geom 'pad_x', which pads names"),
        ({"home_qpos": (0.0, 1.0)}, "has 2 angles; it needs one for each of pan, shoulder"),
        ({"eef_site": "lower"}, "has 3 joints from its base to 'lower'; at least 6"),
        ({"base_pos_m": (-2.0, 0.0, 0.0)}, "cannot hold its tool at"),
    ],
)
def test_a_robot_that_is_not_as_its_config_says_is_one_sentence(
    change: dict, says: str, six: RobotConfig, env_with: Callable[..., BatchEnv]
):
    with pytest.raises(V2PError, match=r"six\.xml") as caught:
        env_with(replace(six, **change))

    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    ["", "not xml", "<mujoco><worldbody><body/></mujoco>"],
    ids=["empty", "text", "broken"],
)
def test_a_file_that_is_no_mjcf_is_refused_by_name(text: str, six: RobotConfig, env_with):
    assert six.path is not None
    six.path.write_text(text)

    with pytest.raises(V2PError, match=r"six\.xml is no MJCF that MuJoCo reads") as caught:
        env_with(six)

    assert "\n" not in str(caught.value)


def test_a_missing_file_is_refused_by_name(six: RobotConfig, env_with: Callable[..., BatchEnv]):
    with pytest.raises(V2PError, match=r"no robot file .*seven\.xml"):
        env_with(replace(six, path=six.path.with_name("seven.xml")))


def test_an_object_wider_than_this_arms_gripper_is_refused(
    six: RobotConfig, make_object: Callable[..., SceneObject], make_scene: Callable[..., Scene]
):
    box = make_object("box", size_m=(0.1, 0.081, 0.05))

    build_world(make_scene(box), COARSE)
    with pytest.raises(V2PError, match="gripper opens by 80 mm"):
        build_world(make_scene(box), COARSE, robot=six)


# --- as part of a task -------------------------------------------------------------------------------------------


def test_a_task_remembers_its_robot_in_its_json(six: RobotConfig):
    text = json.dumps(robot_to_json(six))

    assert robot_from_json(json.loads(text)) == six
    assert robot_to_json(RobotConfig()) == {}
    assert robot_from_json({}) == RobotConfig()


def test_a_task_carries_its_robots_files_and_needs_no_others(
    six: RobotConfig, make_bundle: Callable[..., TaskBundle], lift_task: type[Task], tmp_path: Path
):
    (tmp_path / "arms/meshes").mkdir(parents=True)
    trimesh.creation.box((0.02, 0.02, 0.02)).export(tmp_path / "arms/meshes/palm.stl")
    (tmp_path / "arms/LICENSE").write_text("free")
    palm = '<geom name="palm" type="mesh" mesh="palm" mass="0.5"/><geom type="box"'
    (tmp_path / "arms/xml").mkdir()
    (tmp_path / "arms/xml/arm.xml").write_text(
        ARM.replace('<geom name="palm" type="box"', palm).replace(
            "<worldbody>",
            '<asset><mesh name="palm" file="../meshes/palm.stl"/></asset><worldbody>',
            1,
        )
    )
    arm = replace(six, path=tmp_path / "arms/xml/arm.xml")
    scene = tmp_path / "scene"
    scene.mkdir()
    made = replace(make_bundle(folder=scene), robot=robot_to_json(arm))
    made.scene.save(scene)
    here = BatchEnv(made, CALM, num_envs=1, seed=0, num_threads=1, task=lift_task)

    made.save(tmp_path / "task")

    shutil.rmtree(tmp_path / "arms")
    written = json.loads((tmp_path / "task/task.json").read_text())
    assert written["robot"]["path"] == "robot/xml/arm.xml"
    loaded = TaskBundle.load(tmp_path / "task")
    loaded.save(tmp_path / "again")
    assert task_digest(tmp_path / "again") == task_digest(tmp_path / "task")
    there = BatchEnv(loaded, CALM, num_envs=1, seed=0, num_threads=1, task=lift_task)
    for env in (here, there):
        env.step(np.full((1, 7), 0.3))
    np.testing.assert_array_equal(
        here.snapshot(np.arange(1)).qpos, there.snapshot(np.arange(1)).qpos
    )


def test_a_task_of_an_earlier_version_says_what_to_do_about_its_robot(
    six: RobotConfig, make_bundle: Callable[..., TaskBundle], tmp_path: Path
):
    (tmp_path / "scene").mkdir()
    made = replace(make_bundle(folder=tmp_path / "scene"), robot=robot_to_json(six))
    made.scene.save(tmp_path / "scene")
    made.save(tmp_path / "task")
    file = tmp_path / "task/task.json"
    file.write_text(file.read_text().replace("robot/six.xml", str(six.path)))

    with pytest.raises(V2PError, match=r"robot\.path: .* own folder 'robot'.*--sim\.robot\.path"):
        TaskBundle.load(tmp_path / "task")


def test_a_task_for_another_robot_is_simulated_and_drawn_with_it(
    six: RobotConfig, make_bundle: Callable[..., TaskBundle], lift_task: type[Task]
):
    bundle = replace(make_bundle(), robot=robot_to_json(six))

    env = BatchEnv(bundle, CALM, num_envs=1, seed=0, num_threads=1, task=lift_task)
    with MaskRenderer(bundle, 64) as renderer:
        image = renderer.draw(env.snapshot(np.arange(1)), 0)

    assert env.world.robot.finger_travel_m == 0.04
    assert (image == ROBOT).sum() > 100
    assert (image == FIRST_OBJECT).sum() > 5


@pytest.mark.parametrize(
    ("scenery", "is_robot"),
    [
        ('<geom name="s" type="plane" size="3 3 0.1" pos="0 0 -0.01"/>', False),
        (
            '<body name="room"><geom name="s" type="box" size="2 2 0.01" pos="0 0 -0.02"/></body>',
            False,
        ),
        ('<geom name="s" type="box" size="0.01 2 1" pos="1.1 0 0.5"/>', False),
        ('<geom name="s" type="cylinder" size="0.15 0.2" pos="0 0 -0.2"/>', True),  # a pedestal
    ],
    ids=["plane", "slab", "wall", "pedestal"],
)
def test_a_floor_or_a_wall_in_the_arms_file_is_background(
    scenery: str, is_robot: bool, six: RobotConfig, world_of: Callable[..., World]
):
    plain = world_of(six)
    six.path.write_text(ARM.replace("<worldbody>", f"<worldbody>{scenery}"))

    world = world_of(six)

    labels, names = (
        geom_labels(world),
        [world.model.geom(g).name for g in range(world.model.ngeom)],
    )
    assert labels[names.index("robot/s")] == (ROBOT if is_robot else BACKGROUND)
    rest = np.delete(labels, names.index("robot/s"))
    assert sorted(rest) == sorted(geom_labels(plain))


def test_the_robots_file_and_settings_are_part_of_the_tasks_recipe(
    six: RobotConfig, tmp_path: Path
):
    def recipe(robot: RobotConfig) -> dict:
        video = Stage(name="scene", item="clip", config={}, make=lambda *_: {})
        return task_stage(video, EngineConfig(sim=SimulatorConfig(robot=robot))).recipe

    assert not any(name.startswith("robot") for name in recipe(RobotConfig())["sources"])
    assert {"robot", "robot file"} <= set(recipe(six)["sources"])
    before = recipe(six)
    assert recipe(replace(six, base_yaw_rad=0.1)) != before
    copy = tmp_path / "copy.xml"
    copy.write_text(ARM)
    assert recipe(replace(six, path=copy)) == before
    copy.write_text(ARM.replace("0.4", "0.5"))
    assert recipe(replace(six, path=copy)) != before


BALL = '<body name="ball" pos="0.5 0 0.5"><freejoint/><geom name="ball" size="0.03"/></body>'
DRAWER = '<body name="drawer" pos="1 0 0.3"><joint type="slide"/><geom size="0.05"/></body>'


@pytest.mark.parametrize(
    ("scenery", "after"),
    [
        ('<geom type="plane" size="2 2 .1"/><light pos="0 0 3"/><camera name="view"/>', ""),
        (BALL, '<contact><pair geom1="ball" geom2="palm"/></contact>'),
        (DRAWER, '<option gravity="0 0 0"><flag contact="disable" equality="disable"/></option>'),
        (
            BALL + DRAWER,
            '<equality><weld body1="ball" body2="drawer"/><weld body1="hand" active="false"/></equality>',
        ),
        ("", '<contact><exclude body1="world" body2="hand"/></contact>'),
        (BALL, '<sensor><touch site="grip"/></sensor><keyframe><key name="first"/></keyframe>'),
        (
            "",
            '<tendon><fixed stiffness="1e4"><joint joint="slide_left" coef="1"/></fixed></tendon>',
        ),
    ],
    ids=[
        "floor, light, camera",
        "free ball that is to touch",
        "drawer",
        "scenery in one piece",
        "nothing that may not touch",
        "sensors, keyframes",
        "a spring at a finger",
    ],
)
@pytest.mark.filterwarnings("ignore:Attach conflict")
def test_scenery_in_a_robots_file_touches_nothing_and_moves_no_joint_of_the_arm(
    scenery: str, after: str, six: RobotConfig, world_of: Callable[..., World]
):
    plain = world_of(six)
    assert six.path is not None
    text = ARM.replace("<worldbody>", "<worldbody>" + scenery).replace("</mujoco>", after)
    six.path.write_text(text + "</mujoco>")

    world = world_of(six)

    def colliding(model: mujoco.MjModel) -> set[str]:
        return {model.geom(i).name for i in range(model.ngeom) if model.geom_contype[i]}

    assert colliding(world.model) == colliding(plain.model)
    for count in ("npair", "nu", "nexclude", "nsensor", "nkey", "ntendon"):
        assert getattr(world.model, count) == getattr(plain.model, count), count
    assert world.model.opt.gravity.tolist() == plain.model.opt.gravity.tolist()
    assert world.model.opt.disableflags == plain.model.opt.disableflags
    names = [[w.model.joint(i).name for i in range(w.model.njnt)] for w in (plain, world)]
    assert [n for n in names[1] if n in names[0]] == names[0]
    assert world.robot.arm.stop == world.robot.fingers.start


@pytest.mark.parametrize(
    ("held", "constraint"),
    [
        ("hand", '<weld body1="hand"/>'),
        ("hand", '<weld body1="ball" body2="hand"/>'),
        ("hand", '<weld site1="grip" site2="top"/>'),
        ("left", '<weld body1="right" body2="left"/>'),
        ("upper", '<connect body1="upper" anchor="0 0 0"/>'),
        ("pan", '<joint joint1="pan"/>'),
        ("elbow", '<joint joint1="elbow" joint2="drawer"/>'),
        ("a tendon", '<tendon tendon1="rope"/>'),
    ],
)
def test_a_robot_file_that_holds_its_arm_is_refused(
    held: str, constraint: str, six: RobotConfig, world_of: Callable[..., World]
):
    assert six.path is not None
    drawer = DRAWER.replace("<joint", '<joint name="drawer"')
    ball = BALL.replace("</body>", '<site name="top"/></body>')
    rope = '<tendon><fixed name="rope"><joint joint="pan" coef="1"/></fixed></tendon>'
    text = ARM.replace("<worldbody>", "<worldbody>" + ball + drawer)
    six.path.write_text(
        text.replace("</mujoco>", f"{rope}<equality>{constraint}</equality></mujoco>")
    )

    with pytest.raises(V2PError, match=f"holds '{held}'") as caught:
        world_of(six)

    assert "\n" not in str(caught.value)


def test_a_robot_file_cannot_name_an_object_of_the_scene(
    six: RobotConfig, world_of: Callable[..., World]
):
    assert six.path is not None
    cube = world_of(six).model.body(world_of(six).model.nbody - 1).name
    glue = f'<equality><weld body1="hand" body2="{cube}"/></equality></mujoco>'
    six.path.write_text(ARM.replace("</mujoco>", glue))

    with pytest.raises(V2PError, match=f"unknown element '{cube}'"):
        world_of(six)


def test_targets_of_its_joints_lead_to_where_steps_lead(env_with, six):
    env = env_with(six)
    rng = np.random.default_rng(0)
    for step in rng.uniform(-0.5, 0.5, (10, 8, 7)).astype(np.float32) * [1, 1, 1, 0.2, 0.2, 1, 1]:
        target = targets_of(env, step, "joints")

        made = steps_to(env, target, "joints")

        assert target.shape == (8, 7)  # six joints and the gripper
        led, wanted = env.targets_after(made), env.targets_after(step)
        assert max(np.abs(a - b).max() for a, b in zip(led, wanted, strict=True)) < 1e-8
        env.step(step)
