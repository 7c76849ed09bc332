"""The robots under LeRobot's own tools: masks, limits and the check of the policy are those of `v2p deploy`."""

import json
import shutil

import numpy as np
import pytest

from v2p_data.deployment.limits import LimitsConfig
from v2p_data.episodes.dataset.features import ACTION_NAMES
from v2p_data.errors import V2PError
from v2p_data.scene.frames.mask_ops import iou
from v2p_data.sim.render.masks import rgb_to_labels

pytestmark = pytest.mark.slow


def action(**entries: float) -> dict[str, float]:
    return dict.fromkeys(ACTION_NAMES, 0.0) | {f"{k}.pos": v for k, v in entries.items()}


def test_the_twins_masks_are_those_of_the_training_camera(twin, blind_robot, restarted):
    trained = restarted(blind_robot, 3).read().labels

    overlaps = []
    for training_view in (True, False):
        robot = twin(seed=3, training_view=training_view)
        robot.connect()
        mask = robot.get_observation()["mask"]
        assert mask.shape == robot.observation_features["mask"]
        overlaps.append([iou(rgb_to_labels(mask) == k, trained == k) for k in (1, 2)])

    (robot_here, object_here), (robot_raw, object_raw) = overlaps
    assert robot_here > max(0.9, robot_raw)
    assert object_here > max(0.8, object_raw)


def test_the_twins_arm_waits_while_the_gripper_travels_unless_it_is_told_not_to(twin):
    moved = []
    for waits in (True, False):
        robot = twin(limits=LimitsConfig(wait_for_gripper=waits))
        robot.connect()
        sent = []
        for _ in range(6):
            robot.get_observation()
            sent.append(robot.send_action(action(delta_z=0.5, gripper_close=1.0)))
        moved.append(sent[-1]["delta_z.pos"])

    assert moved == [0.0, pytest.approx(0.5)]


def test_a_limit_acts_on_what_is_sent_to_the_twin(twin):
    robot = twin(limits=LimitsConfig(max_speed_m_s=0.1))
    robot.connect()
    robot.get_observation()

    sent = robot.send_action(action(delta_z=1.0))

    # 0.1 m/s for 50 ms are 5 mm of the 30 mm that an action of 1 is.
    assert sent["delta_z.pos"] == pytest.approx(5 / 30)


@pytest.fixture
def of_another_scale(policy_folder, tmp_path):
    """Return a policy that was trained with half the robot's displacement."""
    folder = shutil.copytree(policy_folder, tmp_path / "policy")
    steps = {"lifting the red box": 0.015}
    (folder / "v2p.json").write_text(json.dumps({"schema": 1, "position_steps_m": steps}))
    return folder


def test_a_policy_of_another_action_scale_does_not_connect(
    twin, of_another_scale, policy_folder, monkeypatch
):
    robot = twin(policy_path=str(of_another_scale))
    with pytest.raises(V2PError, match=r"0\.015 a step, and on this robot it is 0\.03"):
        robot.connect()
    assert not robot.is_connected

    # LeRobot's tools do not hand the policy over: their parser is asked for it.
    monkeypatch.setattr("sys.argv", ["lerobot-rollout", f"--policy.path={of_another_scale}"])
    with pytest.raises(V2PError, match="another action scale"):
        twin().connect()
    twin(check_policy=False).connect()
    twin(policy_path=str(policy_folder)).connect()


def test_the_simulated_arm_compares_the_policy_too(task_folder, of_another_scale, tmp_path):
    from lerobot_policy_v2p.robot.config_v2p_franka import V2PFrankaConfig
    from lerobot_policy_v2p.robot.v2p_franka import V2PFranka

    robot = V2PFranka(
        V2PFrankaConfig(
            task_folder=str(task_folder),
            policy_path=str(of_another_scale),
            calibration_dir=tmp_path,
        )
    )

    with pytest.raises(V2PError, match="another action scale"):
        robot.connect()
    assert not robot.is_connected


@pytest.mark.parametrize(
    ("said", "is_refused"),
    [
        ("lerobot-rollout --strategy.type=sentry --dataset.repo_id=user/rollout_a --fps=20", True),
        ("lerobot-rollout --dataset.repo_id user/rollout_a --dataset.fps 25", True),
        ("lerobot-rollout --dataset.repo_id=user/rollout_a --dataset.fps=20", False),
        ("lerobot-replay --dataset.repo_id=user/toys --dataset.episode=0", False),
        ("lerobot-rollout --strategy.type=base --fps=20", False),
    ],
)
def test_a_recording_that_would_tell_another_rate_is_refused_before_it_begins(
    twin, monkeypatch, said, is_refused
):
    monkeypatch.setattr("sys.argv", said.split())
    robot = twin()

    if is_refused:
        with pytest.raises(V2PError, match=r"takes 20 steps a second; say --dataset\.fps=20"):
            robot.connect()
    else:
        robot.connect()
    assert robot.is_connected is not is_refused


def test_a_run_without_success_ends_with_a_word_on_it(twin, caplog):
    caplog.set_level("INFO", "lerobot_policy_v2p.robot.simulated")
    robot = twin()
    robot.connect()
    for _ in range(2):
        robot.get_observation()
        robot.send_action(dict.fromkeys(robot.action_features, 0.0))

    robot.disconnect()

    assert caplog.messages == ["task 'rest' did not succeed in 2 steps"]


def test_a_policy_that_is_not_here_is_said_not_to_be_compared(twin, caplog):
    twin(policy_path="somebody/a_policy").connect()

    assert "somebody/a_policy is no folder here" in caplog.text


def test_clicks_are_followed_by_the_twin_itself_and_a_bad_one_is_refused(twin):
    from v2p_data.scene.backends.segment import points_inside

    robot = twin(seed=1)
    robot.connect()
    u, v = points_inside(robot.arm.robot.true_labels() == 2, 1)[0]
    true = rgb_to_labels(robot.get_observation()["mask"])
    seeing = twin(seed=1, clicks=f"{u:g},{v:g}")
    seeing.connect()
    try:
        seen = rgb_to_labels(seeing.get_observation()["mask"])
    except V2PError as error:
        if "OpenGL" in str(error):
            pytest.skip(str(error))
        raise

    assert iou(seen == 2, true == 2) > 0.7
    assert np.array_equal(seen == 1, true == 1)
    with pytest.raises(V2PError, match="a click is X,Y"):
        twin(clicks="here").connect()


def test_v2p_deploy_asks_the_twin_for_pictures_unless_it_is_told_otherwise(task_folder, tmp_path):
    from v2p_data.commands.deploy import connected

    words = [
        "--robot.type=v2p_twin",
        f"--robot.task_folder={task_folder}",
        f"--robot.calibration_dir={tmp_path}",
    ]
    with connected(words) as robot:
        assert [*robot.observation_features][-1] == "rgb"
    with connected([*words, "--robot.pictures=mask"]) as robot:
        assert [*robot.observation_features][-1] == "mask"
