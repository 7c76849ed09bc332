"""How well `v2p deploy` sees and acts: one click and tracked masks against the simulator's true masks, episode by episode.

    python scripts/bench_deploy.py --policy POLICY --tasks TASK [TASK ...] --episodes 20

The arm is the simulated one, or its twin in another simulator, and gives what a real one gives: a colour picture, joint angles, force. True masks are looked at
only to choose the clicked pixel, as a person would, and to measure. Both runs of an episode pass the same limits.
"""

import argparse
import json
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_policy_v2p.robot.config_v2p_franka import V2PFrankaConfig
from lerobot_policy_v2p.robot.config_v2p_twin import V2PTwinConfig
from lerobot_policy_v2p.robot.simulated import SimulatedArm
from lerobot_policy_v2p.robot.v2p_franka import V2PFranka
from lerobot_policy_v2p.robot.v2p_twin import V2PTwin
from policies.evaluation.rate import wilson
from v2p_data.commands.deploy import loaded_policy
from v2p_data.deployment.limits import Guard, LimitsConfig
from v2p_data.deployment.loop import LoopConfig, Onlooker, Outcome, Run
from v2p_data.deployment.robot import Reading, Rig
from v2p_data.deployment.sight import Seen, Sight
from v2p_data.errors import V2PError
from v2p_data.scene.backends.segment import points_inside
from v2p_data.scene.frames.mask_ops import iou
from v2p_data.sim.render.masks import FIRST_OBJECT, ROBOT, rgb_to_labels
from v2p_data.sim.wrappers.gym_env import CONTROL_HZ
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
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--policy", type=Path, required=True)
    parser.add_argument("--tasks", type=Path, nargs="+", required=True)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=10_000)
    parser.add_argument("--robot", choices=("sim", "twin"), default="sim")
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
            for tracked in (True, False):
                robot = robot_in(args.robot, folder, seed)
                episode(robot, bundle, policy, limits, measured, tracked=tracked)
                robot.disconnect()
            told = f"tracked {sum(measured.tracked)}, true {sum(measured.true)}, {measured.endings[-1]}"
            print(f"{bundle.title} {len(measured.true)}: {told}", flush=True)
        results[bundle.title] = asdict(measured)
        print(summary(bundle.title, measured), flush=True)
    if args.out:
        args.out.write_text(json.dumps(results))


class Noted(Rig):
    """Keeps the true labels of each reading's moment."""

    true: np.ndarray

    def read(self) -> Reading:
        reading = super().read()
        self.true = true_labels(self.robot)
        return reading


class TrueRig(Noted):
    """Gives the true labels in the picture's place."""

    def read(self) -> Reading:
        return replace(super().read(), picture=None, labels=self.true)


def robot_in(kind: str, folder: Path, seed: int) -> Any:
    """Return a connected robot before an episode."""
    robot = (
        V2PFranka(V2PFrankaConfig(task_folder=str(folder), seed=seed, pictures="rgb"))
        if kind == "sim"
        else V2PTwin(V2PTwinConfig(task_folder=str(folder), seed=seed, pictures="rgb"))
    )
    robot.connect()
    return robot


def true_labels(robot: Any) -> np.ndarray:
    """Return the simulator's own labels of what the camera sees."""
    if isinstance(robot, V2PFranka):
        assert isinstance(robot.arm, SimulatedArm)
        return rgb_to_labels(robot.arm.mask())
    return robot.arm.robot.true_labels()


def episode(
    robot: Any, bundle: TaskBundle, policy: TimedPolicy, limits: LimitsConfig, into: Measured, *, tracked: bool
) -> None:  # fmt: skip
    """Play one episode, from tracked masks or from true ones."""
    rig = Noted(robot) if tracked else TrueRig(robot)
    sight = None
    if tracked:
        rig.read()
        spots = [
            points_inside(rig.true == FIRST_OBJECT + k, 1)[0]
            for k in range(len(bundle.scene.objects))
        ]
        clicks = [(float(u), float(v)) for u, v in spots]
        sight = TimedSight(robot.calibration(), clicks)
        sight.took = into.see_ms

    def compare(reading: Reading, seen: Seen) -> None:
        if tracked:
            for label in range(FIRST_OBJECT, FIRST_OBJECT + len(bundle.scene.objects)):
                into.object_iou.append(iou(seen.in_picture == label, rig.true == label))
            into.robot_iou.append(iou(seen.in_picture == ROBOT, rig.true == ROBOT))

    policy.took = into.decide_ms
    policy.reset(1)
    cfg = LoopConfig(max_seconds=bundle.policy_steps() / CONTROL_HZ, slow=True)
    onlooker = Onlooker(is_done=lambda: robot.has_succeeded, on_step=compare)
    run = Run(rig, sight, policy, Guard(limits, rig.scale), cfg, onlooker)
    try:
        outcome = run.go()
    except V2PError as error:
        outcome = Outcome(ending="robot", sentence=str(error))
    (into.tracked if tracked else into.true).append(outcome.ending == "done")
    if tracked:
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
