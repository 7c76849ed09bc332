"""A tiny policy and tiny tasks, so that a whole evaluation takes seconds."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

SIZE_PX = 64


@pytest.fixture(scope="session")
def policy_folder(tmp_path_factory) -> Path:
    return untrained(tmp_path_factory.mktemp("policy"), "mask")


@pytest.fixture(scope="session")
def wrist_policy_folder(tmp_path_factory) -> Path:
    return untrained(tmp_path_factory.mktemp("wrist"), "mask", "mask_wrist")


@pytest.fixture(scope="session")
def rgb_policy_folder(tmp_path_factory) -> Path:
    return untrained(tmp_path_factory.mktemp("rgb"), "rgb")


def untrained(folder: Path, *cameras: str) -> Path:
    """Save a checkpoint of an untrained v2p_bc policy whose actions are large enough to move something."""
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    from policies.bc.configuration_v2p_bc import V2PBCConfig
    from policies.bc.modeling_v2p_bc import V2PBCPolicy

    mask = PolicyFeature(FeatureType.VISUAL, (3, SIZE_PX, SIZE_PX))
    config = V2PBCConfig(
        input_features={f"observation.images.{camera}": mask for camera in cameras}
        | {
            "observation.state": PolicyFeature(FeatureType.STATE, (11,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        input_size_px=32,
        mask_moments=False,
        head="regression",
        pretrained_backbone_weights=None,
        device="cpu",
        push_to_hub=False,
    )
    with torch.random.fork_rng():
        torch.random.default_generator.manual_seed(0)
        policy = V2PBCPolicy(config)
    policy.save_pretrained(folder)
    stats = {
        "observation.state": {"mean": torch.zeros(11), "std": torch.ones(11)},
        "action": {"mean": torch.tensor([0, 0, -0.5, 0, 0, 0, 0.0]), "std": torch.full((7,), 8.0)},
    }
    for processor in make_pre_post_processors(config, dataset_stats=stats):
        processor.save_pretrained(folder)
    return folder


@pytest.fixture
def benchmark_folder(tmp_path) -> Path:
    """Return a benchmark task of ours, cut short."""
    from v2p_data.task.benchmark import load_benchmark

    bundle = load_benchmark("push_left")
    scene = tmp_path / "scene"
    scene.mkdir()
    bundle.scene.save(scene)
    replace(bundle, horizon_steps=10, scene=replace(bundle.scene, folder=scene)).save(
        tmp_path / "push_left"
    )
    return tmp_path / "push_left"
