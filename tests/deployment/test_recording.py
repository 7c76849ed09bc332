"""What was seen and done comes back from the recording, read by LeRobot."""

import numpy as np
import pytest

from v2p_data.deployment.limits import Guard, LimitsConfig
from v2p_data.deployment.loop import LoopConfig, Onlooker, Run
from v2p_data.deployment.recording import Recorder
from v2p_data.deployment.sight import Sight
from v2p_data.errors import V2PError
from v2p_data.sim.render.masks import labels_to_rgb


def test_lerobot_reads_back_masks_pictures_states_and_the_actions_that_passed_the_limits(
    seeing_robot, restarted, steady, click_on, tmp_path
):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    rig, sent = restarted(seeing_robot), []
    send = rig.act
    rig.act = lambda action: sent.append(action) or send(action)
    sight = Sight(seeing_robot.calibration(), [click_on(seeing_robot)])
    recorder, steps = Recorder("lifting the red box"), []
    limits = LimitsConfig(max_speed_m_s=0.3, max_silence_ms=60_000.0)
    cfg = LoopConfig(max_seconds=0.3, slow=True)
    onlooker = Onlooker(recorder=recorder, on_step=lambda r, s: steps.append((r, s)))
    rig.sight, rig.guard = sight, Guard(limits, rig.scale)
    Run(rig, steady(1, 0, 0, 0, 0, 0, 0), cfg, onlooker).go()

    packed = recorder.save(tmp_path / "run", "v2p/run", ("red box",), {"ending": "time"})

    assert packed is not None
    assert packed.num_frames == 6
    dataset = LeRobotDataset("v2p/run", root=tmp_path / "run")
    assert (len(dataset), dataset.fps) == (6, 20)
    assert sent[0][0] == pytest.approx(0.5)  # the policy wanted 1, and 0.3 m/s are half of that
    for row, (reading, seen), action in zip(dataset, steps, sent, strict=True):
        mask = (row["observation.images.mask"].numpy().transpose(1, 2, 0) * 255).round()
        rgb = row["observation.images.rgb"].numpy().transpose(1, 2, 0) * 255
        np.testing.assert_array_equal(mask, labels_to_rgb(seen.labels))
        assert np.abs(rgb - reading.picture).mean() < 4
        np.testing.assert_allclose(row["observation.state"], reading.state, atol=1e-6)
        np.testing.assert_allclose(row["action"], action, atol=1e-6)
        assert row["task"] == "lifting the red box"
    assert not (tmp_path / "run.partial").exists()


def test_a_place_that_is_taken_is_refused_and_left_alone(tmp_path):
    (tmp_path / "run").mkdir()
    with pytest.raises(V2PError, match="exists already"):
        Recorder("").save(tmp_path / "run", "v2p/run", (), {})


def test_a_run_without_steps_leaves_nothing(tmp_path):
    assert Recorder("").save(tmp_path / "run", "v2p/run", (), {}) is None
    assert not list(tmp_path.iterdir())
