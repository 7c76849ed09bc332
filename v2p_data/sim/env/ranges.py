"""How much is drawn anew from episode to episode: the ranges, and those without any chance."""

from dataclasses import dataclass

import numpy as np

from v2p_data.sim.model.world import CAMERA_FOVY_DEG

POSSIBLE = {
    "_scale": (0.01, 100.0),
    "delay_s": (0.0, 0.02),
    "_m": (0.0, 1.0),
    "_rad": (0.0, 2 * float(np.pi)),
    "_deg": (0.0, CAMERA_FOVY_DEG - 1.0),
    "action_noise": (0.0, 10.0),
}
"""Lowest and highest value of a range, by how its name ends."""


@dataclass(frozen=True, kw_only=True)
class RandomizationConfig:
    """Ranges of what is drawn at each reset. Pairs are (lowest, highest) factors or values.

    By default experts train under what is recorded (the paper's list), so that they are at home there.
    """

    size_scale: tuple[float, float] = (0.9, 1.1)
    """Per axis, independently; one factor for both axes of round things, one for all of a mesh."""
    mass_scale: tuple[float, float] = (0.6, 1.6)
    friction_scale: tuple[float, float] = (0.8, 1.2)
    object_pos_m: float = 0.10
    """Objects are shifted together by up to this much along x and y."""
    layout_distance_scale: tuple[float, float] = (0.85, 1.2)
    """Scale of the distance between manipulated and reference object."""
    layout_angle_rad: float = 0.35
    """The direction from manipulated to reference object turns by up to this much."""
    yaw_rad: float = float(np.pi)
    """Each object turns about the vertical by up to this much."""
    arm_pos_m: tuple[float, float, float] = (0.09, 0.12, 0.05)
    """The tool starts within this distance of its home position, per axis."""
    arm_yaw_rad: float = 0.4
    action_noise: float = 0.02
    """Standard deviation added to actions in [-1, 1] before they are carried out."""
    delay_s: tuple[float, float] = (0.010, 0.020)
    """From command to servo, constant during an episode."""
    servo_gain_scale: tuple[float, float] = (0.9, 1.1)
    """Scale of stiffness and of damping, drawn one by one for all servos; the tool lags by damping / stiffness."""
    camera_pos_m: float = 0.0
    """The camera is shifted by up to this much, per axis. 0 is the fixed camera that policies of earlier datasets know;
    a policy that shall stand a moved camera is recorded, and then evaluated, with more."""
    camera_angle_rad: float = 0.0
    """The camera is turned by up to this much about each of its own axes."""
    camera_fovy_deg: float = 0.0
    """The camera's vertical field of view changes by up to this much."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            low, high = next(
                limits for ending, limits in POSSIBLE.items() if name.endswith(ending)
            )
            if not all(low <= v <= high for v in np.ravel(value)):
                raise ValueError(f"{name} is {value}; {low:g} to {high:g} can be simulated")
            if name.endswith(("_scale", "_s")) and value[0] > value[1]:
                raise ValueError(f"{name} is {value}; the lowest comes first")


def none() -> RandomizationConfig:
    """Return the video's layout about the workspace centre, true sizes, no noise and no delay."""
    one = (1.0, 1.0)
    return RandomizationConfig(
        size_scale=one,
        mass_scale=one,
        friction_scale=one,
        object_pos_m=0.0,
        layout_distance_scale=one,
        layout_angle_rad=0.0,
        yaw_rad=0.0,
        arm_pos_m=(0.0, 0.0, 0.0),
        arm_yaw_rad=0.0,
        action_noise=0.0,
        delay_s=(0.0, 0.0),
        servo_gain_scale=one,
    )
