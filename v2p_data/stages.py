"""START HERE: the engine's stages in the order they happen.

    video --> scene --> task --> (reward -->) expert --> episodes --+--> dataset --> (distillation
    -->) policy --> evaluation video --> scene --> task --> (reward -->) expert --> episodes --+
          (cousin --> task --> ...) -----------------------------------+

Each stage is a recipe and inputs (what it is) and a `make_*` function (how it comes about). A `make_*` loads
its inputs, calls the craft, saves, and returns the counts that the record keeps. Importing this module loads torch,
MuJoCo and trimesh, which takes seconds: commands that only look at a run do without it.
"""

import json
import logging
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from policies.evaluation.rate import wilson
from v2p_data.craft_data import (
    contents,
    named_contents,
    scene_data,
    task_data,
    task_digest,
    tasks_by_name,
)
from v2p_data.distillation.config import DistillationConfig
from v2p_data.episodes.collect import (
    EpisodesConfig,
    Lesson,
    collect,
    judge_expert,
    staged_episodes,
)
from v2p_data.episodes.dataset.about import CARRIED_TASKS
from v2p_data.errors import ItemRejectedError, V2PError
from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.evaluation.judging import (
    PROGRAMS,
    Contestant,
    judge_task,
    own_reset_rate,
    play_of,
    row_of,
    task_folders,
)
from v2p_data.experts import pretrained
from v2p_data.experts.config import ExpertConfig
from v2p_data.experts.labeller import choose_program, labeller_of
from v2p_data.pipeline.artifact import (
    Record,
    demand_whole,
    history,
    provenance,
    write_json_atomically,
)
from v2p_data.pipeline.fingerprint import file_digest, fingerprint
from v2p_data.pipeline.runner import Runtime, Stage, in_order
from v2p_data.policy.config import PolicyConfig
from v2p_data.policy.training import (
    POLICY_FOLDER,
    Demonstrations,
    Source,
    make_distillation,
    make_distilled_dataset,
    make_policy,
)
from v2p_data.reward.config import RewardConfig
from v2p_data.scene.config import SceneConfig
from v2p_data.scene.scene import Scene
from v2p_data.seeds import rng_for, seed_for
from v2p_data.sim.robot.arms import RobotConfig, robot_to_json
from v2p_data.task.generate import TaskConfig, generate_task
from v2p_data.task.llm.config import VlmConfig
from v2p_data.task.task import (
    REWARD_SEARCH_FOLDER,
    SCENE_FOLDER,
    TaskBundle,
    errors_naming,
)
from v2p_data.video.captions import VideoItem
from v2p_data.video.decode import VideoConfig, read_clip

if TYPE_CHECKING:
    from v2p_data.experts.record import Learned
    from v2p_data.scene.frames.prepare import PreparedClip

logger = logging.getLogger(__name__)

ROOT_OF_TASKS = CARRIED_TASKS.as_posix()
COUSIN_MARK = "_cousin_"
"""Between a scene's item and the number of its cousin."""
MODEL_CALLS_FOLDER = "vlm"
"""Folder of a run with every question to a language model and its answer."""
SOLVED_POOL_FOLDER = "pool"
"""Folder of a run with solved tasks that a language model is shown as examples."""
EVALUATION_FILE = "evaluation.json"
VIDEOS_FOLDER, SHEET_FILE = "videos", "sheet.png"
"""Folder of an evaluation: per task a few films and a contact sheet."""


@dataclass(frozen=True, kw_only=True)
class SimulatorConfig:
    """What all tasks are simulated with."""

    robot: RobotConfig = field(default_factory=RobotConfig)


@dataclass(frozen=True, kw_only=True)
class CousinsConfig:
    """How many relatives of each reconstructed object become tasks of their own."""

    count: int = 0
    """Cousins of each scene; 0: none. A third is under 15 mm thick, a third over 150 mm high."""

    def __post_init__(self) -> None:
        if not 0 <= self.count <= 300:
            raise ValueError(f"count must be between 0 and 300, got {self.count}")


@dataclass(frozen=True, kw_only=True)
class EngineConfig:
    """Everything that decides what the engine makes."""

    video: VideoConfig = field(default_factory=VideoConfig)
    scene: SceneConfig = field(default_factory=SceneConfig)
    cousins: CousinsConfig = field(default_factory=CousinsConfig)
    task: TaskConfig = field(default_factory=TaskConfig)
    sim: SimulatorConfig = field(default_factory=SimulatorConfig)
    reward: RewardConfig = field(default_factory=RewardConfig)
    expert: ExpertConfig = field(default_factory=ExpertConfig)
    episodes: EpisodesConfig = field(default_factory=EpisodesConfig)
    distillation: DistillationConfig = field(default_factory=DistillationConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    seed: int = 0
    """All random streams derive from it."""


@dataclass(frozen=True, kw_only=True)
class Seeded:
    """A recipe and the seed that goes with it."""

    config: Any
    seed: int


# --- video -> scene ------------------------------------------------------------------------------------------


def scene_stage(video: VideoItem, cfg: EngineConfig) -> Stage:
    """Return the stage that understands one video; a preset's choice is part of its recipe."""
    from v2p_data.scene.preset import with_preset

    settings = with_preset(cfg.scene)
    recipe = {
        "video": cfg.video,
        "scene": settings,
        "seed": cfg.seed,
        "caption": video.caption,
        "objects": video.objects,
        "hints": video.hints,
    }
    return Stage(
        name="scene",
        item=video.item,
        config=recipe,
        sources={"video": file_digest(video.path)} | scene_data() | named_contents(settings),
        version=6,
        make=partial(make_scene, video=video),
    )


def make_scene(
    cfg: dict[str, Any],
    inputs: Mapping[str, Path],
    out: Path,
    runtime: Runtime,
    *,
    video: VideoItem,
    prepared: Callable[[], "PreparedClip"] | None = None,
) -> dict[str, Any]:
    """Decode the video and rebuild its objects; `prepared` gives the decoded clip where it is at hand."""
    from v2p_data.scene.export import write_scene
    from v2p_data.scene.reconstruct import prepared_for, reconstruct_prepared

    del inputs
    if prepared is None:
        runtime.progress(0.0, "decoding")
        clip = read_clip(video, cfg["video"])
        runtime.progress(0.2, "finding objects")
        ready = prepared_for(clip, cfg["scene"])
    else:
        ready = prepared()
    rng = rng_for(cfg["seed"], "scene", video.item)
    scene = write_scene(reconstruct_prepared(ready, cfg["scene"], rng), out)
    return {
        "frames": len(ready.clip.frames),
        "objects": len(scene.objects),
        "kind": scene.kind,
        "confidence": round(scene.confidence, 3),
    }


# --- scene -> cousin (with --cousins.count above 0) --------------------------------------------------------------


def cousin_stage(scene: Stage, number: int, cfg: EngineConfig) -> Stage:
    """Return the stage that makes another scene of one: with a relative of its manipulated object."""
    robot = cfg.sim.robot
    return Stage(
        name="cousin",
        item=f"{scene.item}{COUSIN_MARK}{number:03d}",
        config=Seeded(config={"number": number}, seed=cfg.seed),
        inputs={"scene": scene},
        sources=_robot_digests(robot),
        make=partial(make_cousin, robot=robot),
    )


def make_cousin(
    cfg: Seeded, inputs: Mapping[str, Path], out: Path, runtime: Runtime, *, robot: RobotConfig
) -> dict[str, Any]:
    """Stretch mesh and convex parts, draw mass and friction, write the scene."""
    from v2p_data.scene.export import write_relative
    from v2p_data.sim.model.cousins import cousin_of, opening_m_of

    del runtime
    scene, number = Scene.load(inputs["scene"]), cfg.config["number"]
    thing, mesh, parts = cousin_of(scene, number, cfg.seed, opening_m_of(robot))
    write_relative(scene, f"{scene.title}{COUSIN_MARK}{number:03d}", thing, mesh, parts, out)
    return {"size_m": list(thing.size_m), "mass_kg": round(thing.mass_kg, 4)}


# --- scene -> task -------------------------------------------------------------------------------------------


def task_stage(scene: Stage, cfg: EngineConfig) -> Stage:
    """Return the stage that writes and audits one scene's task code, for the robot that is to do it."""
    robot = cfg.sim.robot
    return Stage(
        name="task",
        item=scene.item,
        config=Seeded(config=cfg.task.recipe(), seed=cfg.seed),
        inputs={"scene": scene},
        sources=_robot_digests(robot) | task_data(asks_model=cfg.task.writer == "vlm"),
        version=4,
        make=partial(make_task, robot=robot, how=cfg.task),
    )


def _robot_digests(robot: RobotConfig) -> dict[str, str]:
    """Return what identifies another arm than the built-in one."""
    if robot.path is None:
        return {}
    if not robot.path.is_file():
        raise V2PError(f"there is no robot file {robot.path}; --sim.robot.path names an MJCF file")
    settings = fingerprint({**robot_to_json(robot), "path": ""})
    return {"robot": settings} | contents("robot file", robot.path)


def make_task(
    cfg: Seeded,
    inputs: Mapping[str, Path],
    out: Path,
    runtime: Runtime,
    *,
    robot: RobotConfig,
    how: TaskConfig,
) -> dict[str, Any]:
    """Write eight task codes, audit them, keep the best. What a model answers is kept for all tasks of the run.

    A family's code, where one is given, is the only sample.
    """
    from v2p_data.sim.env.task_check import check_task

    scene = Scene.load(inputs["scene"])
    runtime.progress(0.1, "writing task code")
    generated = generate_task(
        scene,
        how,
        seed_for(cfg.seed, "task", scene.title),
        sources=[TaskBundle.load(inputs["family"]).code] if "family" in inputs else None,
        calls=runtime.root / MODEL_CALLS_FOLDER,
        pool=runtime.root / SOLVED_POOL_FOLDER,
    )
    bundle = replace(generated.bundle, robot=robot_to_json(robot))
    generated = replace(generated, bundle=bundle)
    runtime.progress(0.9, "asking the simulator")
    check_task(bundle, num_threads=runtime.num_threads)
    generated.save(out)
    return {
        "kind": generated.bundle.kind,
        "samples": len(generated.samples),
        "runnable": sum(s.runnable for s in generated.samples),
        "picked": generated.picked,
    }


# --- task -> reward (with --reward.iterations above 0) --------------------------------------------------------


def reward_stage(task: Stage, cfg: EngineConfig) -> Stage:
    """Return the stage that searches a task's reward; its result is the task with the reward that was found."""
    vlm = cfg.task.vlm if cfg.task.writer == "vlm" else None
    return Stage(
        name="reward",
        item=task.item,
        config=Seeded(config=cfg.reward, seed=cfg.seed),
        inputs={"task": task},
        sources=task_data(asks_model=vlm is not None)
        | ({} if vlm is None else {"model": fingerprint(vlm.recipe())}),
        version=3,
        make=partial(make_reward, vlm=vlm),
        resumes=True,
    )


def make_reward(
    cfg: Seeded,
    inputs: Mapping[str, Path],
    out: Path,
    runtime: Runtime,
    *,
    vlm: VlmConfig | None,
) -> dict[str, Any]:
    """Search, and write the task with the reward that was found; a model, if there is one, writes the rewards."""
    from v2p_data.reward.search import RewardSearch

    bundle = TaskBundle.load(inputs["task"])
    seed = seed_for(cfg.seed, "reward", bundle.title)
    writer = None
    if vlm is not None:
        from v2p_data.task.llm.client import VlmClient
        from v2p_data.task.llm.writer import ModelWriter

        client = VlmClient(vlm, out / "calls", seed)
        writer = ModelWriter(client=client, pools=(runtime.root / SOLVED_POOL_FOLDER,))
    search = RewardSearch(
        bundle, cfg.config, out / REWARD_SEARCH_FOLDER, seed=seed, runtime=runtime, writer=writer
    )
    best = search.run()
    shutil.rmtree(out / SCENE_FOLDER, ignore_errors=True)  # of a run that was killed just here
    replace(bundle, code=best.code).save(out)
    return search.summary()


# --- task -> expert ------------------------------------------------------------------------------------------


def expert_stage(task: Stage, cfg: EngineConfig) -> Stage:
    """Return the stage that learns one task.

    A killed training starts anew: it lasts a minute or two, and only then is its result the same as an
    undisturbed one's. It learns with the bonus for success that its reward was searched with; a usual one is not named.
    """
    bonus = cfg.reward.bonus_ratio
    named = {} if bonus == RewardConfig().bonus_ratio else {"bonus ratio": f"{bonus:g}"}
    if cfg.expert.start == "pretrained":
        named["pretrained experts"] = file_digest(pretrained.FOLDER / pretrained.CARD_FILE)
    return Stage(
        name="expert",
        item=task.item,
        config=Seeded(config=cfg.expert, seed=cfg.seed),
        inputs={"task": task},
        sources=named,
        version=6,
        on_device=True,
        make=partial(
            make_expert,
            teaches_model=cfg.task.writer == "vlm",
            bonus_ratio=bonus,
        ),
    )


def make_expert(
    cfg: Seeded,
    inputs: Mapping[str, Path],
    out: Path,
    runtime: Runtime,
    *,
    teaches_model: bool,
    bonus_ratio: float,
) -> dict[str, Any]:
    """Find a teacher, imitate it, go on with PPO, or let it act itself; judge with the independent referee."""
    from v2p_data.report.sheet import write_contact_sheet
    from v2p_data.sim.env.task_check import check_reward, check_task
    from v2p_data.task.llm.pool import add_solved

    expert_cfg: ExpertConfig = cfg.config
    bundle = TaskBundle.load(inputs["task"])
    check_task(bundle, num_threads=runtime.num_threads)
    check_reward(bundle)
    learned = _learned(bundle, cfg, out, runtime, bonus_ratio=bonus_ratio)
    runtime.progress(0.95, "judging at the fine step")
    judged = judge_expert(
        Lesson(bundle=bundle, expert=labeller_of(out)),
        episodes=expert_cfg.eval_episodes,
        seed=seed_for(cfg.seed, "expert-evaluation", bundle.title),
        num_threads=runtime.num_threads,
    )
    rate = wilson(int(judged.successes.sum()), len(judged.successes))
    write_contact_sheet(bundle, judged, out / "sheet.png")
    counts = {
        "steps": learned.steps,
        "train_seconds": round(learned.seconds, 1),
        "learning": learned.as_dict(),
        "success": rate.as_dict(),
        "task_success": float(judged.task_successes.mean()),
    }
    write_json_atomically(out / EVALUATION_FILE, counts)
    if rate.value < expert_cfg.min_success:
        raise ItemRejectedError(
            "expert_not_learned",
            f"after {learned.steps} steps the expert succeeds in {rate} of episodes, "
            f"below the {expert_cfg.min_success:.0%} that are worth collecting",
            rate.value,
        )
    if teaches_model:  # an example for the tasks that come after
        add_solved(runtime.root / SOLVED_POOL_FOLDER, bundle, rate.value)
    return counts


def _learned(
    bundle: TaskBundle,
    cfg: Seeded,
    out: Path,
    runtime: Runtime,
    *,
    bonus_ratio: float,
) -> "Learned":
    """Let an expert learn the task, or choose the program that acts in its place."""
    from v2p_data.experts.learning import Worlds, learn

    worlds = Worlds(
        bundle=bundle,
        seed=seed_for(cfg.seed, "expert", bundle.title),
        num_threads=runtime.num_threads,
        bonus_ratio=bonus_ratio,
    )
    if cfg.config.start == "as_program":
        return choose_program(worlds, cfg.config, out)
    return learn(
        worlds,
        cfg.config,
        out,
        device=runtime.device,
        on_progress=lambda share, words: runtime.progress(0.95 * share, words),
    )


# --- expert -> episodes --------------------------------------------------------------------------------------


def episodes_stage(task: Stage, expert: Stage, cfg: EngineConfig) -> Stage:
    """Return the stage that rolls one expert out under randomisation."""
    return Stage(
        name="episodes",
        item=task.item,
        config=Seeded(config=cfg.episodes, seed=cfg.seed),
        inputs={"task": task, "expert": expert},
        version=4,
        make=make_episodes,
        resumes=True,
    )


def make_episodes(
    cfg: Seeded, inputs: Mapping[str, Path], out: Path, runtime: Runtime
) -> dict[str, Any]:
    """Stage successful episodes one by one; list the failed ones."""
    bundle = TaskBundle.load(inputs["task"])
    return collect(
        Lesson(bundle=bundle, expert=labeller_of(inputs["expert"])),
        cfg.config,
        out,
        seed=seed_for(cfg.seed, "episodes", bundle.title),
        num_threads=runtime.num_threads,
        on_progress=runtime.progress,
    )


# --- episodes -> dataset -------------------------------------------------------------------------------------


def dataset_stage(episodes: Sequence[Stage], repo_id: str) -> Stage:
    """Return the stage that packs all episodes into one LeRobot dataset."""
    return Stage(
        name="dataset",
        item=repo_id.split("/")[-1],
        config={"repo_id": repo_id},
        inputs={stage.item: stage for stage in episodes},
        version=3,
        make=partial(make_dataset, tasks={s.item: s.inputs["task"] for s in episodes}),
    )


def make_dataset(
    cfg: dict[str, Any],
    inputs: Mapping[str, Path],
    out: Path,
    runtime: Runtime,
    *,
    tasks: Mapping[str, Stage],
) -> dict[str, Any]:
    """Write the dataset, reopen it with LeRobot and compare every frame with what was drawn."""
    from v2p_data.episodes.dataset.packing import pack_and_verify

    for task in tasks.values():
        demand_whole(task.folder(runtime.root), runtime.root)
    return pack_and_verify(
        [path for folder in inputs.values() for path in staged_episodes(folder)],
        cfg["repo_id"],
        out,
        runtime,
        provenance={
            "items": {item: history(folder, runtime.root) for item, folder in inputs.items()},
            **provenance(),
        },
        tasks={item: stage.folder(runtime.root) for item, stage in tasks.items()},
    )


# --- dataset -> distillation -> policy -------------------------------------------------------------------------


def distillation_stage(
    dataset: Path, record: Record, cfg: EngineConfig, sources: Sequence[Source]
) -> Stage:
    """Return the stage in which a student acts, and the experts of a dataset's tasks label and take over.

    Args:
        dataset: folder of the demonstrations.
        record: its record.
        cfg: settings.
        sources: tasks and experts of the dataset; its record names them, so they are part of its identity.
    """
    return Stage(
        name="distillation",
        item=record.item,
        config=Seeded(
            config={"distillation": cfg.distillation, "policy": cfg.policy.student}, seed=cfg.seed
        ),
        sources={"dataset": f"{record.item}-{record.fingerprint}"},
        version=2,
        on_device=True,
        make=partial(
            make_distillation,
            data=Demonstrations(
                dataset=dataset, repo_id=str(record.counts["repo_id"]), sources=tuple(sources)
            ),
        ),
        resumes=True,
    )


def distilled_dataset_stage(
    distillation: Stage, record: Record, sources: Sequence[Source]
) -> Stage:
    """Return the stage that packs demonstrations and handover episodes into one LeRobot dataset."""
    name = f"{record.item}-distilled"
    return Stage(
        name="dataset",
        item=name,
        config={"repo_id": f"{str(record.counts['repo_id']).split('/')[0]}/{name}"},
        inputs={"distillation": distillation},
        version=1,
        make=partial(make_distilled_dataset, sources=tuple(sources)),
    )


def policy_stage(
    dataset: Path, record: Record, cfg: EngineConfig, sources: Sequence[Source] = ()
) -> Stage:
    """Return the stage that trains a policy on a finished dataset, after a distillation where there are experts.

    Raises:
        V2PError: there are no tasks to judge checkpoints, or the policy learns from one of them.
    """
    judges = tasks_by_name(task_folders(cfg.policy.judge_tasks) if cfg.policy.judge_tasks else ())
    known = {task_digest(source.task, with_code=False) for source in sources}
    if seen := [n for n, task in judges.items() if task_digest(task, with_code=False) in known]:
        raise V2PError(
            f"--policy.judge-tasks={cfg.policy.judge_tasks} holds {', '.join(seen)}, which the policy learns from; "
            "checkpoints are to be judged on tasks of other objects"
        )
    inputs: dict[str, Stage] = {}
    if sources and cfg.distillation.rounds and cfg.policy.preset != "paper":
        inputs["distillation"] = distillation_stage(dataset, record, cfg, sources)
    return Stage(
        name="policy",
        item=record.item,
        config=Seeded(config=replace(cfg.policy, judge_tasks=None), seed=cfg.seed),
        inputs=inputs,
        sources={"dataset": f"{record.item}-{record.fingerprint}"} | _contents_of(judges, "judge"),
        version=2,
        on_device=True,
        make=partial(
            make_policy,
            data=Demonstrations(
                dataset=dataset, repo_id=str(record.counts["repo_id"]), sources=tuple(sources)
            ),
            judges=judges,
        ),
        resumes=True,
    )


# --- policy -> evaluation ------------------------------------------------------------------------------------


def evaluation_stage(
    who: Contestant, tasks: Mapping[str, Path], cfg: EngineConfig, seen: Sequence[Path]
) -> Stage:
    """Return the stage that judges someone in each task.

    Args:
        who: a LeRobot policy, an expert, or the scripted programs.
        tasks: folders of the tasks to try, by name.
        cfg: settings.
        seen: the tasks that the policy's dataset had, or that the expert learned; known again by their contents.
    """
    known = {task_digest(path, with_code=False) for path in seen}
    here = [name for name, path in tasks.items() if task_digest(path, with_code=False) in known]
    return Stage(
        name="evaluation",
        item=_item_of(who),
        config=Seeded(config=cfg.evaluation, seed=cfg.seed),
        sources={
            **({PROGRAMS: ""} if who.kind == PROGRAMS else contents(who.kind, who.folder)),
            **_contents_of(tasks, "task"),
            "seen": ", ".join(here),
        },
        version=4,
        on_device=True,
        make=partial(make_evaluation, who=who, tasks=dict(tasks), seen=here),
    )


def _contents_of(tasks: Mapping[str, Path], name: str) -> dict[str, str]:
    """Return the digest of each file of each task."""
    files = (contents(f"{name} {title}", path) for title, path in tasks.items())
    return {file: digest for those in files for file, digest in those.items()}


def demand_whole_part(place: Path, root: Path | None = None) -> None:
    """Raise if a policy, an expert or a task is not as it was made, wherever it lies: see `demand_whole`."""
    if place.name == POLICY_FOLDER:
        demand_whole(place.parent, root, f"{POLICY_FOLDER}/")
    elif place.parent.as_posix().endswith(ROOT_OF_TASKS):
        demand_whole(place.parents[2], root, f"{ROOT_OF_TASKS}/{place.name}/")
    else:
        demand_whole(place, root)


def _item_of(who: Contestant) -> str:
    if who.kind == "programs":
        return PROGRAMS
    if who.kind == "expert":
        return f"{who.folder.name.rsplit('-', 1)[0]}-expert"
    if who.repo_id:
        return who.repo_id.split("/")[-1]
    folder = who.folder
    return folder.parent.name.rsplit("-", 1)[0] if folder.name == POLICY_FOLDER else folder.name


def make_evaluation(
    cfg: Seeded,
    inputs: Mapping[str, Path],
    out: Path,
    runtime: Runtime,
    *,
    who: Contestant,
    tasks: Mapping[str, Path],
    seen: Sequence[str],
) -> dict[str, Any]:
    """Judge many episodes of each task; write rates with intervals, kinds of failure, films and contact sheets."""
    from v2p_data.report.sheet import SheetConfig, write_contact_sheet, write_films

    del inputs
    for place in (who.folder, *tasks.values()):
        demand_whole_part(place, runtime.root)
    play = play_of(who, cfg.seed, runtime.device)
    rows: list[dict[str, Any]] = []
    for index, (name, folder) in enumerate(tasks.items()):
        bundle = TaskBundle.load(folder)
        seed = seed_for(cfg.seed, "evaluation", name) % 2**31
        with errors_naming(folder):
            judged = judge_task(
                play,
                bundle,
                cfg.config,
                seed,
                runtime,
                lambda share, k=index, words=name: runtime.progress(
                    (k + share) / len(tasks), words
                ),
            )
        videos = out / VIDEOS_FOLDER / name
        write_films(bundle, judged.shown, videos)
        write_contact_sheet(
            bundle, judged.shown, videos / SHEET_FILE, SheetConfig(successes=3, failures=3)
        )
        row = {
            "task": name,
            "folder": folder.resolve().name,
            "digest": task_digest(folder),
            "seen": name in seen,
            "judged": who.kind,
            **row_of(judged),
        }
        own = own_reset_rate(play, bundle, cfg.config, seed, runtime)
        rows.append(row | ({"own_reset": own} if own else {}))
    (out / EVALUATION_FILE).write_text(json.dumps(rows, indent=1), encoding="utf-8")
    return {"tasks": len(rows), "rows": rows}


# --- all of it -----------------------------------------------------------------------------------------------


def with_cousins(stage: Stage, cfg: EngineConfig) -> list[Stage]:
    """Return a stage that a scene leads to, and the same one of each of the scene's cousins."""
    if not cfg.cousins.count:
        return [stage]
    scene = next(s for s in in_order([stage]) if s.name == "scene")
    cousins = (cousin_stage(scene, k, cfg) for k in range(cfg.cousins.count))
    return [stage, *(_of_cousin(stage, cousin, cfg) for cousin in cousins)]


def _of_cousin(stage: Stage, cousin: Stage, cfg: EngineConfig) -> Stage:
    """Return a stage for the cousin.

    Searched rewards and a model's code are the family's, templates write one sample.
    """
    if stage.name == "scene":
        return cousin
    if stage.name in ("task", "reward"):
        task = task_stage(cousin, replace(cfg, task=replace(cfg.task, num_samples=1)))
        if stage.name == "task" and cfg.task.writer == "templates":
            return task
        return replace(task, inputs={"scene": cousin, "family": stage})
    inputs = {name: _of_cousin(needed, cousin, cfg) for name, needed in stage.inputs.items()}
    return replace(stage, item=cousin.item, inputs=inputs)


def chain(video: VideoItem, cfg: EngineConfig) -> Stage:
    """Return the episodes stage of one video, with everything before it."""
    scene = scene_stage(video, cfg)
    task = task_stage(scene, cfg)
    if cfg.reward.iterations:
        task = reward_stage(task, cfg)
    expert = expert_stage(task, cfg)
    return episodes_stage(task, expert, cfg)
