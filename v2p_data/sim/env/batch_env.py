"""Thousands of worlds of one task in step: actions in, observations, rewards and successes out.

A numpy core on `mujoco.batch.Batch`. Actions move a target for the tool, which two leashes hold near the
tool itself: 6 cm for the position, 8 mm for the fingers. Without the latter the command to close winds up
and a policy practically never finds out how to release. There is no automatic reset: worlds that have
ended go on until `reset` is called for them. Results depend on the seed only, not on the number of threads.
"""

# pyright: reportAttributeAccessIssue=false
# mujoco's classes come from a compiled module that declares none of them.

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from mujoco.batch import Batch

from v2p_data.errors import V2PError
from v2p_data.geometry.rotation import (
    exp,
    limited_to,
    product,
    quats_pointing_down,
    rotvec_from_down,
    tilt_limited,
)
from v2p_data.seeds import rng_for
from v2p_data.sim.env import ranges, task_code
from v2p_data.sim.env.randomize import Randomizer
from v2p_data.sim.env.ranges import RandomizationConfig
from v2p_data.sim.env.start_check import (
    check_poses,
    check_solved,
    check_start,
)
from v2p_data.sim.env.states import Observed, StateBlock
from v2p_data.sim.model.world import CAMERA, World, build_world
from v2p_data.sim.robot.arms import RobotConfig, robot_from_json
from v2p_data.sim.robot.robot import (
    COARSE,
    FINE,
    NUM_CONTROLS,
    QUAT_DOWN,
    TARGET_HIGH_M,
    TARGET_LOW_M,
    ToolState,
)
from v2p_data.task.task import FULL_REWARD, MAX_REWARD, Task, TaskBundle

ACT_DIM = 7
HELD_STEPS = 5
"""Success counts when it is true for this many steps on end (0.25 s)."""

STARTS_LOOKED_AT = 8
"""Worlds whose first poses are held against MuJoCo's collisions when an environment is made."""
FRESH, BEGAN_SOLVED = -1, -2
"""Values of `_held`: before an episode's first step, and all through one that began in success."""
Targets = tuple[Float[np.ndarray, "env 3"], Float[np.ndarray, "env 4"], Float[np.ndarray, "env"]]
"""Of the controller: the tool's position [m] and quaternion `wxyz`, and the travel of a finger [m]."""


@dataclass(frozen=True, kw_only=True)
class SimConfig:
    """How a task is simulated."""

    fine: bool = False
    """Small time steps, for evaluation and recording; else large ones, for training."""
    robot: RobotConfig = field(default_factory=RobotConfig)
    """Without a path, the task's own, which is the built-in arm unless the task says otherwise."""
    randomization: RandomizationConfig = field(default_factory=ranges.training)
    position_step_m: float = 0.03
    """Target displacement at action 1, per control step."""
    rotation_step_rad: float = 0.2
    finger_step_m: float = 0.012
    position_leash_m: float = 0.06
    """The target stays this near the tool, per axis."""
    rotation_leash_rad: float = 0.5
    finger_leash_m: float = 0.008
    """The target of a finger that is blocked by an object runs ahead by this much at most."""
    tilt_limit_rad: float = 0.35
    """How far the gripper may lean from pointing straight down."""
    bonus_ratio: float = 1.0
    """What a step of success earns on top, in full rewards (`FULL_REWARD`); PPO knows only this ratio, for it scales
    rewards by their returns. See docs/rewards.md for the measurement."""


@dataclass(frozen=True, kw_only=True)
class StepResult:
    """What one control step led to, per world."""

    obs: Float32[np.ndarray, "env obs"]
    reward: Float32[np.ndarray, "env"]
    """`task_reward / FULL_REWARD + bonus_ratio * success`."""
    success: Bool[np.ndarray, "env"]
    """The task's own judgement of this very moment."""
    held: Bool[np.ndarray, "env"]
    """Success for the last `HELD_STEPS` steps: what an episode is judged by, at its end."""
    terminated: Bool[np.ndarray, "env"]
    """The simulation broke down: the state is not finite, or MuJoCo warned and reset it."""
    truncated: Bool[np.ndarray, "env"]
    """The time is up."""
    task_reward: Float32[np.ndarray, "env"]
    components: dict[str, Float32[np.ndarray, "env"]]
    """The task's named parts of its reward."""


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """All that is needed to draw some worlds later, or to continue them."""

    qpos: Float[np.ndarray, "n q"]
    qvel: Float[np.ndarray, "n v"]
    geom_size: Float[np.ndarray, "n geom 3"]
    geom_pos: Float[np.ndarray, "n geom 3"]
    geom_dataid: Int[np.ndarray, "n geom"]
    camera_pos: Float[np.ndarray, "n 3"]
    """Position of the camera `view`, in the world frame."""
    camera_quat: Float[np.ndarray, "n 4"]
    camera_fovy_deg: Float[np.ndarray, "n"]

    def write(self, model: mujoco.MjModel, data: mujoco.MjData, index: int) -> None:
        """Put world `index` into a model and its data and compute positions, ready to be drawn."""
        model.geom_size[:] = self.geom_size[index]
        model.geom_pos[:] = self.geom_pos[index]
        model.geom_dataid[:] = self.geom_dataid[index]
        camera = model.camera(CAMERA).id
        model.cam_pos[camera] = self.camera_pos[index]
        model.cam_quat[camera] = self.camera_quat[index]
        model.cam_fovy[camera] = self.camera_fovy_deg[index]
        data.qpos[:] = self.qpos[index]
        data.qvel[:] = self.qvel[index]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)

    def rows(self, index: Int[np.ndarray, "k"]) -> "Snapshot":
        """Return some of its worlds."""
        return Snapshot(**{key: value[index] for key, value in self.arrays().items()})

    def arrays(self) -> dict[str, np.ndarray]:
        """Return its fields, e.g. for `np.savez`."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray]) -> "Snapshot":
        """Return what `arrays` gave."""
        return Snapshot(
            **{name: np.asarray(arrays[name]) for name in Snapshot.__dataclass_fields__}
        )

    def save(self, path: Path) -> None:
        """Write it as `.npz`."""
        np.savez_compressed(path, **self.arrays())  # pyright: ignore[reportArgumentType]

    @staticmethod
    def load(path: Path) -> "Snapshot":
        """Read what `save` wrote."""
        with np.load(path) as arrays:
            return Snapshot.from_arrays(dict(arrays))


@dataclass(frozen=True, kw_only=True)
class Followed:
    """A moment of another simulator of the same scene, per world; see `BatchEnv.follow`."""

    arm_qpos: Float[np.ndarray, "env 7"]
    arm_qvel: Float[np.ndarray, "env 7"]
    fingers: Float[np.ndarray, "env 2"]
    """Travel of the fingers [m]."""
    object_qpos: Float[np.ndarray, "env object 7"]
    object_qvel: Float[np.ndarray, "env object 6"]
    """Linear in the world frame, angular in the object's frame."""
    touches: Float[np.ndarray, "env object 2"]
    """1 where the left, right pad touches the object."""
    target_pos: Float[np.ndarray, "env 3"]
    target_quat: Float[np.ndarray, "env 4"]
    target_finger: Float[np.ndarray, "env"]


class BatchEnv:
    """Worlds of one task.

    Args:
        bundle: code and scene of the task.
        cfg: how it is simulated.
        num_envs: number of worlds; 256 to 1024 are fastest.
        seed: everything drawn follows from it.
        num_threads: 0 for all cores; changes no result.
        task: the task, instead of `bundle.code`.
        base_reset: place objects as the environment does, whatever the task's own reset says.

    Raises:
        ItemRejectedError: an object does not suit the robot, or the objects do not fit on the table.
        V2PError: the task's observation is not what it says.
    """

    act_dim = ACT_DIM

    def __init__(
        self,
        bundle: TaskBundle,
        cfg: SimConfig | None = None,
        *,
        num_envs: int,
        seed: int,
        num_threads: int = 0,
        task: type[Task] | None = None,
        base_reset: bool = False,
    ) -> None:
        self._base_reset = base_reset
        self.cfg = cfg or SimConfig()
        self.bundle = bundle
        self.num_envs = num_envs
        self.horizon = bundle.horizon_steps
        self.physics = FINE if self.cfg.fine else COARSE
        robot = robot_of(bundle, self.cfg)
        self.world: World = build_world(bundle.scene, self.physics, robot=robot)
        self._robot = self.world.robot
        self.object_names = [o.name for o in self.world.objects]
        self.broken_count = 0
        """Worlds whose simulation broke down since the environment was made."""
        self._num_starts = self._num_solved = 0
        """Where some episodes begin in the middle; for training only."""
        self._bind(num_threads)
        self.randomizer = Randomizer(
            self.world, self._batch, self.cfg.randomization, rng_for(seed, "start-poses")
        )
        self._rng = rng_for(seed, "worlds")
        self._own_rngs: dict[int, np.random.Generator] = {}
        """Generators of worlds whose episode was seeded by itself."""
        self._allocate()
        self.task = task_code.load(bundle, self, task)
        self.reset(np.arange(num_envs))
        looked_at = slice(0, STARTS_LOOKED_AT)
        fields = {name: array[looked_at] for name, array in self.randomizer.fields().items()}
        check_start(self.world, fields, self._qpos[looked_at], bundle.title)
        self.obs_dim = task_code.checked_obs_dim(self.task, bundle.title, self.observe().shape[1])
        idle = torch.zeros(num_envs, ACT_DIM)
        self.component_names = tuple(self.task.judge(self.task_states, idle).components)

    # -- what task code may ask for

    def sample_object_poses(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return per object poses `(n, 7)`, resting on the table and apart from each other."""
        poses = self.randomizer.place(env_ids.numpy().astype(np.int64), self._rng)
        return {name: torch.from_numpy(poses[:, k]) for k, name in enumerate(self.object_names)}

    # -- the loop

    def seed(self, seed: int) -> None:
        """Restart the stream of everything drawn from now on."""
        self._rng = rng_for(seed, "worlds")
        self.randomizer.forget_prepared()

    def reset_seeded(self, ids: Int[np.ndarray, "n"], seeds: Sequence[int]) -> None:
        """Start an episode in each of the worlds `ids`, each from a seed and with a stream of its own.

        Such a world draws its start and its action noise as the only world of an environment does after `seed` and
        `reset`, whatever the other worlds do. It keeps its stream until it is reset without a seed.
        """
        shared = self._rng
        for k, seed in zip(ids.tolist(), seeds, strict=True):
            self.seed(seed)
            self.reset(np.array([k]))
            self._own_rngs[k] = self._rng
        self._rng = shared
        self.randomizer.forget_prepared()  # by the last world's stream

    def stagger(self, first: int = 0) -> None:
        """Put the worlds from `first` on at random moments of their episodes, so that they do not all end at once."""
        self._steps[first:] = self._rng.integers(0, self.horizon, self.num_envs)[first:]
        self._held[first:] = 0  # no starts, but moments of episodes

    def reset(self, ids: Int[np.ndarray, "n"]) -> None:
        """Start new episodes in the worlds `ids`."""
        ids = np.asarray(ids, np.int64)
        if self._own_rngs:
            for k in ids.tolist():
                self._own_rngs.pop(k, None)
        n = len(ids)
        if n == 0:
            return
        # What `Batch.reset` would do, without waking its threads.
        self._batch.state[ids] = self._fresh_state
        self._batch.warning[ids] = 0
        self.randomizer.draw(ids, self._rng)
        arm, tool_pos, yaw = self.randomizer.start_arm(n, self._rng)
        self._qpos[ids, self._robot.arm] = arm
        self._qpos[ids, self._robot.fingers] = self._robot.finger_travel_m
        self._target_pos[ids] = tool_pos
        self._target_quat[ids] = quats_pointing_down(yaw).T
        self._target_finger[ids] = self._robot.finger_travel_m
        rows = torch.from_numpy(ids)
        poses = (
            self.sample_object_poses(rows)
            if self._base_reset
            else self.task.reset_poses(rows, self.object_names)
        )
        for k, name in enumerate(self.object_names):
            self._object_qpos[ids, k] = poses[name].numpy()
        self._start_pose[ids] = start = self._object_qpos[ids]
        check_poses(self.world, self.randomizer.size_m[ids], start, self.bundle.title)
        self._steps[ids] = 0
        self._held[ids] = FRESH
        self._last_action[ids] = 0
        self._touches[ids] = 0
        self._broken[ids] = False
        self._write_controls(ids)
        # The delay line starts at the controls, not at zero, else the arm is pulled to the origin at first.
        self._history[ids[:, None], self._history_values] = self._ctrl[ids][:, self._history_ctrl]
        self._show(ids)

    @property
    def is_broken(self) -> Bool[np.ndarray, "env"]:
        """Which worlds broke down at the last step."""
        return self._broken

    def _show(self, ids: Int[np.ndarray, "n"]) -> None:
        """Bring what is seen of the worlds `ids` up to date after their state was written."""
        tool = self._tool_of(ids)
        for name in ("pos", "rotation", "quat_wxyz", "vel_linear", "vel_angular"):
            getattr(self._tool, name)[ids] = getattr(tool, name)
        self._fill(ids, tool)

    def observe(self) -> Float32[np.ndarray, "env obs"]:
        """Return the observation of all worlds as they are."""
        return self._observation(self.task.observe(self.task_states))

    def _observation(self, obs: torch.Tensor) -> Float32[np.ndarray, "env obs"]:
        """Return a copy of what the task observed, 0 where it is not finite because the world broke down."""
        array = obs.clone(memory_format=torch.contiguous_format).numpy()
        finite = np.isfinite(array)
        if not finite.all():
            odd = np.flatnonzero(~finite.all(1) & ~self._broken)
            if len(odd):
                raise V2PError(
                    f"the observation of task '{self.bundle.title}' is not finite in world {odd[0]} although its "
                    f"state is; first in column {np.flatnonzero(~finite[odd[0]])[0]}"
                )
            array[~finite] = 0.0
        return array

    def step(
        self, action: Float[np.ndarray, "env 7"], moving: Int[np.ndarray, "n"] | None = None
    ) -> StepResult:
        """Carry out one action of 50 ms in every world; actions are clipped to [-1, 1].

        With `moving`, time passes in the worlds of these numbers only. What is said of the others means nothing until
        their next reset.
        """
        # Worlds come last in all that follows: numpy is fastest along the last axis.
        clipped = np.array(action.T, float, order="C")
        if not np.isfinite(clipped).all():
            clipped = np.nan_to_num(clipped)
        np.minimum(np.maximum(clipped, -1.0, out=clipped), 1.0, out=clipped)
        noise = self.cfg.randomization.action_noise
        moved = clipped + self._action_noise(noise) if noise else clipped
        self._move_targets(moved)
        self._write_controls(slice(None))
        self._batch.step(moving, nstep=self.physics.substeps)
        self._last_action[:] = clipped.T
        self._steps += 1
        self._touches[:] = self._sensordata.reshape(self.num_envs, -1, 2) > 0
        self._find_broken()
        self._tool = self._tool_of(slice(None))
        self._fill(slice(None), self._tool)
        return self._judge(torch.from_numpy(clipped.astype(np.float32).T))

    def begin_following(self, moment: Followed) -> None:
        """Take over the first moment of episodes of another simulator, in all worlds; `follow` goes on."""
        self._steps[:] = 0
        self._held[:] = FRESH
        self._last_action[:] = 0
        self._start_pose[:] = moment.object_qpos
        self._take_over(moment)

    def follow(self, moment: Followed, action: Float[np.ndarray, "env 7"]) -> StepResult:
        """Take over the moment that an action led to in another simulator, and judge it as `step` does."""
        clipped = np.clip(np.nan_to_num(action), -1.0, 1.0)
        self._last_action[:] = clipped
        self._steps += 1
        self._take_over(moment)
        return self._judge(torch.from_numpy(clipped.astype(np.float32)))

    def states(self) -> dict[str, torch.Tensor]:
        """Return the states that success is judged by, never to be given to task code: see `task_states`.

        They share memory that the next step or reset overwrites.
        """
        return self._block.tensors()

    def task_states(self) -> dict[str, torch.Tensor]:
        """Return copies for task code. The next call overwrites them."""
        return self._block.copies()

    def robot_state(self) -> Float32[np.ndarray, "env 11"]:
        """Return `observation.state`.

        Tool position [m], its rotation vector from straight down [rad], gripper opening (0 to 1), then what the
        controller knows of its command: target position minus tool position [m], target opening (0 to 1).
        """
        travel = self._robot.finger_travel_m
        fingers = self._qpos[:, self._robot.fingers].sum(1, keepdims=True)
        return np.concatenate(
            [
                self._tool.pos,
                rotvec_from_down(self._tool.quat_wxyz.T).T,
                np.clip(fingers / (2 * travel), 0.0, 1.0),
                self._target_pos - self._tool.pos,
                self._target_finger[:, None] / travel,
            ],
            axis=1,
            dtype=np.float32,
        )

    @property
    def targets(self) -> Targets:
        """What the controller goes for now."""
        return self._target_pos, self._target_quat, self._target_finger

    def targets_after(self, action: Float[np.ndarray, "env 7"]) -> Targets:
        """Return what the controller would go for after an action, each entry in [-1, 1], without its noise."""
        return self._moved(np.array(action.T, float, order="C"))

    def snapshot(self, ids: Int[np.ndarray, "n"]) -> Snapshot:
        """Return what is needed to draw the worlds `ids` as they are now."""
        drawn = self.randomizer.fields() | self.randomizer.per_world_arrays()
        looks = ("geom_size", "geom_pos", "geom_dataid")
        view = ("camera_pos", "camera_quat", "camera_fovy_deg")
        fields = {name: drawn[name][ids].copy() for name in looks + view}
        return Snapshot(qpos=self._qpos[ids].copy(), qvel=self._qvel[ids].copy(), **fields)

    def contact_torques(self) -> Float[np.ndarray, "env joint"]:
        """Return the torques that contacts and joint limits put on the arms' joints at the last time step [N m].

        They are kept from the first call on, so that call itself returns those of no step.
        """
        return self._batch.bind("qfrc_constraint")[:, self._robot.arm_dofs].copy()

    def motion(self) -> tuple[Float[np.ndarray, "env q"], Float[np.ndarray, "env v"]]:
        """Return copies of all worlds' positions and velocities: what changes in a `Snapshot` during an episode."""
        return self._qpos.copy(), self._qvel.copy()

    def object_poses(self) -> Float[np.ndarray, "env object 7"]:
        """Return a copy of the objects' poses: centre [m] and quaternion wxyz, in the robot's base frame."""
        return self._object_qpos.copy()

    def touches(self) -> Bool[np.ndarray, "env object 2"]:
        """Return whether the left and the right finger's pad touched each object at the last time step."""
        return self._touches > 0

    def episode_params(self, env: int) -> dict[str, Any]:
        """Return what was drawn for the episode in world `env`, for JSON."""
        return {
            **self.randomizer.drawn(env),
            "start_poses": {
                name: np.round(self._start_pose[env, k], 5).tolist()
                for k, name in enumerate(self.object_names)
            },
            "fine": self.cfg.fine,
        }

    def state_dict(self) -> dict[str, Any]:
        """Return everything the next step depends on, as tensors and text; see `load_state_dict`."""
        return {
            **{key: torch.from_numpy(np.array(value)) for key, value in self._arrays().items()},
            "rng": json.dumps(self._rng.bit_generator.state),
            "broken_count": self.broken_count,
            "num_starts": self._num_starts,
            "num_solved": self._num_solved,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on exactly from what `state_dict` of an environment made with the same arguments returned."""
        for key, value in self._arrays().items():
            value[:] = state[key].numpy()
        self._rng.bit_generator.state = json.loads(state["rng"])
        self.broken_count = int(state["broken_count"])
        self._num_starts, self._num_solved = int(state["num_starts"]), int(state["num_solved"])
        self._tool = self._tool_of(slice(None))
        self._fill(slice(None), self._tool)

    # -- inside

    def _arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays that the next step depends on, live, by their names in `state_dict`."""
        arrays = {f"batch.{name}": self._batch.bind(name) for name in _BATCH_STATE}
        arrays |= {f"model.{name}": array for name, array in self.randomizer.fields().items()}
        arrays |= {f"drawn.{name}": a for name, a in self.randomizer.drawn_arrays().items()}
        return arrays | {f"env.{name}": getattr(self, name) for name in _ENV_STATE}

    def _take_over(self, moment: Followed) -> None:
        self._qpos[:, self._robot.arm] = moment.arm_qpos
        self._qvel[:, self._robot.arm_dofs] = moment.arm_qvel
        self._qpos[:, self._robot.fingers] = moment.fingers
        self._object_qpos[:], self._object_qvel[:] = moment.object_qpos, moment.object_qvel
        self._touches[:] = moment.touches
        self._target_pos[:], self._target_quat[:] = moment.target_pos, moment.target_quat
        self._target_finger[:] = moment.target_finger
        self._find_broken()
        self._tool = self._tool_of(slice(None))
        self._fill(slice(None), self._tool)

    def _bind(self, num_threads: int) -> None:
        model = self.world.model
        # MuJoCo would write a log file into the working folder; broken worlds are counted instead.
        mujoco.set_mju_user_warning(_log_warning)
        self._batch = Batch(model, self.num_envs, num_threads)
        self._fresh_state = self._batch.state[0].copy()
        self._qpos = self._batch.bind("qpos")
        self._qvel = self._batch.bind("qvel")
        self._ctrl = self._batch.bind("ctrl")
        self._history = self._batch.bind("history")
        self._sensordata = self._batch.bind("sensordata")
        count = len(self.world.objects)
        q, v = self.world.objects[0].qpos_adr, self.world.objects[0].dof_adr
        self._object_qpos = self._qpos[:, q : q + 7 * count].reshape(self.num_envs, count, 7)
        self._object_qvel = self._qvel[:, v : v + 6 * count].reshape(self.num_envs, count, 6)
        if not np.shares_memory(self._object_qpos, self._qpos):
            raise RuntimeError("object poses must be a view of qpos")
        self._history_values, self._history_ctrl = _history_layout(model)

    def _allocate(self) -> None:
        n, count = self.num_envs, len(self.object_names)
        self._block = StateBlock(self.world, n)
        self._target_pos = np.zeros((3, n)).T
        self._target_quat = np.tile(np.array([QUAT_DOWN]).T, n).T
        self._target_finger = np.zeros(n)
        self._start_pose = np.zeros((n, count, 7))
        self._touches = np.zeros((n, count, 2))
        self._steps = np.zeros(n, np.int64)
        self._held = np.zeros(n, np.int64)
        self._last_action = np.zeros((ACT_DIM, n)).T
        self._broken = np.zeros(n, bool)
        self._tool = self._tool_of(slice(None))

    def _action_noise(self, noise: float) -> Float[np.ndarray, "7 env"]:
        """Draw for all worlds from the shared stream, unless each has one of its own."""
        own, shape = self._own_rngs, (ACT_DIM, self.num_envs)
        all_own = len(own) == self.num_envs
        drawn = np.empty(shape) if all_own else self._rng.normal(0.0, noise, shape)
        for k, rng in own.items():
            drawn[:, k] = rng.normal(0.0, noise, ACT_DIM)
        return drawn

    def _move_targets(self, action: Float[np.ndarray, "7 env"]) -> None:
        self._target_pos, self._target_quat, self._target_finger = self._moved(action)

    def _moved(self, action: Float[np.ndarray, "7 env"]) -> Targets:
        cfg, tool = self.cfg, self._tool
        scale = self.bundle.motion_scale
        pos, tool_pos = self._target_pos.T, tool.pos.T
        pos = pos + action[:3] * (cfg.position_step_m * scale)
        leash = cfg.position_leash_m * scale
        pos = np.minimum(np.maximum(pos, tool_pos - leash), tool_pos + leash)
        pos = np.minimum(np.maximum(pos, _TARGET_LOW_M), _TARGET_HIGH_M)
        turn = exp(action[3:6] * cfg.rotation_step_rad)
        quat = product(turn, self._target_quat.T)
        quat = limited_to(quat, tool.quat_wxyz.T, cfg.rotation_leash_rad)
        quat = tilt_limited(quat, cfg.tilt_limit_rad)
        left, right = self._qpos[:, self._robot.fingers].T
        travel = 0.5 * (left + right)
        finger = self._target_finger - action[6] * cfg.finger_step_m
        finger = np.maximum(finger, travel - cfg.finger_leash_m)
        finger = np.minimum(np.maximum(finger, 0.0), self._robot.finger_travel_m)
        for target, safe in ((pos, [[0.5], [0.0], [0.2]]), (quat, np.array([QUAT_DOWN]).T)):
            if not np.isfinite(target).all():  # broken worlds wait for their reset
                target[:, ~np.isfinite(target).all(0)] = safe
        if not np.isfinite(finger).all():
            finger[~np.isfinite(finger)] = self._robot.finger_travel_m
        return pos.T, quat.T, finger

    def _tool_of(self, rows: slice | np.ndarray) -> ToolState:
        robot = self._robot
        return robot.tool_state(self._qpos[rows, robot.arm], self._qvel[rows, robot.arm_dofs])

    def _write_controls(self, rows: slice | np.ndarray) -> None:
        self._ctrl[rows, 0:3] = self._target_pos[rows]
        self._ctrl[rows, 3:7] = self._target_quat[rows]
        self._ctrl[rows, 7] = self._target_finger[rows]

    def _find_broken(self) -> None:
        warned = self._batch.warning[:, _BAD_STATE_WARNINGS, 1] > 0
        finite_pos, finite_vel = np.isfinite(self._qpos), np.isfinite(self._qvel)
        if finite_pos.all() and finite_vel.all() and not warned.any():
            self._broken = np.zeros(self.num_envs, bool)
            return
        broken = warned.any(1) | ~(finite_pos.all(1) & finite_vel.all(1))
        self.broken_count += int((broken & ~self._broken).sum())
        self._broken = broken

    def _fill(self, rows: slice | np.ndarray, tool: ToolState) -> None:
        self._block.fill(
            rows,
            Observed(
                tool=tool,
                fingers=self._qpos[rows, self._robot.fingers],
                object_qpos=self._object_qpos[rows],
                object_qvel=self._object_qvel[rows],
                object_size=self.randomizer.size_m[rows],
                start_pose=self._start_pose[rows],
                touches=self._touches[rows],
                target_pos=self._target_pos[rows],
                target_finger=self._target_finger[rows],
                last_action=self._last_action[rows],
                progress=np.minimum(self._steps[rows] / self.horizon, 1.0),
            ),
        )

    def _judge(self, action: Float32[torch.Tensor, "env 7"]) -> StepResult:
        ok = ~self._broken
        said = self.task.judge(self.task_states, action)
        obs = self._observation(said.observation)
        if obs.shape[1] != self.obs_dim:
            raise V2PError(
                f"task '{self.bundle.title}' observes {obs.shape[1]} numbers after it observed {self.obs_dim}"
            )
        success = said.success.numpy() & ok
        task_reward = self._of_sound_worlds(said.reward)
        is_fair = np.abs(task_reward) <= MAX_REWARD  # false for NaN too
        if not is_fair.all():
            env = int(np.flatnonzero(~is_fair)[0])
            raise V2PError(
                f"the reward of task '{self.bundle.title}' is {task_reward[env]} in world {env} although its state "
                f"is finite; rewards lie within +-{MAX_REWARD:g}, a full one is {FULL_REWARD:g}; "
                f"parts: { {k: float(v[env]) for k, v in said.components.items()} }"
            )
        self._count_held(success)
        reward = task_reward / FULL_REWARD + self.cfg.bonus_ratio * success
        return StepResult(
            obs=obs,
            reward=reward.astype(np.float32),
            success=success,
            held=self._held >= HELD_STEPS,
            terminated=self._broken.copy(),
            truncated=(self._steps >= self.horizon) & ok,
            task_reward=task_reward,
            components={k: self._of_sound_worlds(v) for k, v in said.components.items()},
        )

    def _count_held(self, success: Bool[np.ndarray, "env"]) -> None:
        """Count the steps for which success has been true on end; an episode that began in success never counts.

        Raises:
            ItemRejectedError: `starts_solved`: more episodes began so than chance explains.
        """
        is_fresh = self._held == FRESH
        began = (self._held == BEGAN_SOLVED) | (is_fresh & success)
        self._held = np.where(success, np.maximum(self._held, 0) + 1, 0)
        self._held[began] = BEGAN_SOLVED
        if is_fresh.any():
            self._num_starts += int(is_fresh.sum())
            self._num_solved += int((is_fresh & success).sum())
            check_solved(self._num_solved, self._num_starts, self.bundle.title)

    def _of_sound_worlds(self, value: torch.Tensor) -> Float32[np.ndarray, "env"]:
        """Return a copy of what the task gave, 0 for broken worlds."""
        array = value.detach().numpy().astype(np.float32)
        array[self._broken] = 0.0
        return array


_BATCH_STATE = ("time", "qpos", "qvel", "ctrl", "history", "qacc_warmstart")
_ENV_STATE = (
    "_target_pos",
    "_target_quat",
    "_target_finger",
    "_start_pose",
    "_touches",
    "_steps",
    "_held",
    "_last_action",
    "_broken",
)
_BAD_STATE_WARNINGS = slice(
    int(mujoco.mjtWarning.mjWARN_BADQPOS), int(mujoco.mjtWarning.mjWARN_BADCTRL) + 1
)
"""Warnings about positions, velocities, accelerations and controls."""
_TARGET_LOW_M = np.array([TARGET_LOW_M]).T
_TARGET_HIGH_M = np.array([TARGET_HIGH_M]).T


def robot_of(bundle: TaskBundle, cfg: SimConfig) -> RobotConfig:
    """Return the arm to simulate: the one in the settings, else the one that the task was made for."""
    return cfg.robot if cfg.robot.path else robot_from_json(bundle.robot)


def _log_warning(message: str) -> None:
    logging.getLogger(__name__).debug("MuJoCo: %s", message)


def _history_layout(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return positions of past control values in `history`, and the control each belongs to.

    Per actuator the buffer holds a user slot, a cursor, `nsample` times, then `nsample` rows of values.
    """
    places, controls = [], []
    for k in range(len(model.actuator_historyadr)):
        start, samples = int(model.actuator_historyadr[k]), int(model.actuator_history[k, 0])
        first, width = int(model.actuator_ctrladr[k]), int(model.actuator_ctrlnum[k])
        places += range(start + 2 + samples, start + 2 + samples + samples * width)
        controls += list(range(first, first + width)) * samples
    if len(set(controls)) != NUM_CONTROLS:
        raise RuntimeError("every control needs a delay line")
    return np.array(places), np.array(controls)
