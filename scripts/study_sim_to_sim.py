"""How far success in the training simulator predicts success in the twin, and how much policies stand: sim-to-sim.

    python scripts/study_sim_to_sim.py --policies NAME=FOLDER ... --tasks TASK ... --out outputs/sim_to_sim
    python scripts/study_sim_to_sim.py --policies NAME=FOLDER --tasks TASK --sweeps latency placement --out outputs/sim_to_sim
    python scripts/study_sim_to_sim.py --out outputs/sim_to_sim --table --figure outputs/sim_to_sim/figure.svg

Each line of `results.jsonl` is one policy on one task in one place: the training simulator, the twin with true masks, the twin
with masks tracked from one click (`--tracked`), or the twin with one quantity changed. All start from the same seeds. Lines
that are there are kept. No real robot was asked for any number.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench_deploy import PATIENCE_MS, Measured, TimedPolicy, episode, robot_in
from studies.places import in_training, in_twin
from studies.results import Row, letters_of, make_missing, rate_of, results_to_show
from studies.sim_to_sim import table
from studies.sweeps import SWEEPS, FaultyLook
from v2p_data.commands.deploy import loaded_policy
from v2p_data.deployment.limits import LimitsConfig
from v2p_data.deployment.view import allowing_for_place
from v2p_data.errors import V2PError
from v2p_data.task.task import TaskBundle
from v2p_data.twin.judge import TwinSetup, true_labels
from v2p_data.twin.parameters import nominal

PLACES = ("training", "twin", "twin_hasty", "twin_raw", "tracked")
"""Training simulator; twin with true masks, through all of `v2p deploy`; without waiting for the gripper; without carrying
masks over to the training camera either; masks tracked in the twin's pictures."""

Key = tuple[str, str, str, float | None]
"""Policy, task, place, value."""


@dataclass(frozen=True, kw_only=True)
class Asked:
    """One policy on one task."""

    policy: Path
    task: Path
    first_seed: int
    episodes: int

    @property
    def seeds(self) -> range:
        return range(self.first_seed, self.first_seed + self.episodes)


def main() -> None:
    """Read the command line, play what is missing, show what is there."""
    args = _arguments()
    try:
        if args.policies:
            play(args)
        show(args)
    except V2PError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def play(args: argparse.Namespace) -> None:
    """Add the lines that are missing.

    Raises:
        V2PError: a policy or task cannot be read, or the lines are of other episodes.
    """
    args.out.mkdir(parents=True, exist_ok=True)
    tasks = {TaskBundle.load(folder).title: folder for folder in args.tasks}
    wanted: list[tuple[str, float | None]] = [(place, None) for place in args.places]
    wanted += [(s, float(v)) for s in args.sweeps for v in SWEEPS[s].values]
    for word in args.policies:
        name, _, folder = word.partition("=")
        if not folder:
            raise V2PError(f"--policies takes NAME=FOLDER, got '{word}'")

        def made(key: Key, policy: Path = Path(folder)) -> Row:
            name, title, place, value = key
            asked = Asked(
                policy=policy,
                task=tasks[title],
                first_seed=args.first_seed,
                episodes=args.episodes,
            )
            about = {"policy": name, "task": title, "place": place, "value": value}
            about |= {"first_seed": asked.first_seed, "episodes": asked.episodes}
            return about | _played(asked, place, value)

        keys = [(name, title, *one) for title in tasks for one in wanted]
        make_missing(args.out, keys, key_of, made, told)


def key_of(row: Row) -> Key:
    return row["policy"], row["task"], row["place"], row["value"]


def told(row: Row) -> str:
    """Return what is printed of a line."""
    at = "" if row["value"] is None else f" {row['value']:g}"
    return f"{row['policy']}, {row['task']}, {row['place']}{at}: {rate_of(row)}"


def show(args: argparse.Namespace) -> None:
    """Print the tables, and write the figure where it is asked for.

    Raises:
        V2PError: there is no result yet.
    """
    rows = results_to_show(args.out)
    if args.table:
        print(table(rows))
    if args.figure:
        from studies.sim_to_sim_figure import write_figure

        write_figure(rows, args.figure)
        print(f"figure: {args.figure}")


def _played(asked: Asked, place: str, value: float | None) -> Row:
    if place == "training":
        return in_training(asked.policy, asked.task, asked.seeds, at_end=True)
    if place == "tracked":
        return _tracked(asked)
    look, parameters = allowing_for_place, nominal()
    if place == "twin_raw":
        look = true_labels
    elif value is not None:
        sweep = SWEEPS[place]
        if sweep.parameters is not None:
            parameters = sweep.parameters(value)
        else:
            look = FaultyLook(place, value, asked.first_seed)
    setup = TwinSetup(
        parameters=parameters, look=look, waits=place not in ("twin_raw", "twin_hasty")
    )
    at_end = place.startswith("twin")
    row = in_twin(asked.policy, asked.task, asked.seeds, at_end=at_end, setup=setup)
    if isinstance(look, FaultyLook):
        row["iou"] = round(float(np.mean(look.overlaps)), 4)
    return row


def _tracked(asked: Asked) -> Row:
    """Play with masks from one click, through `v2p deploy`'s loop and limits."""
    bundle = TaskBundle.load(asked.task)
    policy = TimedPolicy(loaded_policy(asked.policy, bundle.description, "cpu"))
    measured = Measured()
    limits = LimitsConfig(max_silence_ms=PATIENCE_MS)
    for seed in asked.seeds:
        robot = robot_in("twin", asked.task, seed)
        try:
            episode(robot, bundle, policy, limits, measured, tracked=True)
        finally:
            robot.disconnect()
    endings = [e for e in measured.endings if e != "done"]
    return {
        "once": letters_of(np.array(measured.tracked)),
        "failures": {e: endings.count(e) for e in sorted(set(endings))},
        "iou": round(float(np.mean(measured.object_iou)), 4),
        "iou_5th": round(float(np.percentile(measured.object_iou, 5)), 4),
    }


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--policies", nargs="+", default=[], help="NAME=FOLDER of each policy")
    parser.add_argument("--tasks", nargs="+", type=Path, default=[], help="task folders")
    parser.add_argument("--places", nargs="*", choices=PLACES, default=[])
    parser.add_argument("--sweeps", nargs="*", choices=list(SWEEPS), default=[])
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=1_000_000)
    parser.add_argument("--out", type=Path, default=Path("outputs/sim_to_sim"))
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--figure", type=Path, help="write the figure (.svg or .png)")
    return parser.parse_args()


if __name__ == "__main__":
    main()
