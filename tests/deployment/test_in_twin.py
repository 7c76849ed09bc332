"""The loop in the twin: another simulator, whose pictures and readings are as late and as wrong as a real arm's."""

import json
import shutil

import numpy as np
import pytest

from v2p_data.deployment.limits import Guard, LimitsConfig
from v2p_data.deployment.loop import LoopConfig, Onlooker, Run
from v2p_data.deployment.rig import Rig
from v2p_data.deployment.robot import ActionScale
from v2p_data.deployment.sight import Sight
from v2p_data.errors import V2PError
from v2p_data.scene.backends.segment import points_inside
from v2p_data.scene.frames.mask_ops import iou
from v2p_data.task.task import TASK_FILE

pytestmark = pytest.mark.slow


def test_the_twin_says_the_action_scale_of_its_task(task_folder, tmp_path):
    from lerobot_policy_v2p.robot.config_v2p_twin import V2PTwinConfig
    from lerobot_policy_v2p.robot.v2p_twin import V2PTwin

    far = shutil.copytree(task_folder, tmp_path / "far")
    task = json.loads((far / TASK_FILE).read_text())
    (far / TASK_FILE).write_text(json.dumps({**task, "motion_scale": 2.0}))
    robot = V2PTwin(V2PTwinConfig(task_folder=str(far), calibration_dir=tmp_path))
    robot.connect()

    scale = Rig(robot).scale
    before = robot.arm.target.pos[2]
    robot.arm.carry_out(np.array([0, 0, 1.0, 0, 0, 0, 0]))
    moved = robot.arm.target.pos[2] - before
    robot.disconnect()

    assert scale == ActionScale(position_step_m=2 * ActionScale.position_step_m)
    assert moved == pytest.approx(scale.position_step_m)


def test_the_twin_is_seen_from_one_click_and_kept_within_limits(task_folder, steady, tmp_path):
    from lerobot_policy_v2p.robot.config_v2p_twin import V2PTwinConfig
    from lerobot_policy_v2p.robot.v2p_twin import V2PTwin

    robot = V2PTwin(
        V2PTwinConfig(task_folder=str(task_folder), pictures="rgb", calibration_dir=tmp_path)
    )
    robot.connect()
    rig, places, seen_labels, true = Rig(robot), [], [], []
    try:
        rig.read()
    except V2PError as error:
        pytest.skip(str(error))
    u, v = points_inside(robot.arm.robot.true_labels() == 2, 1)[0]
    sight = Sight(robot.calibration(), [(float(u), float(v))])

    read = rig.read

    def noted():
        reading = read()
        true.append(robot.arm.robot.true_labels())
        return reading

    rig.read = noted
    limits = LimitsConfig(max_speed_m_s=0.2, max_silence_ms=60_000.0)

    def note(reading, seen):
        places.append(reading.tool_pos)
        seen_labels.append(seen.in_picture)

    cfg, noting = LoopConfig(max_seconds=0.6, slow=True), Onlooker(on_step=note)
    rig.sight, rig.guard = sight, Guard(limits, rig.scale)
    outcome = Run(rig, steady(0.3, 0, 1, 0, 0, 0, 0), cfg, noting).go()
    robot.disconnect()

    assert (outcome.ending, outcome.steps) == ("time", 12)
    assert outcome.acted["speed"] == 12
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() * 20 < 0.2 * 1.3
    overlaps = [iou(a == 2, b == 2) for a, b in zip(seen_labels, true[-12:], strict=True)]
    assert np.mean(overlaps) > 0.8
