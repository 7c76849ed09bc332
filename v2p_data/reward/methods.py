"""What each method of the paper's comparison starts from: whose eyes the writer has, and which success is trained on.

* `v2p`: the audited task; every first reward is another one over the same success.
* `eureka`: the writer sees the caption and no video, so success comes from words alone, and is not audited.
* `robogen`: the task as it is, one reward, no bonus for success and no second round.
* `code_as_policy`: no training; `reward.programs` plays scripted programs, chosen anew every 50 control steps.

The switches of `RewardConfig.without` take single parts of `v2p` away, as in the paper's tables 3 and 7.
Simulation is the same for all: only what the writer is told differs. Templates write, or the model that wrote the task.
"""

import ast
import shutil
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from v2p_data.reward.config import RewardConfig
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.task.llm.config import VlmConfig
from v2p_data.task.sandbox.sandbox import class_name
from v2p_data.task.sandbox.splice import REWARD, reward_part, with_reward
from v2p_data.task.task import SCENE_FOLDER, TaskBundle
from v2p_data.task.templates.variants import NUM_VARIANTS
from v2p_data.task.templates.write import write_samples

UNSEEN_SIZE_M = (0.06, 0.06, 0.06)
"""What a writer supposes who has seen nothing."""


@runtime_checkable
class RewardWriter(Protocol):
    """Who writes instead of templates and rules; it was made with what it may see (`told`)."""

    def task_code(self, bundle: TaskBundle) -> str:
        """Return one code for a task, unaudited."""
        ...

    def first_rewards(self, bundle: TaskBundle, count: int) -> list[str]:
        """Return at most `count` codes with other rewards than the task's."""
        ...

    def better_rewards(
        self, bundle: TaskBundle, code: str, feedback_text: str, count: int
    ) -> list[str]:
        """Return at most `count` codes with better rewards, after a training with `code`."""
        ...


@dataclass(frozen=True, kw_only=True)
class Prepared:
    """A task to search rewards for, as one method sees it."""

    bundle: TaskBundle
    """Its code has the success, reset and observation that every candidate keeps; it is simulated as it is."""
    seen: Scene
    """What the writer knows of the scene."""
    codes: tuple[str, ...] = field(repr=False)
    """The first round, without those that turn out alike; of a model's only the task's own."""
    origins: tuple[str, ...]


def prepare(
    bundle: TaskBundle,
    cfg: RewardConfig,
    rng: np.random.Generator,
    writer: RewardWriter | None = None,
    made: TaskBundle | None = None,
) -> Prepared:
    """Return the task and the first rewards of a method.

    Args:
        bundle: the task as it was written and audited with all that the video says.
        cfg: method and switches.
        rng: which sample is taken where nobody picks.
        writer: writes the task anew where a method takes another success; by default a template does.
        made: the task of a search that was stopped: a writer that is asked again may give another success.

    Raises:
        V2PError: the writer gives no code that runs.
    """
    seen = what_the_writer_sees(bundle.scene, cfg)
    is_own_success = writes_success(cfg)
    if writer is not None:
        if not is_own_success:
            return Prepared(bundle=bundle, seen=seen, codes=(bundle.code,), origins=("given",))
        code = writer.task_code(bundle) if made is None else made.code
        base = replace(bundle, code=code, class_name=class_name(code), audit={})
        return Prepared(bundle=base, seen=seen, codes=(code,), origins=("model",))
    samples = write_samples(seen, NUM_VARIANTS)
    base = bundle
    if is_own_success:
        # Nobody holds it against the video: the writer's first thought, or any of its samples.
        chosen = int(rng.integers(NUM_VARIANTS)) if "pick" in cfg.without else 0
        code = samples[chosen]
        base = replace(bundle, code=code, class_name=class_name(code), audit={})
    codes = list(dict.fromkeys([base.code, *(in_place_of_reward(base.code, s) for s in samples)]))
    if cfg.num_candidates == 1:
        # Without a choice there is no reason why the one reward should be the best known.
        codes = [codes[int(rng.integers(len(codes)))]]
    codes = codes[: cfg.num_candidates]
    return Prepared(
        bundle=base,
        seen=seen,
        codes=tuple(codes),
        origins=tuple("given" if code == bundle.code else "template" for code in codes),
    )


def told(vlm: VlmConfig, cfg: RewardConfig) -> VlmConfig:
    """Return a model's settings with what a method hides from it left out of what it is told."""
    if _is_blind(cfg):
        return replace(vlm, images=False, tracking=False)
    return replace(vlm, tracking=vlm.tracking and "tracking" not in cfg.without)


def writes_success(cfg: RewardConfig) -> bool:
    """Tell whether a method trains on another success than the audited one."""
    return _is_blind(cfg) or "tracking" in cfg.without or "pick" in cfg.without


def _is_blind(cfg: RewardConfig) -> bool:
    return cfg.method == "eureka" or "visual" in cfg.without


def what_the_writer_sees(scene: Scene, cfg: RewardConfig) -> Scene:
    """Return the scene as the writer of task code knows it: all of it, or less."""
    if _is_blind(cfg):
        blind = tuple(replace(_still(o), shape="box", size_m=UNSEEN_SIZE_M) for o in scene.objects)
        return replace(scene, objects=blind)
    if "tracking" in cfg.without:
        return replace(scene, objects=tuple(_still(o) for o in scene.objects))
    return scene


def _still(obj: SceneObject) -> SceneObject:
    """Return an object of whose motion nothing is known."""
    return replace(
        obj,
        frames=obj.frames[:1],
        poses_world=obj.poses_world[:1],
        confidences=obj.confidences[:1],
    )


# --- code ----------------------------------------------------------------------------------------------------


def in_place_of_reward(code: str, other: str) -> str:
    """Return task code with another one's reward, or as it is where that is the same.

    Raises:
        SpliceError: the other one holds no reward that could be put there.
    """
    if reward_part(code) == reward_part(other):
        return code
    return with_reward(code, other)


def reward_text(code: str) -> str:
    """Return the text of a task's reward function, for a person."""
    for node in ast.parse(code).body:
        if isinstance(node, ast.FunctionDef) and node.name == REWARD:
            return "\n".join(code.splitlines()[node.lineno - 1 : node.end_lineno])
    return ""


# --- disk ----------------------------------------------------------------------------------------------------


def save_bundle(bundle: TaskBundle, folder: Path) -> None:
    """Write a task so that it is whole or absent, also one whose scene never lay on disk."""
    partial = folder.with_name(folder.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    bundle.save(partial)
    bundle.scene.save(partial / SCENE_FOLDER)  # as it is here, whatever its folder says
    partial.rename(folder)


def load_candidate(bundle: Path, code: Path) -> TaskBundle:
    """Return a saved task with a candidate's code."""
    loaded = TaskBundle.load(bundle)
    text = code.read_text()
    # Tried by whoever made the candidate; a confined worker can start no trial of its own.
    return replace(loaded, code=text, class_name=class_name(text), folder=Path())
