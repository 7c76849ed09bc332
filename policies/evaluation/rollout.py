"""Roll a LeRobot policy out in simulated tasks and say which episodes succeeded.

LeRobot's own evaluation does the work, with one environment per episode at a time. `v2p eval` has a faster way to
the same successes (`actor`); this one is what it is compared with. The tasks come through LeRobot's environment type
`v2p`, which the plugin `lerobot_policy_v2p` registers.
"""

import copy
from collections.abc import Container, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch

from policies.evaluation.statistics import statistics_fault

ENV_TYPE = "v2p"
NUM_VIDEOS = 3
SETTINGS_ALONE = ("v2p_bc", "act", "diffusion", "vqbet", "tdmpc")
"""Policy types whose networks follow from their settings; the others' are those of other models, which are named."""


class UnsuitablePolicyError(ValueError):
    """A policy cannot be opened, or wants to see or do something that the simulator does not have."""


@dataclass(frozen=True, kw_only=True)
class LoadedPolicy:
    """A policy with the processors around it."""

    policy: Any
    preprocessor: Any
    postprocessor: Any


def load_policy(folder: Path, env_config: Any, device: str | None = None) -> LoadedPolicy:
    """Read a checkpoint of any policy type LeRobot knows, checked against the environment's features.

    It runs on `device`, by default where its settings say. Whoever made the checkpoint is trusted:
    LeRobot runs what its processors name, unless the engine has looked at them before
    (`v2p_data.evaluation.checkpoint`).

    Raises:
        UnsuitablePolicyError: its weights are not those of the network in its settings, or its statistics do not
            normalise what the settings say.
    """
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import make_policy, make_pre_post_processors

    _register_plugins()
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    if device is not None:
        config.device = device
    if getattr(config, "pretrained_backbone_weights", None):
        # They would be fetched; those of the checkpoint follow.
        config.pretrained_backbone_weights = None  # type: ignore[attr-defined]
    if config.type in SETTINGS_ALONE:
        _check_weights(folder, config)
    policy = make_policy(config, env_cfg=env_config)
    _load_renamed(folder, policy)
    preprocessor, postprocessor = make_pre_post_processors(
        policy_cfg=config,
        pretrained_path=str(folder),
        preprocessor_overrides={"device_processor": {"device": str(policy.config.device)}},
    )
    if fault := statistics_fault(policy.config, preprocessor, postprocessor):
        raise UnsuitablePolicyError(
            f"the policy in {folder} would see or do numbers of another scale: {fault}; copy both processors with"
            " their .safetensors files from the training anew"
        )
    return LoadedPolicy(policy=policy, preprocessor=preprocessor, postprocessor=postprocessor)


def env_config(tasks: Path | None = None, **settings: Any) -> Any:
    """Return LeRobot's settings for the tasks in a folder; without one, of the simulator in general."""
    from lerobot.envs.factory import make_env_config

    _register_plugins()
    return make_env_config(ENV_TYPE, tasks="" if tasks is None else str(tasks), **settings)


def roll_out(
    loaded: LoadedPolicy,
    envs: dict[str, dict[int, gym.vector.VectorEnv]],
    env_config: Any,
    *,
    episodes: int,
    first_seed: int,
    videos: Path | None = None,
) -> dict[int, list[bool]]:
    """Return, per task, which of its episodes succeeded; episode k starts from `first_seed + k`.

    Closes the environments. An episode counts as soon as `info["is_success"]` is true.
    """
    from lerobot.envs.factory import make_env_pre_post_processors
    from lerobot.scripts.lerobot_eval import eval_policy_all

    before, after = make_env_pre_post_processors(env_config, loaded.policy.config)
    with torch.no_grad():
        info = eval_policy_all(
            envs,
            loaded.policy,
            before,
            after,
            loaded.preprocessor,
            loaded.postprocessor,
            episodes,
            start_seed=first_seed,
            videos_dir=videos,
            max_episodes_rendered=NUM_VIDEOS if videos else 0,
        )
    return {
        task["task_id"]: [bool(success) for success in task["metrics"]["successes"]]
        for task in info["per_task"]
    }


def _check_weights(folder: Path, config: Any) -> None:
    """Demand the weights of the network that the settings describe, before a network of any size takes memory.

    LeRobot takes a file without some of the weights, and leaves those random.
    """
    from lerobot.policies.factory import get_policy_class
    from safetensors import safe_open

    kind = get_policy_class(config.type)
    with torch.device("meta"):
        wanted = kind(copy.deepcopy(config)).state_dict(keep_vars=True)
    with safe_open(folder / "model.safetensors", framework="pt") as file:
        shapes = {
            own: tuple(file.get_slice(name).get_shape())
            for name, own in _own_names(file.keys(), wanted).items()
        }
    known = {
        id(wanted[name]) for name in shapes.keys() & wanted.keys()
    }  # tied weights are written once
    for name, value in wanted.items():
        if id(value) not in known:
            raise UnsuitablePolicyError(
                f"the weights of the policy in {folder} lack '{name}' of the network in its config.json: weights and"
                " settings are not of one training; copy both anew"
            )
        if shapes.get(name, tuple(value.shape)) != tuple(value.shape):
            raise UnsuitablePolicyError(
                f"'{name}' has shape {shapes[name]} in the weights of the policy in {folder}, and "
                f"{tuple(value.shape)} in"
                " the network of its config.json: weights and settings are not of one training; copy both anew"
            )


def _own_names(names: Iterable[str], wanted: Container[str]) -> dict[str, str]:
    """Return the network's name of each tensor: `torch.compile` and parallel training put words between."""
    plain = {
        name: ".".join(part for part in name.split(".") if part not in ("_orig_mod", "module"))
        for name in names
    }
    return {
        name: own if name not in wanted and own in wanted else name for name, own in plain.items()
    }


def _load_renamed(folder: Path, policy: Any) -> None:
    """Load the weights that LeRobot passed over, since it knows them by another name."""
    from safetensors import safe_open

    with safe_open(folder / "model.safetensors", framework="pt") as file:
        names = _own_names(file.keys(), policy.state_dict())
        other = {own: file.get_tensor(name) for name, own in names.items() if own not in names}
    if other:
        policy.load_state_dict(other, strict=False)


def _register_plugins() -> None:
    import lerobot.policies  # noqa: F401 - registers LeRobot's own types
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
