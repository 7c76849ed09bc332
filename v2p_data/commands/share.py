"""Commands for finished things: check them, tell where they come from, give them away."""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from v2p_data.cli import parse
from v2p_data.commands.display import telling
from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import demand_whole, write_json_atomically

if TYPE_CHECKING:
    from v2p_data.episodes.hub.hub import Pushed


@dataclass(frozen=True, kw_only=True)
class Verify:
    dataset: tyro.conf.Positional[Path]
    """Folder of a dataset that v2p made."""
    json: Path | None = None
    """Write the findings as JSON to this file, too."""


@dataclass(frozen=True, kw_only=True)
class Replay:
    dataset: tyro.conf.Positional[Path]
    """Folder of a dataset that v2p made, with the tasks in it."""
    episodes: int | None = None
    """Replay the first so many; all by default."""
    threads: int = 1
    """For physics; changes no result."""
    json: Path | None = None
    """Write what came back as JSON to this file, too."""


@dataclass(frozen=True, kw_only=True)
class Push:
    path: tyro.conf.Positional[Path]
    """Folder of a dataset or of a policy; with --envhub of a task, of tasks, of a run, or of a
    dataset with its tasks."""
    repo_id: str
    """Where to: USER/NAME. The token comes from the environment variable HF_TOKEN."""
    private: bool = False
    """Make a new repository private; one that exists and is not private is refused."""
    envhub: bool = False
    """Push the tasks as an environment that LeRobot loads by its name."""
    tag: str | None = None
    """Tag this version, say v1.0; a dataset gets LeRobot's format version as a tag in any case."""


@dataclass(frozen=True, kw_only=True)
class Explain:
    path: tyro.conf.Positional[Path]
    """Folder of a dataset, or of any result of a run."""
    other: tyro.conf.Positional[Path | None] = None
    """A second one: in which fields do the two differ?"""
    episode: int | None = None
    """This episode only."""


def verify_command(argv: list[str]) -> int:
    """Return 0 where all is well, 1 where there are problems; what cannot be read is an error (2)."""
    from v2p_data.episodes.dataset.verify import verify

    args = parse(Verify, argv, "verify")
    with telling("verify") as progress:
        report = verify(args.dataset, on_progress=progress)
    if args.json is not None:
        write_json_atomically(args.json, report.as_json())
    print("\n".join([*report.lines(), report.summary()]))  # noqa: T201
    return 0 if report.is_good else 1


def replay_command(argv: list[str]) -> int:
    """Return 0 where every episode came back, 1 where one did not."""
    from v2p_data.episodes.replay import replay

    args = parse(Replay, argv, "replay")
    with telling("replay") as progress:
        report = replay(
            args.dataset,
            num_episodes=args.episodes,
            num_threads=args.threads,
            on_progress=progress,
        )
    if args.json is not None:
        write_json_atomically(args.json, report.as_json())
    print("\n".join(report.lines()))  # noqa: T201
    return 0 if report.is_same else 1


def push_command(argv: list[str]) -> int:
    args = parse(Push, argv, "push")
    pushed, then = _pushed(args)
    kept = pushed.visibility != ("private" if args.private else "public")
    note = f", which is {pushed.visibility} and stays so" if kept else ""
    print(f"Pushed to {pushed.url}{note}\nNext: {then}")  # noqa: T201
    return 0


def _pushed(args: Push) -> tuple["Pushed", str]:
    from v2p_data.episodes.dataset.repo_id import check_repo_id
    from v2p_data.episodes.hub.hub import push_dataset, push_envhub, push_policy
    from v2p_data.stages import demand_whole_part

    check_repo_id(args.repo_id)
    if args.envhub:
        from v2p_data.episodes.hub.envhub import write_envhub

        with tempfile.TemporaryDirectory() as folder:
            made = Path(folder) / "envhub"
            write_envhub(args.path, args.repo_id, made)
            pushed = push_envhub(made, args.repo_id, private=args.private, tag=args.tag)
        return pushed, f"make_env('{args.repo_id}', trust_remote_code=True)"
    if (args.path / "meta" / "info.json").is_file():
        demand_whole_part(args.path.resolve())
        pushed = push_dataset(args.path, args.repo_id, private=args.private, tag=args.tag)
        return pushed, f"LeRobotDataset('{args.repo_id}')"
    if (args.path / "model.safetensors").is_file():
        demand_whole_part(args.path.resolve())
        pushed = push_policy(args.path, args.repo_id, private=args.private, tag=args.tag)
        return (
            pushed,
            f"lerobot-eval --policy.path={args.repo_id} --env.type=v2p --env.tasks=TASKS",
        )
    raise V2PError(
        f"{args.path} is neither a LeRobot dataset (meta/info.json) nor a policy (model.safetensors); tasks are pushed "
        "with --envhub"
    )


def explain_command(argv: list[str]) -> int:
    from v2p_data.episodes.dataset.explain import differences, explain, records_of

    args = parse(Explain, argv, "explain")
    for path in (args.path, args.other):
        if path is not None:
            demand_whole(path, below="meta/")
    if args.other is None:
        lines = explain(records_of(args.path, args.episode))
    else:
        found = differences(args.path, args.other)
        lines = [f"{field}: {first} -> {second}" for field, first, second in found]
        lines.append(f"{len(found)} fields differ")
    print("\n".join(lines))  # noqa: T201
    return 0
