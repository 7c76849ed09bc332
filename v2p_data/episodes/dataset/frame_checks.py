"""What is checked on the frames of one episode after the other, in one pass and little memory.

Pictures are looked at as they come and not kept; numbers are, for the statistics at the end.
"""

import hashlib
from typing import Any

import numpy as np

from v2p_data.episodes.dataset.encoding import decode_rgb
from v2p_data.episodes.dataset.episode_stats import QUANTILES
from v2p_data.episodes.dataset.features import (
    ACTION_KEY,
    CAMERA_OF_MASKS,
    CAMERA_POSE_KEY,
    DEMONSTRATION,
    DONE_KEY,
    EXECUTED_KEY,
    INTERVENTION_KEY,
    INTRINSICS_KEY,
    METADATA_FILE,
    OBJECT_POSE_KEY,
    RGB_KEY,
    SUCCESS_KEY,
    actions_in,
    columns_of,
)
from v2p_data.episodes.dataset.tables import BOOKKEEPING, STATS_FILE, Problem, camera_keys
from v2p_data.episodes.staging import Episode
from v2p_data.sim.render.masks import PALETTE, rgb_to_labels

TIME_TOLERANCE_S = 1e-4
STATS_TOLERANCE = 1e-4
VARIANCE_TOLERANCE = 1e-6
UNIT_TOLERANCE = 1e-4
"""Of the length of quaternions, which are stored in 32 bits."""
QUANTILE_TOLERANCE = 0.005
"""Share of rows by which a quantile may be off, and share of the range."""
PICTURE_MEAN_TOLERANCE = 0.1
"""Of the brightness range; LeRobot takes a picture's statistics from a sample of frames."""
DECODERS_DIFFER = 6
"""Of 255: LeRobot's decoders round colours differently; of greys they do not."""
IS_GREY = np.isin(np.arange(256), PALETTE)


class DatasetChecks:
    """All episodes of one dataset.

    Args:
        info: its `meta/info.json`.
        about: its `meta/v2p.json`.
        problems: what is found is added here.
    """

    def __init__(
        self, info: dict[str, Any], about: dict[str, Any], problems: list[Problem]
    ) -> None:
        self.fps = float(info["fps"])
        self.problems = problems
        self.entries: list[dict[str, Any]] = about["episodes"]
        features: dict[str, Any] = info["features"]
        self.cameras = camera_keys(info)
        self.numbers = [
            k
            for k, f in features.items()
            if f["dtype"].startswith(("float", "int", "uint", "bool")) and k not in BOOKKEEPING
        ]
        self.floats = [k for k in self.numbers if features[k]["dtype"].startswith("float")]
        self.steps = ACTION_KEY if actions_in(info) == "delta_tool" else EXECUTED_KEY
        self.first_with: dict[str, int] = {}
        """Digest of an episode's numbers -> the first episode with these."""
        summed = [
            k
            for k in (*self.numbers, *BOOKKEEPING)
            if k in (*self.floats, *BOOKKEEPING, INTERVENTION_KEY)
        ]
        self.columns: dict[str, list[np.ndarray]] = {k: [] for k in summed}
        self.brightness: dict[str, list[tuple[float, int]]] = {k: [] for k in self.cameras}

    def add(self, check: str, where: str, detail: str) -> None:
        self.problems.append(Problem(check=check, where=where, detail=detail))

    def statistics(self, stats: dict[str, Any]) -> None:
        """Compare `meta/stats.json` with the numbers that were read."""
        for key, parts in self.columns.items():
            if not parts:
                continue
            if key not in stats:
                self.add("statistics", STATS_FILE, f"has nothing on {key}")
                continue
            values = np.concatenate(parts).astype(np.float64)
            for name in ("min", "max", "mean", "std"):
                if not _is_near(name, values, stats[key]):
                    self.add("statistics", STATS_FILE, f"{name} of {key} is not that of the data")
            if wrong := wrong_quantiles(values, stats[key]):
                words = f"{', '.join(wrong)} of {key} are not those of all rows"
                self.add("quantiles", STATS_FILE, words)
        for key in self.cameras:
            if self.brightness[key]:
                self._picture_statistics(key, stats.get(key) or {})

    def _picture_statistics(self, key: str, stats: dict[str, Any]) -> None:
        names = ("min", "mean", "max", "std")
        low, mean, high, std = (_entries(stats, name) for name in names)
        sums, counts = zip(*self.brightness[key], strict=True)
        true = sum(sums) / sum(counts)
        is_ordered = (
            low.shape == mean.shape == high.shape
            and ((low >= 0) & (low <= mean) & (mean <= high) & (high <= 1)).all()
        )
        if not (is_ordered and (std >= 0).all()):
            self.add(
                "statistics", STATS_FILE, f"those of {key} are no brightness in [0, 1] in order"
            )
        elif abs(float(mean.mean()) - true) > PICTURE_MEAN_TOLERANCE:
            words = f"mean of {key} is {mean.mean():.3f}, the pictures' is {true:.3f}"
            self.add("statistics", STATS_FILE, words)


def _entries(stats: dict[str, Any], name: str) -> np.ndarray:
    return np.asarray(stats.get(name, np.nan), np.float64).reshape(-1)


def _is_near(name: str, values: np.ndarray, stats: dict[str, Any]) -> bool:
    """Return whether a statistic is that of `values` `(row, entry)`."""
    true, noted = getattr(values, name)(0), _entries(stats, name)
    if noted.shape != true.shape:
        return False
    scale = max(1.0, float(np.abs(true).max()))
    # Written so that NaN on either side is a difference.
    is_near = bool(np.abs(noted - true).max() <= STATS_TOLERANCE * scale)
    if name == "std":
        # LeRobot subtracts squares in 32 bits, of which a column that hardly varies has little left.
        largest = max(1.0, float(np.abs(values).max()))
        is_near |= bool(np.abs(noted**2 - true**2).max() <= VARIANCE_TOLERANCE * largest**2)
    return is_near


def wrong_quantiles(values: np.ndarray, stats: dict[str, Any]) -> list[str]:
    """Return the names of the quantiles that are not those of `values` `(row, entry)`; what is missing is not wrong."""
    slack = QUANTILE_TOLERANCE + 1 / len(values)
    # Of what is 0 throughout LeRobot says 1e-10 or so.
    largest = np.maximum(np.abs(values).max(0), 1e-3)
    near = QUANTILE_TOLERANCE * np.ptp(values, axis=0) + STATS_TOLERANCE * largest
    wrong: list[str] = []
    for name, share in QUANTILES.items():
        if name in stats:
            at = _entries(stats, name)
            is_right = at.shape == near.shape and bool(
                ((values < at - near).mean(0) <= share + slack).all()
                and ((values <= at + near).mean(0) >= share - slack).all()
            )
            wrong += [] if is_right else [name]
    return wrong


class EpisodeCheck:
    """One episode, whose rows begin at `start`; `look_at` takes them in order, `finish` judges the whole."""

    def __init__(
        self, checks: DatasetChecks, k: int, start: int, length: int, recorded: Episode | None
    ) -> None:
        self.checks = checks
        self.k = k
        self.start = start
        self.where = f"episode {k}"
        self.recorded = recorded
        self.comparable = recorded is not None and recorded.num_frames == length
        self.wrong_pixels = 0
        self.wrong_pictures = 0
        self.pictures: np.ndarray | None = None
        if self.comparable and recorded is not None and recorded.rgb_mp4:
            self.pictures = decode_rgb(recorded.rgb_mp4)
        self.rows: dict[str, list[np.ndarray]] = {k: [] for k in (*checks.numbers, *BOOKKEEPING)}
        self.tasks: list[str] = []
        self.first_pictures: dict[str, np.ndarray] = {}
        self.moving: set[str] = set()
        self.strange: set[str] = set()
        self.brightness = dict.fromkeys(checks.cameras, 0.0)

    def look_at(self, row: dict[str, Any]) -> None:
        """Take the next row, as `LeRobotDataset` gives it with `return_uint8`."""
        t = len(self.tasks)
        for key, values in self.rows.items():
            values.append(np.asarray(row[key]).reshape(-1))
        self.tasks.append(str(row["task"]))
        for key in self.checks.cameras:
            picture = np.asarray(row[key])
            self.brightness[key] += float(picture.mean()) / 255
            if not np.array_equal(self.first_pictures.setdefault(key, picture), picture):
                self.moving.add(key)
            if key in CAMERA_OF_MASKS:
                if not IS_GREY[picture].all():
                    self.strange.add(key)
                if self.comparable and self.recorded is not None:
                    labels = rgb_to_labels(np.ascontiguousarray(picture.transpose(1, 2, 0)))
                    drawn = self.recorded.labels_of(CAMERA_OF_MASKS[key])[t]
                    self.wrong_pixels += int((labels != drawn).sum())
            elif key == RGB_KEY and self.pictures is not None:
                off = np.abs(picture.transpose(1, 2, 0).astype(np.int16) - self.pictures[t]).max()
                self.wrong_pictures += bool(off > DECODERS_DIFFER)

    def finish(self) -> None:
        """Judge the episode."""
        columns = {key: np.stack(values) for key, values in self.rows.items()}
        for key, parts in self.checks.columns.items():
            parts.append(columns[key])
        self._numbering(columns)
        self._numbers(columns)
        self._who_acted(columns)
        self._simulated(columns)
        self._pictures()
        if self.recorded is not None:
            self._compare(columns, self.recorded)

    def _numbering(self, columns: dict[str, np.ndarray]) -> None:
        add, where, count = self.checks.add, self.where, len(self.tasks)
        if not np.array_equal(columns["index"][:, 0], np.arange(self.start, self.start + count)):
            add("index", where, "rows are out of order or from another episode")
        if (columns["episode_index"] != self.k).any():
            add("index", where, "rows carry another episode's number")
        if not np.array_equal(columns["frame_index"][:, 0], np.arange(count)):
            add("index", where, "frames are not numbered 0, 1, 2, ...")
        late = np.abs(columns["timestamp"][:, 0] - np.arange(count) / self.checks.fps).max()
        if not late <= TIME_TOLERANCE_S:
            add(
                "timestamps",
                where,
                f"timestamps do not follow {self.checks.fps:g} frames a second",
            )
        if count < 2:
            add("length", where, f"{count} frames")
        if not self.tasks[0].strip():
            add("task", where, "has no instruction")

    def _numbers(self, columns: dict[str, np.ndarray]) -> None:
        add, where = self.checks.add, self.where
        digest = hashlib.sha256()
        for key in self.checks.floats:
            digest.update(columns[key].tobytes())
            if not np.isfinite(columns[key]).all():
                add("finite", where, f"{key} holds NaN or infinity")
        first = self.checks.first_with.setdefault(digest.hexdigest(), self.k)
        if first != self.k:
            add("duplicate", where, f"holds the same numbers as episode {first}")
        if (largest := np.abs(columns.get(self.checks.steps, np.zeros(1))).max()) > 1:
            add("action_bounds", where, f"an action is {largest:.3f}, beyond 1")
        if SUCCESS_KEY in columns and not columns[SUCCESS_KEY][-1].all():
            add("success", where, "ends before its task is done")

    def _who_acted(self, columns: dict[str, np.ndarray]) -> None:
        if INTERVENTION_KEY not in columns or self.k >= len(self.checks.entries):
            return
        entry = self.checks.entries[self.k]
        source, noted = entry.get("source", DEMONSTRATION), int(entry.get("student_frames", 0))
        true = int((~columns[INTERVENTION_KEY].astype(bool)).sum())
        if true != noted or (true and source == DEMONSTRATION):
            words = (
                f"a student acted in {true} frames, {METADATA_FILE} names {noted} in a {source}"
            )
            self.checks.add("who_acted", self.where, words)

    def _simulated(self, columns: dict[str, np.ndarray]) -> None:
        """Judge ends of episodes, poses and the camera, where they are in the dataset."""
        add, where = self.checks.add, self.where
        if DONE_KEY in columns and not (columns[DONE_KEY][-1] and columns[DONE_KEY].sum() == 1):
            add("done", where, f"{DONE_KEY} is not true in the last row alone")
        for key in (OBJECT_POSE_KEY, CAMERA_POSE_KEY):
            if key in columns and columns[key].shape[1] % 7 == 0:
                length = np.linalg.norm(columns[key].reshape(-1, 7)[:, 3:], axis=1)
                is_none = (length == 0) & (key == OBJECT_POSE_KEY)
                if not (is_none | (np.abs(length - 1) < UNIT_TOLERANCE)).all():
                    add("poses", where, f"a quaternion of {key} is not of length 1")
        if INTRINSICS_KEY in columns and not (columns[INTRINSICS_KEY] > 0).all():
            add("poses", where, f"{INTRINSICS_KEY} are not above 0: the camera is not calibrated")

    def _pictures(self) -> None:
        add, where, count = self.checks.add, self.where, len(self.tasks)
        for key in self.checks.cameras:
            self.checks.brightness[key].append((self.brightness[key], count))
            if count > 1 and key not in self.moving:
                add("dead_camera", where, f"{key} never changes")
            if key in self.strange:
                add("palette", where, f"{key} holds greys that are no label")

    def _compare(self, columns: dict[str, np.ndarray], episode: Episode) -> None:
        where = f"{self.where} ({episode.id})"
        add = self.checks.add
        if not self.comparable:
            add(
                "differs",
                where,
                f"has {len(self.tasks)} frames, {episode.num_frames} were recorded",
            )
            return
        if self.wrong_pixels:
            add("differs", where, f"{self.wrong_pixels} mask pixels differ from what was drawn")
        if self.wrong_pictures:
            add("differs", where, f"{self.wrong_pictures} pictures differ from what was drawn")
        if episode.is_handover and INTERVENTION_KEY not in columns:
            add("differs", where, f"{INTERVENTION_KEY} was recorded and is no column")
        for key, values in columns_of(episode).items():
            if key in columns and not np.array_equal(columns[key].reshape(values.shape), values):
                add("differs", where, f"{key} differs from what was recorded")
        if set(self.tasks) != {episode.task}:
            add("differs", where, f"says '{self.tasks[0]}', recorded was '{episode.task}'")
