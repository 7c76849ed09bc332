"""Thousands of worlds of one task in step: actions in, observations, rewards and successes out.

A numpy core over one of two physics: MuJoCo on CPU cores, or MuJoCo Warp on a GPU for training. There is no automatic
reset: worlds that have ended go on until `reset` is called for them. Results depend on the seed only, not on the number
of threads.
"""

# pyright: reportAttributeAccessIssue=false
# mujoco's classes come from a compiled module that declares none of them.

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int

from v2p_data.errors import V2PError
from v2p_data.seeds import rng_for
from v2p_data.sim.env import task_code
from v2p_data.sim.env.cpu_physics import CpuPhysics
from v2p_data.sim.env.physics import Physics, SimConfig, Targets
from v2p_data.sim.env.randomize import Randomizer
from v2p_data.sim.env.start_check import check_poses, check_start
from v2p_data.sim.env.states import Observed, StateBlock
from v2p_data.sim.env.task_code import FRESH, Judgement, StepResult
from v2p_data.sim.model.world import CAMERA, World, build_world
from v2p_data.sim.robot.arms import RobotConfig, robot_from_json
from v2p_data.sim.robot.robot import COARSE, FINE, ToolState
from v2p_data.task.task import Task, TaskBundle

ACT_DIM = 7


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
        return Snapshot(**{key: value[index] for key, value in vars(self).items()})


class BatchEnv:
    """Worlds of one task.

    Args:
        bundle: code and scene of the task.
        cfg: how it is simulated.
        num_envs: number of worlds; 256 to 1024 are fastest on a CPU, a large GPU takes 8,192.
        seed: everything drawn follows from it.
        num_threads: of the backend `cpu`; 0 for all cores; changes no result.
        task: the task, instead of `bundle.code`.

    Raises:
        ItemRejectedError: an object does not suit the robot, or the objects do not fit on the table.
        V2PError: the task's observation is not what it says; MuJoCo Warp or the device is missing,
            or it is another arm's task.
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
    ) -> None:
        self.cfg = cfg or SimConfig()
        self.bundle = bundle
        self.num_envs = num_envs
        self.horizon = bundle.horizon_steps
        robot = robot_of(bundle, self.cfg)
        if self.cfg.backend == "warp" and robot.path is not None:
            raise V2PError(
                f"the backend 'warp' has the built-in arm only; simulate {robot.path} with the backend 'cpu'"
            )
        self.world: World = build_world(
            bundle.scene, FINE if self.cfg.fine else COARSE, robot=robot
        )
        self.object_names = [o.name for o in self.world.objects]
        self.broken_count = 0
        """Worlds whose simulation broke down since the environment was made."""
        self._sim = _physics_of(self.world, self.cfg, bundle.motion_scale, num_envs, num_threads)
        self.device = self._sim.device
        """Where who learns in these worlds computes; arrays are numpy's anyway."""
        self.randomizer = Randomizer(
            self.world, self._sim, self.cfg.randomization, rng_for(seed, "start-poses")
        )
        self._rng = rng_for(seed, "worlds")
        self._own_rngs: dict[int, np.random.Generator] = {}
        """Generators of worlds whose episode was seeded by itself."""
        self._block = StateBlock(self.world, num_envs)
        self._start_pose = np.zeros((num_envs, len(self.object_names), 7))
        self._placed = np.full_like(self._start_pose, np.nan)
        self._touches = np.zeros((num_envs, len(self.object_names), 3))
        self._steps = np.zeros(num_envs, np.int64)
        self._last_action = np.zeros((ACT_DIM, num_envs)).T
        self.task = task_code.load(bundle, self, task)
        self._judgement = Judgement(self.task, bundle.title, self.cfg.bonus_ratio, num_envs)
        self.reset(np.arange(num_envs))
        self.obs_dim = self._judgement.obs_dim = task_code.checked_obs_dim(
            self.task, bundle.title, self.observe().shape[1]
        )
        idle = torch.zeros(num_envs, ACT_DIM)
        self.component_names = tuple(self.task.judge(self.task_states, idle).components)

    # -- what task code may ask for

    def sample_object_poses(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return per object poses `(n, 7)`, resting on the table and apart from each other."""
        ids = env_ids.numpy().astype(np.int64)
        poses = self._placed[ids] = self.randomizer.place(ids, self._rng)
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
        self._judgement.held[first:] = 0  # no starts, but moments of episodes

    def reset(self, ids: Int[np.ndarray, "n"]) -> None:
        """Start new episodes in the worlds `ids`."""
        ids = np.asarray(ids, np.int64)
        if self._own_rngs:
            for k in ids.tolist():
                self._own_rngs.pop(k, None)
        if len(ids) == 0:
            return
        self._sim.reset(ids)
        self.randomizer.draw(ids, self._rng)
        self._sim.place_arms(ids, *self.randomizer.start_arm(len(ids), self._rng))
        rows = torch.from_numpy(ids)
        poses = (
            self.sample_object_poses(rows)
            if self.cfg.base_reset
            else self.task.reset_poses(rows, self.object_names)
        )
        for k, name in enumerate(self.object_names):
            self._sim.object_qpos[ids, k] = poses[name].numpy()
        self._start_pose[ids] = start = self._sim.object_qpos[ids]
        check_poses(self.world, self.randomizer.size_m[ids], start, self.bundle.title)
        own = ids[(start != self._placed[ids]).any((1, 2))]  # what the randomizer placed is apart
        check_start(self.world, self.randomizer.fields(), self._sim.qpos, own, self.bundle.title)
        self._steps[ids] = 0
        self._judgement.held[ids] = FRESH
        self._last_action[ids] = 0
        self._touches[ids] = 0
        self._fill(ids, self._sim.look_at(ids))

    @property
    def is_broken(self) -> Bool[np.ndarray, "env"]:
        """Which worlds broke down at the last step."""
        return self._sim.broken

    def observe(self) -> Float32[np.ndarray, "env obs"]:
        """Return the observation of all worlds as they are."""
        return self._judgement.observation(self.task.observe(self.task_states), self.is_broken)

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
        self.broken_count += self._sim.step(moved, moving)
        self._last_action[:] = clipped.T
        self._steps += 1
        self._touches[:] = self._sim.touches()
        self._fill(slice(None), self._sim.tool)
        return self._judged(torch.from_numpy(clipped.astype(np.float32).T))

    def states(self) -> dict[str, torch.Tensor]:
        """Return the states that success is judged by, never to be given to task code: see `task_states`.

        They share memory that the next step or reset overwrites.
        """
        return self._block.tensors()

    def task_states(self) -> dict[str, torch.Tensor]:
        """Return copies for task code. The next call overwrites them."""
        return self._block.copies()

    def robot_state(self) -> Float32[np.ndarray, "env 11"]:
        """Return `observation.state`; see `Physics.robot_state`."""
        return self._sim.robot_state()

    @property
    def targets(self) -> Targets:
        """What the controller goes for now."""
        return self._sim.target_pos, self._sim.target_quat, self._sim.target_finger

    def targets_after(self, action: Float[np.ndarray, "env 7"]) -> Targets:
        """Return what the controller would go for after an action, each entry in [-1, 1], without its noise."""
        return self._sim.moved(np.array(action.T, float, order="C"))

    def snapshot(self, ids: Int[np.ndarray, "n"]) -> Snapshot:
        """Return what is needed to draw the worlds `ids` as they are now."""
        drawn = self.randomizer.fields() | self.randomizer.per_world_arrays()
        looks = ("geom_size", "geom_pos", "geom_dataid")
        view = ("camera_pos", "camera_quat", "camera_fovy_deg")
        fields = {name: drawn[name][ids].copy() for name in looks + view}
        return Snapshot(qpos=self._sim.qpos[ids].copy(), qvel=self._sim.qvel[ids].copy(), **fields)

    def contact_torques(self) -> Float[np.ndarray, "env joint"]:
        """Return the torques that contacts and joint limits put on the arms' joints at the last time step [N m].

        They are kept from the first call on, so that call itself returns those of no step.
        """
        return self._sim.contact_torques()

    def motion(self) -> tuple[Float[np.ndarray, "env q"], Float[np.ndarray, "env v"]]:
        """Return copies of all worlds' positions and velocities: what changes in a `Snapshot` during an episode."""
        return self._sim.qpos.copy(), self._sim.qvel.copy()

    def object_poses(self) -> Float[np.ndarray, "env object 7"]:
        """Return a copy of the objects' poses: centre [m] and quaternion wxyz, in the robot's base frame."""
        return self._sim.object_qpos.copy()

    def touches(self) -> Bool[np.ndarray, "env object 3"]:
        """Return whether the left pad, the right pad (at the last time step) and the arm touched each object."""
        return self._touches > 0

    def arm_touches(self) -> Bool[np.ndarray, "env object"]:
        """Return whether any part of the arm touched each object during the last control step."""
        return self._touches[:, :, 2] > 0

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
            "num_starts": self._judgement.num_starts,
            "num_solved": self._judgement.num_solved,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on exactly from what `state_dict` of an environment made with the same arguments returned."""
        for key, value in self._arrays().items():
            value[:] = state[key].numpy()
        self._rng.bit_generator.state = json.loads(state["rng"])
        self.broken_count = int(state["broken_count"])
        said = self._judgement
        said.num_starts, said.num_solved = int(state["num_starts"]), int(state["num_solved"])
        self._sim.resume()
        self._fill(slice(None), self._sim.tool)

    # -- inside

    def _arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays that the next step depends on, live, by their names in `state_dict`."""
        sim = self._sim
        arrays = sim.state()
        arrays |= {f"model.{name}": array for name, array in self.randomizer.fields().items()}
        arrays |= {f"drawn.{name}": a for name, a in self.randomizer.drawn_arrays().items()}
        return arrays | {
            "env._target_pos": sim.target_pos,
            "env._target_quat": sim.target_quat,
            "env._target_finger": sim.target_finger,
            "env._start_pose": self._start_pose,
            "env._touches": self._touches,
            "env._steps": self._steps,
            "env._held": self._judgement.held,
            "env._last_action": self._last_action,
            "env._broken": sim.broken,
        }

    def _action_noise(self, noise: float) -> Float[np.ndarray, "7 env"]:
        """Draw for all worlds from the shared stream, unless each has one of its own."""
        own, shape = self._own_rngs, (ACT_DIM, self.num_envs)
        all_own = len(own) == self.num_envs
        drawn = np.empty(shape) if all_own else self._rng.normal(0.0, noise, shape)
        for k, rng in own.items():
            drawn[:, k] = rng.normal(0.0, noise, ACT_DIM)
        return drawn

    def _fill(self, rows: slice | np.ndarray, tool: ToolState) -> None:
        self._block.fill(
            rows,
            Observed(
                tool=tool,
                fingers=self._sim.qpos[rows, self.world.robot.fingers],
                object_qpos=self._sim.object_qpos[rows],
                object_qvel=self._sim.object_qvel[rows],
                object_size=self.randomizer.size_m[rows],
                start_pose=self._start_pose[rows],
                touches=self._touches[rows, :, :2],
                target_pos=self._sim.target_pos[rows],
                target_finger=self._sim.target_finger[rows],
                last_action=self._last_action[rows],
                progress=np.minimum(self._steps[rows] / self.horizon, 1.0),
            ),
        )

    def _judged(self, action: Float32[torch.Tensor, "env 7"]) -> StepResult:
        return self._judgement.of(
            self.task_states, action, self.is_broken, self._steps >= self.horizon
        )


def _physics_of(
    world: World, cfg: SimConfig, motion_scale: float, num_envs: int, num_threads: int
) -> Physics:
    """Return what simulates a world many times.

    Raises:
        V2PError: MuJoCo Warp or the device is missing.
    """
    if cfg.backend == "cpu":
        return CpuPhysics(world, cfg, motion_scale, num_envs, num_threads)
    from v2p_data.sim.env.warp_physics import WarpPhysics

    return WarpPhysics(world, cfg, motion_scale, num_envs)


def robot_of(bundle: TaskBundle, cfg: SimConfig) -> RobotConfig:
    """Return the arm to simulate: the one in the settings, else the one that the task was made for."""
    return cfg.robot if cfg.robot.path else robot_from_json(bundle.robot)
