"""Commands for finished things: check them, give them away."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from v2p_data.cli import parse
from v2p_data.errors import V2PError


@dataclass(frozen=True, kw_only=True)
class Verify:
    dataset: tyro.conf.Positional[Path]
    """Folder of a LeRobot v3 dataset, ours or anybody's."""
    json: Path | None = None
    """Write the findings as JSON to this file, too."""


@dataclass(frozen=True, kw_only=True)
class Push:
    path: tyro.conf.Positional[Path]
    """Folder of a dataset or of a policy."""
    repo_id: str
    """Where to: USER/NAME. The token comes from the environment variable HF_TOKEN."""
    private: bool = False
    """Make the repository private."""


def verify_command(argv: list[str]) -> int:
    """Return 0 where all is well, 1 where there are problems; what cannot be read is an error (2)."""
    from v2p_data.episodes.verify import verify
    from v2p_data.pipeline.artifact import write_json_atomically

    args = parse(Verify, argv, "verify")
    report = verify(args.dataset)
    if args.json is not None:
        write_json_atomically(args.json, report.as_json())
    print("\n".join([*report.lines(), report.summary()]))  # noqa: T201
    return 0 if report.is_good else 1


def push_command(argv: list[str]) -> int:
    from v2p_data.episodes.hub import push_dataset, push_policy

    args = parse(Push, argv, "push")
    if (args.path / "meta" / "info.json").is_file():
        url = push_dataset(args.path, args.repo_id, private=args.private).url
        then = f"LeRobotDataset('{args.repo_id}')"
    elif (args.path / "model.safetensors").is_file():
        url = push_policy(args.path, args.repo_id, private=args.private).url
        then = f"lerobot-eval --policy.path={args.repo_id} --env.type=v2p --env.tasks=TASKS"
    else:
        raise V2PError(
            f"{args.path} is neither a LeRobot dataset (meta/info.json) nor a policy (model.safetensors)"
        )
    print(f"Pushed to {url}\nNext: {then}")  # noqa: T201
    return 0
