"""An arm behind a driver that speaks the protocol of docs/deploy.md, for the robot type `v2p_franka`.

Actions become Cartesian targets here, with the scale and the leashes of the training; the driver brings the tool there.
"""

import numpy as np
from jaxtyping import Float

from lerobot_policy_v2p.robot.config_v2p_franka import V2PFrankaConfig
from v2p_data.deployment.protocol import Driver, Sample
from v2p_data.deployment.robot import ActionScale
from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera
from v2p_data.sim.env.batch_env import SimConfig
from v2p_data.sim.env.targets import next_target
from v2p_data.twin.interface import RGB_PX


class NetworkArm:
    """A driver's arm."""

    is_real = is_limited = True
    action_scale, has_succeeded, task_description = ActionScale(), False, ""

    def __init__(self, config: V2PFrankaConfig) -> None:
        self.cfg = SimConfig()
        self.driver = Driver(config.address, config.timeout_s)
        self.hello = self.driver.hello()
        camera = self.hello.camera
        if (camera.width_px, camera.height_px) != (RGB_PX, RGB_PX):
            raise V2PError(
                f"the driver at {config.address} gives pictures of {camera.width_px} x {camera.height_px} pixels, and"
                f" policies see {RGB_PX} x {RGB_PX}; let it crop and scale them, and K with them"
            )
        self.seen: Sample = self._read()
        self.target = self.seen.tool

    def state(self) -> Float[np.ndarray, "11"]:
        """Ask the driver and return `observation.state`."""
        self.seen = self._read()
        return self.seen.tool.state(self.target)

    def mask(self) -> np.ndarray:
        raise V2PError("the network driver gives no masks; say what to track with --robot.clicks")

    def picture(self) -> np.ndarray:
        return self.seen.picture

    def calibration(self) -> Camera:
        return self.hello.camera

    def joints(self) -> Float[np.ndarray, "7"]:
        return self.seen.joints_rad

    def opening(self) -> float:
        return self.seen.tool.opening

    def force_n(self) -> float | None:
        return self.seen.force_n

    def carry_out(self, step: Float[np.ndarray, "7"]) -> None:
        """Send the target after one step."""
        self.target = next_target(
            self.target, self.seen.tool, step, self.cfg, self.hello.finger_travel_m
        )
        self.driver.target(self.target)

    def hold(self) -> None:
        """Tell the driver to stay."""
        self.driver.hold()
        self.target = self.seen.tool

    def close(self) -> None:
        self.driver.close()

    def _read(self) -> Sample:
        return self.driver.read((RGB_PX, RGB_PX))
