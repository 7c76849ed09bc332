"""A dataset becomes a policy: distillation in rounds, where there are experts, and a last training on all frames.

The student of the distillation is the LeRobot policy itself, so the last training goes on from its weights.
"""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from v2p_data.distillation.config import DistillationConfig
from v2p_data.episodes.collect import staged_episodes
from v2p_data.episodes.config import EpisodesConfig
from v2p_data.episodes.dataset.features import RGB_KEY, WRIST_KEY, ArmInterface, interface_in
from v2p_data.errors import V2PError
from v2p_data.evaluation.checkpoint import check_checkpoint
from v2p_data.pipeline.artifact import demand_whole, provenance, read_record
from v2p_data.pipeline.runner import Runtime
from v2p_data.pipeline.settings import from_values
from v2p_data.play import VisionActor
from v2p_data.policy.config import PolicyConfig
from v2p_data.seeds import seed_for
from v2p_data.task.task import TaskBundle

if TYPE_CHECKING:
    from policies.bc.student import Student

CACHE_FOLDER = "cache"
"""Folder of a run with decoded pictures of its datasets, as networks take them. Safe to delete."""
POLICY_FOLDER = "policy"
ACTION_LIMIT = 1.0
"""The simulator clips every entry of an action to this."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """Where one task of a dataset came from, in its run folder."""

    item: str
    task: Path
    expert: Path
    episodes: Path


@dataclass(frozen=True, kw_only=True)
class Demonstrations:
    """A dataset that is trained on."""

    dataset: Path
    """Its folder."""
    repo_id: str
    """Its name."""
    sources: Sequence[Source]
    """Where its tasks came from; empty where that is not known."""


def sources_of(dataset: Path, root: Path) -> list[Source]:
    """Return the tasks and experts behind a dataset of `v2p generate`; empty where they are not in the run folder."""
    record = read_record(dataset)
    found: list[Source] = []
    for item, folder in (record.inputs if record else {}).items():
        episodes = root / "episodes" / folder
        of_episodes = read_record(episodes)
        if of_episodes is None or not {"task", "expert"} <= of_episodes.inputs.keys():
            return []
        task = next(root.glob(f"*/{of_episodes.inputs['task']}"), None)
        expert = root / "expert" / of_episodes.inputs["expert"]
        if task is None or read_record(expert) is None:
            return []
        found.append(Source(item=item, task=task, expert=expert, episodes=episodes))
    return found


def recorded_under(source: Source) -> EpisodesConfig:
    """Return the settings that a task's demonstrations were recorded with."""
    record = read_record(source.episodes)
    assert record is not None
    return from_values(EpisodesConfig, record.recipe["config"]["config"], str(source.episodes))


def demand_whole_sources(dataset: Path, sources: Sequence[Source], root: Path) -> None:
    """Raise if a dataset, or what is behind it, is not as it was made: see `demand_whole`."""
    for folder in (dataset, *(f for s in sources for f in (s.task, s.expert, s.episodes))):
        demand_whole(folder, root)


def make_distillation(
    cfg: Any,
    inputs: Mapping[str, Path],
    out: Path,
    runtime: Runtime,
    *,
    data: Demonstrations,
) -> dict[str, Any]:
    """Let a student act, the expert label and take over, and train on, in rounds."""
    from policies.bc.trainer import TrainerConfig
    from v2p_data.distillation.rounds import Course, demand_masks, distill
    from v2p_data.episodes.rollouts import Lesson
    from v2p_data.experts.labeller import labeller_of

    del inputs
    demand_whole_sources(data.dataset, data.sources, runtime.root)
    recipe: DistillationConfig = cfg.config["distillation"]
    policy: PolicyConfig = cfg.config["policy"]
    episodes = recorded_under(data.sources[0])
    demand_masks(episodes)
    seed = seed_for(cfg.seed, "distillation")
    runtime.progress(0.0, "reading the demonstrations")
    with dataset_errors_explained():
        student = new_student(data, policy, seed, runtime)
        last: dict[str, Any] = {}

        def train(steps: int, folder: Path, seed: int, progress: Any) -> None:
            trained = student.train(
                TrainerConfig(steps=steps, batch_size=policy.batch_size),
                folder,
                seed=seed,
                on_progress=progress,
            )
            last.update(asdict(trained))

        course = Course(
            lessons={
                s.item: Lesson(bundle=TaskBundle.load(s.task), expert=labeller_of(s.expert))
                for s in data.sources
            },
            cfg=recipe,
            episodes=episodes,
            seed=seed,
            num_threads=runtime.num_threads,
        )
        distilled = distill(course, student, train, out, runtime.progress)
    return distilled.counts() | {"samples_per_s": round(last.get("samples_per_s", 0.0), 1)}


def make_distilled_dataset(
    cfg: dict[str, Any],
    inputs: Mapping[str, Path],
    out: Path,
    runtime: Runtime,
    *,
    sources: Sequence[Source],
) -> dict[str, Any]:
    """Write demonstrations and handover episodes as one LeRobot dataset and compare every frame with what was drawn."""
    from v2p_data.distillation.rounds import handover_episodes
    from v2p_data.episodes.dataset.packing import pack_and_verify

    for source in sources:
        demand_whole(source.task, runtime.root)
        demand_whole(source.episodes, runtime.root)
    demonstrations = [path for source in sources for path in staged_episodes(source.episodes)]
    return pack_and_verify(
        [*demonstrations, *handover_episodes(inputs["distillation"])],
        cfg["repo_id"],
        out,
        runtime,
        provenance=provenance(),
        tasks={source.item: source.task for source in sources},
    )


def make_policy(
    cfg: Any,
    inputs: Mapping[str, Path],
    out: Path,
    runtime: Runtime,
    *,
    data: Demonstrations,
    judges: Mapping[str, Path] | None = None,
) -> dict[str, Any]:
    """Train on all frames, from the distillation's student where there is one; keep what succeeds most."""
    from policies.bc.trainer import TrainerConfig, write_train_config
    from v2p_data.distillation.rounds import STUDENT_FOLDER, handover_episodes, take_in
    from v2p_data.episodes.hub.policy_card import write_policy_card
    from v2p_data.evaluation.facts import write_facts

    dataset = data.dataset
    demand_whole_sources(dataset, data.sources, runtime.root)
    policy: PolicyConfig = cfg.config.resolved
    judges = judges or {source.item: source.task for source in data.sources}
    seed = seed_for(cfg.seed, "policy")
    distilled = inputs.get("distillation")
    runtime.progress(0.0, "reading the frames")
    with dataset_errors_explained():
        start_from = distilled / STUDENT_FOLDER if distilled else None
        student = new_student(data, policy, seed, runtime, start_from=start_from)
        handovers = handover_episodes(distilled) if distilled else []
        # A task's at once: each call copies the whole table.
        for _, paths in itertools.groupby(handovers, key=lambda path: path.parent):
            take_in(student, list(paths))
        steps = policy.num_steps(len(student.table))
        recipe = TrainerConfig(
            steps=steps, batch_size=policy.batch_size, checkpoints=policy.checkpoints
        )
        judge = None
        if policy.checkpoints > 1 and judges:
            interface, episodes = interface_of(dataset), policy.judge_episodes
            judge = checkpoint_judge(student, judges, episodes, seed, runtime, interface)
        trained = student.train(
            recipe, out, seed=seed % 2**63, judge=judge, on_progress=runtime.progress
        )
    student.save(out / POLICY_FOLDER)
    place = _seen_from(runtime.root.resolve(), dataset)
    write_train_config(out / POLICY_FOLDER, student.policy, place, data.repo_id, recipe, seed)
    write_facts(out / POLICY_FOLDER, dataset)
    write_policy_card(out / POLICY_FOLDER)
    return {
        "steps": steps,
        "samples": steps * policy.batch_size,
        "frames": len(student.table),
        "final_loss": trained.final_loss,
        "samples_per_s": round(trained.samples_per_s, 1),
        "loader_share": round(trained.loader_share, 4),
        "judged": [list(pair) for pair in trained.judged],
        "policy": POLICY_FOLDER,
    }


def _seen_from(root: Path, dataset: Path) -> Path:
    """Return where a dataset lies in the run folder, its name alone elsewhere, for what may be pushed."""
    return dataset.relative_to(root) if dataset.is_relative_to(root) else Path(dataset.name)


def new_student(
    data: Demonstrations,
    policy: PolicyConfig,
    seed: int,
    runtime: Runtime,
    *,
    start_from: Path | None = None,
) -> "Student":
    """Return a student that knows the demonstrations; `start_from` is a policy to go on from."""
    from policies.bc.configuration_v2p_bc import V2PBCConfig
    from policies.bc.student import DatasetPlace, Student

    if start_from is not None:
        check_checkpoint(start_from)
    try:
        network = V2PBCConfig(
            **policy.network(), num_labels=_num_labels(data.dataset), device="cpu"
        )
    except ValueError as error:
        raise V2PError(f"no such network can be made: {error}") from error
    cache = runtime.root / CACHE_FOLDER / data.dataset.name
    return Student.of_dataset(
        DatasetPlace(folder=data.dataset, repo_id=data.repo_id, cache=cache),
        network,
        seed=seed % 2**63,
        device=runtime.device,
        start_from=start_from,
        num_threads=runtime.num_threads,
        action_limit=ACTION_LIMIT if interface_of(data.dataset).actions == "delta_tool" else None,
    )


def interface_of(dataset: Path) -> ArmInterface:
    """Return what a dataset holds of the arm."""
    from v2p_data.episodes.dataset.tables import read_info

    return interface_in(read_info(dataset))


def checkpoint_judge(
    student: "Student",
    tasks: Mapping[str, Path],
    episodes: int,
    seed: int,
    runtime: Runtime,
    interface: ArmInterface,
) -> Callable[[Any], float]:
    """Return what gives a policy's mean success rate over task folders, on seeds that no evaluation uses."""
    from v2p_data.evaluation.batch import judge
    from v2p_data.evaluation.config import EvaluationConfig

    bundles = {item: TaskBundle.load(folder) for item, folder in tasks.items()}
    cfg = EvaluationConfig(episodes=episodes, worlds=episodes, at_end=False)

    def rate(policy: Any) -> float:
        judged = [
            judge(
                bundle,
                VisionActor(
                    replace(student, policy=policy.eval(), task=bundle.description),
                    wrist=WRIST_KEY in student.cameras,
                    interface=interface,
                    rgb=RGB_KEY in student.cameras,
                ),
                first_seed=seed_for(seed, "checkpoints", item) % 2**31,
                cfg=cfg,
                num_threads=runtime.num_threads,
            )
            for item, bundle in bundles.items()
        ]
        return sum(float(j.successes.mean()) for j in judged) / len(judged)

    return rate


def _num_labels(dataset: Path) -> int | None:
    """Return how many labels occur in a dataset of ours, the background included; None where it is not known."""
    from v2p_data.episodes.dataset.about import read_about

    about = read_about(dataset)
    return max(
        (1 + int(label) for e in (about or {}).get("episodes", ()) for label in e["labels"]),
        default=None,
    )


@contextmanager
def dataset_errors_explained() -> Iterator[None]:
    """Turn complaints about a dataset or a training into errors of ours, one sentence each."""
    from policies.bc.frames import DatasetError

    try:
        yield
    except DatasetError as error:
        raise V2PError(str(error)) from error
