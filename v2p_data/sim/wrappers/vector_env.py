"""Many worlds of one task as a Gymnasium vector environment, `v2p/States-v0`: for trainers of experts.

| | |
|---|---|
| Observation | Box((obs_dim,)) float32: the simulator's states as the task's code chooses them |
| Action | Box(-1, 1, (7,)): delta position, delta rotation, gripper; 20 Hz |
| Reward | the task's training reward, `BatchEnv.step` |
| End | terminated: the simulation broke down; truncated: the task's horizon. Success does not end an episode |
| Info | `is_success`: the task's own success has held for 0.25 s |
| Autoreset | `NEXT_STEP`: the step after an episode's end starts the next one and ignores its action |

Made by `gymnasium.make_vec("v2p/States-v0", num_envs=512, vectorization_mode="vector_entry_point", task_folder=...)`.
"""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float, Float32

from v2p_data.errors import V2PError
from v2p_data.sim.env.batch_env import ACT_DIM, BatchEnv, SimConfig
from v2p_data.sim.wrappers.gym_env import demand_no_options
from v2p_data.task.task import TaskBundle, told_of

ENV_ID = "v2p/States-v0"


class V2PVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """A batch of worlds.

    Args:
        num_envs: number of worlds.
        task_folder: folder with `task.json`, as `v2p task` writes it.
        fine: small time steps, as experts are judged under; else large ones, as they are trained.
        num_threads: for the physics; 0 for all cores; changes no result.

    Raises:
        V2PError: the folder holds no task.
        ItemRejectedError: the task cannot be simulated.
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}  # noqa: RUF012 - Gymnasium's attribute

    def __init__(
        self, num_envs: int, task_folder: str, *, fine: bool = False, num_threads: int = 0
    ) -> None:
        bundle = TaskBundle.load(Path(task_folder))
        with told_of(bundle.folder):
            self.worlds = BatchEnv(
                bundle, SimConfig(fine=fine), num_envs=num_envs, seed=0, num_threads=num_threads
            )
        self.num_envs = num_envs
        self.single_observation_space = spaces.Box(
            -np.inf, np.inf, (self.worlds.obs_dim,), np.float32
        )
        self.single_action_space = spaces.Box(-1.0, 1.0, (ACT_DIM,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._over = np.zeros(num_envs, bool)

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Float32[np.ndarray, "env obs"], dict[str, Any]]:
        """Start new episodes everywhere; with a seed, or a list of one a world, always the same ones.

        Raises:
            V2PError: the list has not one seed a world, or there are options.
        """
        demand_no_options(options)
        worlds = np.arange(self.num_envs)
        if isinstance(seed, list):
            seeds = [one for one in seed if one is not None]
            if len(seeds) != self.num_envs:
                raise V2PError(
                    f"a list of seeds needs one for each of the {self.num_envs} worlds, got {seed}"
                )
            self.worlds.seed(seeds[0])  # of the episodes that come after these
            self.worlds.reset_seeded(worlds, seeds)
        else:
            if seed is not None:
                self.worlds.seed(seed)
            self.worlds.reset(worlds)
        self._over[:] = False
        return self.worlds.observe(), self._info(self._over)

    def step(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, actions: Float[np.ndarray, "env 7"]
    ) -> tuple[
        Float32[np.ndarray, "env obs"],
        Float[np.ndarray, "env"],
        Bool[np.ndarray, "env"],
        Bool[np.ndarray, "env"],
        dict[str, Any],
    ]:
        """Carry out one action in every world whose episode goes on."""
        result = self.worlds.step(actions)
        fresh, obs = self._over, result.obs
        if fresh.any():
            self.worlds.reset(np.flatnonzero(fresh))
            obs = self.worlds.observe()
        terminated, truncated = result.terminated & ~fresh, result.truncated & ~fresh
        self._over = terminated | truncated
        reward = np.where(fresh, 0.0, result.reward)
        return obs, reward, terminated, truncated, self._info(result.held & ~fresh)

    def _info(self, success: Bool[np.ndarray, "env"]) -> dict[str, Any]:
        return {"is_success": success.copy(), "_is_success": np.ones(self.num_envs, bool)}


gym.register(id=ENV_ID, vector_entry_point=V2PVectorEnv)  # pyright: ignore[reportArgumentType]
