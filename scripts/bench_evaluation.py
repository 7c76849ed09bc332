"""Time the batch judge of `v2p eval` against LeRobot's own evaluation: same policy, same task, same seeds.

    python scripts/bench_evaluation.py                            # an untrained v2p_bc policy
    python scripts/bench_evaluation.py --size-px 64 --input-px 32 # the same with a small network
    python scripts/bench_evaluation.py --policy FOLDER --task FOLDER --episodes 128

Both play whole episodes, to the first success or to the horizon, so both do the same work. LeRobot plays fewer: it has
one MuJoCo world per environment, and its environments take their time one after the other. The successes of the
episodes that both played should be the same; of networks that round otherwise in larger batches a few may differ.

The last line, `judge_over_lerobot: N`, is the ratio of the episodes per second.
"""

import tempfile
import time
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import tyro

from v2p_data.evaluation.batch import Judged, judge
from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.play import VisionActor
from v2p_data.sim.render.masks import PALETTE
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.task import TaskBundle


@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """What is timed."""

    task: str = "push_left"
    """Name of a benchmark task, or a task folder."""
    policy: Path | None = None
    """Folder of a LeRobot policy; without one, an untrained v2p_bc."""
    size_px: int = 256
    """Of the untrained policy's pictures."""
    input_px: int = 64
    """Of what its network sees."""
    episodes: int = 128
    """For the judge, all at the same time."""
    lerobot_episodes: int = 8
    """For LeRobot's evaluation, all at the same time."""
    first_seed: int = 0
    threads: int = 2
    """For physics, masks and network, of both."""


def main(cfg: BenchConfig) -> None:
    """Time both and print."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(cfg.threads)
    with tempfile.TemporaryDirectory() as folder:
        task = _task_folder(cfg.task, Path(folder))
        policy = cfg.policy or _untrained_policy(cfg, Path(folder) / "policy")
        _compare(cfg, task, policy)


def _compare(cfg: BenchConfig, task: Path, policy: Path) -> None:
    from policies.evaluation.actor import load_actor
    from policies.evaluation.rollout import env_config, load_policy, roll_out

    bundle = TaskBundle.load(task)
    actor = load_actor(policy, greys=PALETTE, task=bundle.description)

    def judged(episodes: int) -> Judged:
        return judge(
            bundle,
            VisionActor(actor),
            first_seed=cfg.first_seed,
            cfg=EvaluationConfig(episodes=episodes, worlds=episodes, at_end=False),
            num_threads=cfg.threads,
            size_px=actor.size_px,
        )

    judged(2)  # compiles what is compiled
    ours = judged(cfg.episodes)
    ours_per_s = cfg.episodes / ours.seconds["all"]
    _tell("judge", ours)

    count = cfg.lerobot_episodes
    config = env_config(task, size_px=actor.size_px[0])
    loaded = load_policy(policy, config)
    network_s = _time_network(loaded.policy)
    start = time.perf_counter()
    envs = config.create_envs(n_envs=count)
    flags = roll_out(loaded, envs, config, episodes=count, first_seed=cfg.first_seed)[0]
    seconds = time.perf_counter() - start
    print(
        f"lerobot: {count} episodes in {seconds:.1f} s (network {sum(network_s):.1f} s), {sum(flags)} successes"
    )
    same = sum(a == b for a, b in zip(flags, ours.successes.tolist(), strict=False))
    print(f"same successes: {same} of {count}")
    print(f"judge_over_lerobot: {ours_per_s / (count / seconds):.1f}")


def _time_network(policy: Any) -> list[float]:
    """Return a list to which the seconds of each call of the policy will be added."""
    seconds: list[float] = []
    select = policy.select_action

    def timed(observation: Any) -> Any:
        start = time.perf_counter()
        action = select(observation)
        seconds.append(time.perf_counter() - start)
        return action

    policy.select_action = timed
    return seconds


def _tell(name: str, result: Judged) -> None:
    parts = ", ".join(f"{k} {v:.1f} s" for k, v in result.seconds.items() if k != "all")
    count = len(result.success_step)
    print(
        f"{name}: {count} episodes of at most {result.horizon_steps} steps in {result.seconds['all']:.1f} s"
        f" ({parts}), {int(result.successes.sum())} successes, failures {result.failure_counts()}"
    )


def _task_folder(task: str, folder: Path) -> Path:
    if Path(task).is_dir():
        return Path(task)
    bundle = load_benchmark(task)
    scene = folder / "scene"
    scene.mkdir()
    bundle.scene.save(scene)
    replace(bundle, scene=replace(bundle.scene, folder=scene)).save(folder / task)
    return folder / task


def _untrained_policy(cfg: BenchConfig, folder: Path) -> Path:
    """Write a policy whose actions are small, so that episodes last to the horizon."""
    from lerobot.configs import FeatureType, PolicyFeature
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot.utils.import_utils import register_third_party_plugins

    register_third_party_plugins()
    from policies.bc.configuration_v2p_bc import V2PBCConfig
    from policies.bc.modeling_v2p_bc import V2PBCPolicy

    config = V2PBCConfig(
        input_features={
            "observation.images.mask": PolicyFeature(
                FeatureType.VISUAL, (3, cfg.size_px, cfg.size_px)
            ),
            "observation.state": PolicyFeature(FeatureType.STATE, (11,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        input_size_px=cfg.input_px,
        pretrained_backbone_weights=None,
        device="cpu",
        push_to_hub=False,
    )
    V2PBCPolicy(config).save_pretrained(folder)
    stats = {
        "observation.state": {"mean": torch.zeros(11), "std": torch.ones(11)},
        "action": {"mean": torch.zeros(7), "std": torch.ones(7)},
    }
    for processor in make_pre_post_processors(config, dataset_stats=stats):
        processor.save_pretrained(folder)
    return folder


if __name__ == "__main__":
    main(tyro.cli(BenchConfig))
