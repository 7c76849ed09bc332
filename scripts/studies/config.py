"""Settings of the study of lifting, or of another kind of task: arms, numbers of tasks, and sizes."""

from dataclasses import dataclass, field, replace
from typing import Literal

from v2p_data.geometry.mesh import Size
from v2p_data.kinds import Kind
from v2p_data.policy.config import PolicyConfig
from v2p_data.stages import CousinsConfig, EngineConfig

Arm = Literal[
    "videos",
    "toys",
    "bc",
    "paper",
    "cop",
    "cousins",
    "toys_cousins",
]
ARMS: dict[Arm, str] = {
    "videos": "objects from videos, distillation; data grow with N",
    "toys": "random primitive toys, distillation; data grow with N",
    "bc": "objects from videos, behaviour cloning only, same network",
    "paper": "objects from videos, behaviour cloning only, ResNet18 on two frames",
    "cop": "Code-as-Policies with our primitives on the simulator's states; learns nothing, hence without N",
    "cousins": "objects from videos and stretched cousins of each, all labelled by the scripted program, distillation",
    "toys_cousins": "random toys and stretched cousins of each, all labelled by the scripted program, distillation",
}
"""What each arm trains on, and how."""
WITH_COUSINS: tuple[Arm, ...] = ("cousins", "toys_cousins")
Source = Literal["videos", "toys"]


@dataclass(frozen=True, kw_only=True)
class Asked:
    """What is asked of an object that no clip showed, as in the sample clips."""

    instruction: str
    """Of every task of the study."""
    caption: str
    move_m: tuple[float, float, float]
    """From its first pose to its last."""
    onto_m: Size | None = None
    """Full extents of a block that stands under the last pose."""


ASKED: dict[Kind, Asked] = {
    "lift_up": Asked(instruction="lift it up", caption="Lifting {} up", move_m=(0.0, 0.0, 0.15)),
    "push_left": Asked(
        instruction="push it to the left",
        caption="Pushing {} to the left",
        move_m=(0.01, 0.16, 0.0),
    ),
    "place_onto": Asked(
        instruction="put it onto the other one",
        caption="Putting {} onto a block",
        move_m=(0.02, 0.18, 0.03),
        onto_m=(0.13, 0.13, 0.03),
    ),
}
"""Kinds of task that can be studied."""


@dataclass(frozen=True, kw_only=True)
class PoolConfig:
    """Where training objects come from, and what is done with them."""

    kind: Kind = "lift_up"
    """Of clips and tasks, unseen objects' too: a key of `ASKED`."""
    clips: int = 90
    """Clips that may be drawn, at most; a clip whose scene, task or expert is rejected counts."""
    toys: int = 60
    """Toys that may be made, at most."""
    fps: int = 12
    """Of drawn clips, as of Something-Something-v2."""
    held_out: tuple[str, ...] = (
        *("banana", "marker", "scissors", "spoon", "brick", "pitcher", "plantain"),
        *("toy duck", "egg", "candle", "jar", "tape"),
    )
    """Categories of the evaluation: no training clip may be about one."""
    seed: int = 0
    """Of clips, toys, experts and demonstrations, which all seeds of the study share."""

    def __post_init__(self) -> None:
        if self.kind not in ASKED:
            raise ValueError(f"kind must be one of {', '.join(ASKED)}, got {self.kind}")


@dataclass(frozen=True, kw_only=True)
class UnseenConfig:
    """The evaluation's objects, by the names of their folders."""

    shapes: tuple[str, ...] = (
        *("apple", "cracker_box", "e_cups", "mustard_bottle", "tomato_soup_can"),
    )
    """New shapes of things that training clips are about too: one of each noun that the gripper spans as it stands."""
    categories: tuple[str, ...] = (*("banana", "large_marker", "scissors", "spoon", "foam_brick"),)
    """Things that no training clip is about."""
    drawn_shapes: tuple[str, ...] = ("apple", "cracker box", "cup", "mustard bottle", "soup can")
    """Instead of `shapes`, where no folder of scans is given: products that clips are about, other specimens."""
    drawn_categories: tuple[str, ...] = ("toy duck", "egg", "candle", "jar", "tape")
    """Instead of `categories`, where no folder of scans is given: products of `pool.held_out`."""
    episodes: int = 50
    """Per object, seed and cell; all cells of a seed start from the same states."""
    films: int = 1
    """Successes and failures filmed per object, each."""

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.shapes, *self.categories)


@dataclass(frozen=True, kw_only=True)
class LiftingConfig:
    """The whole study."""

    arms: tuple[Arm, ...] = ("cop", "videos", "toys", "bc")
    counts: tuple[int, ...] = (5, 10, 20, 40)
    """Numbers of training tasks N; the tasks of a smaller N are among those of a larger one."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of subset, distillation, weights and evaluation."""
    pool: PoolConfig = field(default_factory=PoolConfig)
    unseen: UnseenConfig = field(default_factory=UnseenConfig)
    cousins: int = 4
    """Of each object, in the arms with cousins; an object and its cousins share the trajectories of one object."""
    max_training: float = 4.0
    """Gradient steps grow with the data up to this multiple of `engine`'s, which are those of the smallest N."""
    paper_policy: PolicyConfig = field(default_factory=lambda: PolicyConfig(preset="paper"))
    """The network and training of the arm `paper`."""
    engine: EngineConfig = field(default_factory=EngineConfig)
    """All stages at the smallest N: `episodes.num_episodes` trajectories a task, handovers, gradient steps."""

    def __post_init__(self) -> None:
        if not self.counts or list(self.counts) != sorted(set(self.counts)) or self.counts[0] < 1:
            raise ValueError(f"counts must grow from 1 or more, got {list(self.counts)}")
        if not self.arms or not self.seeds:
            raise ValueError("arms and seeds must each name at least one")
        if set(self.unseen.shapes) & set(self.unseen.categories) or not self.unseen.names:
            raise ValueError("unseen.shapes and unseen.categories must name objects, each once")
        if self.max_training < 1:
            raise ValueError(f"max_training must be at least 1, got {self.max_training}")

    def engine_for(self, arm: Arm, count: int, seed: int) -> EngineConfig:
        """Return the engine's settings of a cell: what scales with N, and how its policy learns."""
        least = self.counts[0]
        engine, grown = self.engine, min(count / least, self.max_training)
        if arm in WITH_COUSINS:
            wanted = max(1, round(engine.distillation.episodes / (1 + self.cousins)))
            engine = replace(
                engine,
                episodes=self.episodes_for(arm),
                distillation=replace(
                    engine.distillation,
                    episodes=wanted,
                    worlds=min(engine.distillation.worlds, wanted),
                ),
            )
        policy = self.paper_policy if arm == "paper" else engine.policy
        distillation = engine.distillation
        if arm in ("bc", "paper"):
            # Cloning only takes the gradient steps that distillation has in all.
            steps = policy.steps
            if arm != "paper" and distillation.rounds:
                steps += distillation.first_steps
                steps += (distillation.rounds - 1) * distillation.round_steps
            policy = replace(policy, steps=steps)
            distillation = replace(distillation, rounds=0)
        return replace(
            engine,
            seed=seed,
            distillation=replace(
                distillation,
                first_steps=round(distillation.first_steps * grown),
                round_steps=round(distillation.round_steps * grown),
            ),
            policy=replace(policy, steps=round(policy.steps * grown)),
        )

    def episodes_for(self, arm: Arm):  # noqa: ANN201 - the engine's own type
        """Return how demonstrations of one task are collected; a smaller number is the beginning of a larger one."""
        episodes = self.engine.episodes
        if arm not in WITH_COUSINS:
            return episodes
        wanted = max(1, round(episodes.num_episodes / (1 + self.cousins)))
        return replace(
            episodes, num_episodes=wanted, min_episodes=min(episodes.min_episodes, wanted)
        )

    @property
    def pool_engine(self) -> EngineConfig:
        """The settings of scenes, tasks, experts and demonstrations."""
        return replace(self.engine, seed=self.pool.seed)

    def pool_engine_of(self, arm: Arm) -> EngineConfig:
        """Return the settings up to an arm's demonstrations: with cousins the program labels all of them."""
        engine = self.pool_engine
        if arm not in WITH_COUSINS:
            return engine
        return replace(
            engine,
            episodes=self.episodes_for(arm),
            cousins=CousinsConfig(count=self.cousins),
            expert=replace(engine.expert, start="as_program"),
        )


def source_of(arm: Arm) -> Source:
    """Return where an arm's training objects come from."""
    return "toys" if arm in ("toys", "toys_cousins") else "videos"
