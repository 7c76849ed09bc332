"""`v2p deploy` and `lerobot-rollout` from end to end on the simulated arm, seen by its colour pictures."""

import json
import logging
import shutil
import signal
import warnings

import numpy as np
import pytest

from v2p_data.cli import run
from v2p_data.commands.deploy import connected, robot_config, robot_settings
from v2p_data.errors import V2PError

pytestmark = pytest.mark.slow


@pytest.fixture
def words(policy_folder, task_folder, tmp_path, seeing_robot):
    """Return the command's words for the simulated arm; `seeing_robot` has skipped where there is no OpenGL."""
    return [
        "deploy",
        str(policy_folder),
        "--robot.type=v2p_franka",
        f"--robot.task_folder={task_folder}",
        f"--robot.calibration_dir={tmp_path}",
        "--slow",
        "--max-seconds",
        "0.4",
        "--limits.max-silence-ms",
        "60000",
    ]


@pytest.fixture
def click(seeing_robot, restarted, click_on):
    restarted(seeing_robot)
    u, v = click_on(seeing_robot)
    return ["--click", f"{u:g},{v:g}"]


def test_a_policy_runs_from_one_click_and_its_run_is_recorded(words, click, tmp_path, capsys):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    out = tmp_path / "run"

    code = run([*words, *click, "--record", str(out), "--objects", "red box"])

    told = capsys.readouterr().out
    assert code == 0
    assert "8 steps" in told
    assert "the 0.4 s are up, after 8 steps (0.4 s); the robot holds its position" in told
    dataset = LeRobotDataset("v2p/deployed", root=out)
    assert len(dataset) == 8
    said = json.loads((out / "meta/v2p.json").read_text())["episodes"][0]
    assert said["labels"] == {"0": "background", "1": "robot", "2": "red box"}
    assert said["task"] == "lifting the red box"
    assert said["params"]["ending"] == "time"
    assert len(said["params"]["limits_acted"]) == 8
    assert run([*words, *click, "--record", str(out)]) == 2
    assert "exists already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--click", "250,250"], "on the table or the background"),
        (["--click", "here"], "a click is X,Y"),
        (["--click", "128,100", "--limits.max-speed-m-s", "-1"], "--limits.max-speed-m-s must be"),
        (
            ["--click", "128,100", "--limits.workspace-low-m", "0.65", "-0.3", "0.0"],
            "outside the workspace",
        ),
        (["--robot.type=v2p_frank"], "Did you mean 'v2p_franka'?"),
        (["--robot.backend=network"], "--robot.address=HOST:PORT"),
        (["--robot.colour=red"], "colour"),
        (
            ["--robot.backend=network", "--robot.address=127.0.0.1:9"],
            "no driver answers at 127.0.0.1:9",
        ),
    ],
)
def test_bad_input_gets_one_sentence(words, more, told, capsys):
    assert run([*words, *more]) == 2

    said = capsys.readouterr().err
    assert told in said
    assert said.count("\n") == 1


def test_a_policy_of_another_network_is_told_so(words, click, tmp_path, capsys):
    policy = shutil.copytree(words[1], tmp_path / "policy")
    config = json.loads((policy / "config.json").read_text())
    (policy / "config.json").write_text(json.dumps({**config, "head_dim": 32}))

    assert run(["deploy", str(policy), *words[2:], *click]) == 2

    said = capsys.readouterr().err
    assert "weights and settings are not of one training" in said


def test_the_robots_words_are_told_from_the_others():
    robot, others = robot_settings(
        ["P", "--robot.type", "v2p_franka", "--click", "1,2", "--robot.seed=3"]
    )

    assert robot == ["--robot.type=v2p_franka", "--robot.seed=3"]
    assert others == ["P", "--click", "1,2"]
    with pytest.raises(V2PError, match="say which robot"):
        robot_config([])


def test_a_robot_is_disconnected_whatever_happens(task_folder, tmp_path):
    words = [
        "--robot.type=v2p_franka",
        f"--robot.task_folder={task_folder}",
        f"--robot.calibration_dir={tmp_path}",
    ]
    seen = []

    def fail() -> None:
        with connected(words) as robot:
            seen.append((robot, robot.is_connected, robot.config.pictures))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert seen[0][1:] == (True, "rgb")
    assert not seen[0][0].is_connected


def test_lerobots_own_rollout_sees_by_tracking_from_a_click(
    policy_folder, task_folder, tmp_path, click, monkeypatch
):
    from lerobot.scripts.lerobot_rollout import main

    from lerobot_policy_v2p.robot.simulated import SimulatedArm
    from lerobot_policy_v2p.robot.v2p_franka import V2PFranka
    from v2p_data.sim.render.masks import rgb_to_labels

    seen = []
    observe = V2PFranka.get_observation

    def noted(self):
        said = observe(self)
        assert isinstance(self.arm, SimulatedArm)
        seen.append((rgb_to_labels(said["mask"]) == 2, rgb_to_labels(self.arm.mask()) == 2))
        return said

    monkeypatch.setattr(V2PFranka, "get_observation", noted)
    monkeypatch.setattr(
        "sys.argv",
        [
            "lerobot-rollout",
            "--strategy.type=base",
            f"--policy.path={policy_folder}",
            "--robot.type=v2p_franka",
            f"--robot.task_folder={task_folder}",
            f"--robot.clicks={click[1]}",
            f"--robot.calibration_dir={tmp_path}",
            "--task=lifting the red box",
            "--duration=3",
            "--fps=20",
            "--device=cpu",
            "--play_sounds=false",
            "--return_to_initial_position=false",
        ],
    )
    root = logging.getLogger()
    level, handlers = root.level, root.handlers[:]
    signals = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        main()
    root.handlers[:] = handlers
    root.setLevel(level)
    for number, handler in signals.items():
        signal.signal(number, handler)

    assert len(seen) > 3
    overlaps = [(a & b).sum() / (a | b).sum() for a, b in seen]
    assert np.mean(overlaps) > 0.9


def test_a_gpu_that_is_not_there_is_one_sentence_before_a_robot_is_asked(capsys):
    assert run(["deploy", "nowhere", "--robot.type=v2p_twin", "--device=mps"]) == 2
    assert "--device mps is not on this machine; it has cpu" in capsys.readouterr().err
