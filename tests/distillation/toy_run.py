"""A run of the toy task, and a student that learns nothing and remembers everything."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import toy_task

from policies.ppo.config import ActorConfig
from policies.ppo.policy import ActorCritic, Expert
from v2p_data.distillation.config import DistillationConfig
from v2p_data.episodes.config import EpisodesConfig
from v2p_data.pipeline.artifact import Record, read_record
from v2p_data.pipeline.runner import (
    Make,
    Outcome,
    Runtime,
    Stage,
    blocked_by,
    in_order,
    make_stage,
    stored_outcome,
)
from v2p_data.policy.config import PolicyConfig
from v2p_data.stages import EngineConfig, dataset_stage, episodes_stage
from v2p_data.task.task import TaskBundle

SIZE_PX = 48
ITEM, REPO_ID = "toy", "me/toys"
EPISODES = EpisodesConfig(num_episodes=3, batch_worlds=6, max_batches=3, size_px=SIZE_PX)
DISTILLATION = DistillationConfig(
    rounds=2, episodes=4, worlds=3, takeover=(0.1, 0.5), first_steps=3, round_steps=3
)
ENGINE = EngineConfig(
    episodes=EPISODES,
    distillation=DISTILLATION,
    policy=PolicyConfig(preset="small", steps=4, batch_size=8),
)
CODE = """
from factory.tasks.task import Task

class Push(Task):
    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, {})

    def compute_success(self, states):
        return (states["eef_pos"][:, 1] > 0.08) & (states["cube_pos"][:, 0] < 0.55)

    def compute_reward(self, actions, states):
        left = states["eef_pos"][:, 1]
        return left, {"left": left}
"""


def bundle() -> TaskBundle:
    """Return the toy task, as text."""
    return replace(toy_task.bundle(), code=CODE, class_name="Push")


def agree(_: object, history: Mapping[str, np.ndarray]) -> np.ndarray:
    return np.ones(history["eef_pos"].shape[1], bool)


def make_agreeing(
    make: Make, cfg: Any, inputs: Mapping[str, Path], out: Path, how: Runtime
) -> Any:
    """Make a stage in a worker process, where the referee must be told anew to agree."""
    from v2p_data.episodes import rollouts
    from v2p_data.sim.env import verdict

    verdict.referee_verdict = rollouts.referee_verdict = agree
    return make(cfg, inputs, out, how)


def expert() -> Expert:
    """Return a network that goes left at about the same speed, whatever it sees."""
    model = ActorCritic(90, 7, ActorConfig(hidden=(4,)), torch.Generator().manual_seed(0))
    with torch.no_grad():
        for parameter in model.actor.net.parameters():
            parameter.mul_(0.3)
        list(model.actor.net.parameters())[-1][1] = 0.7
    return Expert(model)


def make_task(
    cfg: Any, inputs: Mapping[str, Path], out: Path, runtime: Runtime, *, item: str = ITEM
) -> None:
    scene = replace(bundle().scene, folder=out / "made")
    scene.folder.mkdir()
    scene.save(scene.folder)
    replace(bundle(), title=item, scene=scene).save(out)


def make_expert(cfg: Any, inputs: Mapping[str, Path], out: Path, runtime: Runtime) -> None:
    expert().save(out)


def task_stage(item: str = ITEM) -> Stage:
    """Return the stage that makes the toy task under this name, from nothing."""
    return Stage(name="task", item=item, config={}, make=partial(make_task, item=item))


def chain(item: str = ITEM, engine: EngineConfig = ENGINE) -> Stage:
    """Return the episodes stage of the toy task and of an expert that knows how to do it."""
    task = task_stage(item)
    learned = Stage(name="expert", item=item, config={}, inputs={"task": task}, make=make_expert)
    return episodes_stage(task, learned, engine)


def last_stage(repo_id: str = REPO_ID) -> Stage:
    """Return the stage that packs the run's episodes."""
    return dataset_stage([chain()], repo_id)


def make_run(root: Path) -> Path:
    """Make task, expert, episodes and dataset; return the dataset."""
    stage = last_stage()
    outcomes = made([stage], Runtime(root=root))
    assert all(o.is_usable for o in outcomes.values()), [o.detail for o in outcomes.values()]
    return stage.folder(root)


def made(
    stages: Sequence[Stage], runtime: Runtime, on_event: object = None
) -> dict[tuple[str, str], Outcome]:
    """Make what is missing in this process: workers would import LeRobot anew."""
    outcomes: dict[tuple[str, str], Outcome] = {}
    for stage in in_order(stages):
        outcome = stored_outcome(stage, runtime.root)
        bad = blocked_by(stage, outcomes)
        if outcome is None and bad is not None:
            outcome = Outcome(
                stage=stage.name,
                item=stage.item,
                status="blocked",
                folder=stage.folder(runtime.root),
                detail=f"needs {bad.stage} of {bad.item}",
            )
        outcome = outcome or make_stage(stage, runtime)
        outcomes[(stage.name, stage.folder_name)] = outcome
    return outcomes


def dataset_of(root: Path) -> Path:
    (folder,) = (root / "dataset").glob("toys-????????")
    return folder


def record_of(folder: Path) -> Record:
    record = read_record(folder)
    assert record is not None
    return record


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@dataclass
class Pupil:
    """Goes right at a speed that depends on what it sees and on all that it was ever told."""

    told: list[str] = field(default_factory=list)
    """What `skill` follows from; frames that were taken in are told again after a kill."""
    skill: float = 0.0
    tasks: list[str] = field(default_factory=list)
    num_acts: int = 0

    def for_task(self, words: str) -> "Pupil":
        self.tasks.append(words)
        return self

    def reset(self, n: int) -> None:
        pass

    def act(self, labels: np.ndarray, state: np.ndarray) -> np.ndarray:
        self.num_acts += 1
        action = np.zeros((len(state), 7), np.float32)
        seen = labels.reshape(len(labels), -1).mean(1)
        action[:, 1] = -0.2 - 0.1 * np.tanh(seen) - 0.2 * self.skill
        return action

    def add(self, labels, state, action, task, lengths) -> None:
        assert len(labels) == len(state) == len(action) == sum(lengths)
        self.told.append(f"{labels.sum()} {state.sum()} {action.sum()} {task} {list(lengths)}")

    def train(self, steps: int, folder: Path, seed: int, progress: Any) -> None:
        progress(0.5, "learning")
        text = json.dumps([steps, seed, self.skill, self.told])
        self.skill = sum(text.encode()) % 997 / 997

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True)
        (folder / "skill.json").write_text(json.dumps(self.skill))

    def load(self, folder: Path) -> None:
        self.skill = json.loads((folder / "skill.json").read_text())
