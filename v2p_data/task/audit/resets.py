"""Looks at where a task's own reset puts things, before anything is trained from there.

A reset can make a task easy: the object beside its goal, always at one place, or lying as it should come to lie. What
the sandboxed child was answered by the sample's reset is held against the layouts of the environment, which follow
the video. Poses that the environment itself drew are never faulted.
"""

import ast
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from v2p_data.kinds import KINDS
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.task.sandbox.probes import WORKSPACE_M, States, first_pose, rest_height
from v2p_data.task.sandbox.smoke import SmokeResult

CONSUMED = 0.5
"""An object that starts with less than this share of the video's way to go is near its goal."""
SHORT_WAY_M = 0.02
"""A way shorter than this is none."""
SPREAD_M = 0.04
"""Starts of the manipulated object lie at least this far apart, along x or along y."""
AROUND_VIDEO_M = 0.05
"""The video's own layout may lie this far outside of the starts."""
REACH_MARGIN_M = 0.06
"""How far from the workspace the manipulated object may start."""
TABLE_M = 1.4
SUNK_M, RAISED_M = 0.003, 0.01
"""How far below and above its support an object may start."""
LEANS_RAD = 0.35


@dataclass(frozen=True, kw_only=True)
class ResetFindings:
    """What is wrong with a reset, as shares of its starts."""

    solved: float = 0.0
    """Success is true."""
    impossible: float = 0.0
    """Objects off the table, in it, in the air or in each other; or the manipulated one out of reach."""
    near_goal: float = 0.0
    """Most of the video's way to the other object is done."""
    leaning: float = 0.0
    """The manipulated object does not stand as at the video's start."""
    spread_m: float = 1.0
    """The larger of the starts' ranges along x and y."""
    outside_m: float = 0.0
    """How far the video's layout lies outside of the starts."""


def has_own_reset(code: str) -> bool:
    """Tell whether task code places objects in another way than the environment does."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.FunctionDef) and node.name == "reset_objects_states":
            does = [s for s in node.body if not isinstance(s, ast.Expr)]
            asked = does[0].value if len(does) == 1 and isinstance(does[0], ast.Return) else None
            if not isinstance(asked, ast.Call) or not isinstance(asked.func, ast.Attribute):
                return True
            base = ("super().reset_objects_states", "self.envs.sample_object_poses")
            return ast.unparse(asked.func) not in base
    return False


def reset_findings(scene: Scene, offered: States, result: SmokeResult) -> ResetFindings:
    """Return what the sample's reset made of the layouts that it was offered.

    Args:
        scene: what was understood of the video.
        offered: the layouts.
        result: the child's answer.
    """
    rows = np.array(result.start_rows, int)
    if not len(rows):
        return ResetFindings()
    solved = np.array(result.start_success, bool)
    made, given = result.start_poses, _poses(scene, offered, rows)
    own = np.zeros(len(rows), bool)
    for name, pose in made.items():
        own |= ~np.isclose(pose, given[name], atol=1e-4).all(axis=1)
    if not own.any():
        return ResetFindings()
    at = made[scene.manipulated.name]
    return ResetFindings(
        solved=float((solved & own).mean()),
        impossible=float((_impossible(scene, made) & own).mean()),
        near_goal=float((_near_goal(scene, made, given) & own).mean()),
        leaning=float((_leans(scene.manipulated, at) & own).mean()),
        spread_m=float(np.ptp(at[:, :2], axis=0).max()),
        outside_m=_outside(scene, made, given),
    )


def _poses(scene: Scene, states: States, rows: np.ndarray) -> dict[str, np.ndarray]:
    return {
        o.name: np.concatenate([states[f"{o.name}_pos"], states[f"{o.name}_quat"]], axis=1)[rows]
        for o in scene.objects
    }


def _impossible(scene: Scene, poses: dict[str, np.ndarray]) -> Bool[np.ndarray, "start"]:
    objects = scene.objects
    low: dict[str, np.ndarray] = {}
    high: dict[str, np.ndarray] = {}
    for obj in objects:
        half = np.array([rest_height(obj, pose[3:]) for pose in poses[obj.name]])
        low[obj.name] = poses[obj.name][:, 2] - half
        high[obj.name] = poses[obj.name][:, 2] + half
    bad = np.zeros(len(poses[objects[0].name]), bool)
    for obj in objects:
        here, support = poses[obj.name], np.zeros(len(bad))
        for other in objects:
            if other is obj:
                continue
            there = poses[other.name]
            apart = np.linalg.norm(here[:, :2] - there[:, :2], axis=1)
            room = (min(obj.size_m[:2]) + min(other.size_m[:2])) / 2
            is_beside = (low[obj.name] < high[other.name] - SUNK_M) & (
                low[other.name] < high[obj.name] - SUNK_M
            )
            if not KINDS[scene.kind].starts_over:
                bad |= is_beside & (apart < room - SUNK_M)
            over = (apart < room) & (low[obj.name] > high[other.name] - SUNK_M)
            support = np.where(over, np.maximum(support, high[other.name]), support)
        above = low[obj.name] - support
        bad |= (above < -SUNK_M) | (above > RAISED_M)
        bad |= np.linalg.norm(here[:, :2], axis=1) > TABLE_M
    lowest, highest = np.array(WORKSPACE_M)
    at = poses[scene.manipulated.name][:, :2]
    out = (at < lowest - REACH_MARGIN_M) | (at > highest + REACH_MARGIN_M)
    return bad | out.any(axis=1)


def _near_goal(
    scene: Scene, made: dict[str, np.ndarray], given: dict[str, np.ndarray]
) -> Bool[np.ndarray, "start"]:
    """Tell where more than half of the video's way to the other object is done."""
    kind, none = KINDS[scene.kind], np.zeros(len(made[scene.manipulated.name]), bool)
    if not scene.others or not (kind.comes_near or kind.touches) or kind.grasps == "tool":
        return none
    thing, other = scene.manipulated, scene.others[0]
    if not thing.poses_world or not other.poses_world:
        return none
    end = float(np.linalg.norm(thing.last_pose[:2] - other.last_pose[:2]))
    way = _apart(given, thing, other) - end
    left = _apart(made, thing, other) - end
    return (way > SHORT_WAY_M) & (left < CONSUMED * way)


def _apart(
    poses: dict[str, np.ndarray], a: SceneObject, b: SceneObject
) -> Float[np.ndarray, "start"]:
    return np.linalg.norm(poses[a.name][:, :2] - poses[b.name][:, :2], axis=1)


def _leans(obj: SceneObject, poses: np.ndarray) -> Bool[np.ndarray, "start"]:
    """Tell where another side is up than at the video's start."""
    up = Rotation.from_quat(first_pose(obj)[3:], scalar_first=True).as_matrix()[2]
    ups = Rotation.from_quat(poses[:, 3:], scalar_first=True).as_matrix()[:, 2]
    return ups @ up < np.cos(LEANS_RAD)


def _outside(scene: Scene, made: dict[str, np.ndarray], given: dict[str, np.ndarray]) -> float:
    """Return how far the video's place, and the distance between its objects, lie outside of the starts [m]."""
    spans = [(made[scene.manipulated.name][:, k], (0.5, 0.0)[k]) for k in range(2)]
    spans.extend(
        (
            _apart(made, scene.manipulated, other),
            float(np.median(_apart(given, scene.manipulated, other))),
        )
        for other in scene.others
        if not KINDS[scene.kind].starts_over
    )
    return max(
        max(float(values.min()) - video, video - float(values.max()), 0.0)
        for values, video in spans
    )
