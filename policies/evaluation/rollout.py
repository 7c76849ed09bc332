"""Roll a LeRobot policy out in simulated tasks and say which episodes succeeded.

LeRobot's own evaluation does the work, with one environment per episode at a time. `v2p eval` has a faster way to
the same successes (`actor`); this one is what it is compared with. The tasks come through LeRobot's environment type
`v2p`, which the plugin `lerobot_policy_v2p` registers.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch

ENV_TYPE = "v2p"
NUM_VIDEOS = 3


@dataclass(frozen=True, kw_only=True)
class LoadedPolicy:
    """A policy with the processors around it."""

    policy: Any
    preprocessor: Any
    postprocessor: Any


def load_policy(folder: Path, env_config: Any, device: str | None = None) -> LoadedPolicy:
    """Read a checkpoint of any policy type LeRobot knows, checked against the environment's features.

    It runs on `device`, by default where its settings say.
    """
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import make_policy, make_pre_post_processors

    _register_plugins()
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    if device is not None:
        config.device = device
    policy = make_policy(config, env_cfg=env_config)
    preprocessor, postprocessor = make_pre_post_processors(
        policy_cfg=config,
        pretrained_path=str(folder),
        preprocessor_overrides={"device_processor": {"device": str(policy.config.device)}},
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


def evaluate_policy(
    policy: Path,
    tasks: Path,
    *,
    episodes: int,
    batch_size: int = 10,
    first_seed: int = 0,
    videos: Path | None = None,
    **settings: Any,
) -> list[bool]:
    """Return which episodes of the task (or of all tasks, one after the other) in a folder succeeded.

    Args:
        policy: folder of a LeRobot policy.
        tasks: a task folder, or a folder of several.
        episodes: episodes per task.
        batch_size: episodes at the same time.
        first_seed: seed of a task's first episode; the others follow.
        videos: where to put a few videos; none are made without it.
        settings: of the environment, such as `size_px`.
    """
    config = env_config(tasks, **settings)
    loaded = load_policy(policy, config)
    envs = config.create_envs(n_envs=min(batch_size, episodes), use_async_envs=False)
    results = roll_out(
        loaded, envs, config, episodes=episodes, first_seed=first_seed, videos=videos
    )
    return [success for task in sorted(results) for success in results[task]]


def _register_plugins() -> None:
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
