"""What `v2p deploy` does around a robot, for robots that LeRobot's own tools drive: masks, limits, a check of the policy."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from lerobot.configs import parser

from lerobot_policy_v2p.robot.config_arm import ArmRobotConfig
from v2p_data.deployment.checks import check_meaning
from v2p_data.deployment.limits import Guard
from v2p_data.deployment.robot import ActionScale, Reading, Rig
from v2p_data.deployment.sight import LOST_AFTER, Sight, clicks_from
from v2p_data.deployment.steps import StepMaker
from v2p_data.errors import V2PError
from v2p_data.sim.render.masks import labels_to_rgb
from v2p_data.twin.interface import RGB_NAME

logger = logging.getLogger(__name__)


class Unattended:
    """Sees and limits for one connected robot, from its first observation to its last.

    Args:
        robot: the connected one; can be told to hold.
        config: its settings.
        own_mask: returns the label greys of now, h x w x 3 uint8, where nothing is clicked.
        picture: returns the colour picture of the last state, where something is clicked.
        is_limited: actions pass `config.limits`.

    Raises:
        V2PError: the clicks cannot be read, or the camera sees too little of what the training camera sees.
    """

    def __init__(
        self,
        robot: Any,
        config: ArmRobotConfig,
        own_mask: Callable[[], UInt8[np.ndarray, "h w 3"]],
        picture: Callable[[], UInt8[np.ndarray, "h w 3"]],
        *,
        is_limited: bool = True,
    ) -> None:
        self._rig = Rig(robot)
        self._own_mask, self._picture = own_mask, picture
        self._sight: Sight | None = None
        if config.clicks:
            clicks = clicks_from(config.clicks.split())
            self._sight = Sight(robot.calibration(), clicks, training_view=config.training_view)
        self._guard = Guard(config.limits, self._rig.scale) if is_limited else None
        self._maker = StepMaker(config.interface, self._rig.scale)
        self._has_seen = self._has_acted = False

    def mask(self, state: dict[str, Any]) -> UInt8[np.ndarray, "h w 3"]:
        """Return the label greys that belong to a state.

        Raises:
            V2PError: what was clicked is not found or lost; the robot then holds its position.
        """
        if self._sight is None:
            return self._own_mask()
        reading = self._rig.reading_of({**state, RGB_NAME: self._picture()})
        try:
            seen = self._sight.see(reading) if self._has_seen else self._sight.start(reading)
        except V2PError:
            self._rig.hold()
            raise
        self._has_seen = True
        if max(seen.missed) >= LOST_AFTER:
            self._rig.hold()
            raise V2PError(
                f"object {int(np.argmax(seen.missed)) + 1} is no longer seen; the robot holds its position"
            )
        return labels_to_rgb(seen.labels)

    def step(
        self, action: Float[np.ndarray, " act"], state: dict[str, Any]
    ) -> Float[np.ndarray, "7"]:
        """Return the step of the tool that an action asks for, and may be done.

        Args:
            action: wanted, as the policy says it.
            state: of the last observation, by name.

        Raises:
            LimitStop: a limit ends the run; the robot then holds its position.
        """
        reading = self._rig.reading_of(state)
        step = self._maker.step(action, reading)
        if self._guard is not None:
            step = self._limited(self._guard, step, reading)
        self._maker.sent(step, reading)
        return step

    def _limited(
        self, guard: Guard, step: Float[np.ndarray, "7"], reading: Reading
    ) -> Float[np.ndarray, "7"]:
        try:
            (guard.look if self._has_acted else guard.check_start)(reading)
            self._has_acted = True
            return guard.limit(step, reading).action
        except V2PError:
            self._rig.hold()
            raise


def check_policy_of(config: ArmRobotConfig, scale: ActionScale, task: str) -> None:
    """Compare the policy that is about to act with a robot; say so where it is not known or not here.

    LeRobot's tools do not tell a robot which policy acts; their parser knows what `--policy.path` says.

    Args:
        config: the robot's settings.
        scale: what an action of 1 means on it.
        task: in words, of a simulated robot; LeRobot's `--task` comes first.

    Raises:
        V2PError: its palette, names, rate or action scale are not the robot's.
    """
    path = config.policy_path or parser.get_path_arg("policy") or ""
    if not path or not config.check_policy:
        return
    if not Path(path).is_dir():
        logger.warning(
            "the policy %s is no folder here, so its action scale is not checked; fetch it and say --robot.policy_path=FOLDER",
            path,
        )  # fmt: skip
        return
    check_meaning(Path(path), scale, parser.parse_arg("task") or task, config.interface)
