"""What happens in an episode, in words with exact times: LeRobot's language columns, from contacts, poses and states.

LeRobot fills them with a model that looks at the pictures (`lerobot-annotate`); here each word
follows from numbers of the dataset. Its own validator and writer are used. In directions of the
robot's base: forward is +x, left +y, up +z.
"""

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from jaxtyping import Bool, Float

from v2p_data.episodes.dataset.features import (
    CAMERA_POSE_KEY,
    CONTACT_KEY,
    INTRINSICS_KEY,
    OBJECT_POSE_KEY,
    SLOTS,
    STATE_KEY,
    SUCCESS_KEY,
)
from v2p_data.episodes.dataset.tables import INFO_FILE, camera_keys, read_info
from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera
from v2p_data.geometry.pose import transform_from_pose
from v2p_data.geometry.rotation import conjugates, product

ASKED = (
    "{}",
    "please {}",
    "{}, please",
    "can you {}?",
    "could you {}?",
    "I want you to {}",
    "now {}",
    "go ahead and {}",
    "your task is to {}",
    "the robot should {}",
)
LOSE_E = ("close", "move", "place", "poke", "raise", "remove", "shove", "slide", "take")
"""Verbs whose last letter is lost before -ing."""
WORDS = (("forward", "back"), ("left", "right"), ("up", "down"))
MOVED_M = 0.005
"""An object that is so far from its first place has been moved."""
STILL_M, GRIPPER_STILL = 0.002, 0.02
"""A tool that moves less in a row, and fingers whose opening (0 to 1) changes less, stand still."""
TIPPED_RAD = np.pi / 4
"""An object that leans by more than that from where it stood lies on another side."""
SHORTEST_ROWS = 2
"""Motions that last less are no words of their own (0.1 s)."""


def paraphrases(task: str) -> list[str]:
    """Return ten ways to ask for a task, whose caption says what is done ("Lifting the cup") or to do ("Lift it")."""
    verb, _, rest = task.strip().rstrip(".").partition(" ")
    verb = verb.lower()
    if verb.endswith("ing") and len(verb) > 5:
        verb = verb[:-3]
        if f"{verb}e" in LOSE_E:
            verb += "e"
        elif verb[-1] == verb[-2] and verb[-1] not in "ls":
            verb = verb[:-1]
    return [way.format(f"{verb} {rest}".strip()) for way in ASKED]


def subtasks(
    name: str,
    poses: Float[np.ndarray, "time 7"],
    touches: Bool[np.ndarray, "time part"],
    success: Bool[np.ndarray, "time"],
) -> dict[int, str]:
    """Return what the robot does with an object, by the first row of each part.

    Args:
        name: of the object.
        poses: of its centre [m] and quaternion wxyz, in the robot's base frame.
        touches: whether the left pad, the right pad, and, where it is known, the hand touches it.
        success: whether success has held by the end of the row's action.
    """
    places, rows = poses[:, :3], np.flatnonzero(touches.any(1))
    moved = np.flatnonzero(np.linalg.norm(places - places[0], axis=1) > MOVED_M)
    done = np.flatnonzero(success) + 1
    is_grasped = bool(touches[:, :2].all(1).any())
    parts = {0: f"reach for the {name}"}
    if len(rows):
        parts[int(rows[0])] = f"grasp the {name}" if is_grasped else f"touch the {name}"
        moved = moved[moved >= rows[0]]
        if len(moved):
            tips = not is_grasped and has_tipped(poses)
            doing = "carry" if is_grasped else "tip" if tips else "push"
            last = -1 if tips else rows[-1]  # it falls by itself
            way = direction((places[last] - places[0]) * (1, 1, not tips))
            parts[int(moved[0])] = f"{doing} the {name} {way}"
        parts.setdefault(int(rows[-1]) + 1, f"let go of the {name}")
    if len(done):
        parts[int(done[0])] = "stay"
    return {row: parts[row] for row in sorted(parts) if row < len(places)}


def has_tipped(poses: Float[np.ndarray, "time 7"]) -> bool:
    """Tell whether an object ends on another side; one that rolls keeps its height all the way."""
    _, x, y, _ = product(poses[-1:, 3:].T, conjugates(poses[:1, 3:].T))
    leans = 1 - 2 * (x**2 + y**2) < np.cos(TIPPED_RAD)
    return bool(leans.all() and np.ptp(poses[:, 2]) > MOVED_M)


def motions(state: Float[np.ndarray, "time 11"]) -> dict[int, str]:
    """Return how tool and fingers move, by the first row of each motion."""
    words_at: dict[int, str] = {}
    words = [_motion(step) for step in np.diff(state, axis=0)]
    for row, word in enumerate(words):
        is_new = not words_at or words_at[max(words_at)] != word
        if is_new and (row == 0 or words[row : row + SHORTEST_ROWS] == [word] * SHORTEST_ROWS):
            words_at[row] = word
    return words_at


def direction(way: Float[np.ndarray, "3"]) -> str:
    """Return a displacement in words, the largest part first; parts of less than half of it are left out."""
    size = np.abs(way)
    large = [k for k in np.argsort(-size) if size[k] >= size.max() / 2]
    return " and ".join(WORDS[k][int(way[k] < 0)] for k in large)


def _motion(step: Float[np.ndarray, "11"]) -> str:
    words = [f"move {direction(step[:3])}"] if np.linalg.norm(step[:3]) > STILL_M else []
    if abs(step[6]) > GRIPPER_STILL:
        words.append(f"{'open' if step[6] > 0 else 'close'} the gripper")
    return ", ".join(words) or "hold still"


def write_language(root: Path, about: Mapping[str, Any] | None) -> None:
    """Write the columns into the dataset at `root`, which nobody else reads yet.

    Args:
        root: a dataset of ours.
        about: its `meta/v2p.json`, None where it is somebody else's.

    Raises:
        V2PError: the episodes are not a simulator's.
    """
    from lerobot.annotations.steerable_pipeline.reader import iter_episodes
    from lerobot.annotations.steerable_pipeline.staging import EpisodeStaging
    from lerobot.annotations.steerable_pipeline.validator import StagingValidator
    from lerobot.annotations.steerable_pipeline.writer import LanguageColumnsWriter
    from lerobot.datasets.language import language_feature_info

    info = read_info(root)
    if about is None or CONTACT_KEY not in info["features"]:
        raise V2PError(
            f"{INFO_FILE} names no column {CONTACT_KEY}, from which the words' times follow; only "
            "episodes that this version "
            "of v2p simulated have it, so leave out --language or collect them anew with 'v2p episodes'"
        )
    records = list(iter_episodes(root))
    with tempfile.TemporaryDirectory() as staging:
        for record in records:
            table = pq.read_table(record.data_path).slice(record.row_offset, record.row_count)
            persistent, events = _rows(table, about["episodes"][record.episode_index], info)
            episode = EpisodeStaging(Path(staging), record.episode_index)
            episode.write("plan", persistent)
            episode.write("vqa", events)
        cameras = tuple(camera_keys(info))
        report = StagingValidator(dataset_camera_keys=cameras).validate(records, Path(staging))
        if not report.ok:
            raise RuntimeError(f"LeRobot finds the words wrong: {report.errors[0]}")
        LanguageColumnsWriter().write_all(records, Path(staging), root)
    info["features"] |= language_feature_info()
    (root / INFO_FILE).write_text(json.dumps(info, indent=4, ensure_ascii=False), encoding="utf-8")


def _rows(
    table: Any, entry: Mapping[str, Any], info: Mapping[str, Any]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return what lasts and what happens at a moment in an episode, in LeRobot's words."""

    def numbers(key: str) -> np.ndarray:
        return np.array(table.column(key).to_pylist(), float)

    times = table.column("timestamp").to_pylist()
    poses, state = numbers(OBJECT_POSE_KEY)[:, :7], numbers(STATE_KEY)
    name = str(entry["labels"].get("2", "object")).replace("_", " ")
    touches = numbers(CONTACT_KEY).reshape(len(times), SLOTS, -1)[:, 0] > 0
    parts = subtasks(name, poses, touches, numbers(SUCCESS_KEY) > 0)
    plan = "\n".join(f"{k}. {part}" for k, part in enumerate(parts.values(), start=1))
    rows = [(0, "user", "task_aug", words) for words in paraphrases(entry["task"])]
    rows += [(0, "assistant", "plan", plan)]
    rows += [(row, "assistant", "subtask", words) for row, words in parts.items()]
    rows += [(row, "assistant", "motion", words) for row, words in motions(state).items()]
    persistent = [
        {"role": role, "content": content, "style": style, "timestamp": times[row]}
        for row, role, style, content in rows
    ]
    fx, fy, cx, cy = numbers(INTRINSICS_KEY)[0]
    lens = Camera(
        width_px=0,
        height_px=0,
        K=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        T_world_cam=transform_from_pose(numbers(CAMERA_POSE_KEY)[0]),
    )

    def seen(points: np.ndarray) -> list[list[float]]:
        return np.round(lens.project(points), 1).tolist()

    events: list[dict[str, Any]] = []
    ends = [*list(parts)[1:], len(times)]
    for row, end in zip(parts, ends, strict=True):
        for camera in camera_keys(dict(info)):
            point = {
                "label": name,
                "point_format": "xy",
                "point": seen(poses[row : row + 1, :3])[0],
            }
            trace = {"label": "gripper", "point_format": "xy", "points": seen(state[row:end, :3])}
            events += [
                {
                    "role": role,
                    "content": content,
                    "style": style,
                    "timestamp": times[row],
                    "camera": camera,
                }
                for role, style, content in (
                    ("user", "vqa", f"Where is the {name}?"),
                    ("assistant", "vqa", json.dumps(point)),
                    ("assistant", "trace", json.dumps(trace)),
                )
            ]
    return persistent, events
