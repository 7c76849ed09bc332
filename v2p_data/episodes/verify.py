"""A dataset, reopened with LeRobot and looked at frame by frame.

Everything is read the way a training would read it. With the staged episodes at hand each mask, state and
action is compared with what was recorded; without them the checks that any LeRobot v3 dataset should pass
remain, and for datasets of ours those on palette, action bounds and success.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from v2p_data.episodes.features import (
    ACTION_KEY,
    ACTION_NAMES,
    MASK_KEY,
    METADATA_FILE,
    STATE_KEY,
    SUCCESS_KEY,
)
from v2p_data.episodes.staging import Episode
from v2p_data.errors import V2PError
from v2p_data.sim.masks import PALETTE, rgb_to_labels

TIME_TOLERANCE_S = 1e-4
STATS_TOLERANCE = 1e-4
SHOWN_PROBLEMS = 5


@dataclass(frozen=True, kw_only=True)
class Problem:
    """One thing that is not as it should be."""

    check: str
    """Slug of the check."""
    where: str
    detail: str


@dataclass(frozen=True, kw_only=True)
class VerifyReport:
    """What was read and what is wrong with it."""

    root: Path
    num_episodes: int
    num_frames: int
    is_ours: bool
    """Written by this engine, so that its own rules apply."""
    is_compared: bool
    """Every frame was compared with what was recorded."""
    problems: tuple[Problem, ...]

    @property
    def is_good(self) -> bool:
        return not self.problems

    def summary(self) -> str:
        """Return one sentence."""
        read = f"{self.num_episodes} episodes, {self.num_frames} frames"
        if self.is_good:
            same = ", all equal to what was recorded" if self.is_compared else ""
            return f"{read}: no problem found{same}"
        shown = "; ".join(f"{p.where}: {p.detail}" for p in self.problems[:SHOWN_PROBLEMS])
        more = len(self.problems) - SHOWN_PROBLEMS
        return f"{read}: {len(self.problems)} problems: {shown}" + (
            f"; and {more} more" if more > 0 else ""
        )

    def as_json(self) -> dict[str, Any]:
        """Return it for JSON."""
        return asdict(self) | {"root": str(self.root), "is_good": self.is_good}


def verify(
    root: Path,
    staged: Sequence[Path] | None = None,
    *,
    on_progress: Callable[[float, str], None] = lambda share, words: None,
) -> VerifyReport:
    """Read every frame of the LeRobot dataset at `root` and list what is wrong.

    Args:
        root: folder of a finished dataset.
        staged: the episodes it was packed from, in order, to compare with.
        on_progress: told the share that is done and a few words.

    Raises:
        V2PError: there is no LeRobot v3 dataset at `root`.
    """
    info = _read_info(root)
    about = _read_json(root / METADATA_FILE)
    checks = _Checks(root=root, info=info, is_ours=about is not None)
    missing = _missing_files(root, info)
    if missing:
        # LeRobot would look for them on the Hub.
        for path in missing:
            checks.add(
                "missing_file",
                path,
                "is missing; the dataset was not finalized or not copied whole",
            )
        return checks.report(0, 0, is_compared=False)
    repo_id = str((about or {}).get("repo_id", "local/dataset"))
    on_progress(0.0, "starting LeRobot")
    return _read(checks, repo_id, staged, on_progress)


def _read(
    checks: "_Checks",
    repo_id: str,
    staged: Sequence[Path] | None,
    on_progress: Callable[[float, str], None],
) -> VerifyReport:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    try:
        dataset: Any = LeRobotDataset(repo_id, root=checks.root, return_uint8=True)
    except Exception as error:  # noqa: BLE001 - whatever LeRobot stumbles over is the finding
        checks.add("does_not_open", str(checks.root), f"{type(error).__name__}: {error}")
        return checks.report(0, 0, is_compared=False)
    checks.counts(dataset, staged)
    start = 0
    for k in range(dataset.meta.total_episodes):
        length = int(dataset.meta.episodes[k]["length"])
        try:
            rows = [dataset[i] for i in range(start, start + length)]
        except Exception as error:  # noqa: BLE001 - whatever LeRobot stumbles over is the finding
            checks.add("does_not_read", f"episode {k}", f"{type(error).__name__}: {error}")
        else:
            checks.episode(k, start, rows)
            if staged is not None and k < len(staged):
                checks.compare(k, rows, Episode.load(staged[k]))
        start += length
        on_progress((k + 1) / dataset.meta.total_episodes, f"read {k + 1} episodes")
    checks.statistics(dataset.meta.stats or {})
    return checks.report(dataset.meta.total_episodes, start, is_compared=staged is not None)


class _Checks:
    def __init__(self, *, root: Path, info: dict[str, Any], is_ours: bool) -> None:
        self.root = root
        self.info = info
        self.is_ours = is_ours
        self.features: dict[str, Any] = info["features"]
        self.cameras = [k for k, f in self.features.items() if f["dtype"] in ("video", "image")]
        self.floats = [
            k for k, f in self.features.items()
            if f["dtype"] in ("float32", "float64") and k != "timestamp"
        ]  # fmt: skip
        self.problems: list[Problem] = []
        self.seen: dict[str, int] = {}
        self.columns: dict[str, list[np.ndarray]] = {k: [] for k in self.floats}

    def add(self, check: str, where: str, detail: str) -> None:
        self.problems.append(Problem(check=check, where=where, detail=detail))

    def report(self, num_episodes: int, num_frames: int, *, is_compared: bool) -> VerifyReport:
        return VerifyReport(
            root=self.root,
            num_episodes=num_episodes,
            num_frames=num_frames,
            is_ours=self.is_ours,
            is_compared=is_compared,
            problems=tuple(self.problems),
        )

    def counts(self, dataset: Any, staged: Sequence[Path] | None) -> None:
        lengths = [int(n) for n in dataset.meta.episodes["length"]]
        rows = len(dataset.hf_dataset)
        said = int(self.info["total_episodes"]), int(self.info["total_frames"])
        if said != (len(lengths), sum(lengths)):
            self.add("counts", "meta/info.json",
                     f"names {said} episodes and frames, the episode table {(len(lengths), sum(lengths))}")  # fmt: skip
        if rows != sum(lengths):
            self.add("counts", "data", f"holds {rows} rows, the episode table {sum(lengths)}")
        if staged is not None and len(staged) != len(lengths):
            self.add(
                "counts", "dataset", f"holds {len(lengths)} episodes, {len(staged)} were recorded"
            )

    def episode(self, k: int, start: int, rows: list[dict[str, Any]]) -> None:
        where = f"episode {k}"
        fps = float(self.info["fps"])
        index = np.array([int(r["index"]) for r in rows])
        times = np.array([float(r["timestamp"]) for r in rows])
        if not (index == np.arange(start, start + len(rows))).all():
            self.add("index", where, "rows are out of order or from another episode")
        if any(int(r["episode_index"]) != k for r in rows):
            self.add("index", where, "rows carry another episode's number")
        if np.abs(times - np.arange(len(rows)) / fps).max() > TIME_TOLERANCE_S:
            self.add("timestamps", where, f"timestamps do not follow {fps:g} frames a second")
        if len(rows) < 2:
            self.add("length", where, f"{len(rows)} frames")
        if not str(rows[0]["task"]).strip():
            self.add("task", where, "has no instruction")
        for key in self.floats:
            values = np.stack([np.asarray(r[key]) for r in rows])
            self.columns[key].append(values.reshape(len(rows), -1))
            if not np.isfinite(values).all():
                self.add("finite", where, f"{key} holds NaN or infinity")
        self._actions(where, rows)
        self._duplicate(k, where, rows)
        for key in self.cameras:
            self._camera(where, key, np.stack([np.asarray(r[key]) for r in rows]))
        if (
            self.is_ours
            and SUCCESS_KEY in rows[-1]
            and not bool(np.all(np.asarray(rows[-1][SUCCESS_KEY])))
        ):
            self.add("success", where, "ends before its task is done")

    def _actions(self, where: str, rows: list[dict[str, Any]]) -> None:
        if list(self.features.get(ACTION_KEY, {}).get("names") or []) != list(ACTION_NAMES):
            return
        largest = max(float(np.abs(np.asarray(r[ACTION_KEY])).max()) for r in rows)
        if largest > 1.0:
            self.add("action_bounds", where, f"an action is {largest:.3f}, beyond 1")

    def _duplicate(self, k: int, where: str, rows: list[dict[str, Any]]) -> None:
        digest = hashlib.sha256()
        for row in rows:
            for key in self.floats:
                digest.update(np.asarray(row[key]).tobytes())
        first = self.seen.setdefault(digest.hexdigest(), k)
        if first != k:
            self.add("duplicate", where, f"holds the same numbers as episode {first}")

    def _camera(self, where: str, key: str, pictures: np.ndarray) -> None:
        if len(pictures) > 1 and (pictures == pictures[:1]).all():
            self.add("dead_camera", where, f"{key} never changes")
        if self.is_ours and key == MASK_KEY and not np.isin(pictures, PALETTE).all():
            self.add("palette", where, f"{key} holds greys that are no label")

    def compare(self, k: int, rows: list[dict[str, Any]], episode: Episode) -> None:
        where = f"episode {k} ({episode.id})"
        if len(rows) != episode.num_frames:
            self.add(
                "differs", where, f"has {len(rows)} frames, {episode.num_frames} were recorded"
            )
            return
        pictures = np.stack([np.asarray(r[MASK_KEY]) for r in rows]).transpose(0, 2, 3, 1)
        wrong = int((rgb_to_labels(np.ascontiguousarray(pictures)) != episode.labels).sum())
        if wrong:
            self.add("differs", where, f"{wrong} mask pixels differ from what was drawn")
        recorded = {
            STATE_KEY: episode.state,
            ACTION_KEY: episode.action,
            SUCCESS_KEY: episode.success[:, None],
        }
        for key, values in recorded.items():
            read = np.stack([np.asarray(r[key]) for r in rows]).reshape(values.shape)
            if not (read == values).all():
                self.add("differs", where, f"{key} differs from what was recorded")
        if rows[0]["task"] != episode.task:
            self.add("differs", where, f"says '{rows[0]['task']}', recorded was '{episode.task}'")

    def statistics(self, stats: dict[str, Any]) -> None:
        for key in self.floats:
            if not self.columns[key]:
                continue
            values = np.concatenate(self.columns[key])
            if key not in stats:
                self.add("statistics", "meta/stats.json", f"has nothing on {key}")
                continue
            for name, true in (
                ("min", values.min(0)), ("max", values.max(0)), ("mean", values.mean(0)), ("std", values.std(0)),
            ):  # fmt: skip
                said = np.asarray(stats[key][name], float).reshape(-1)
                if said.shape != true.shape or np.abs(said - true).max() > STATS_TOLERANCE * max(
                    1.0, float(np.abs(true).max())
                ):
                    self.add(
                        "statistics", "meta/stats.json", f"{name} of {key} is not that of the data"
                    )


def _read_info(root: Path) -> dict[str, Any]:
    info = _read_json(root / "meta/info.json")
    if info is None:
        raise V2PError(
            f"{root} holds no LeRobot dataset: there is no readable meta/info.json in it; "
            "give the folder that 'v2p generate' named at its end"
        )
    version = str(info.get("codebase_version", ""))
    if not version.startswith("v3"):
        raise V2PError(
            f"{root} is a LeRobot dataset of version '{version}'; only v3 can be read, "
            "convert it with LeRobot's own converter"
        )
    return info


def _read_json(path: Path) -> dict[str, Any] | None:
    try:
        return json.loads(path.read_text())
    except (FileNotFoundError, NotADirectoryError, json.JSONDecodeError):
        return None


def _missing_files(root: Path, info: dict[str, Any]) -> list[str]:
    wanted = [
        "meta/stats.json",
        "meta/tasks.parquet",
        "meta/episodes/*/*.parquet",
        "data/*/*.parquet",
    ]
    wanted += [
        f"videos/{key}/*/*.mp4" for key, f in info["features"].items() if f["dtype"] == "video"
    ]
    return [pattern for pattern in wanted if not any(root.glob(pattern))]
