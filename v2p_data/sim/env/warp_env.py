"""`BatchEnv`'s contract with tensors on one device, on MuJoCo Warp: for training with thousands of worlds on a GPU.

The same task code, states, observation, rewards and randomisation; for a seed the first worlds are those of
`BatchEnv`. `step` takes and returns tensors on the device and copies nothing to the host but two flags;
`reset` draws on the host, with the CPU backend's own code, and copies the drawn rows over. Evaluation and
recording stay with `BatchEnv` at the fine time step: there is no snapshot here. How the physics differs is told
in `warp_physics`.
"""

# pyright: reportAttributeAccessIssue=false
# mujoco's classes come from a compiled module that declares none of them.

import json
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int

from v2p_data.errors import V2PError
from v2p_data.geometry.rotation import quats_pointing_down
from v2p_data.seeds import rng_for, torch_rng_for
from v2p_data.sim.env import task_code
from v2p_data.sim.env.batch_env import ACT_DIM, robot_of
from v2p_data.sim.env.cpu_physics import SimConfig
from v2p_data.sim.env.randomize import Randomizer
from v2p_data.sim.env.start_check import check_poses, check_solved
from v2p_data.sim.env.states import named_states
from v2p_data.sim.env.task_code import BEGAN_SOLVED, FRESH, HELD_STEPS
from v2p_data.sim.env.tensor_states import (
    SeenTensors,
    base_observation,
    moved_position,
    moved_rotation,
    object_block,
    robot_block,
)
from v2p_data.sim.env.warp_physics import CONTACTS_PER_WORLD, WarpPhysics
from v2p_data.sim.model.world import World, build_world
from v2p_data.sim.robot.robot import COARSE, FINE, FINGER_TRAVEL_M, NUM_ARM_JOINTS
from v2p_data.task.task import FULL_REWARD, MAX_REWARD, Task, TaskBundle


@dataclass(frozen=True, kw_only=True)
class TensorStepResult:
    """`batch_env.StepResult` as tensors on the environment's device."""

    obs: Float32[torch.Tensor, "env obs"]
    reward: Float32[torch.Tensor, "env"]
    success: Bool[torch.Tensor, "env"]
    held: Bool[torch.Tensor, "env"]
    terminated: Bool[torch.Tensor, "env"]
    truncated: Bool[torch.Tensor, "env"]
    task_reward: Float32[torch.Tensor, "env"]
    components: dict[str, Float32[torch.Tensor, "env"]]


class WarpBatchEnv:
    """Worlds of one task on a GPU; see `BatchEnv` for what its methods mean.

    Args:
        bundle: code and scene of the task.
        cfg: how it is simulated.
        num_envs: number of worlds; a large GPU takes 8,192.
        seed: everything drawn follows from it.
        device: a CUDA device, or `cpu` to check the GPU's model (slowly).
        task: the task, instead of `bundle.code`.

    Raises:
        ItemRejectedError: an object does not suit the robot, or the objects do not fit on the table.
        V2PError: there is no such device, or the task's observation is not what it says.
    """

    act_dim = ACT_DIM

    def __init__(
        self,
        bundle: TaskBundle,
        cfg: SimConfig | None = None,
        *,
        num_envs: int,
        seed: int,
        device: str = "cuda:0",
        task: type[Task] | None = None,
    ) -> None:
        self.device = _present(device)
        self.cfg = cfg or SimConfig()
        robot = robot_of(bundle, self.cfg)
        if robot.path is not None:
            raise V2PError(
                f"the backend 'warp' has the built-in arm only; simulate {robot.path} with the backend 'cpu'"
            )
        self.bundle = bundle
        self.num_envs = num_envs
        self.horizon = bundle.horizon_steps
        self.physics = FINE if self.cfg.fine else COARSE
        self.world: World = build_world(bundle.scene, self.physics)
        self.object_names = [o.name for o in self.world.objects]
        self.randomizer = Randomizer(
            self.world,
            _HostFields(self.world.model, num_envs),
            self.cfg.randomization,
            rng_for(seed, "start-poses"),
        )
        self.seed(seed)
        self._sim = WarpPhysics(self.world, num_envs, self.device)
        self._allocate()
        self.task = task_code.load(bundle, self, task)
        self.reset(torch.arange(num_envs, device=self.device))
        self.obs_dim = task_code.checked_obs_dim(self.task, bundle.title, self.observe().shape[1])
        idle = self._zeros(num_envs, ACT_DIM)
        self.component_names = tuple(self.task.judge(self.task_states, idle).components)

    @property
    def broken_count(self) -> int:
        """Worlds whose simulation broke down since the environment was made."""
        return int(self._broken_count)

    # -- what task code may ask for

    def sample_object_poses(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return per object poses `(n, 7)`, resting on the table and apart from each other."""
        poses = self.randomizer.place(env_ids.cpu().numpy().astype(np.int64), self._rng)
        tensor = torch.from_numpy(poses).to(self.device, torch.float32)
        return {name: tensor[:, k] for k, name in enumerate(self.object_names)}

    # -- the loop

    def seed(self, seed: int) -> None:
        """Restart the streams of everything drawn from now on."""
        self._rng = rng_for(seed, "worlds")
        self.randomizer.forget_prepared()
        self._noise = torch_rng_for(seed, "action-noise", device=str(self.device))

    def stagger(self, first: int = 0) -> None:
        """Put the worlds from `first` on at random moments of their episodes, so that they do not all end at once."""
        steps = self._rng.integers(0, self.horizon, self.num_envs)
        self._steps[first:].copy_(torch.from_numpy(steps[first:]))
        self._held[first:] = 0  # no starts, but moments of episodes

    def reset(self, ids: Int[torch.Tensor, "n"]) -> None:
        """Start new episodes in the worlds `ids`."""
        n = len(ids)
        if n == 0:
            return
        ids = ids.to(self.device, torch.int64)
        rows = ids.cpu().numpy()
        self.randomizer.draw(rows, self._rng)
        arm, tool_pos, yaw = self.randomizer.start_arm(n, self._rng)
        sim = self._sim
        sim.reset(ids, self.randomizer.delay_s[rows])
        sim.write_fields(self.randomizer.fields(), ids, rows)
        self._object_size[ids] = self._to_device(self.randomizer.size_m[rows])
        arm_and_fingers = np.concatenate([arm, np.full((n, 2), FINGER_TRAVEL_M)], axis=1)
        sim.qpos[ids, : NUM_ARM_JOINTS + 2] = self._to_device(arm_and_fingers)
        self._target_pos[ids] = self._to_device(tool_pos)
        self._target_quat[ids] = self._to_device(quats_pointing_down(yaw).T)
        self._target_finger[ids] = FINGER_TRAVEL_M
        poses = self.task.reset_poses(ids, self.object_names)
        for k, name in enumerate(self.object_names):
            self._object_qpos[ids, k] = poses[name].to(self.device, torch.float32)
        self._start_pose[ids] = start = self._object_qpos[ids]
        where = start.cpu().numpy().astype(float)
        check_poses(self.world, self.randomizer.size_m[rows], where, self.bundle.title)
        check_solved(int(self._num_solved), int(self._num_starts), self.bundle.title)
        self._steps[ids] = 0
        self._held[ids] = FRESH
        self._last_action[ids] = 0
        self._touches[ids] = 0
        self._broken[ids] = False
        self._write_command()
        sim.settle(ids)
        sim.refresh()
        self._see()

    def observe(self) -> Float32[torch.Tensor, "env obs"]:
        """Return the observation of all worlds as they are."""
        return _finite(self.task.observe(self.task_states))

    def step(self, action: Float[torch.Tensor, "env 7"]) -> TensorStepResult:
        """Carry out one action of 50 ms in every world; actions are clipped to [-1, 1]."""
        action = action.to(self.device, torch.float32)
        clipped = torch.nan_to_num(action).clamp(-1.0, 1.0)
        moved = clipped
        if noise := self.cfg.randomization.action_noise:
            moved = clipped + noise * torch.randn(
                clipped.shape, generator=self._noise, device=self.device
            )
        self._move_targets(moved)
        self._write_command()
        self._sim.step()
        self._last_action.copy_(clipped)
        self._steps += 1
        self._touches.copy_(self._sim.sensordata.reshape(self.num_envs, -1, 2) > 0)
        broken = self._sim.broken()
        self._broken_count += (broken & ~self._broken).sum()
        self._broken.copy_(broken)
        self._see()
        return self._judge(clipped)

    def states(self) -> dict[str, torch.Tensor]:
        """Return the states that success is judged by, never to be given to task code: see `task_states`.

        They share memory that the next step or reset overwrites.
        """
        return named_states(self._robot, self._objects, self._base, self.object_names)

    def task_states(self) -> dict[str, torch.Tensor]:
        """Return copies for task code."""
        blocks = (self._robot.clone(), self._objects.clone(), self._base.clone())
        return named_states(*blocks, self.object_names)

    def state_dict(self) -> dict[str, Any]:
        """Return everything the next step depends on, on the host; see `load_state_dict`."""
        return {
            **{key: value.cpu().clone() for key, value in self._state().items()},
            "rng": json.dumps(self._rng.bit_generator.state),
            "noise": self._noise.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from what `state_dict` of an environment made with the same arguments returned."""
        for key, value in self._state().items():
            value.copy_(state[key])
        self._rng.bit_generator.state = json.loads(state["rng"])
        self._noise.set_state(state["noise"])
        self._sim.refresh()
        self._see()

    # -- inside

    def _allocate(self) -> None:
        n, count = self.num_envs, len(self.object_names)
        q, v = self.world.objects[0].qpos_adr, self.world.objects[0].dof_adr
        self._is_round = [o.is_round or o.kind == "sphere" for o in self.world.objects]
        sim = self._sim
        self._fingers = sim.qpos[:, NUM_ARM_JOINTS : NUM_ARM_JOINTS + 2]
        self._object_qpos = sim.qpos[:, q : q + 7 * count].view(n, count, 7)
        self._object_qvel = sim.qvel[:, v : v + 6 * count].view(n, count, 6)
        self._object_size = self._zeros(n, count, 3)
        self._start_pose = self._zeros(n, count, 7)
        self._touches = self._zeros(n, count, 2)
        self._last_action = self._zeros(n, ACT_DIM)
        self._target_pos, self._target_quat = self._zeros(n, 3), self._zeros(n, 4)
        self._target_finger = self._zeros(n)
        self._steps = torch.zeros(n, dtype=torch.int64, device=self.device)
        self._held = torch.zeros_like(self._steps)
        self._broken = torch.zeros(n, dtype=torch.bool, device=self.device)
        self._broken_count = torch.zeros((), dtype=torch.int64, device=self.device)
        self._num_starts = torch.zeros_like(self._broken_count)
        self._num_solved = torch.zeros_like(self._broken_count)

    def _zeros(self, *shape: int) -> torch.Tensor:
        return torch.zeros(shape, device=self.device)

    def _to_device(self, array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array, np.float32)).to(self.device)

    def _state(self) -> dict[str, torch.Tensor]:
        drawn = self.randomizer.drawn_arrays() | self.randomizer.fields()
        return {
            **{f"physics.{key}": value for key, value in self._sim.state().items()},
            **{f"drawn.{key}": torch.from_numpy(value) for key, value in drawn.items()},
            **{f"env.{name}": getattr(self, name) for name in _ENV_STATE},
        }

    def _move_targets(self, action: torch.Tensor) -> None:
        cfg, sim, scale = self.cfg, self._sim, self.bundle.motion_scale
        pos = moved_position(
            self._target_pos,
            action[:, :3],
            sim.tool_pos,
            step_m=cfg.position_step_m * scale,
            leash_m=cfg.position_leash_m * scale,
        )
        quat = moved_rotation(
            self._target_quat,
            action[:, 3:6],
            sim.tool_quat,
            step_rad=cfg.rotation_step_rad,
            leash_rad=cfg.rotation_leash_rad,
            tilt_rad=cfg.tilt_limit_rad,
        )
        finger = torch.maximum(
            self._target_finger - action[:, 6] * cfg.finger_step_m,
            self._fingers.mean(1) - cfg.finger_leash_m,
        ).clamp(0.0, FINGER_TRAVEL_M)
        # Broken worlds wait for their reset with the targets they had.
        fine = ~self._broken & torch.isfinite(torch.cat([pos, quat], dim=1)).all(1)
        fine &= torch.isfinite(finger)
        self._target_pos.copy_(torch.where(fine[:, None], pos, self._target_pos))
        self._target_quat.copy_(torch.where(fine[:, None], quat, self._target_quat))
        self._target_finger.copy_(torch.where(fine, finger, self._target_finger))

    def _write_command(self) -> None:
        command = self._sim.command
        command[:, 0:3] = self._target_pos
        command[:, 3:7] = self._target_quat
        command[:, 7] = self._target_finger

    def _see(self) -> None:
        sim = self._sim
        seen = SeenTensors(
            tool_pos=sim.tool_pos,
            tool_rotation=sim.tool_rotation,
            tool_quat=sim.tool_quat,
            tool_vel_linear=sim.tool_vel_linear,
            tool_vel_angular=sim.tool_vel_angular,
            fingers=self._fingers,
            object_qpos=self._object_qpos,
            object_qvel=self._object_qvel,
            object_size=self._object_size,
            start_pose=self._start_pose,
            touches=self._touches,
            target_pos=self._target_pos,
            target_finger=self._target_finger,
            last_action=self._last_action,
            progress=(self._steps / self.horizon).clamp(max=1.0),
        )
        self._robot, self._objects = robot_block(seen), object_block(seen)
        self._base = base_observation(seen, self._is_round)

    def _judge(self, action: torch.Tensor) -> TensorStepResult:
        said = self.task.judge(self.task_states, action)
        obs, total, parts = _finite(said.observation), said.reward, said.components
        ok = ~self._broken
        success = said.success & ok
        zero = torch.zeros_like(total)
        task_reward = torch.where(ok, total.detach(), zero).float()
        _check(self.bundle.title, task_reward, parts, self._sim.dropped_contacts())
        self._count_held(success)
        reward = task_reward / FULL_REWARD + self.cfg.bonus_ratio * success
        return TensorStepResult(
            obs=obs,
            reward=reward,
            success=success,
            held=self._held >= HELD_STEPS,
            terminated=self._broken.clone(),
            truncated=(self._steps >= self.horizon) & ok,
            task_reward=task_reward,
            components={k: torch.where(ok, v.detach(), zero).float() for k, v in parts.items()},
        )

    def _count_held(self, success: torch.Tensor) -> None:
        """Count as `BatchEnv` does; how many began in success is looked at when worlds start, without a wait for the GPU."""
        is_fresh = self._held == FRESH
        began = (self._held == BEGAN_SOLVED) | (is_fresh & success)
        held = torch.where(success, self._held.clamp(min=0) + 1, 0)
        self._held = torch.where(began, BEGAN_SOLVED, held)
        self._num_starts += is_fresh.sum()
        self._num_solved += (is_fresh & success).sum()


def _present(name: str) -> torch.device:
    """Return a device.

    Raises:
        V2PError: the machine has none like it.
    """
    device = torch.device("cuda:0" if name == "cuda" else name)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise V2PError(
            f"the backend 'warp' was asked for {name}, but this machine has no CUDA device; use the "
            "backend 'cpu', or device 'cpu' to try the GPU's model slowly"
        )
    return device


def _check(
    title: str,
    task_reward: Float32[torch.Tensor, "env"],
    parts: dict[str, torch.Tensor],
    dropped_contacts: torch.Tensor,
) -> None:
    """Demand fair rewards and room for all contacts."""
    bad = ~(task_reward.abs() <= MAX_REWARD)  # of NaN too
    flags = torch.stack([bad.any(), dropped_contacts]).tolist()
    if flags[0]:
        env = int(bad.nonzero()[0])
        raise task_code.unfair_reward(title, env, float(task_reward[env]), parts)
    if flags[1]:
        raise V2PError(
            f"the worlds of task '{title}' have more contacts than the backend 'warp' has room "
            f"for ({CONTACTS_PER_WORLD} a world on average); raise CONTACTS_PER_WORLD in sim/env/warp_physics.py "
            "or simplify the scene's objects"
        )


def _finite(obs: torch.Tensor) -> Float32[torch.Tensor, "env obs"]:
    return torch.nan_to_num(obs, nan=0.0, posinf=0.0, neginf=0.0)


_ENV_STATE = (
    "_target_pos",
    "_target_quat",
    "_target_finger",
    "_object_size",
    "_start_pose",
    "_touches",
    "_steps",
    "_held",
    "_last_action",
    "_broken",
    "_broken_count",
    "_num_starts",
    "_num_solved",
)


class _HostFields:
    """Stands in for `mujoco.batch.Batch` where only its per-world model fields are wanted."""

    def __init__(self, model: mujoco.MjModel, num_envs: int) -> None:
        self._model = model
        self.nsim = num_envs

    def expand(self, name: str, /) -> np.ndarray:
        value = np.asarray(getattr(self._model, name))
        return np.repeat(value[None], self.nsim, axis=0)
