"""Play experts that learned with reconstructed sizes on the true ones: the paper's test of what an error of size costs.

The objects are those of drawn clips, whose truth lies beside them: a run folder of `scripts/study_lifting.py`. Each expert
plays the same episodes with the size that was reconstructed and with the true one; the referee judges both. A line for each
object is appended to a JSON-lines file, so that a stopped run goes on where it was.

    python scripts/study_true_sizes.py outputs/study_lifting/run --out outputs/study_true_sizes
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from policies.evaluation.paired import success_difference
from policies.evaluation.rate import wilson
from studies.results import commit, letters_of, make_missing, results_to_show
from v2p_data.episodes.collect import judge_expert
from v2p_data.episodes.rollouts import Lesson
from v2p_data.errors import ItemRejectedError
from v2p_data.experts.labeller import labeller_of
from v2p_data.scene.scene import SceneObject
from v2p_data.task.task import TaskBundle

SEED = 20


def main() -> None:
    """Read the command line, judge what is not judged yet, print the summary."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("run", type=Path, help="of scripts/study_lifting.py, its folder `run`")
    parser.add_argument("--out", type=Path, default=Path("outputs/study_true_sizes"))
    parser.add_argument("--episodes", type=int, default=128)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    experts = {
        folder.name.split("-")[0]: folder
        for folder in sorted((args.run / "expert").glob("clip_*"))
        if (folder / "evaluation.json").is_file()
    }
    make_missing(
        args.out,
        experts,
        lambda row: row["item"],
        lambda item: row_of(args.run, item, experts[item], args.episodes),
        lambda row: (
            f"{row['item']} {row['label']}: {row['reconstructed']} and {row['true']} of {row['episodes']}"
        ),
    )
    print(summary(results_to_show(args.out)))


def row_of(run: Path, item: str, expert: Path, episodes: int) -> dict[str, Any]:
    """Return an expert's successes in the same episodes with either size."""
    (clip,) = (run / "clip").glob(f"{item}-*/truth/{item}.json")
    (task,) = (run / "task").glob(f"{item}-*")
    bundle = TaskBundle.load(task)
    thing = bundle.scene.manipulated
    size = true_size(thing, json.loads(clip.read_text())["things"][0]["size_m"])
    objects = (replace(thing, size_m=size), *bundle.scene.others)
    true = replace(bundle, scene=replace(bundle.scene, objects=objects))
    once: list[str | None] = []
    for each in (bundle, true):
        try:
            lesson = Lesson(bundle=each, expert=labeller_of(expert))
            played = judge_expert(lesson, episodes=episodes, seed=SEED)
            once.append(letters_of(played.successes))
        except ItemRejectedError as error:
            print(f"{item}: {error}")
            once.append(None)
    return {
        "item": item,
        "label": thing.label,
        "episodes": episodes,
        "size_m": list(thing.size_m),
        "true_size_m": list(size),
        "reconstructed": once[0],
        "true": once[1],
        "commit": commit(),
    }


def true_size(thing: SceneObject, size_m: list[float]) -> tuple[float, float, float]:
    """Return the true extents along the axes that the reconstruction chose: its horizontal axes may be the other way round."""
    x, y, z = size_m
    ways = (x, y, z), (y, x, z)
    return min(ways, key=lambda way: float(np.abs(np.log(np.divide(way, thing.size_m))).sum()))


def pair(row: dict[str, Any]) -> tuple[str | None, str | None]:
    """Return the episodes with the reconstructed size and with the true one; None where the gripper cannot take it."""
    return row["reconstructed"], row["true"]


def summary(rows: list[dict[str, Any]]) -> str:
    """Return both rates over all objects that the gripper takes at either size, and their paired difference."""
    both = [(at, true) for at, true in map(pair, rows) if at and true]
    at, true = (np.array([c == "1" for c in "".join(side)]) for side in zip(*both, strict=True))
    change = success_difference(true, at)
    return (
        f"{len(both)} of {len(rows)} objects: {wilson(int(at.sum()), len(at))} with reconstructed sizes, "
        f"{wilson(int(true.sum()), len(true))} with true ones; "
        f"difference {change.value:+.3f} [{change.low:+.3f}, {change.high:+.3f}]"
    )


if __name__ == "__main__":
    main()
