"""Commands that make things: the whole chain, or up to one stage."""

import os
import shlex
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import tyro

from policies.evaluation.rate import Rate
from v2p_data.cli import parse
from v2p_data.commands.display import (
    Display,
    cost_line,
    describe,
    exit_code,
    outcome_table,
    tally,
    telling,
)
from v2p_data.commands.judged import contestant_at, home_of, rate_lines, seen_tasks
from v2p_data.commands.progress import Progress
from v2p_data.commands.settings import How, Running, Settings, goes_on, run_folder_for, with_config
from v2p_data.commands.setup import fetch_preset
from v2p_data.craft_data import tasks_by_name
from v2p_data.episodes.dataset.repo_id import check_repo_id, is_repo_id
from v2p_data.episodes.hub.policy_card import DEMO_REPO_ID, note_results
from v2p_data.errors import NotAllError, V2PError
from v2p_data.evaluation.judging import PROGRAMS, Contestant, contestant, task_folders
from v2p_data.pipeline.artifact import Record, read_record, write_json_atomically
from v2p_data.pipeline.contents import list_files, memory_of
from v2p_data.pipeline.fingerprint import fingerprint
from v2p_data.pipeline.run_file import RUN_FILE, outcomes_json
from v2p_data.pipeline.runner import Outcome, Runtime, Stage, in_order, stored_outcome
from v2p_data.pipeline.settings import load_settings
from v2p_data.pipeline.workers import Key, only_run_in, run_stages
from v2p_data.policy.training import sources_of
from v2p_data.report.page import write_page
from v2p_data.stages import (
    COUSIN_MARK,
    EVALUATION_FILE,
    POLICY_FOLDER,
    EngineConfig,
    chain,
    dataset_stage,
    demand_whole_part,
    distillation_stage,
    distilled_dataset_stage,
    evaluation_stage,
    policy_stage,
    scene_stage,
    task_stage,
    with_cousins,
)
from v2p_data.video.captions import CAPTIONS_FILE, NO_CAPTION, VideoItem, read_footage


@dataclass(frozen=True, kw_only=True)
class FromVideos(Settings):
    videos: tyro.conf.Positional[Path]
    """Folder of videos, or one video; captions in captions.json beside them, or in the file names."""
    out: Path
    """Run folder; running again keeps what is done."""


@dataclass(frozen=True, kw_only=True)
class Generate(FromVideos):
    repo_id: str
    """Name of the dataset on the Hub: USER/NAME. Nothing is uploaded."""


@dataclass(frozen=True, kw_only=True)
class Train(Settings):
    dataset: tyro.conf.Positional[Path]
    """Folder of a dataset that `v2p generate` made."""
    out: Path | None = None
    """Run folder; by default the one the dataset lies in."""


@dataclass(frozen=True, kw_only=True)
class Evaluate(Settings):
    policy: tyro.conf.Positional[Path]
    """Folder of a policy or of an expert, or a policy's USER/NAME on the Hub; `programs` for the scripted programs."""
    tasks: tuple[Path, ...] = ()
    """More task folders (or folders of tasks) to try: these count as unseen."""
    out: Path | None = None
    """Run folder; by default the one the policy lies in, and outputs/NAME of a policy on the Hub."""


@dataclass(frozen=True, kw_only=True)
class Try(Settings):
    clip: tyro.conf.Positional[Path]
    """One video."""
    caption: str = ""
    """What the hand does, e.g. "Lifting a red box up"; without it, what the file beside the clip or its name says."""
    out: Path = Path("outputs/try")
    """Run folder."""


@dataclass(frozen=True, kw_only=True)
class Demo:
    out: Path = Path("outputs/demo")
    """Run folder."""
    how: Running = field(default_factory=How)


# --- commands ------------------------------------------------------------------------------------------------


def scene_command(argv: list[str]) -> int:
    return _up_to("scene", argv, lambda video, cfg: scene_stage(video, cfg), "task")


def task_command(argv: list[str]) -> int:
    return _up_to("task", argv, lambda v, cfg: task_stage(scene_stage(v, cfg), cfg), "expert")


def expert_command(argv: list[str]) -> int:
    return _up_to("expert", argv, lambda v, cfg: chain(v, cfg).inputs["expert"], "episodes")


def episodes_command(argv: list[str]) -> int:
    return _up_to("episodes", argv, chain, "generate")


def generate_command(argv: list[str]) -> int:
    args = with_config(Generate, argv, "generate")
    root = run_folder_for(args.out)
    check_repo_id(args.repo_id)
    with only_run_in(root):
        dataset, code = generate(
            args.videos, root, args.repo_id, args.engine, args.how.runtime(root)
        )
        page = _page(root)
    if dataset is None:
        raise V2PError(f"no video came as far as episodes, so there is no dataset; see {page}")
    counts = _record(dataset).counts
    _say(
        f"Made {dataset}",
        f"{counts['episodes']} episodes, {counts['frames']} frames; page: {page}",
        goes_on("train", dataset, args),
    )
    return code


def train_command(argv: list[str]) -> int:
    args = with_config(Train, argv, "train")
    root = run_folder_for(args.out or args.dataset.resolve().parent.parent)
    with only_run_in(root):
        policy = train(args.dataset, root, args.engine, args.how.runtime(root))
        page = _page(root)
    counts = _record(policy.parent).counts
    _say(
        f"Made {policy}",
        f"loss {counts['final_loss']:.3f} after {counts['steps']} steps; page: {page}",
        goes_on("eval", policy, args),
    )
    return 0


def distill_command(argv: list[str]) -> int:
    args = with_config(Train, argv, "distill")
    root = run_folder_for(args.out or args.dataset.resolve().parent.parent)
    if not args.engine.distillation.rounds:
        raise V2PError("--distillation.rounds=0 leaves nothing to do; it is 1 or more")
    record = _dataset_record(args.dataset)
    sources = sources_of(args.dataset.resolve(), root)
    if not sources:
        raise V2PError(
            f"the tasks and experts of {args.dataset} are not in {root}: distillation needs the run that made it;"
            " 'v2p train' clones the demonstrations without"
        )
    stage = distillation_stage(args.dataset.resolve(), record, args.engine, sources)
    packed = distilled_dataset_stage(stage, record, sources)
    check_repo_id(packed.config["repo_id"])
    with only_run_in(root):
        outcomes = _run([packed], _all_threads(args.how.runtime(root)))
        for part in (stage, packed):
            _demand(outcomes[(part.name, part.folder_name)])
        page = _page(root)
    counts = _record(stage.folder(root)).counts
    recovered = ", ".join(f"{share:.0%}" for share in counts["recovered"])
    _say(
        f"Made {packed.folder(root)}",
        f"{counts['episodes']} handover episodes, {counts['frames']} frames; the expert recovered {recovered} of each"
        f" round's; page: {page}",
        goes_on("train", args.dataset, args),
    )
    return 0


def eval_command(argv: list[str]) -> int:
    args = with_config(Evaluate, argv, "eval")
    who = contestant_at(args.policy)
    root = run_folder_for(args.out or home_of(who, args.tasks))
    others = [task for folder in args.tasks for task in task_folders(folder)]
    with only_run_in(root):
        outcome, rows = evaluate(who, others, root, args.engine, args.how.runtime(root))
        page = _page(root)
    goes_on = {
        "policy": f"v2p push {shlex.quote(str(args.policy))} --repo-id USER/NAME",
        "expert": f"v2p eval {PROGRAMS} --tasks TASKS   (the same judge on scripted programs)",
        "programs": "v2p eval POLICY   (the same judge on a policy)",
    }
    _say(
        f"Made {outcome.folder / EVALUATION_FILE}",
        "\n".join(rate_lines(rows)) + f"\npage: {page}",
        f"v2p report {shlex.quote(str(root))}" if who.repo_id else goes_on[who.kind],
    )
    return 0


def try_command(argv: list[str]) -> int:
    args = with_config(Try, argv, "try")
    root = run_folder_for(args.out)
    if not args.clip.is_file():
        raise V2PError(f"{args.clip} is no video file; v2p generate takes a folder of them")
    fetch_preset(args.engine.scene)
    with only_run_in(root):
        (video,) = _videos(args.clip)
        last = chain(replace(video, caption=args.caption or video.caption), args.engine)
        outcomes = _run([last], args.how.runtime(root))
        page = _page(root)
    for stage in in_order([last]):
        _demand(outcomes[(stage.name, stage.folder_name)])
    folder = last.inputs["expert"].folder(root)
    expert, count = _record(folder).counts, _record(last.folder(root)).counts["episodes"]
    rate = Rate(**{k: expert["success"][k] for k in ("successes", "trials", "low", "high")})
    _say(
        f"Made {count} episodes in {last.folder(root)}; pictures: {folder / 'sheet.png'}",
        f"the expert succeeds in {rate} of episodes ({expert['learning']['made_by']}); page: {page}",
        f"v2p generate {shlex.quote(str(args.clip.parent))} --out outputs/mine --repo-id USER/NAME",
    )
    return 0


def demo_command(argv: list[str]) -> int:
    args = parse(Demo, argv, "demo")
    samples = Path(__file__).parents[2] / "datasets" / "sample_videos"
    settings = Path(__file__).parents[2] / "configs" / "demo.yaml"
    if not samples.is_dir():
        raise V2PError(
            f"the sample clips are not at {samples}; run the demo from a clone of the repository"
        )
    root = run_folder_for(args.out)
    cfg = load_settings(settings, EngineConfig)
    runtime = args.how.runtime(root)
    print(  # noqa: T201
        "v2p demo: three clips become tasks, experts, a dataset, a policy and a page; 10 to 15 minutes on two"
        f" cores.\nEverything goes to {root}; running again keeps what is done.",
        flush=True,
    )
    with only_run_in(root):
        dataset, code = generate(samples, root, DEMO_REPO_ID, cfg, runtime)
        if dataset is None:
            raise V2PError(f"no sample clip came as far as episodes; see {_page(root)}")
        policy = train(dataset, root, cfg, runtime)
        unseen, code_of_unseen = _unseen_tasks(samples / "unseen", root, cfg, runtime)
        _, rows = evaluate(contestant(policy), unseen, root, cfg, runtime)
        page = _page(root)
    _say(
        f"Made {page}",
        "\n".join(rate_lines(rows)),
        f"v2p generate YOUR_VIDEOS --out outputs/mine --repo-id USER/NAME   (dataset: {dataset})",
    )
    return max(code, code_of_unseen)


# --- what they share -----------------------------------------------------------------------------------------


def generate(
    videos: Path, root: Path, repo_id: str, cfg: EngineConfig, runtime: Runtime
) -> tuple[Path | None, int]:
    """Run the chain on every video and pack what came through; return the dataset, if there is one, and the exit code.

    A new dataset takes those whose scene, task and expert are still as they were made.
    """
    fetch_preset(cfg.scene)
    chains = [c for video in _videos(videos) for c in with_cousins(chain(video, cfg), cfg)]
    outcomes = _run(chains, runtime)
    good = [c for c in chains if outcomes[(c.name, c.folder_name)].is_usable]
    good = [c for c in good if _record(c.folder(root)).counts.get("episodes", 0)]
    _tell_cousins(outcomes.values())
    print(outcome_table(list(outcomes.values())), file=sys.stderr)  # noqa: T201
    print(cost_line(list(outcomes.values())), file=sys.stderr)  # noqa: T201
    if good and stored_outcome(dataset_stage(good, repo_id), root) is None:
        usable = {key for key, outcome in outcomes.items() if outcome.is_usable}
        good = [c for c in good if all((s.name, s.folder_name) in usable for s in in_order([c]))]
    code = exit_code(outcomes.values(), is_made=bool(good))
    if not good:
        return None, code
    packed = dataset_stage(good, repo_id)
    outcome = _run([packed], runtime)[(packed.name, packed.folder_name)]
    _demand(outcome)
    return outcome.folder, code


def train(dataset: Path, root: Path, cfg: EngineConfig, runtime: Runtime) -> Path:
    """Train a policy on a finished dataset and return its folder."""
    record = _record_to_train(dataset, root)
    sources = sources_of(dataset.resolve(), root)
    if not sources and cfg.distillation.rounds and cfg.policy.preset != "paper":
        print(  # noqa: T201
            f"the experts of {dataset} are not in {root}, so the policy clones its demonstrations only",
            file=sys.stderr,
        )
    if (
        runtime.device == "cpu"
        and cfg.policy.preset != "small"
        and cfg.policy.encoder == "resnet18"
    ):
        print(  # noqa: T201
            "ResNet18 trains for hours to days on a CPU; --policy.preset=small --policy.steps=4000"
            " --policy.batch-size=256 takes minutes",
            file=sys.stderr,
        )
    stage = policy_stage(dataset.resolve(), record, cfg, sources)
    outcomes = _run([stage], _all_threads(runtime))
    for made in (*stage.inputs.values(), stage):  # what a policy waits for says why it failed
        _demand(outcomes[(made.name, made.folder_name)])
    return stage.folder(root) / POLICY_FOLDER


def evaluate(
    who: Contestant,
    others: Sequence[tuple[str, Path]],
    root: Path,
    cfg: EngineConfig,
    runtime: Runtime,
) -> tuple[Outcome, list[dict[str, Any]]]:
    """Judge a policy, an expert or the programs in the tasks that it learned from and in others."""
    seen = seen_tasks(who)
    if not (named := [*seen, *others]):
        raise V2PError(
            f"no task is known for {who.repo_id or who.folder}; name task folders with --tasks"
        )
    for _, task in named:
        demand_whole_part(task.resolve(), root)
    # Reads all tasks: what is wrong with a file is said before anything starts.
    stage = evaluation_stage(who, tasks_by_name(named), cfg, seen=[path for _, path in seen])
    outcome = _run([stage], _all_threads(runtime))[(stage.name, stage.folder_name)]
    _demand(outcome)
    rows = _record(outcome.folder).counts["rows"]
    if who.kind == "policy" and not who.repo_id and os.access(who.folder, os.W_OK):
        note_results(who.folder, rows)
    return outcome, rows


def _all_threads(runtime: Runtime) -> Runtime:
    """Let the only job have all threads."""
    return replace(runtime, num_threads=max(runtime.workers, runtime.num_threads))


def _dataset_record(dataset: Path) -> Record:
    """Return the record of a dataset of this engine.

    Raises:
        V2PError: it is none.
    """
    record = read_record(dataset)
    if (
        record is None
        or record.stage != "dataset"
        or not is_repo_id(str(record.counts.get("repo_id")))
    ):
        raise V2PError(
            f"{dataset} is no dataset of v2p generate; for others use"
            " 'lerobot-train --policy.type=v2p_bc --dataset.root=...'"
        )
    return record


def _record_to_train(dataset: Path, root: Path) -> Record:
    """Return the record of a dataset of this engine; one that was merged or cut gets a record by its content.

    Raises:
        V2PError: it is none, or not as it was made.
    """
    if not (dataset / "meta/info.json").exists():
        return _dataset_record(dataset)  # which says what is wrong
    from v2p_data.episodes.dataset.about import demand_ours

    about = demand_ours(dataset, memory_of(dataset, root))
    if read_record(dataset) is not None:
        return _dataset_record(dataset)
    listed = {name: mark.sha256 for name, mark in list_files(dataset).items()}
    return Record(
        stage="dataset",
        item=dataset.resolve().name,
        version=0,
        fingerprint=fingerprint(listed)[:8],
        recipe={},
        inputs={},
        seconds=0.0,
        counts={"repo_id": about["repo_id"]},
    )


def _unseen_tasks(
    videos: Path, root: Path, cfg: EngineConfig, runtime: Runtime
) -> tuple[list[tuple[str, Path]], int]:
    stages = [task_stage(scene_stage(video, cfg), cfg) for video in _videos(videos)]
    outcomes = _run(stages, runtime)
    usable = [s for s in stages if outcomes[(s.name, s.folder_name)].is_usable]
    return [(s.item, s.folder(root)) for s in usable], exit_code(outcomes.values(), is_made=True)


def _up_to(
    name: str, argv: list[str], stage_of: Callable[[VideoItem, EngineConfig], Stage], then: str
) -> int:
    args = with_config(FromVideos, argv, name)
    root = run_folder_for(args.out)
    fetch_preset(args.engine.scene)
    with only_run_in(root):
        stages = [stage_of(video, args.engine) for video in _videos(args.videos)]
        family = [s for stage in stages for s in with_cousins(stage, args.engine)]
        outcomes = _run(stages if name == "scene" else family, args.how.runtime(root))
        _tell_cousins(outcomes.values())
        page = _page(root)
    print(outcome_table(list(outcomes.values())), file=sys.stderr)  # noqa: T201
    stages = stages if name == "scene" else family
    counts = tally(list(outcomes.values()), name)
    rest = ", ".join(f"{n} {status}" for status, n in counts.items() if status != "usable")
    made = "videos" if len(family) == len(stages) else "tasks of videos and cousins"
    if name == "scene" and not counts["usable"]:
        then = f"v2p scene review {shlex.quote(str(args.out))}   (to mark what was not found)"
    else:
        repo = " --repo-id USER/NAME" if then == "generate" else ""
        then = goes_on(then, args.videos, args, "--out", str(args.out)) + repo
    _say(
        f"Made {root / name}",
        f"{counts['usable']} of {len(stages)} {made}{f' ({rest})' if rest else ''}; page: {page}",
        then,
    )
    return exit_code(outcomes.values(), is_made=bool(counts["usable"]))


def _tell_cousins(outcomes: Iterable[Outcome]) -> None:
    """Say of each family how many cousins came through, and what became of the others."""
    of_family: dict[str, dict[str, list[Outcome]]] = {}
    for outcome in outcomes:
        family, mark, number = outcome.item.rpartition(COUSIN_MARK)
        if mark and number.isdecimal():
            of_family.setdefault(family, {}).setdefault(number, []).append(outcome)
    for family, cousins in of_family.items():
        bad = [
            next((o for o in made if o.status in ("failed", "rejected")), None)
            for made in cousins.values()
        ]
        why = Counter(o.reason or o.status for o in bad if o is not None)
        first = {o.reason: o.detail for o in reversed(bad) if o is not None}
        reasons = "; ".join(
            f"{n} {reason}: {first.get(reason, '')}" for reason, n in why.most_common()
        )
        came = sum(all(o.is_usable for o in made) for made in cousins.values())
        print(  # noqa: T201
            f"{family}: {came} of {len(cousins)} cousins came through{f' ({reasons})' if reasons else ''}",
            file=sys.stderr,
        )


def _videos(folder: Path) -> list[VideoItem]:
    """Return a folder's videos; say what was passed over, and which videos have no caption."""
    footage = read_footage(folder)
    for note in footage.notes:
        print(note, file=sys.stderr)  # noqa: T201
    videos = list(footage.videos)
    mute = [video.path.name for video in videos if video.caption == NO_CAPTION]
    if mute:
        print(  # noqa: T201
            f"{len(mute)} of {len(videos)} videos without a caption ({', '.join(mute)}): what moves there is called "
            f"'{NO_CAPTION}'; captions go into {CAPTIONS_FILE} beside the videos",
            file=sys.stderr,
        )
    return videos


def _run(stages: Sequence[Stage], runtime: Runtime) -> dict[Key, Outcome]:
    with Display() as display:
        progress = Progress(runtime, stages, display)
        outcomes = run_stages(stages, runtime, progress)
        progress.write()
    path = runtime.root / RUN_FILE
    try:
        write_json_atomically(path, outcomes_json(outcomes.values()))
    except OSError as error:
        raise V2PError(
            f"cannot write {path} ({error.strerror}); what was made is kept: remove what is there and run again"
        ) from error
    return outcomes


def _page(root: Path) -> Path:
    """Write the run's page.

    Raises:
        NotAllError: it cannot be written; all else is there.
    """
    with telling("report"):
        try:
            return write_page(root)
        except V2PError as error:
            raise NotAllError(str(error)) from error


def _demand(outcome: Outcome) -> None:
    if not outcome.is_usable:
        raise V2PError(f"{outcome.stage} {outcome.item} {describe(outcome)}")


def _record(folder: Path) -> Record:
    record = read_record(folder)
    if record is None:
        raise V2PError(f"{folder} is not complete")
    return record


def _say(made: str, number: str, then: str) -> None:
    print(f"\n{made}\n{number}\nNext: {then}")  # noqa: T201
