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
from studies.results import Row, append_result, letters_of, results_in
from studies.sim_to_sim import table
from studies.sweeps import SWEEPS, FaultyLook
from v2p_data.commands.deploy import loaded_policy
from v2p_data.deployment.limits import LimitsConfig
from v2p_data.deployment.view import allowing_for_place
from v2p_data.errors import V2PError
from v2p_data.evaluation.batch import judge
from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.evaluation.judging import contestant, play_of
from v2p_data.task.task import TaskBundle
from v2p_data.twin.judge import judge_in_twin, true_labels
from v2p_data.twin.parameters import nominal

PLACES = ("training", "twin", "twin_hasty", "twin_raw", "tracked")
"""Training simulator; twin with true masks, through all of `v2p deploy`; without waiting for the gripper; without carrying
masks over to the training camera either; masks tracked in the twin's pictures."""


@dataclass(frozen=True, kw_only=True)
class Asked:
    """One policy on one task."""

    name: str
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
    done = {(r["policy"], r["task"], r["place"], r["value"]) for r in results_in(args.out)}
    for word in args.policies:
        name, _, folder = word.partition("=")
        if not folder:
            raise V2PError(f"--policies takes NAME=FOLDER, got '{word}'")
        for task in args.tasks:
            asked = Asked(
                name=name, policy=Path(folder), task=task, first_seed=args.first_seed,
                episodes=args.episodes,
            )  # fmt: skip
            title = TaskBundle.load(task).title
            wanted: list[tuple[str, float | None]] = [(place, None) for place in args.places]
            wanted += [(s, float(v)) for s in args.sweeps for v in SWEEPS[s].values]
            for place, value in wanted:
                if (name, title, place, value) in done:
                    continue
                row = {"policy": name, "task": title, "place": place, "value": value}
                row |= {"first_seed": asked.first_seed, "episodes": asked.episodes}
                row |= _played(asked, place, value)
                append_result(args.out, row)
                at = "" if value is None else f" {value:g}"
                print(f"{name}, {title}, {place}{at}: {row['once'].count('1')} of {len(row['once'])}", flush=True)  # fmt: skip


def show(args: argparse.Namespace) -> None:
    """Print the tables, and write the figure where it is asked for.

    Raises:
        V2PError: there is no result yet.
    """
    rows = results_in(args.out)
    if not rows:
        raise V2PError(f"{args.out} holds no results; give --policies and --tasks")
    if args.table:
        print(table(rows))
    if args.figure:
        from studies.sim_to_sim_figure import write_figure

        write_figure(rows, args.figure)
        print(f"figure: {args.figure}")


def _played(asked: Asked, place: str, value: float | None) -> Row:
    if place == "training":
        bundle = TaskBundle.load(asked.task)
        actor, size_px = play_of(contestant(asked.policy), asked.first_seed, "cpu")(bundle)
        judged = judge(
            bundle, actor, episodes=asked.episodes, first_seed=asked.first_seed,
            cfg=EvaluationConfig(episodes=asked.episodes, at_end=True), size_px=size_px,
        )  # fmt: skip
        assert judged.at_end is not None
        return {
            "once": letters_of(judged.successes),
            "at_end": letters_of(judged.at_end),
            "failures": judged.failure_counts(),
        }
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
    found = judge_in_twin(
        asked.task, play_of(contestant(asked.policy), asked.first_seed, "cpu"), seeds=asked.seeds,
        cfg=EvaluationConfig(episodes=asked.episodes, at_end=place.startswith("twin")),
        parameters=parameters, look=look, waits=place not in ("twin_raw", "twin_hasty"),
    )  # fmt: skip
    row = {
        "once": letters_of(found.successes),
        "failures": found.failure_counts(),
        "twin": parameters.digest()[:12],
    }
    if place.startswith("twin"):
        row["at_end"] = letters_of(found.at_end)
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
