"""Policies that do not suit the robot get one sentence that names what does not."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from v2p_data.deployment.checks import check_policy, unknowns
from v2p_data.deployment.robot import ActionScale
from v2p_data.episodes.dataset.features import ACTION_NAMES, STATE_NAMES
from v2p_data.errors import V2PError
from v2p_data.evaluation.facts import Facts, facts_of_dataset, write_facts

OFFER = (256, 256), ActionScale()
BEFORE = "policy_preprocessor_step_3_normalizer_processor.safetensors"
AFTER = "policy_postprocessor_step_0_unnormalizer_processor.safetensors"


@pytest.fixture
def policy(policy_folder, tmp_path):
    return shutil.copytree(policy_folder, tmp_path / "policy")


def told(policy, offer=OFFER, task=""):
    with pytest.raises(V2PError) as error:
        check_policy(policy, *offer, task)
    sentence = str(error.value)
    assert str(policy) in sentence
    assert "\n" not in sentence
    return sentence


def changed(policy, **fields):
    path = policy / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **fields}))
    return policy


def with_facts(policy, **fields):
    known = {
        "fps": 20.0,
        "state": STATE_NAMES,
        "action": ACTION_NAMES,
        "position_steps_m": {"lift": 0.03},
        "rotation_step_rad": 0.2,
        "finger_step_m": 0.012,
    }
    (policy / "v2p.json").write_text(json.dumps({"schema": 1, **known, **fields}))
    return policy


def test_a_policy_that_suits_passes_and_what_it_does_not_say_is_named(policy):
    facts = check_policy(policy, *OFFER)

    assert facts == Facts()
    assert "its rate (taken to be 20 Hz)" in unknowns(facts)
    assert unknowns(check_policy(with_facts(policy), *OFFER)) == ""


def test_a_truncated_checkpoint(policy):
    weights = policy / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[: weights.stat().st_size // 2])
    assert "is damaged or cut off" in told(policy)


def test_a_missing_or_garbled_checkpoint(policy):
    (policy / "policy_preprocessor.json").write_text('{"steps": [')
    assert "policy_preprocessor.json: Invalid JSON" in (said := told(policy))
    assert "at line 1 column 11; copy the policy anew" in said
    (policy / "model.safetensors").unlink()
    assert "holds no model.safetensors" in told(policy)
    (policy / "config.json").unlink()
    assert "holds no config.json: it is no LeRobot policy" in told(policy)


def test_a_processor_that_names_a_program_is_not_asked(policy, tmp_path):
    path = policy / "policy_postprocessor.json"
    said = json.loads(path.read_text())
    step = {"class": "subprocess.Popen", "config": {"args": ["touch", str(tmp_path / "canary")]}}
    path.write_text(json.dumps({**said, "steps": [step, *said["steps"]]}))

    assert "names 'subprocess.Popen'" in told(policy)
    assert not (tmp_path / "canary").exists()


def test_other_features(policy):
    inputs = json.loads((policy / "config.json").read_text())["input_features"]
    front = {"observation.images.front": {"type": "VISUAL", "shape": [3, 256, 256]}}
    assert "wants 'observation.images.front'" in told(
        changed(policy, input_features=inputs | front)
    )
    state = {"observation.state": {"type": "STATE", "shape": [7]}}
    assert "'observation.state' of shape (7,)" in told(
        changed(policy, input_features=inputs | state)
    )
    blind = {"observation.state": inputs["observation.state"]}
    assert "does not look at 'observation.images.mask'" in told(
        changed(policy, input_features=blind)
    )


def test_another_robots_actions(policy):
    six = {"action": {"type": "ACTION", "shape": [6]}}
    assert "gives 'action' of shape (6,)" in told(changed(policy, output_features=six))


def test_another_image_size(policy):
    inputs = json.loads((policy / "config.json").read_text())["input_features"]
    inputs["observation.images.mask"]["shape"] = [3, 64, 96]
    sentence = told(changed(policy, input_features=inputs))
    assert "pictures of 96 x 64 pixels, and the robot gives 256 x 256" in sentence


def test_another_palette(policy):
    assert "grey 64 is label 1 here and 2 there" in told(changed(policy, mask_greys=[0, 128, 64]))


@pytest.mark.parametrize(
    ("file", "key"), [(BEFORE, "observation.state.std"), (AFTER, "action.max")]
)
def test_a_missing_statistic(policy, file, key):
    stats = load_file(policy / file)
    name, statistic = key.rsplit(".", 1)
    save_file({k: v for k, v in stats.items() if k != key}, policy / file)
    assert f"lacks the statistic '{statistic}' of '{name}'" in told(policy)


def test_a_statistic_that_is_no_number_or_of_another_length(policy):
    stats = load_file(policy / BEFORE)
    save_file({**stats, "observation.state.mean": np.full(11, np.nan)}, policy / BEFORE)
    assert "is not finite" in told(policy)
    save_file({**stats, "observation.state.mean": np.zeros(5)}, policy / BEFORE)
    assert "has shape (5,)" in told(policy)


def test_another_action_scale_by_the_statistics(policy):
    stats = load_file(policy / AFTER)
    metres = np.float32([0.03, 0.03, 0.03, 0.2, 0.2, 0.2, 1])
    save_file({**stats, "action.max": metres, "action.min": -metres}, policy / AFTER)
    assert "displacements never exceed 0.03" in told(policy)
    save_file({**stats, "action.max": np.full(7, 40.0)}, policy / AFTER)
    assert "reaches 40" in told(policy)


def test_another_action_scale_by_what_the_training_says(policy):
    throws = {"throw": 0.06, "lift": 0.03}
    with_facts(policy, position_steps_m=throws)
    check_policy(policy, *OFFER, "lift")
    assert "displacement [m] of 0.06 a step, and on this robot it is 0.03" in told(
        policy, task="throw"
    )
    assert "rotation [rad] of 0.05" in told(with_facts(policy, rotation_step_rad=0.05))


def test_another_rate(policy):
    assert "trained at 30 frames per second, and the loop runs at 20 Hz" in told(
        with_facts(policy, fps=30.0)
    )


def test_other_names(policy):
    joints = [f"joint_{k}.pos" for k in range(7)]
    assert "actions named joint_0.pos" in told(with_facts(policy, action=joints))
    swapped = [ACTION_NAMES[1], ACTION_NAMES[0], *ACTION_NAMES[2:]]
    assert "the same in another order" in told(with_facts(policy, action=swapped))


def test_a_datasets_own_words_are_written_beside_the_policy(policy, tmp_path):
    dataset = tmp_path / "dataset"
    (dataset / "meta").mkdir(parents=True)
    (dataset / "v2p/tasks/throw").mkdir(parents=True)
    features = {
        "action": {"names": list(ACTION_NAMES)},
        "observation.state": {"names": list(STATE_NAMES)},
    }
    (dataset / "meta/info.json").write_text(json.dumps({"fps": 20, "features": features}))
    (dataset / "meta/v2p.json").write_text(json.dumps({"palette": {"0": 0, "1": 64, "10": 9}}))
    (dataset / "v2p/tasks/throw/task.json").write_text(
        json.dumps({"description": "throw it", "motion_scale": 2.0})
    )

    write_facts(policy, dataset)

    facts = check_policy(policy, (256, 256), ActionScale(position_step_m=0.06))
    assert facts == facts_of_dataset(dataset)
    assert facts.position_steps_m == {"throw it": pytest.approx(0.06)}
    assert facts.palette == (0, 64, 9)
    (dataset / "meta/info.json").write_text("[]")
    with pytest.raises(V2PError, match="no JSON object"):
        facts_of_dataset(dataset)


@pytest.mark.parametrize(
    "dataset",
    [
        [1],
        7,
        "here",
        {"root": 5},
        {"root": ["a"]},
        {"root": {}},
        {"root": "x" * 5000},
        {"root": "\0"},
        None,
    ],
)
def test_a_training_that_names_its_dataset_oddly(policy, dataset):
    (policy / "train_config.json").write_text(json.dumps({"dataset": dataset}))
    root = dataset.get("root") if isinstance(dataset, dict) else None

    if dataset is None or isinstance(root, str) or root == {}:
        assert check_policy(policy, *OFFER) == Facts()
    else:
        assert "train_config.json names no dataset" in told(policy)


@pytest.mark.parametrize("spoil", [os.mkfifo, Path.mkdir, lambda path: path.write_text("noise")])
def test_only_files_that_a_processor_names_are_opened(policy, spoil):
    spoil(policy / "policy_postprocessor_old.safetensors")

    assert check_policy(policy, *OFFER) == Facts()
    (policy / AFTER).unlink()
    spoil(policy / AFTER)
    assert AFTER in told(policy)
