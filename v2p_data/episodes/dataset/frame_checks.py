"""What is checked on the frames of one episode after the other, in one pass and little memory.

Pictures are looked at as they come and not kept; numbers are, for the statistics at the end.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
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
    MASK_KEY,
    METADATA_FILE,
    OBJECT_POSE_KEY,
    RGB_KEY,
    STATE_KEY,
    SUCCESS_KEY,
    actions_in,
)
from v2p_data.episodes.dataset.tables import BOOKKEEPING, STATS_FILE, Found
from v2p_data.episodes.staging import Episode
from v2p_data.sim.render.masks import PALETTE, rgb_to_labels

TIME_TOLERANCE_S = 1e-4
STATS_TOLERANCE = 1e-4
VARIANCE_TOLERANCE = 1e-6
UNIT_TOLERANCE = 1e-4
"""Of the length of quaternions, which are stored in 32 bits."""
QUANTILE_TOLERANCE = 0.005
"""Share of rows by which a quantile may be off, and share of the range: LeRobot estimates it from 5,000 bins."""
PICTURE_MEAN_TOLERANCE = 0.1
"""Of the brightness range; LeRobot takes a picture's statistics from a sample of frames."""
FROZEN_SHARE, FROZEN_FRAMES = 0.5, 10
"""A picture that stands still for this share of an episode, and this many frames at least ..."""
FROZEN_MOTION = 0.25
"""... while some state entry runs through this share of its range in the episode is frozen."""
DECODERS_DIFFER = 6
"""Of 255: LeRobot's decoders round colours differently; of greys they do not."""
LONGEST_NOTES = 20
IS_GREY = np.isin(np.arange(256), PALETTE)


@dataclass
class Said:
    """Where findings are collected."""

    problems: list[Found] = field(default_factory=list)
    notes: list[Found] = field(default_factory=list)

    def add(self, check: str, where: str, detail: str) -> None:
        self.problems.append(Found(check=check, where=where, detail=detail))

    def note(self, check: str, where: str, detail: str) -> None:
        if len(self.notes) < LONGEST_NOTES:
            self.notes.append(Found(check=check, where=where, detail=detail))


class Checks:
    """All episodes of one dataset.

    Args:
        info: its `meta/info.json`.
        about: its `meta/v2p.json`, where this engine wrote it.
        said: where findings go.
    """

    def __init__(self, *, info: dict[str, Any], about: dict[str, Any] | None, said: Said) -> None:
        self.fps = float(info["fps"])
        self.is_ours = about is not None
        self.said = said
        self.features: dict[str, Any] = info["features"]
        self.cameras = [k for k, f in self.features.items() if f["dtype"] in ("video", "image")]
        self.depths = [k for k in self.cameras if _is_depth(self.features[k])]
        self.numbers = [
            k
            for k, f in self.features.items()
            if f["dtype"].startswith(("float", "int", "uint", "bool")) and k not in BOOKKEEPING
        ]
        self.floats = [k for k in self.numbers if self.features[k]["dtype"].startswith("float")]
        actions = actions_in(info)
        self.has_our_actions = actions is not None
        self.steps = ACTION_KEY if actions == "delta_tool" else EXECUTED_KEY
        self.has_masks = self.is_ours and MASK_KEY in self.features
        self.seen: dict[str, int] = {}
        self.sources: list[dict[str, Any]] | None = None
        if about is not None and INTERVENTION_KEY in self.features:
            self.sources = about["episodes"]
        summed = (*self.floats, *BOOKKEEPING, *((INTERVENTION_KEY,) if self.sources else ()))
        self.columns: dict[str, list[np.ndarray]] = {k: [] for k in summed}
        self.brightness: dict[str, list[tuple[float, int]]] = {k: [] for k in self.cameras}

    def skipped(self) -> Iterator[str]:
        """Yield what does not apply to this dataset."""
        if not self.is_ours:
            words = "so it is not ours"
            if self.has_our_actions:
                words = "which another tool left out; 'v2p merge DATASET --from ORIGINAL --out NEW --repo-id USER/NAME' brings it back"
            yield f"palette, labels and provenance: there is no {METADATA_FILE}, {words}"
        if not self.has_our_actions:
            yield "action bounds: the action is not named as ours, and LeRobot states no bounds"
        if SUCCESS_KEY not in self.features:
            yield f"success at the end: there is no column {SUCCESS_KEY}"
        elif not self.is_ours:
            yield f"success at the end: noted only, as recordings of others may hold failures on purpose ({SUCCESS_KEY})"
        if not self.cameras:
            yield "pictures: it has no camera"
        for key in self.depths:
            yield f"statistics of {key}: depth is stored in other units than it is read in"

    def episode(self, k: int, start: int, length: int, recorded: Episode | None) -> "EpisodeCheck":
        """Return what looks at episode `k`, whose rows begin at `start`."""
        return EpisodeCheck(self, k, start, length, recorded)

    def statistics(self, stats: dict[str, Any]) -> None:
        """Compare `meta/stats.json` with the numbers that were read."""
        for key, parts in self.columns.items():
            if not parts:
                continue
            values = np.concatenate(parts).astype(np.float64)
            tell = self.said.note if key in BOOKKEEPING else self.said.add
            if key not in stats:
                tell("statistics", STATS_FILE, f"has nothing on {key}")
                continue
            for name in ("min", "max", "mean", "std"):
                true = getattr(values, name)(0)
                said = np.asarray(stats[key].get(name, np.nan), np.float64).reshape(-1)
                scale = max(1.0, float(np.abs(true).max()))
                # Written so that NaN on either side is a difference.
                is_near = said.shape == true.shape and np.abs(said - true).max() <= STATS_TOLERANCE * scale  # fmt: skip
                if name == "std" and said.shape == true.shape:
                    # LeRobot subtracts squares in 32 bits, of which a column that hardly varies has little left.
                    largest = max(1.0, float(np.abs(values).max()))
                    is_near |= np.abs(said**2 - true**2).max() <= VARIANCE_TOLERANCE * largest**2
                if not is_near:
                    tell("statistics", STATS_FILE, f"{name} of {key} is not that of the data")
            if wrong := wrong_quantiles(values, stats[key]):
                tell = self.said.add if self.is_ours and key not in BOOKKEEPING else self.said.note
                tell("quantiles", STATS_FILE, f"{', '.join(wrong)} of {key} are not those of all rows" + _left_out(values, stats[key]))  # fmt: skip
        for key in self.cameras:
            if key not in self.depths and self.brightness[key]:
                self._picture_statistics(key, stats.get(key))

    def _picture_statistics(self, key: str, said: dict[str, Any] | None) -> None:
        if said is None:
            self.said.add("statistics", STATS_FILE, f"has nothing on {key}")
            return
        low, mean, high, std = (
            np.asarray(said.get(n, np.nan), np.float64).reshape(-1) for n in ("min", "mean", "max", "std")
        )  # fmt: skip
        sums, counts = zip(*self.brightness[key], strict=True)
        true = sum(sums) / sum(counts)
        if not (low.shape == mean.shape == high.shape and (low >= 0).all() and (low <= mean).all()
                and (mean <= high).all() and (high <= 1).all() and (std >= 0).all()):  # fmt: skip
            self.said.add("statistics", STATS_FILE, f"those of {key} are no brightness in [0, 1] in order")  # fmt: skip
        elif abs(float(mean.mean()) - true) > PICTURE_MEAN_TOLERANCE:
            self.said.add("statistics", STATS_FILE, f"mean of {key} is {mean.mean():.3f}, the pictures' is {true:.3f}")  # fmt: skip


def wrong_quantiles(values: np.ndarray, said: dict[str, Any]) -> list[str]:
    """Return the names of the quantiles that are not those of `values` `(row, entry)`; what is not said is not wrong."""
    slack = QUANTILE_TOLERANCE + 1 / len(values)
    # Of what is 0 throughout LeRobot says 1e-10 or so.
    largest = np.maximum(np.abs(values).max(0), 1e-3)
    near = QUANTILE_TOLERANCE * np.ptp(values, axis=0) + STATS_TOLERANCE * largest
    wrong: list[str] = []
    for name, share in QUANTILES.items():
        if name in said:
            at = np.asarray(said[name], np.float64).reshape(-1)
            is_right = at.shape == near.shape and bool(
                ((values < at - near).mean(0) <= share + slack).all()
                and ((values <= at + near).mean(0) >= share - slack).all()
            )  # fmt: skip
            wrong += [] if is_right else [name]
    return wrong


def _left_out(values: np.ndarray, said: dict[str, Any]) -> str:
    """Return in words how many rows lie outside of the range that policies take for that of 98 %."""
    ends = [np.asarray(said.get(name, []), np.float64).reshape(-1) for name in ("q01", "q99")]
    if any(end.shape != values[0].shape for end in ends):
        return ""
    share = ((values < ends[0]) | (values > ends[1])).mean(0).max()
    return f": {share:.0%} of an entry's rows lie outside of q01 to q99, where 2 % should; LeRobot averages episodes, 'v2p merge' writes them anew"


class EpisodeCheck:
    """One episode; `look_at` takes its rows in order, `finish` judges the whole."""

    def __init__(
        self, checks: Checks, k: int, start: int, length: int, recorded: Episode | None
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
        self.cameras = {key: _Camera(hashed=not checks.floats) for key in checks.cameras}

    def look_at(self, row: dict[str, Any]) -> None:
        """Take the next row, as `LeRobotDataset` gives it with `return_uint8`."""
        for key, values in self.rows.items():
            values.append(np.asarray(row[key]).reshape(-1))
        self.tasks.append(str(row["task"]))
        for key, camera in self.cameras.items():
            picture = np.asarray(row[key])
            camera.look_at(picture)
            if key in CAMERA_OF_MASKS and self.checks.has_masks:
                camera.strange |= not bool(IS_GREY[picture].all())
                if self.comparable and self.recorded is not None:
                    labels = rgb_to_labels(np.ascontiguousarray(picture.transpose(1, 2, 0)))
                    drawn = self.recorded.labels_of(CAMERA_OF_MASKS[key])
                    self.wrong_pixels += int((labels != drawn[camera.frames - 1]).sum())
            elif key == RGB_KEY and self.pictures is not None:
                shown = picture.transpose(1, 2, 0).astype(np.int16)
                off = np.abs(shown - self.pictures[camera.frames - 1]).max()
                self.wrong_pictures += bool(off > DECODERS_DIFFER)

    def finish(self) -> None:
        """Judge the episode."""
        add, where = self.checks.said.add, self.where
        columns = {key: np.stack(values) for key, values in self.rows.items()}
        count = len(self.tasks)
        for key in self.checks.columns:
            self.checks.columns[key].append(columns[key])
        if not np.array_equal(columns["index"][:, 0], np.arange(self.start, self.start + count)):
            add("index", where, "rows are out of order or from another episode")
        if (columns["episode_index"] != self.k).any():
            add("index", where, "rows carry another episode's number")
        if not np.array_equal(columns["frame_index"][:, 0], np.arange(count)):
            add("index", where, "frames are not numbered 0, 1, 2, ...")
        late = np.abs(columns["timestamp"][:, 0] - np.arange(count) / self.checks.fps).max()
        if not late <= TIME_TOLERANCE_S:
            add("timestamps", where, f"timestamps do not follow {self.checks.fps:g} frames a second")  # fmt: skip
        if count < 2:
            add("length", where, f"{count} frames")
        if not self.tasks[0].strip():
            add("task", where, "has no instruction")
        for key in self.checks.floats:
            if not np.isfinite(columns[key]).all():
                add("finite", where, f"{key} holds NaN or infinity")
        if (
            self.checks.has_our_actions
            and (largest := np.abs(columns.get(self.checks.steps, np.zeros(1))).max()) > 1
        ):
            add("action_bounds", where, f"an action is {largest:.3f}, beyond 1")
        self._success(columns)
        self._who_acted(columns)
        self._simulated(columns)
        self._duplicate(columns)
        self._cameras(columns.get(STATE_KEY))
        if self.recorded is not None:
            self._compare(columns, self.recorded)

    def _success(self, columns: dict[str, np.ndarray]) -> None:
        if SUCCESS_KEY in columns and not columns[SUCCESS_KEY][-1].all():
            tell = self.checks.said.add if self.checks.is_ours else self.checks.said.note
            tell("success", self.where, "ends before its task is done")

    def _who_acted(self, columns: dict[str, np.ndarray]) -> None:
        if self.checks.sources is None or self.k >= len(self.checks.sources):
            return
        told = self.checks.sources[self.k]
        source, said = told.get("source", DEMONSTRATION), int(told.get("student_frames", 0))
        true = int((~columns[INTERVENTION_KEY].astype(bool)).sum())
        if true != said or (true and source == DEMONSTRATION):
            self.checks.said.add(
                "who_acted", self.where,
                f"a student acted in {true} frames, {METADATA_FILE} tells of {said} in a {source}",
            )  # fmt: skip

    def _simulated(self, columns: dict[str, np.ndarray]) -> None:
        """Judge ends of episodes, poses and the camera, where they are in the dataset and it is ours."""
        add = self.checks.said.add if self.checks.is_ours else self.checks.said.note
        if DONE_KEY in columns and not (columns[DONE_KEY][-1] and columns[DONE_KEY].sum() == 1):
            add("done", self.where, f"{DONE_KEY} is not true in the last row alone")
        for key in (OBJECT_POSE_KEY, CAMERA_POSE_KEY):
            if key in columns and columns[key].shape[1] % 7 == 0:
                length = np.linalg.norm(columns[key].reshape(-1, 7)[:, 3:], axis=1)
                is_none = (length == 0) & (key == OBJECT_POSE_KEY)
                if not (is_none | (np.abs(length - 1) < UNIT_TOLERANCE)).all():
                    add("poses", self.where, f"a quaternion of {key} is not of length 1")
        if INTRINSICS_KEY in columns and not (columns[INTRINSICS_KEY] > 0).all():
            add("poses", self.where, f"{INTRINSICS_KEY} are not above 0: the camera is not calibrated")  # fmt: skip

    def _duplicate(self, columns: dict[str, np.ndarray]) -> None:
        digest = hashlib.sha256()
        for key in self.checks.floats:
            digest.update(columns[key].tobytes())
        if not self.checks.floats:
            for camera in self.cameras.values():
                digest.update(camera.digest.digest())
        first = self.checks.seen.setdefault(digest.hexdigest(), self.k)
        if first != self.k:
            self.checks.said.add(
                "duplicate", self.where, f"holds the same numbers as episode {first}"
            )

    def _cameras(self, state: np.ndarray | None) -> None:
        add, where = self.checks.said.add, self.where
        for key, camera in self.cameras.items():
            if key not in self.checks.depths:
                self.checks.brightness[key].append((camera.brightness, camera.frames))
            if camera.frames > 1 and camera.longest == camera.frames:
                add("dead_camera", where, f"{key} never changes")
            elif camera.plain == camera.frames:
                add("dead_camera", where, f"every picture of {key} is of one colour")
            elif state is not None and _stands_still(camera, state):
                a, b = camera.longest_at, camera.longest_at + camera.longest - 1
                add("dead_camera", where, f"{key} stands still from frame {a} to {b} while the robot moves")  # fmt: skip
            if camera.strange:
                add("palette", where, f"{key} holds greys that are no label")

    def _compare(self, columns: dict[str, np.ndarray], episode: Episode) -> None:
        where = f"{self.where} ({episode.id})"
        add = self.checks.said.add
        if not self.comparable:
            add("differs", where, f"has {len(self.tasks)} frames, {episode.num_frames} were recorded")  # fmt: skip
            return
        if self.wrong_pixels:
            add("differs", where, f"{self.wrong_pixels} mask pixels differ from what was drawn")
        if self.wrong_pictures:
            add("differs", where, f"{self.wrong_pictures} pictures differ from what was drawn")
        recorded = {
            STATE_KEY: episode.state,
            ACTION_KEY: episode.action,
            SUCCESS_KEY: episode.success[:, None],
        }
        recorded |= {k: v.reshape(len(v), -1) for k, v in episode.simulated.items()}
        if INTERVENTION_KEY in columns:
            recorded[INTERVENTION_KEY] = episode.expert_acted[:, None]
        elif episode.is_handover:
            add("differs", where, f"{INTERVENTION_KEY} was recorded and is no column")
        for key, values in recorded.items():
            if key in columns and not np.array_equal(columns[key].reshape(values.shape), values):
                add("differs", where, f"{key} differs from what was recorded")
        if set(self.tasks) != {episode.task}:
            add("differs", where, f"says '{self.tasks[0]}', recorded was '{episode.task}'")


class _Camera:
    """The pictures of one camera in one episode, of which only the last is kept."""

    def __init__(self, *, hashed: bool) -> None:
        self.hashed = hashed
        self.last: np.ndarray | None = None
        self.frames = 0
        self.plain = 0
        self.brightness = 0.0
        self.strange = False
        self.run = self.longest = self.longest_at = 0
        self.digest = hashlib.sha256()

    def look_at(self, picture: np.ndarray) -> None:
        is_same = self.last is not None and np.array_equal(picture, self.last)
        self.run = self.run + 1 if is_same else 1
        self.frames += 1
        if self.run > self.longest:
            self.longest, self.longest_at = self.run, self.frames - self.run
        low, high = picture.min(), picture.max()
        self.plain += bool(low == high)
        self.brightness += float(picture.mean()) / (255.0 if picture.dtype == np.uint8 else 1.0)
        if self.hashed:
            self.digest.update(picture.tobytes())
        self.last = picture


def _stands_still(camera: _Camera, state: np.ndarray) -> bool:
    if camera.longest < max(FROZEN_FRAMES, FROZEN_SHARE * camera.frames):
        return False
    during = state[camera.longest_at : camera.longest_at + camera.longest]
    whole = np.ptp(state, axis=0)
    moves = whole > 1e-6
    return bool((np.ptp(during, axis=0)[moves] >= FROZEN_MOTION * whole[moves]).any())


def _is_depth(feature: dict[str, Any]) -> bool:
    info = feature.get("info") or {}
    return bool(info.get("is_depth_map") or info.get("video.is_depth_map"))
