"""Policies that do not suit the simulator are turned away, and those that do see what LeRobot would show them."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from v2p_data.sim.render.masks import PALETTE, labels_to_rgb

pytestmark = pytest.mark.slow

MASK, STATE = "observation.images.mask", "observation.state"
WRIST, RGB = "observation.images.mask_wrist", "observation.images.rgb"


def checkpoint(folder, cameras=(MASK,), state_dim=11, act_dim=7, sizes=None):
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    from policies.bc.configuration_v2p_bc import V2PBCConfig

    shapes = dict.fromkeys(cameras, (3, 48, 64)) | (sizes or {})
    seen = {key: PolicyFeature(FeatureType.VISUAL, shape) for key, shape in shapes.items()}
    config = V2PBCConfig(
        input_features={**seen, STATE: PolicyFeature(FeatureType.STATE, (state_dim,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (act_dim,))},
        device="cpu",
        push_to_hub=False,
    )
    config.save_pretrained(folder)
    return folder


@pytest.mark.parametrize(
    ("odd", "said"),
    [
        (
            {"state_dim": 7},
            r"'observation\.state' of shape \(7,\), and the simulator gives \(11,\)",
        ),
        ({"act_dim": 8}, r"'action' of shape \(8,\), and the simulator gives \(7,\)"),
        (
            {"cameras": [MASK, "observation.images.top"]},
            r"wants 'observation\.images\.top' \(3, 48, 64\), which the simulator does not give",
        ),
        ({"cameras": []}, r"has no camera; it wants observation\.state"),
        ({"sizes": {RGB: (3, 48, 48)}, "cameras": [MASK, RGB]}, "wants pictures of several sizes"),
    ],
)
def test_a_policy_that_wants_something_else_is_told_what_there_is(tmp_path, odd, said):
    from policies.evaluation.actor import UnsuitablePolicyError, load_actor

    with pytest.raises(UnsuitablePolicyError, match=said):
        load_actor(checkpoint(tmp_path, **odd), greys=PALETTE)


@pytest.mark.parametrize(
    ("wanted", "shown"),
    [([MASK], (MASK,)), ([RGB], (RGB,)), ([RGB, WRIST], (MASK, WRIST, RGB))],
)
def test_a_policy_is_shown_the_cameras_and_the_size_that_it_knows(tmp_path, wanted, shown):
    from policies.evaluation.actor import check_features
    from policies.evaluation.rollout import env_config

    found = check_features(checkpoint(tmp_path, wanted), env_config(rgb=True))

    assert found == (48, 64, shown)


@pytest.mark.parametrize("cameras", [(MASK,), (RGB,), (MASK, WRIST, RGB)])
def test_another_policy_type_sees_what_lerobot_shows_it(cameras):
    from lerobot.envs.utils import preprocess_observation

    from policies.evaluation.actor import PolicyActor
    from policies.evaluation.rollout import LoadedPolicy

    class Records:
        def eval(self):
            pass

        def reset(self):
            pass

        def select_action(self, observation):
            self.seen = observation
            return torch.zeros(2, 7)

    def same(data):
        return data

    rng = np.random.default_rng(0)
    labels = rng.integers(0, len(PALETTE), (2, 12 * (1 + (WRIST in cameras)), 16)).astype(np.uint8)
    rgb = rng.integers(0, 256, (2, 12, 16, 3)).astype(np.uint8)
    state = np.arange(22, dtype=np.float32).reshape(2, 11)
    policy = Records()
    actor = PolicyActor(
        loaded=LoadedPolicy(policy=policy, preprocessor=same, postprocessor=same),
        before=same,
        after=same,
        values=np.asarray(PALETTE, np.float32) / np.float32(255),
        channels=3,
        task="lifting a cube",
        size_px=(12, 16),
        cameras=cameras,
    )
    actor.reset(2)

    action = actor.act(labels, state, rgb)

    drawn = {MASK: labels_to_rgb(labels[:, :12]), WRIST: labels_to_rgb(labels[:, 12:]), RGB: rgb}
    pixels = {key.rpartition(".")[2]: drawn[key] for key in cameras}
    theirs = preprocess_observation({"pixels": pixels, "agent_pos": state})
    assert action.shape == (2, 7)
    assert policy.seen.pop("task") == ["lifting a cube"] * 2
    assert policy.seen.keys() == theirs.keys()
    for key, value in theirs.items():
        torch.testing.assert_close(policy.seen[key], value, rtol=0, atol=0)


@pytest.mark.long
def test_lerobots_own_types_are_known_in_a_process_that_has_read_no_policy_yet():
    code = (
        "from policies.evaluation.rollout import env_config; env_config()\n"
        "from lerobot.configs import PreTrainedConfig; PreTrainedConfig.get_choice_class('act')"
    )

    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
