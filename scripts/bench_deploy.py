"""How well `v2p deploy` sees and acts: one click and tracked masks against the simulator's true masks, episode by episode.

    python scripts/bench_deploy.py --policy POLICY --tasks TASK [TASK ...] --episodes 20

The arm is the simulated one and gives what a real one gives: a colour picture, joint angles, force. True masks are looked at
only to choose the clicked pixel, as a person would, and to measure. Both runs of an episode pass the same limits.
"""

import argparse
import json
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_policy_v2p.robot.config_v2p_franka import V2PFrankaConfig
from lerobot_policy_v2p.robot.v2p_franka import V2PFranka
from policies.evaluation.rate import wilson
from v2p_data.commands.deploy import loaded_policy
from v2p_data.deployment.limits import Guard, LimitsConfig
from v2p_data.deployment.loop import LoopConfig, Outcome, Run
from v2p_data.deployment.robot import Reading, Rig
from v2p_data.deployment.sight import Seen, Sight
from v2p_data.errors import V2PError
from v2p_data.scene.backends.segment import points_inside
from v2p_data.scene.segment import iou
from v2p_data.sim.gym_env import CONTROL_HZ
from v2p_data.sim.masks import FIRST_OBJECT, ROBOT, rgb_to_labels
from v2p_data.task.task import TaskBundle

PATIENCE_MS = 60_000.0
"""A simulated arm waits, however busy the machine is."""


@dataclass
class Measured:
    """What the episodes of one task gave."""

    tracked: list[bool] = field(default_factory=list)
    true: list[bool] = field(default_factory=list)
    endings: list[str] = field(default_factory=list)
    object_iou: list[float] = field(default_factory=list)
    robot_iou: list[float] = field(default_factory=list)
    see_ms: list[float] = field(default_factory=list)
    """Processor time of masks a step."""
    decide_ms: list[float] = field(default_factory=list)
    work_ms: list[float] = field(default_factory=list)
    """Wall time of a whole step, rendering and physics of the simulated arm included."""


class TimedSight(Sight):
    """Notes the processor time of each picture."""

    took: list[float]

    def see(self, reading: Reading) -> Seen:
        began = time.thread_time()
        seen = super().see(reading)
        self.took.append(1000 * (time.thread_time() - began))
        return seen


class TimedPolicy:
    """The same for the policy."""

    def __init__(self, actor: Any) -> None:
        self.actor = actor
        self.took: list[float] = []

    def reset(self, n: int) -> None:
        self.actor.reset(n)

    def act(self, labels: np.ndarray, state: np.ndarray) -> np.ndarray:
        began = time.thread_time()
        action = self.actor.act(labels, state)
        self.took.append(1000 * (time.thread_time() - began))
        return action


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", type=Path, required=True)
    parser.add_argument("--tasks", type=Path, nargs="+", required=True)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=10_000)
    parser.add_argument("--max-force-n", type=float, default=LimitsConfig.max_force_n)
    parser.add_argument("--out", type=Path, help="where all numbers go, as JSON")
    args = parser.parse_args()
    limits = LimitsConfig(max_silence_ms=PATIENCE_MS, max_force_n=args.max_force_n)
    results: dict[str, Any] = {}
    for folder in args.tasks:
        bundle = TaskBundle.load(folder)
        policy = TimedPolicy(loaded_policy(args.policy, bundle.description, "cpu"))
        measured = Measured()
        for seed in range(args.first_seed, args.first_seed + args.episodes):
            for pictures in ("rgb", "mask"):
                episode(folder, bundle, seed, pictures, policy, measured, limits)
            done = len(measured.true)
            print(f"{bundle.title} {done}: tracked {sum(measured.tracked)}, true {sum(measured.true)}, {measured.endings[-1]}", flush=True)  # fmt: skip
        results[bundle.title] = asdict(measured)
        print(summary(bundle.title, measured), flush=True)
    if args.out:
        args.out.write_text(json.dumps(results))


def episode(
    folder: Path,
    bundle: TaskBundle,
    seed: int,
    pictures: str,
    policy: TimedPolicy,
    into: Measured,
    limits: LimitsConfig,
) -> None:
    """Play one episode, from tracked masks (`rgb`) or true ones (`mask`)."""
    robot = V2PFranka(V2PFrankaConfig(task_folder=str(folder), seed=seed, pictures=pictures))  # type: ignore[arg-type]
    robot.connect()
    sight = None

    def compare(reading: Reading, seen: Seen) -> None:
        # The picture was taken before the action, so the labels of that moment are those kept then.
        for k in range(len(sight.clicks_px) if sight else 0):
            into.object_iou.append(iou(seen.labels == FIRST_OBJECT + k, before[0] == FIRST_OBJECT + k))  # fmt: skip
        into.robot_iou.append(iou(seen.labels == ROBOT, before[0] == ROBOT))

    before = [rgb_to_labels(robot.arm.mask())]  # type: ignore[union-attr]

    class Noted(Rig):
        def read(self) -> Reading:
            before[0] = rgb_to_labels(robot.arm.mask())  # type: ignore[union-attr]
            return super().read()

    rig = Noted(robot)
    if pictures == "rgb":
        clicks = [
            tuple(points_inside(before[0] == FIRST_OBJECT + k, 1)[0])
            for k in range(len(bundle.scene.objects))
        ]
        sight = TimedSight(robot.calibrated_camera(), clicks)
        sight.took = into.see_ms
    policy.took = into.decide_ms
    policy.reset(1)
    cfg = LoopConfig(max_seconds=bundle.policy_steps() / CONTROL_HZ, slow=True)
    run = Run(
        rig, sight, policy, Guard(limits, rig.scale), cfg,
        is_done=lambda: robot.has_succeeded, on_step=compare if sight else lambda reading, seen: None,
    )  # fmt: skip
    try:
        outcome = run.go()
    except V2PError as error:
        outcome = Outcome(ending="robot", sentence=str(error))
    robot.disconnect()
    (into.tracked if sight else into.true).append(outcome.ending == "done")
    if sight:
        into.endings.append(outcome.ending if outcome.ending in ("done", "time") else outcome.sentence)  # fmt: skip
        into.work_ms += outcome.work_ms


def summary(title: str, m: Measured) -> str:
    objects, robots = np.array(m.object_iou), np.array(m.robot_iou)
    return "\n".join(
        [
            f"{title}: tracked masks {wilson(sum(m.tracked), len(m.tracked))}, true masks {wilson(sum(m.true), len(m.true))}",
            f"  object IoU mean {objects.mean():.3f}, 5th percentile {np.percentile(objects, 5):.3f}, least {objects.min():.3f};"
            f" robot IoU mean {robots.mean():.3f}, 5th percentile {np.percentile(robots, 5):.3f}; {len(robots)} pictures",
            f"  processor time a step: masks {np.mean(m.see_ms):.1f} ms, policy {np.mean(m.decide_ms):.1f} ms;"
            f" wall time with the simulator {np.mean(m.work_ms):.0f} ms",
        ]
    )


if __name__ == "__main__":
    main()
