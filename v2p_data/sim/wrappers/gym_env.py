"""One task as a Gymnasium environment, `v2p/Task-v0`: what a policy sees, does, and is judged by.

`gymnasium.make("v2p_data.sim.wrappers:v2p/Task-v0", task_folder=FOLDER)` makes it.

| | |
|---|---|
| Observation | `pixels/mask`: 256 x 256 x 3 uint8, label greys; `pixels/mask_wrist`, `pixels/rgb`: of the same size, if asked for; `agent_pos`: 11 float32, see `BatchEnv.robot_state`; with `joint_state` the angles of the arm's joints [rad] follow. `observation="flat"` puts all of them in one level, as Stable-Baselines3 wants it; `"states"`, of `v2p/States-v0`, shows what experts see |
| Action | Box(-1, 1, (7,)): delta position, delta rotation, gripper; 20 Hz; with `actions`, a target of the tool (7) or of the joints (8) |
| Reward | the task's training reward |
| Start | drawn under the randomisation that episodes are recorded under; `reset(seed=...)` repeats it exactly |
| End | terminated: success, or the simulation broke down; truncated: twice the task's horizon (`horizon_scale`) |
| Info | `is_success`: the task's own success has held for 0.25 s and the independent referee agrees |

The simulation runs at the fine time step: what the coarse one calls a success can be an object pressed
through the table.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.seeding import np_random
from jaxtyping import Float, Float32, UInt8

from v2p_data.errors import V2PError
from v2p_data.sim.env.actions import bounds_of, state_as_seen, steps_to
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig, Snapshot
from v2p_data.sim.env.ranges import RandomizationConfig
from v2p_data.sim.env.verdict import RefereeRecord
from v2p_data.sim.model.world import World
from v2p_data.sim.render.masks import (
    MASK_CAMERA,
    MASK_CAMERAS,
    RGB_CAMERA,
    MaskRenderer,
    labels_to_rgb,
)
from v2p_data.sim.robot.action_names import Actions
from v2p_data.sim.robot.interface import ArmInterface
from v2p_data.task.task import POLICY_HORIZON_SCALE, TaskBundle, errors_naming

CONTROL_HZ = 20
OBSERVATIONS = ("pictures", "flat", "states")
STATE_LOW = (-1.5, -1.5, -0.5, -np.pi, -np.pi, -np.pi, 0.0, -1.0, -1.0, -1.0, 0.0)
STATE_HIGH = (1.5, 1.5, 1.5, np.pi, np.pi, np.pi, 1.0, 1.0, 1.0, 1.0, 1.0)
"""Bounds of `BatchEnv.robot_state`."""


def state_bounds(num_joints: int) -> tuple[Float[np.ndarray, "state"], Float[np.ndarray, "state"]]:
    """Return the lowest and highest values of a state in which the angles of so many joints follow."""
    low, high = bounds_of("joints", num_joints)
    return np.array([*STATE_LOW, *low[:-1]]), np.array([*STATE_HIGH, *high[:-1]])


def within_bounds(state: Float[np.ndarray, "*env state"]) -> Float32[np.ndarray, "*env state"]:
    """Return a state, or several, as the environment shows it: within the bounds of its space."""
    low, high = state_bounds(state.shape[-1] - len(STATE_LOW))
    return np.clip(state, low, high).astype(np.float32)


def stream_seed(seed: int) -> int:
    """Return what `V2PEnv.reset(seed=seed)` seeds its world with, for `BatchEnv.reset_seeded`."""
    return _next_seed(np_random(seed)[0])


class V2PEnv(gym.Env[Any, np.ndarray]):
    """A single world of one task.

    Args:
        task_folder: folder with `task.json`, as `v2p task` writes it.
        size_px: width and height of the mask.
        render_mode: `rgb_array`, or None.
        camera_pos_m, camera_angle_rad, camera_fovy_deg: how far the camera is moved at each reset, as in
            `RandomizationConfig`; a policy is evaluated under what its dataset was recorded under.
        horizon_scale: an episode lasts at most this multiple of the task's own horizon.
        wrist: whether masks of the camera that the hand carries are seen too.
        rgb: whether the colour picture is seen too; needs OpenGL.
        observation: `pictures` in a level of their own, `flat`, or the simulator's `states` alone.
        actions: what an action says: `delta_tool`, `absolute_tool`, `joints`; see `sim.env.actions`.
        joint_state: whether the angles of the arm's joints [rad] follow in `agent_pos`.

    Raises:
        V2PError: the folder holds no task, or there is no such render mode.
        ItemRejectedError: the task cannot be simulated.
    """

    _spec: EnvSpec | None = None
    metadata = {"render_modes": ["rgb_array"], "render_fps": CONTROL_HZ}  # noqa: RUF012 - Gymnasium's attribute

    def __init__(
        self,
        task_folder: str,
        size_px: int = 256,
        render_mode: str | None = "rgb_array",
        *,
        camera_pos_m: float = 0.0,
        camera_angle_rad: float = 0.0,
        camera_fovy_deg: float = 0.0,
        horizon_scale: float = POLICY_HORIZON_SCALE,
        wrist: bool = False,
        rgb: bool = False,
        observation: str = "pictures",
        actions: Actions = "delta_tool",
        joint_state: bool = False,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise V2PError(f"render_mode is 'rgb_array' or None, got {render_mode!r}")
        if observation not in OBSERVATIONS:
            raise V2PError(f"observation is one of {', '.join(OBSERVATIONS)}, got {observation!r}")
        bundle = TaskBundle.load(Path(task_folder))
        self.render_mode = render_mode
        self.task = bundle.title
        self.task_description = bundle.description
        self._max_episode_steps = bundle.policy_steps(horizon_scale)
        self._num_steps = 0
        randomization = replace(
            RandomizationConfig(),
            camera_pos_m=camera_pos_m,
            camera_angle_rad=camera_angle_rad,
            camera_fovy_deg=camera_fovy_deg,
        )
        sim = SimConfig(fine=True, randomization=randomization)
        with errors_naming(bundle.folder):
            self._world = BatchEnv(bundle, sim, num_envs=1, seed=0, num_threads=1)
        self._referee = RefereeRecord(self._world)
        self._masks = MaskRenderer(self._world.world, size_px, wrist=wrist)
        self._cameras, self._rgb = MASK_CAMERAS[: 1 + wrist], rgb
        self._shows = observation
        self._interface = ArmInterface(actions=actions, joint_state=joint_state)
        num_joints = self.world.robot.num_joints
        self.observation_space = self._space(size_px, num_joints * joint_state)
        low, high = bounds_of(actions, num_joints)
        self.action_space = spaces.Box(np.array(low, np.float32), np.array(high, np.float32))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; with a seed, always the same one.

        Raises:
            V2PError: there are options.
        """
        # LeRobot's own options tell that a rollout begins.
        unheeded = [str(name) for name in options or () if not str(name).startswith("lerobot_")]
        if unheeded:
            raise V2PError(
                f"reset takes a seed and no options, got {', '.join(unheeded)}; what can be set is given when the "
                "environment is made"
            )
        super().reset(seed=seed)
        self._world.seed(_next_seed(self.np_random))
        self._world.reset(np.array([0]))
        self._num_steps = 0
        self._referee.restart()
        return self._observe(), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Carry out one action.

        A step of the tool is clipped to [-1, 1], a target is gone for as far as one step leads.

        Raises:
            V2PError: it has another number of entries.
        """
        target = np.asarray(action, float)[None]
        result = self._world.step(steps_to(self._world, target, self._interface.actions))
        self._referee.note()
        self._num_steps += 1
        broke = bool(result.terminated[0])
        success = not broke and bool(result.held[0]) and bool(self._referee.verdict()[0])
        terminated = success or broke
        return (
            self._observe(),
            float(result.reward[0]),
            terminated,
            self._num_steps >= self._max_episode_steps and not terminated,
            {"is_success": success},
        )

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return a picture for people; the mask where there is no OpenGL."""
        if self.render_mode is None:
            return None
        try:
            return self.picture()
        except V2PError:  # no OpenGL
            return self._pictures()[MASK_CAMERA]

    @property
    def spec(self) -> EnvSpec | None:
        """What Gymnasium made it from, with the longest episode of this task."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec) -> None:  # pyright: ignore[reportIncompatibleVariableOverride]
        self._spec = replace(spec, max_episode_steps=self._max_episode_steps)

    @property
    def world(self) -> World:
        """The compiled model."""
        return self._world.world

    def moment(self) -> Snapshot:
        """Return the world as it is now: its joints, its camera, all that is needed to draw it."""
        return self._world.snapshot(np.array([0]))

    def picture(self) -> UInt8[np.ndarray, "h w 3"]:
        """Return the camera's colour picture.

        Raises:
            V2PError: there is no OpenGL.
        """
        return self._masks.draw_rgb(self.moment(), 0)

    def contact_torques(self) -> Float[np.ndarray, "joint"]:
        """Return the torques that contacts put on the arm's joints at the last time step [N m]."""
        return self._world.contact_torques()[0]

    def close(self) -> None:
        """Free the graphics memory."""
        self._masks.close()

    def _space(self, size_px: int, num_joints: int) -> spaces.Space[Any]:
        if self._shows == "states":
            return spaces.Box(-np.inf, np.inf, (self._world.obs_dim,), np.float32)
        low, high = (bound.astype(np.float32) for bound in state_bounds(num_joints))
        cameras = (*self._cameras, *([RGB_CAMERA] if self._rgb else []))
        picture = spaces.Box(0, 255, (size_px, size_px, 3), np.uint8)
        shown: dict[str, spaces.Space[Any]] = dict.fromkeys(cameras, picture)
        if self._shows == "pictures":
            shown = {"pixels": spaces.Dict(shown)}
        return spaces.Dict({**shown, "agent_pos": spaces.Box(low, high)})

    def _observe(self) -> Any:
        if self._shows == "states":
            return self._world.observe()[0]
        state = within_bounds(
            state_as_seen(self._world.robot_state(), self._world, self._interface)[0]
        )
        pictures: dict[str, Any] = self._pictures()
        if self._shows == "pictures":
            pictures = {"pixels": pictures}
        return pictures | {"agent_pos": state}

    def _pictures(self) -> dict[str, UInt8[np.ndarray, "h w 3"]]:
        drawn = labels_to_rgb(self._masks.draw(self.moment(), 0))
        pictures = dict(zip(self._cameras, np.split(drawn, len(self._cameras)), strict=True))
        return pictures | ({RGB_CAMERA: self.picture()} if self._rgb else {})


def _next_seed(rng: np.random.Generator) -> int:
    return int(rng.integers(2**62))
