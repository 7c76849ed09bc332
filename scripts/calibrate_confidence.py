"""Ask how far a scene's confidence can be trusted: each clip is judged by a fit to the clips of all other sources.

Takes the files that `judge_real_clips.py --no-gate --out` (`judged.json`) and
`bench_reconstruction.py --out` (`results.json`) write. Clips that ended before they had a
confidence are counted and left out. The source is what follows the last `__` in a clip's name; a
name without is a source of its own. Four rules are compared:

| rule | probability that the scene is right |
|---|---|
| `shipped` | the confidence itself, accepted by the default gate |
| `calibrated` | logistic regression (ridge, no negative weight) on the confidence's logarithm, accepted from 0.5 |
| `stages` | the same on the logarithm of each stage's confidence |
| `threshold` | the confidence itself, accepted from the least value from which nine of ten others are right |

A clip that the default gate turns away for another reason than its confidence is accepted by
`shipped` and `threshold` never.

    python scripts/calibrate_confidence.py outputs/judged/judged.json outputs/more/judged.json
"""

import argparse
import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize
from scipy.special import expit
from scipy.stats import rankdata

from policies.evaluation.rate import wilson

LEAST = 1e-3
"""Confidences below count as this one: their logarithm says no more."""
RIDGE = 0.1
ACCEPTED_FROM = 0.5
RIGHT_OF_ACCEPTED = 0.9
"""The goal for scenes of clips that nobody looked at."""
EDGES = (0.0, 0.3, 0.52, 0.7, 0.85, 1.0)


@dataclass(frozen=True, kw_only=True)
class Judged:
    """A clip with a confidence, and whether its scene is right."""

    clip: str
    source: str
    """Clips of one source are never on both sides of a fit."""
    stages: dict[str, float]
    confidence: float
    gate: str
    """Slug of the rejection by the default gate; empty where it accepts."""
    right: bool


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line and print one table of rules and one of confidences."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("judged", type=Path, nargs="+", help="judged.json or results.json")
    rows = [row for path in parser.parse_args(args).judged for row in _rows(path)]
    clips = [judged for row in rows if (judged := judged_of(row)) is not None]
    if len(sources(clips)) < 2:
        parser.error("a fit to the clips of all other sources needs clips of two sources at least")
    print(f"{len(clips)} of {len(rows)} clips have a confidence; sources: {len(sources(clips))}")
    print(rules_table(clips))
    print(bins_table(clips))


def _rows(path: Path) -> list[dict[str, Any]]:
    read = json.loads(path.read_text(encoding="utf-8"))
    return read["rows"] if isinstance(read, dict) else read


def judged_of(row: dict[str, Any]) -> Judged | None:
    """Return a clip of either file; None where it ended without a confidence."""
    if row["confidence"] is None:
        return None
    name = row.get("clip") or row["name"]
    stages = {k: v[0] if isinstance(v, list) else v for k, v in row["stages"].items()}
    gate = row["gate"] if "gate" in row else row["gate_slug"]
    return Judged(
        clip=name,
        source=name.rsplit("__", 1)[-1],
        stages=stages,
        confidence=row["confidence"],
        gate=gate or "",
        right=row["right"] if "right" in row else row["usable"],
    )


def sources(clips: Sequence[Judged]) -> list[str]:
    """Return the clips' sources, each once."""
    return sorted({clip.source for clip in clips})


def fitted(
    x: Float[np.ndarray, "clip feature"], right: Bool[np.ndarray, " clip"]
) -> Float[np.ndarray, "weights"]:
    """Return the weights of a logistic regression, the constant last; none but the constant is negative."""

    def loss(w: np.ndarray) -> float:
        score = x @ w[:-1] + w[-1]
        return float(
            np.logaddexp(0, np.where(right, -score, score)).sum() + RIDGE * w[:-1] @ w[:-1]
        )

    bounds = [(0.0, None)] * x.shape[1] + [(None, None)]
    return minimize(loss, np.zeros(x.shape[1] + 1), bounds=bounds, method="L-BFGS-B").x


def held_out_probability(
    x: Float[np.ndarray, "clip feature"], clips: Sequence[Judged]
) -> Float[np.ndarray, " clip"]:
    """Return each clip's probability of being right by a fit to the clips of the other sources."""
    right, where = np.array([c.right for c in clips]), np.array([c.source for c in clips])
    out = np.empty(len(clips))
    for source in sources(clips):
        held = where == source
        weights = fitted(x[~held], right[~held])
        out[held] = expit(x[held] @ weights[:-1] + weights[-1])
    return out


def held_out_accepted(clips: Sequence[Judged]) -> Bool[np.ndarray, " clip"]:
    """Return which clips pass the threshold that the clips of the other sources ask for, and the rest of the gate."""
    out = [
        c.confidence >= least_threshold([o for o in clips if o.source != c.source]) for c in clips
    ]
    return np.array(out) & passes_otherwise(clips)


def passes_otherwise(clips: Sequence[Judged]) -> Bool[np.ndarray, " clip"]:
    """Return which clips the default gate would accept if they were sure enough."""
    return np.array([c.gate in ("", "low_confidence") for c in clips])


def least_threshold(clips: Sequence[Judged]) -> float:
    """Return the least confidence from which nine of ten scenes are right; 1 where there is none."""
    clips = [c for c, passes in zip(clips, passes_otherwise(clips), strict=True) if passes]
    at_least = [
        (c.confidence, [o.right for o in clips if o.confidence >= c.confidence]) for c in clips
    ]
    return min((t for t, right in at_least if np.mean(right) >= RIGHT_OF_ACCEPTED), default=1.0)


def rules_table(clips: Sequence[Judged]) -> str:
    """Return what each rule accepts, how much of it is right, how well it ranks, and its Brier score."""
    right = np.array([c.right for c in clips])
    sure = np.array([c.confidence for c in clips])
    names = sorted({name for c in clips for name in c.stages})
    logs = np.log(np.maximum([[c.stages.get(n, 1.0) for n in names] for c in clips], LEAST))
    of_all, of_each = (
        held_out_probability(np.log(np.maximum(sure, LEAST))[:, None], clips),
        held_out_probability(logs, clips),
    )
    rules = {
        "shipped": (sure, np.array([not c.gate for c in clips])),
        "calibrated": (of_all, of_all >= ACCEPTED_FROM),
        "stages": (of_each, of_each >= ACCEPTED_FROM),
        "threshold": (sure, held_out_accepted(clips)),
    }
    lines = [
        "| rule | accepted and right | accepted and wrong | AUC | Brier |",
        "|---|---|---|---|---|",
    ]
    for name, (p, taken) in rules.items():
        brier = float(((p - right) ** 2).mean())
        lines.append(
            f"| {name} | {(taken & right).sum()} of {right.sum()} | {(taken & ~right).sum()} of {(~right).sum()}"
            f" | {auc(p, right):.2f} | {brier:.3f} |"
        )
    weights = dict(zip([*names, "constant"], fitted(logs, right).round(2).tolist(), strict=True))
    return "\n".join(
        [
            *lines,
            f"weights of `stages` on all clips: {weights}; threshold: {least_threshold(clips):.2f}",
        ]
    )


def auc(p: Float[np.ndarray, " clip"], right: Bool[np.ndarray, " clip"]) -> float:
    """Return how often a right clip is surer than a wrong one, ties half; NaN without both."""
    good, bad = int(right.sum()), int((~right).sum())
    if not good or not bad:
        return float("nan")
    return float((rankdata(p)[right].sum() - good * (good + 1) / 2) / (good * bad))


def bins_table(clips: Sequence[Judged]) -> str:
    """Return the share of right scenes by confidence, with Wilson intervals."""
    lines = ["| confidence | right |", "|---|---|"]
    for low, high in itertools.pairwise(EDGES):
        inside = [
            c.right for c in clips if low <= c.confidence < high or c.confidence == high == 1
        ]
        if inside:
            lines.append(f"| {low:g} to {high:g} | {wilson(sum(inside), len(inside))} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
