"""What a recipe is given, the video's own measurements, and what it hands over: a task in expressions."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from v2p_data.kinds import KINDS, Kind
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.task.sandbox.probes import first_pose

SPANNED_M = 0.083 / 0.9
"""Things up to here fit between the open pads in some episodes: sizes are drawn from nine tenths on."""


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What the video says about the manipulated object's motion, and about the sizes."""

    kind: Kind
    obj: SceneObject
    ref: SceneObject | None
    """The first other object."""
    move_m: tuple[float, float, float]
    """From the first to the last pose."""
    lift_m: float
    """The highest the centre came above its start."""
    beside_m: tuple[float, float] = (0.0, 0.0)
    """At the end, horizontally, from the first other object to the manipulated one."""
    stood: bool = True
    """Whether the object's axis that pointed up at first did so at the end, too."""

    @property
    def by_wall(self) -> bool:
        """Whether the gripper takes the manipulated object by a wall: it is open above and too wide for the pads."""
        is_cover = KINDS[self.kind].has_cover
        return self.obj.hollow and not is_cover and min(self.obj.size_m[:2]) > SPANNED_M

    @staticmethod
    def of(scene: Scene) -> "Measured":
        obj = scene.manipulated
        poses = np.array(obj.poses_world, float).reshape(-1, 7)
        if not len(poses):
            poses = first_pose(obj)[None]
        move = poses[-1, :3] - poses[0, :3]
        ref = scene.others[0] if scene.others else None
        at = np.array(ref.poses_world[-1][:2]) if ref and ref.poses_world else poses[-1, :2]
        ups = Rotation.from_quat(poses[[0, -1], 3:], scalar_first=True).as_matrix()[:, 2]
        return Measured(
            kind=scene.kind,
            obj=obj,
            ref=ref,
            beside_m=(float(poses[-1, 0] - at[0]), float(poses[-1, 1] - at[1])),
            stood=bool(ups[0] @ ups[1] > 0.8),
            move_m=(float(move[0]), float(move[1]), float(move[2])),
            lift_m=float(poses[:, 2].max() - poses[0, 2]),
        )


@dataclass(kw_only=True)
class Draft:
    """A task in expressions; `eef_pos`, `obj_pos`, `ref_pos` and the like are defined before them."""

    thoughts: list[str]
    """The chain of thought: the steps of the task."""
    setup: list[str] = field(default_factory=list[str])
    """Lines that success and reward share."""
    success: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    """(name, bool expression), the main condition first."""
    target: str = "obj_pos"
    """Point to which the gripper should go."""
    contact: str = "near"
    """Float expression: 1 while the gripper has the object."""
    pays_contact: bool = False
    """Whether contact is worth something by itself: where something must be grasped, see `grasp_setup`."""
    progress: str = "obj_pos[:, 2] * 0"
    """Float expression, 0 at the start and 1 when done."""
    remaining: str = "obj_pos[:, 2] * 0"
    """Metres left to go."""
    goal: str = "obj_pos"
    """Where the object should be."""
    direction: str = "goal_direction"
    """Unit vector in which the object should move."""
    extras: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    """Further reward components (name, expression), bonuses and penalties, with their weights."""
    reward_setup: list[str] = field(default_factory=list[str])
