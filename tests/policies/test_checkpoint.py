"""A policy from elsewhere is opened, or refused in one sentence that names its folder; nothing else happens."""

import importlib.util
import json
import resource
import shutil
import time
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import spoiled
import torch

from v2p_data.cli import run
from v2p_data.errors import V2PError
from v2p_data.evaluation.checkpoint import (
    CONFIG_FILE,
    ConfigFile,
    StepName,
    Type,
    check_checkpoint,
)
from v2p_data.evaluation.judging import contestant, play_of

TINY: dict[str, dict[str, Any]] = {
    "act": {
        "chunk_size": 2,
        "n_action_steps": 2,
        "dim_model": 16,
        "n_heads": 2,
        "dim_feedforward": 16,
        "n_encoder_layers": 1,
        "n_vae_encoder_layers": 1,
    },
    "diffusion": {
        "horizon": 8,
        "n_action_steps": 4,
        "down_dims": (16, 32),
        "n_groups": 4,
        "diffusion_step_embed_dim": 16,
        "spatial_softmax_num_keypoints": 4,
    },
    "vqbet": {
        "gpt_n_layer": 1,
        "gpt_hidden_dim": 16,
        "gpt_input_dim": 16,
        "gpt_output_dim": 16,
        "gpt_n_head": 2,
        "vqvae_embedding_dim": 16,
        "vqvae_enc_hidden_dim": 16,
        "crop_shape": (64, 64),
    },
    "tdmpc": {
        "mlp_dim": 16,
        "latent_dim": 8,
        "image_encoder_hidden_dim": 4,
        "state_encoder_hidden_dim": 8,
    },
}


def opened(folder: Path) -> Any:
    """Open a policy as `v2p eval` does."""
    return play_of(contestant(folder), 0, "cpu")


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return spoiled.good_policy(tmp_path_factory.mktemp("checkpoint") / "good")


@pytest.fixture
def policy(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "policy"))


def refused(folder: Path) -> str:
    with pytest.raises(V2PError) as caught:
        opened(folder)
    said = str(caught.value)
    assert str(folder) in said
    assert "\n" not in said
    assert len(said) < 1500
    return said


def test_the_policy_that_all_are_made_of_can_be_opened(good: Path):
    opened(good)


@pytest.mark.parametrize("name", spoiled.POLICIES)
def test_a_spoiled_policy_is_refused_in_one_sentence_and_runs_nothing(name: str, policy: Path):
    spoiled.POLICIES[name](policy)
    began = time.process_time()

    refused(policy)

    assert not spoiled.canary(policy).exists()
    assert time.process_time() - began < 10


@pytest.mark.parametrize("name", spoiled.SAME)
def test_a_policy_under_the_names_of_other_versions_acts_as_before(
    name: str, policy: Path, good: Path
):
    spoiled.SAME[name](policy)
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 4, (2, 64, 64)).astype(np.uint8)
    state = rng.normal(size=(2, 11)).astype(np.float32)
    state[:, 0] = 0.0

    actions = [actor_of(folder).act(labels, state) for folder in (good, policy)]

    assert np.abs(actions[0]).max() > 0
    np.testing.assert_array_equal(*actions)


def actor_of(folder: Path) -> Any:
    actor, _ = opened(folder)(Described())
    actor.policy.reset(2)
    return actor.policy


def test_the_program_runs_where_lerobot_opens_the_policy_by_itself(policy: Path):
    """Else the tests above would hold without any check."""
    from policies.evaluation.rollout import env_config, load_policy

    spoiled.with_step(spoiled.BEFORE, spoiled.POPEN)(policy)

    with pytest.raises(TypeError, match="must inherit from ProcessorStep"):
        load_policy(policy, env_config())

    for _ in range(100):  # the program is a process of its own
        if spoiled.canary(policy).exists():
            return
        time.sleep(0.05)
    pytest.fail("it did not run")


def test_the_command_line_ends_with_exit_code_2(policy: Path, capsys):
    spoiled.with_step(spoiled.BEFORE, spoiled.POPEN)(policy)

    code = run(["eval", str(policy)])

    said = " ".join(capsys.readouterr().err.split())
    assert code == 2
    assert "steps.0.class: names 'subprocess.Popen', which LeRobot would import and call" in said
    assert not spoiled.canary(policy).exists()


def test_a_policy_in_the_hubs_cache_is_opened(good: Path, tmp_path: Path):
    repository = tmp_path / "models--a--b"
    folder = repository / "snapshots" / "0123"
    folder.mkdir(parents=True)
    shutil.copytree(good, repository / "blobs")
    for path in (repository / "blobs").iterdir():
        (folder / path.name).symlink_to(f"../../blobs/{path.name}")

    opened(folder)


def test_a_network_larger_than_its_weights_is_refused_before_it_takes_memory(policy: Path):
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    path = policy / CONFIG_FILE
    features = {k: v for k, v in json.loads(path.read_text()).items() if k.endswith("_features")}
    large = {
        "dim_model": 8192,
        "dim_feedforward": 8192,
        "n_encoder_layers": 24,
        "chunk_size": 2,
        "n_action_steps": 2,
    }
    path.write_text(json.dumps({"type": "act", "n_heads": 8, **large, **features}))

    said = refused(policy)

    assert "weights and settings are not of one training" in said
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < 1_000_000


# --- what LeRobot's own training writes ------------------------------------------------------------------------


def config_of(kind: str, **settings: Any) -> Any:
    import lerobot.policies  # noqa: F401 - registers the types
    from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig

    cfg: Any = PreTrainedConfig.get_choice_class(kind)(device="cpu", **settings)
    cfg.input_features = {
        spoiled.MASK: PolicyFeature(FeatureType.VISUAL, (3, 64, 64)),
        "observation.state": PolicyFeature(FeatureType.STATE, (11,)),
    }
    cfg.output_features = {"action": PolicyFeature(FeatureType.ACTION, (7,))}
    return cfg


def lerobots(kind: str, folder: Path) -> Path:
    """Write an untrained policy of one of LeRobot's types, as `lerobot-train` does."""
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    cfg = config_of(kind, **TINY[kind])
    if hasattr(cfg, "pretrained_backbone_weights"):
        cfg.pretrained_backbone_weights = None
    shapes = {spoiled.MASK: (3, 1, 1), "observation.state": (11,), "action": (7,)}
    values = {"mean": 0.0, "std": 1.0, "min": -1.0, "max": 1.0}
    stats = {
        key: {name: torch.full(shape, value) for name, value in values.items()}
        for key, shape in shapes.items()
    }
    get_policy_class(cfg.type)(cfg).save_pretrained(folder)
    for processor in make_pre_post_processors(cfg, dataset_stats=stats):
        processor.save_pretrained(folder)
    return folder


@pytest.mark.parametrize("kind", TINY)
def test_a_policy_that_lerobot_trains_is_opened_and_acts(kind: str, tmp_path: Path):
    if kind == "diffusion" and importlib.util.find_spec("diffusers") is None:
        pytest.skip("LeRobot needs diffusers for it")
    folder = lerobots(kind, tmp_path / kind)
    path = folder / CONFIG_FILE
    said = json.loads(path.read_text())
    if "pretrained_backbone_weights" in said:  # as most have it; nothing may be fetched
        path.write_text(
            json.dumps({**said, "pretrained_backbone_weights": "ResNet18_Weights.IMAGENET1K_V1"})
        )

    actor, size_px = opened(folder)(Described())

    if kind == "tdmpc":  # acts on cameras named 'observation.image' only
        return
    policy = actor.policy
    policy.reset(2)
    action = policy.act(np.zeros((2, 64, 64), np.uint8), np.zeros((2, 11), np.float32))
    assert size_px == (64, 64)
    assert action.shape == (2, 7)
    assert np.isfinite(action).all()


class Described:
    """What an actor is told of its task."""

    description = "lift the cube"


@pytest.mark.parametrize("kind", get_args(Type))
def test_the_settings_of_every_type_are_taken_as_lerobot_writes_them(kind: str, tmp_path: Path):
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    config_of(kind).save_pretrained(tmp_path)

    ConfigFile.model_validate_json((tmp_path / CONFIG_FILE).read_bytes())


def test_every_step_that_is_taken_is_one_of_lerobots():
    from lerobot.processor.pipeline import ProcessorStepRegistry

    assert set(get_args(StepName)) <= set(ProcessorStepRegistry.list())


def test_what_is_read_is_told(good: Path):
    found = check_checkpoint(good)

    assert found.config.type == "v2p_bc"
    assert found.config.output_features is not None
    assert found.config.output_features["action"].shape == (7,)
    assert [s.registry_name for s in found.steps[spoiled.AFTER]] == [
        "unnormalizer_processor",
        "device_processor",
    ]
