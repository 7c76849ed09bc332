"""Who is judged by `v2p eval`, and how: a LeRobot policy, an expert of ours, or the scripted programs.

All of them go through the same judge, so an expert's and a program's rates say what a policy can reach at best.
"""

import os
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from policies.evaluation.rate import wilson
from v2p_data.episodes.dataset.features import STATE_NAMES
from v2p_data.errors import V2PError
from v2p_data.evaluation.batch import Judged, judge
from v2p_data.evaluation.checkpoint import WEIGHTS_FILE, check_checkpoint
from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.evaluation.facts import interface_of
from v2p_data.experts.labeller import PROGRAM_FILE, program_in
from v2p_data.pipeline.runner import Runtime
from v2p_data.play import Actor, StateActor, VisionActor
from v2p_data.seeds import seed_for
from v2p_data.sim.env.batch_env import ACT_DIM
from v2p_data.sim.render.masks import PALETTE
from v2p_data.task.audit.resets import has_own_reset
from v2p_data.task.task import TASK_FILE, TaskBundle

PROGRAMS = "programs"
"""What `v2p eval` is told in a policy's place for the scripted programs."""
EXPERT_FILE, EXPERT_WEIGHTS_FILE = "expert.json", "weights.safetensors"
EXPERT_FILES = (EXPERT_FILE, EXPERT_WEIGHTS_FILE, PROGRAM_FILE)
UNSEEN_PX = 256
"""Size of pictures that nobody looks at."""
Kind = Literal["policy", "expert", "programs"]
Play = Callable[[TaskBundle], tuple[Actor, int | tuple[int, int]]]
"""From a task to who acts in it, and the size of the pictures that it sees [px]."""


@dataclass(frozen=True, kw_only=True)
class Contestant:
    """Who is judged."""

    kind: Kind
    folder: Path
    """Folder of a policy or an expert."""
    repo_id: str = ""
    """Name on the Hub of a policy that was fetched from there."""


def contestant(path: Path) -> Contestant:
    """Return who lies at `path`.

    Raises:
        V2PError: nobody that can be judged, or a policy that cannot be opened safely.
    """
    if str(path) == PROGRAMS and not path.is_dir():
        return Contestant(kind="programs", folder=path)
    if os.path.lexists(path / WEIGHTS_FILE):
        check_checkpoint(path)
        return Contestant(kind="policy", folder=path.resolve())
    is_network = (path / EXPERT_FILE).is_file() and (path / EXPERT_WEIGHTS_FILE).is_file()
    if is_network or (path / PROGRAM_FILE).is_file():
        return Contestant(kind="expert", folder=path.resolve())
    raise V2PError(
        f"{path} holds no {WEIGHTS_FILE}: it is no LeRobot policy. It holds no {EXPERT_FILE} either: it is no expert;"
        f" the scripted programs are judged by 'v2p eval {PROGRAMS} --tasks TASKS'"
    )


def play_of(who: Contestant, seed: int, device: str) -> Play:
    """Load a contestant, once for all tasks.

    Raises:
        V2PError: it does not suit the simulator.
    """
    match who.kind:
        case "policy":
            return _policy(who.folder, device)
        case "expert":
            return _expert(who.folder)
        case "programs":
            return _programs(seed)


def judge_task(
    play: Play,
    bundle: TaskBundle,
    cfg: EvaluationConfig,
    first_seed: int,
    runtime: Runtime,
    told: Callable[[float], None],
) -> Judged:
    """Judge a contestant in one task."""
    actor, size_px = play(bundle)
    return judge(
        bundle,
        actor,
        first_seed=first_seed,
        cfg=cfg,
        num_threads=runtime.num_threads,
        size_px=size_px,
        on_progress=told,
    )


def own_reset_rate(
    play: Play, bundle: TaskBundle, cfg: EvaluationConfig, first_seed: int, runtime: Runtime
) -> dict[str, Any] | None:
    """Return the rate with the task's own reset, where others are judged with the environment's and the two differ."""
    if cfg.reset == "task" or not has_own_reset(bundle.code):
        return None
    own = replace(cfg, reset="task")
    judged = judge_task(play, bundle, own, first_seed, runtime, lambda _: None)
    return wilson(int(judged.successes.sum()), len(judged.successes)).as_dict()


def row_of(judged: Judged) -> dict[str, Any]:
    """Return what a task's line in `evaluation.json` says of its episodes; the rate by itself is that of `once`."""
    once = wilson(int(judged.successes.sum()), len(judged.successes)).as_dict()
    at_end = judged.at_end
    said = judged.as_dict()
    seconds = said.pop("seconds")
    return {
        **once,
        "once": once,
        "at_end": None if at_end is None else wilson(int(at_end.sum()), len(at_end)).as_dict(),
        **said,
        "seconds": seconds.pop("all"),
        "seconds_of": seconds,
    }


def _policy(folder: Path, device: str) -> Play:
    from policies.evaluation.actor import RGB_KEY, WRIST_KEY, UnsuitablePolicyError, load_actor

    try:
        interface, num_states, num_actions = interface_of(folder)
        actor = load_actor(
            folder,
            greys=PALETTE,
            device=device,
            num_states=num_states if interface.joint_state else len(STATE_NAMES),
            num_actions=num_actions if interface.actions == "joints" else ACT_DIM,
        )
    except UnsuitablePolicyError as error:
        raise V2PError(str(error)) from error
    wrist, rgb = (key in actor.cameras for key in (WRIST_KEY, RGB_KEY))
    return lambda bundle: (
        VisionActor(actor.for_task(bundle.description), wrist, interface, num_states, rgb),
        actor.size_px,
    )


def _expert(folder: Path) -> Play:
    from policies.ppo.policy import Expert
    from v2p_data.experts.actors import ProgramActor

    if (name := program_in(folder)) is not None:
        return lambda bundle: (ProgramActor(0, name), UNSEEN_PX)
    try:
        expert = Expert.load(folder)
    except ValueError as error:
        raise V2PError(str(error)) from error
    return lambda bundle: (StateActor(expert.act, expert.model.obs_dim), UNSEEN_PX)


def _programs(seed: int) -> Play:
    from v2p_data.experts.actors import ProgramActor

    return lambda bundle: (ProgramActor(seed_for(seed, "programs", bundle.title)), UNSEEN_PX)


def task_folders(folder: Path) -> list[tuple[str, Path]]:
    """Return the finished task folders at or below `folder`, each with its item's name.

    Raises:
        V2PError: there is none.
    """
    if (folder / TASK_FILE).is_file():
        return [(_item_name(folder.resolve()), folder)]
    found = [p.parent for p in sorted(folder.glob(f"*/{TASK_FILE}"))]
    found = [path for path in found if path.suffix != ".partial"]
    if not found:
        raise V2PError(f"{folder} holds no task; tasks are the folders with a {TASK_FILE}")
    return [(_item_name(path), path) for path in found]


def _item_name(folder: Path) -> str:
    return re.sub(r"-[0-9a-f]{8}$", "", folder.name)
