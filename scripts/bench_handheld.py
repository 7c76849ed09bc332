"""Compare drawn clips from a hand with the same clips from a stand: how many are usable, and how true the table is.

Each clip is drawn twice, once from a stand and once as a hand films it: sway and tremor of up to 40 px of 320, with pans,
slow walks and zooms among them (`drawn_clips/handheld.py`). Both are reconstructed without hints.
Two errors are given beside the usable shares. Alignment compares each frame's way back to the first one with the true
cameras, at points of the table in the picture [px of 320]. The table's pose compares its normal and its distance as the
first frame's camera sees them.

    python scripts/bench_handheld.py --clips 16
    python scripts/bench_handheld.py --clips 40 --align-only
"""

import argparse
import json
import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from bench_reconstruction import (
    FPS,
    KINDS,
    Job,
    Row,
    commit,
    drawn,
    each,
    planned,
    reconstructed,
    summarised,
)
from drawn_clips.clips import VideoSpec
from drawn_clips.handheld import random_handheld, table_homography
from drawn_clips.truth import Truth, load_truth
from v2p_data.errors import ItemRejectedError
from v2p_data.scene.frames.stabilise import stabilised
from v2p_data.scene.frames.working_clip import WIDTH_PX, working_clip_of
from v2p_data.seeds import rng_for
from v2p_data.video.captions import find_videos
from v2p_data.video.decode import read_clip


@dataclass(frozen=True, kw_only=True)
class HandheldJob(Job):
    """One clip as a hand films it."""

    @property
    def name(self) -> str:
        return f"{self.kind}_{self.seed:04d}_handheld"

    def spec(self) -> VideoSpec:
        stand = Job(kind=self.kind, seed=self.seed, fps=self.fps).spec()
        hand = random_handheld(rng_for(self.seed, "bench_handheld", self.kind))
        return replace(stand, name=self.name, handheld=hand)


def main() -> None:
    """Read the command line, draw, reconstruct both, compare, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--clips", type=int, default=16)
    parser.add_argument("--split", choices=["tune", "final"], default="tune")
    parser.add_argument("--align-only", action="store_true", help="reconstruct nothing")
    parser.add_argument("--old-clips", action="store_true", help="clips of older drawing code too")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes at once")
    parser.add_argument("--out", type=Path, default=Path("outputs/bench_handheld"))
    args = parser.parse_args()
    stands = planned(args.split, args.clips, list(KINDS), FPS)
    hands = [HandheldJob(kind=job.kind, seed=job.seed, fps=FPS) for job in stands]
    jobs = hands if args.align_only else [*stands, *hands]
    folders = drawn(jobs, args)
    aligned = [alignment(job, folders[job.name]) for job in hands]
    print("\n".join(alignment_row(row) for row in aligned), flush=True)
    print(alignment_summary(aligned), flush=True)
    if args.align_only:
        return
    tasks = [(job, folders[job.name], frozenset(), args.out / "pictures") for job in jobs]
    rows = {row["name"]: row for row in each(args.jobs, reconstructed, tasks, "reconstructed")}
    pairs = [(rows[a.name], rows[b.name]) for a, b in zip(stands, hands, strict=True)]
    for pair, job in zip(pairs, hands, strict=True):
        for row, name in zip(pair, (pair[0]["name"], job.name), strict=True):
            row["table"] = table_error(row, load_truth(folders[name], name))
    (args.out / f"{args.split}.json").write_text(
        json.dumps({"commit": commit(), "aligned": aligned, "pairs": pairs}, indent=1) + "\n"
    )
    print(compared(pairs))


def alignment(job: HandheldJob, folder: Path) -> Row:
    """Return how far the aligned frames are off at the table, and what became of the clip."""
    truth = load_truth(folder, job.name)
    clip = read_clip(next(v for v in find_videos(folder) if v.path.stem == job.name))
    try:
        to_filmed = stabilised(clip, working_clip_of(clip)).to_filmed
    except ItemRejectedError:  # it travels too far
        to_filmed = None
    hand = job.spec().handheld
    assert hand is not None
    row: Row = {"name": job.name, **asdict(hand), "aligned": to_filmed is not None}
    spots = _table_spots(truth)
    true = [
        _moved(spots, table_homography(truth.camera, truth.cameras[int(i)]))
        for i in clip.source_frame
    ]
    scale = WIDTH_PX / truth.camera.width_px
    row["peak_seen_px"] = float(max(np.linalg.norm(t - spots, axis=1).max() for t in true)) * scale
    if to_filmed is not None:
        to_file = truth.camera.width_px / clip.width_px
        S = np.diag([to_file, to_file, 1.0])
        ours = [_moved(spots, S @ H @ np.linalg.inv(S)) for H in to_filmed]
        off = np.array(
            [np.linalg.norm(a - b, axis=1).mean() for a, b in zip(ours, true, strict=True)]
        )
        row |= {"mean_px": float(off.mean() * scale), "worst_px": float(off.max() * scale)}
    return row


def table_error(row: Row, truth: Truth) -> dict[str, float] | None:
    """Return how far the table is off as the first frame's camera sees it: its normal [rad], and its distance, as a share of the true one."""
    if row.get("camera") is None:
        return None
    pitch = float(np.arcsin(-truth.camera.T_world_cam[2, 2]))
    return {
        "pitch_rad": abs(row["camera"]["pitch_rad"] - pitch),
        "height_share": abs(row["height_m"] / row["true_height_m"] - 1),
    }


def compared(pairs: list[tuple[Row, Row]]) -> str:
    """Return usable shares and table errors from the stand and from the hand, and the clips that changed."""
    lines = []
    for words, rows in zip(("stand", "handheld"), zip(*pairs, strict=True), strict=True):
        s = summarised(list(rows))
        tables = [row["table"] for row in rows if row["table"]]
        pitch = np.degrees(np.median([t["pitch_rad"] for t in tables])) if tables else np.nan
        height = np.median([t["height_share"] for t in tables]) if tables else np.nan
        u, a = s["usable"], s["accepted"]
        lines.append(
            f"{words:9}: usable {u['successes']} of {u['trials']} [{u['low']:.0%}, {u['high']:.0%}], accepted {a['successes']}, "
            f"of these usable {s['accepted_usable']['successes']}; table's normal off by {pitch:.1f} degrees, "
            f"its distance by {height:.0%} (medians of {len(tables)}); rejected: {s['slugs'] or 'none'}"
        )
    lines += [
        f"{b['name']}: stand {_outcome(a)}, handheld {_outcome(b)}"
        for a, b in pairs
        if a["usable"] != b["usable"] or a["accepted"] != b["accepted"]
    ]
    return "\n".join(lines)


def alignment_row(row: Row) -> str:
    off = f"off {row['mean_px']:.2f}, at worst {row['worst_px']:.2f}" if row["aligned"] else "no"
    return (
        f"{row['name']:32} peak {row['peak_px']:5.1f} (table's farthest {row['peak_seen_px']:5.1f}) px, pan {row['pan']:.1f}, "
        f"turning {row['turning']:.2f}, zoom {row['zoom']:+.2f}: aligned {off}"
    )


def alignment_summary(rows: list[Row]) -> str:
    done = [row for row in rows if row["aligned"]]
    worst = [row["worst_px"] for row in done]
    mean = [row["mean_px"] for row in done]
    good = sum(px < 1.5 for px in mean)
    return (
        f"aligned {len(done)} of {len(rows)}, {good} to within 1.5 px in the mean; median of the means "
        f"{np.median(mean or [np.nan]):.2f}, of the worst frames {np.median(worst or [np.nan]):.2f} px of {WIDTH_PX}"
    )


def _outcome(row: Row) -> str:
    state = "accepted" if row["accepted"] else row["gate_slug"] or row["slug"]
    return f"usable, {state}" if row["usable"] else f"{row['trouble']}, {state}"


def _table_spots(truth: Truth) -> Float[np.ndarray, "n 2"]:
    """Return a grid of the first picture's pixels that show the bare table or objects on it."""
    w, h = truth.camera.width_px, truth.camera.height_px
    grid = np.stack(np.meshgrid(np.linspace(0, w - 1, 24), np.linspace(0, h - 1, 18)), -1)
    spots = grid.reshape(-1, 2)
    x, y = spots.round().astype(int).T
    return spots[truth.masks[0][y, x] >= 2]


def _moved(spots: Float[np.ndarray, "n 2"], H: Any) -> Float[np.ndarray, "n 2"]:
    return cv2.perspectiveTransform(spots[None], H)[0]


if __name__ == "__main__":
    main()
