"""Learn from drawn clips which standing thing a caption means (`v2p_data/scene/grounding`).

    python scripts/train_standing.py data --out DATA --clips 120 --jobs 2
    python scripts/train_standing.py train DATA --out v2p_data/scene/grounding/standing.json

`data` draws clips with a second object, lets the scene network watch them, and keeps the cues of
all candidates with how well each overlaps the thing that is meant. `train` fits a conditional
logit (McFadden 1974): the odds between candidates are exponential in the sums of their weighted
cues. Then it fits, by logistic regression on clips left out in turn, how sure one may be of the
likeliest candidate: once with all candidates, once without those that show the thing that is
meant, as where it was not seen; both are taken to be as frequent. Where a caption mentions
something by the way the task does not tell its place: there the odds among the candidates alone
say how sure that is. Clips are drawn from seeds of their own (`standing things`), so that no clip
of `bench_reconstruction.py` is among them.
"""

import argparse
import json
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize
from scipy.special import expit, log_expit, log_softmax, logsumexp, softmax

from bench_reconstruction import FPS, true_of
from drawn_clips.clips import MOTION_KINDS, random_spec, render
from drawn_clips.truth import load_truth, write
from training import draw_all
from v2p_data.errors import ItemRejectedError
from v2p_data.kinds import KINDS as TASK_KINDS
from v2p_data.scene.frames.mask_ops import iou
from v2p_data.scene.frames.segmentation import segment_clip
from v2p_data.scene.frames.stabilise import stabilised
from v2p_data.scene.frames.working_clip import working_clip_of
from v2p_data.scene.grounding.ground_objects import ground_objects
from v2p_data.scene.grounding.static_cues import StaticCandidate, StaticSearch
from v2p_data.scene.grounding.static_objects import candidates, odds_of, overlaps_of
from v2p_data.seeds import rng_for
from v2p_data.video.captions import find_videos, parse_caption
from v2p_data.video.clip import Clip
from v2p_data.video.decode import read_clip

KINDS = tuple(kind for kind in MOTION_KINDS if TASK_KINDS[kind].locates_other)
RIGHT_IOU = 0.5
FULLY_RIGHT_IOU = 0.9
"""Overlaps from which a candidate counts as right at all, and in full."""
NOT_IT_IOU = 0.1
"""What overlaps less shows another thing."""
FOLDS = 10
LEAST_SPREAD = 1e-3
"""A cue that varies less says nothing, and gets no weight."""
HELD = 2.0
"""How strongly weights are drawn towards zero, per squared standard deviation of the cue."""

Group = tuple[
    Float[np.ndarray, "candidate cue"],
    Float[np.ndarray, "candidate"],
    Float[np.ndarray, "candidate candidate"],
]
"""Cues, overlap with the thing that is meant, and overlap with each other."""


def make_clip(job: tuple[int, Path]) -> str:
    """Draw and watch one clip, and write what training needs; return an error's words, or nothing."""
    number, out = job
    path = out / f"{number:05d}.npz"
    if path.is_file():
        return ""
    kind = KINDS[number % len(KINDS)]
    try:
        spec = replace(
            random_spec(f"clip{number}", kind, rng_for(number, "standing things")), fps=FPS
        )
        with tempfile.TemporaryDirectory() as home:
            write(render(spec), Path(home))
            truth = load_truth(Path(home), spec.name)
            said = {f"{spec.name}.mp4": {"caption": truth.caption}}
            (Path(home) / "captions.json").write_text(json.dumps(said), encoding="utf-8")
            clip = read_clip(find_videos(Path(home))[0])
            things = true_of(truth).things
        if len(things) < 2:
            return f"{number} {kind}: the caption names one thing"
        found = candidates_in(clip, things[1].phrase)
    except (ValueError, RuntimeError, ItemRejectedError) as error:
        return f"{number} {kind}: {type(error).__name__} {error}"
    if not found:
        return f"{number} {kind}: no candidate"
    shown = np.any(list(things[1].masks.values()), axis=0)
    cues = np.array([list(one.cues.values()) for one in found])
    np.savez(
        path,
        names=list(found[0].cues),
        cues=cues,
        right=[iou(one.mask, shown) for one in found],
        alike=overlaps_of(found),
    )
    return ""


def candidates_in(clip: Clip, phrase: str) -> list[StaticCandidate]:
    """Return the candidates for a phrase of a clip's caption."""
    meaning = parse_caption(clip.caption, clip.objects)
    working = working_clip_of(clip)
    steady = stabilised(clip, working)
    if steady is not clip:
        clip, working = steady, working_clip_of(steady)
    seen = ground_objects(clip, working, meaning, segment_clip(clip, working), min_found=0.0)
    assert seen.segmentation is not None
    search = StaticSearch(
        working=seen.working,
        table=seen.table,
        segmentation=seen.segmentation,
        phrase=phrase,
        moved=seen.objects[0].noun,
        kind=meaning.kind,
        ends=(seen.objects[0].first, seen.objects[0].last),
        taken=np.zeros(working.shape, bool),
    )
    return candidates(search)


def main() -> None:
    """Read the command line; draw, or train."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    data = commands.add_parser("data", help="draw and watch clips")
    data.add_argument("--out", type=Path, required=True)
    data.add_argument("--clips", type=int, default=120)
    data.add_argument("--start", type=int, default=0, help="number of the first clip")
    data.add_argument("--jobs", type=int, default=2)
    train = commands.add_parser("train", help="fit the weights")
    train.add_argument("data", type=Path)
    train.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    if args.command == "data":
        draw_all(make_clip, range(args.start, args.start + args.clips), args.out, args.jobs)
        return
    names, groups = read(args.data)
    folds = [groups[k::FOLDS] for k in range(FOLDS)]
    findings: list[list[Finding]] = []
    asides: list[Finding] = []
    for k, left_out in enumerate(folds):
        weights = choosing([g for j, fold in enumerate(folds) if j != k for g in fold])
        findings.append(
            [
                f
                for group in left_out
                for f in (found(group, weights), missed(group, weights))
                if f is not None
            ]
        )
        asides += [found(untold(group, names), weights) for group in left_out]
    chances, right = [], []
    for k, left_out in enumerate(findings):
        doubt = doubting([f for j, fold in enumerate(findings) if j != k for f in fold])
        chances += [float(expit(doubt[0] + doubt[1:] @ f.cues)) for f in left_out]
        right += [f.right for f in left_out]
    every = [f for fold in findings for f in fold]
    there = [f for f in every if f.there]
    says, is_right = np.array(chances) > 0.5, np.array(right)
    print(
        f"{len(groups)} clips, left out in turn: right on {np.mean([f.right for f in there]):.1%}, overlap "
        f"{np.mean([f.overlap for f in there]):.3f} (of the best candidates "
        f"{np.mean([g[1].max() for g in groups]):.3f}); with the "
        f"right one there or taken away ({len(every)} cases), what is found is told from what is "
        f"not on {(says == is_right).mean():.1%}; "
        f"of what is taken for found {is_right[says].mean():.1%} is right"
    )
    choice, doubt = choosing(groups), doubting(every)
    sure = {"offset": round(float(doubt[0]), 4), **_named([*names, "odds"], doubt[1:])}
    offset, slope = doubting([replace(f, cues=f.cues[-1:]) for f in asides])
    print(
        f"without what their task tells of the place: right on {np.mean([f.right for f in asides]):.1%}"
    )
    learned = {
        "choice": _named(names, choice),
        "sure": sure,
        "aside": {"offset": round(float(offset), 4), "odds": round(float(slope), 4)},
    }
    args.out.write_text(json.dumps(learned, indent=1) + "\n", encoding="utf-8")


def _named(names: list[str], values: Float[np.ndarray, "cue"]) -> dict[str, float]:
    return {name: round(float(value), 4) for name, value in zip(names, values, strict=True)}


def read(folder: Path) -> tuple[list[str], list[Group]]:
    """Return the cues' names, and a group of candidates per clip."""
    groups, names = [], list[str]()
    for file in sorted(folder.glob("*.npz")):
        with np.load(file) as arrays:
            names = arrays["names"].tolist()
            groups.append((arrays["cues"], arrays["right"], arrays["alike"]))
    return names, groups


def worth(right: Float[np.ndarray, "candidate"]) -> Float[np.ndarray, "candidate"]:
    """Return how far each candidate counts as the right one: the better cut out, the more."""
    return np.clip((right - RIGHT_IOU) / (FULLY_RIGHT_IOU - RIGHT_IOU), 0, 1)


def choosing(groups: list[Group]) -> Float[np.ndarray, "cue"]:
    """Return the weights that make the right candidates likely; clips without a right one say nothing."""
    told = [(cues, worth(right)) for cues, right, _ in groups if worth(right).max() > 0]
    spread = spread_of(np.concatenate([cues for cues, _ in told]))

    def lost(w: Float[np.ndarray, "cue"]) -> tuple[float, Float[np.ndarray, "cue"]]:
        loss, slope = HELD * float(w @ w), 2 * HELD * w
        for cues, good in told:
            x = cues / spread
            logs = log_softmax(x @ w)
            with np.errstate(divide="ignore"):
                own = logs + np.log(good)
            loss -= float(logsumexp(own))
            slope -= (softmax(own) - np.exp(logs)) @ x
        return loss, slope

    return minimize(lost, np.zeros(len(spread)), jac=True, method="L-BFGS-B").x / spread


@dataclass(frozen=True)
class Finding:
    """The likeliest candidate of a clip."""

    cues: Float[np.ndarray, "cue+1"]
    """Its cues, and the log odds of it and those like it among all."""
    overlap: float
    there: bool
    """Whether all candidates were there, or the right ones were taken away."""

    @property
    def right(self) -> bool:
        return self.overlap >= RIGHT_IOU


def found(group: Group, weights: Float[np.ndarray, "cue"], *, there: bool = True) -> Finding:
    """Return the likeliest candidate."""
    cues, right, alike = group
    likely = softmax(cues @ weights)
    k = int(likely.argmax())
    return Finding(np.append(cues[k], odds_of(likely, alike[k])), float(right[k]), there)


def untold(group: Group, names: list[str]) -> Group:
    """Return the candidates as in a clip whose task does not tell where the thing stands."""
    cues, right, alike = group
    return np.where([": " in name for name in names], 0.0, cues), right, alike


def missed(group: Group, weights: Float[np.ndarray, "cue"]) -> Finding | None:
    """Return the likeliest candidate if none showed the thing that is meant; None where there is no other."""
    cues, right, alike = group
    other = right < NOT_IT_IOU
    if not other.any():
        return None
    return found((cues[other], right[other], alike[other][:, other]), weights, there=False)


def doubting(findings: list[Finding]) -> Float[np.ndarray, "cue+2"]:
    """Return offset and weights of the log odds that the likeliest candidate is right (logistic regression)."""
    cues, right = np.stack([f.cues for f in findings]), np.array([f.right for f in findings])
    spread = spread_of(cues)
    x = np.column_stack([np.ones(len(cues)), cues / spread])
    sign = np.where(right, 1.0, -1.0)

    def lost(w: Float[np.ndarray, "cue+2"]) -> tuple[float, Float[np.ndarray, "cue+2"]]:
        z = sign * (x @ w)
        held = np.append(0.0, HELD * w[1:])
        return float(held @ w - log_expit(z).sum()), 2 * held - (sign * expit(-z)) @ x

    w = minimize(lost, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B").x
    return np.append(w[0], w[1:] / spread)


def spread_of(cues: Float[np.ndarray, "some cue"]) -> Float[np.ndarray, "cue"]:
    """Return each cue's standard deviation, and much for those that say nothing, so that they get no weight."""
    spread = cues.std(0)
    return np.where(spread < LEAST_SPREAD, 1.0, spread)


if __name__ == "__main__":
    main()
