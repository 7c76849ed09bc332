"""States on which task code is tried before anything trains on it: made up, but such as the simulator gives.

A batch is a dict of float32 arrays with the keys of `task.ROBOT_STATES` and `task.OBJECT_STATES`; all rows
obey what those tables say (`up` agrees with `quat`, `touched` is set where `grasped` is, ...).
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial.transform import Rotation

from v2p_data.kinds import KINDS
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.task.task import BASE_OBSERVATION_DIM

WORKSPACE_M = ((0.35, -0.3), (0.7, 0.3))
"""Corners of the part of the table that the gripper reaches."""
GRIPPER_OPENING_M = 0.085
HAND_HEIGHT_M = 0.2
EEF_DOWN_WXYZ = (0.0, 1.0, 0.0, 0.0)

States = dict[str, Float32[np.ndarray, "..."]]


@dataclass(kw_only=True)
class ObjectProbe:
    """Where one object is and what it does, for the rows of a batch."""

    pos: Float[np.ndarray, "env 3"]
    quat: Float[np.ndarray, "env 4"]
    size: Float[np.ndarray, "*env 3"]
    """One for all rows, or one per row."""
    start_pos: Float[np.ndarray, "env 3"]
    start_quat: Float[np.ndarray, "env 4"]
    vel_linear: Float[np.ndarray, "env 3"]
    vel_angular: Float[np.ndarray, "env 3"]
    grasped: Float[np.ndarray, "env"]
    touched: Float[np.ndarray, "env"]

    @staticmethod
    def still(
        pose: Float[np.ndarray, "env 7"], start: Float[np.ndarray, "env 7"], obj: SceneObject
    ) -> "ObjectProbe":
        """Return an object that rests at `pose` and was at `start` when the episode began."""
        n = len(pose)
        return ObjectProbe(
            pos=pose[:, :3],
            quat=pose[:, 3:],
            size=np.asarray(obj.size_m),
            start_pos=start[:, :3],
            start_quat=start[:, 3:],
            vel_linear=np.zeros((n, 3)),
            vel_angular=np.zeros((n, 3)),
            grasped=np.zeros(n),
            touched=np.zeros(n),
        )


@dataclass(kw_only=True)
class Probe:
    """A batch of moments of one scene; edit its arrays, then ask for `states()`."""

    eef_pos: Float[np.ndarray, "env 3"]
    gripper_width: Float[np.ndarray, "env"]
    objects: dict[str, ObjectProbe] = field(default_factory=dict[str, ObjectProbe])
    eef_vel_linear: Float[np.ndarray, "env 3"] | None = None
    progress: float = 0.5

    def __len__(self) -> int:
        return len(self.eef_pos)

    def states(self) -> States:
        """Return what task code would see."""
        n = len(self)
        states: dict[str, np.ndarray] = {
            "eef_pos": self.eef_pos,
            "eef_quat": np.tile(EEF_DOWN_WXYZ, (n, 1)),
            "eef_vel_linear": np.zeros((n, 3))
            if self.eef_vel_linear is None
            else self.eef_vel_linear,
            "eef_vel_angular": np.zeros((n, 3)),
            "gripper_width": self.gripper_width,
            "table_height": np.zeros(n),
            "progress": np.full(n, self.progress),
            "base_observation": np.zeros((n, BASE_OBSERVATION_DIM)),
        }
        for name, o in self.objects.items():
            up = Rotation.from_quat(o.quat, scalar_first=True).as_matrix()[:, 2, 2]
            states |= {
                f"{name}_pos": o.pos,
                f"{name}_quat": o.quat,
                f"{name}_vel_linear": o.vel_linear,
                f"{name}_vel_angular": o.vel_angular,
                f"{name}_size": np.broadcast_to(o.size, (n, 3)),
                f"{name}_start_pos": o.start_pos,
                f"{name}_start_quat": o.start_quat,
                f"{name}_up": up,
                f"{name}_grasped": o.grasped,
                f"{name}_touched": np.maximum(o.touched, o.grasped),
            }
        return {k: np.ascontiguousarray(v, np.float32) for k, v in states.items()}


def rest_height(obj: SceneObject, quat_wxyz: Float[np.ndarray, "4"]) -> float:
    """Return how high the centre of its bounding box is above the table when it rests turned like this [m]."""
    return float(rest_heights(obj, quat_wxyz[None], np.asarray(obj.size_m)[None])[0])


def rest_heights(
    obj: SceneObject, quat_wxyz: Float[np.ndarray, "n 4"], size_m: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n"]:
    """Return `rest_height` of copies of an object, turned and sized one by one [m]."""
    up = Rotation.from_quat(quat_wxyz, scalar_first=True).as_matrix()[:, 2]
    half = size_m / 2
    if obj.shape == "sphere":
        return half.max(axis=1)
    if obj.shape == "cylinder":
        return half[:, 0] * np.hypot(up[:, 0], up[:, 1]) + half[:, 2] * np.abs(up[:, 2])
    return (np.abs(up) * half).sum(axis=1)


def at_rest(scene: Scene, count: int = 1, centre: tuple[float, float] = (0.5, 0.0)) -> Probe:
    """Return the scene's first moment, the manipulated object standing at `centre`, the open gripper above."""
    n = count
    probe = Probe(
        eef_pos=np.tile([centre[0], centre[1], HAND_HEIGHT_M], (n, 1)),
        gripper_width=np.full(n, GRIPPER_OPENING_M),
        progress=0.02,
    )
    origin = first_pose(scene.manipulated)[:2]
    for obj in scene.objects:
        pose = first_pose(obj)
        pose[:3] = *(pose[:2] - origin + centre), rest_height(obj, pose[3:])
        probe.objects[obj.name] = ObjectProbe.still(
            np.tile(pose, (n, 1)), np.tile(pose, (n, 1)), obj
        )
    _spread(probe, scene)
    return probe


def first_pose(obj: SceneObject) -> Float[np.ndarray, "7"]:
    """Return its first pose in the video, laid down where a hand held it; upright at the origin where it has none."""
    if not obj.poses_world:
        return np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    return obj.laid_pose.copy()


def turned(
    yaw_rad: Float[np.ndarray, "n"], quat_wxyz: Float[np.ndarray, "n 4"]
) -> Float[np.ndarray, "n 4"]:
    """Return orientations turned about the vertical."""
    turn = Rotation.from_rotvec(np.column_stack([0 * yaw_rad, 0 * yaw_rad, yaw_rad]))
    return (turn * Rotation.from_quat(quat_wxyz, scalar_first=True)).as_quat(scalar_first=True)


def random_states(scene: Scene, count: int, rng: np.random.Generator) -> States:
    """Return moments drawn at random: objects on the table or carried, the hand anywhere, things moving."""
    probe = at_rest(scene, count)
    low, high = np.array(WORKSPACE_M)
    probe.eef_pos = np.column_stack(
        [rng.uniform(low, high, (count, 2)), rng.uniform(0.02, 0.4, count)]
    )
    probe.gripper_width = rng.uniform(0, GRIPPER_OPENING_M, count)
    probe.eef_vel_linear = rng.normal(0, 0.1, (count, 3))
    for o in probe.objects.values():
        o.size = o.size * rng.uniform(0.85, 1.15, (count, 3))
        shift = np.column_stack([rng.uniform(-0.1, 0.1, (count, 2)), np.zeros(count)])
        o.start_pos = o.start_pos + shift
        o.start_quat = turned(rng.uniform(-np.pi, np.pi, count), o.start_quat)
        tilt = Rotation.from_rotvec(rng.normal(0, 0.3, (count, 3)))
        o.quat = (tilt * Rotation.from_quat(o.start_quat, scalar_first=True)).as_quat(
            scalar_first=True
        )
        lifted = rng.random(count) < 0.4
        o.pos = o.start_pos + rng.normal(0, 0.05, (count, 3)) * [1, 1, 0]
        o.pos[:, 2] += np.where(lifted, rng.uniform(0, 0.25, count), 0)
        o.vel_linear = rng.normal(0, 0.2, (count, 3)) * lifted[:, None]
        o.vel_angular = rng.normal(0, 1.0, (count, 3)) * lifted[:, None]
        o.grasped = (lifted & (rng.random(count) < 0.7)).astype(float)
        o.touched = (rng.random(count) < 0.3).astype(float)
    states = probe.states()
    states["base_observation"] = rng.normal(0, 1, (count, BASE_OBSERVATION_DIM)).astype(np.float32)
    return states


def concatenated(batches: list[States]) -> States:
    """Return one batch with the rows of all."""
    return {k: np.concatenate([b[k] for b in batches]) for k in batches[0]}


def _spread(probe: Probe, scene: Scene) -> None:
    """Move other objects away from the manipulated one where their first poses overlap."""
    main = probe.objects[scene.manipulated.name]
    for obj in scene.others:
        other = probe.objects[obj.name]
        gap = other.pos[:, :2] - main.pos[:, :2]
        distance = np.linalg.norm(gap, axis=1, keepdims=True)
        wanted = 0.02 + (max(obj.size_m[:2]) + max(scene.manipulated.size_m[:2])) / 2
        direction = np.where(distance > 1e-3, gap / np.maximum(distance, 1e-3), [1.0, 0.0])
        if not KINDS[scene.kind].starts_over:
            other.pos[:, :2] = main.pos[:, :2] + direction * np.maximum(distance, wanted)
        other.start_pos = other.pos.copy()
