"""The physics of many worlds on CPU cores, by `mujoco.batch.Batch`."""

# pyright: reportAttributeAccessIssue=false
# mujoco's classes come from a compiled module that declares none of them.

import logging

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int
from mujoco.batch import Batch

from v2p_data.sim.env.physics import Physics, SimConfig
from v2p_data.sim.model.world import World
from v2p_data.sim.robot.robot import NUM_CONTROLS

_BAD_STATE_WARNINGS = slice(
    int(mujoco.mjtWarning.mjWARN_BADQPOS), int(mujoco.mjtWarning.mjWARN_BADCTRL) + 1
)
"""Warnings about positions, velocities, accelerations and controls."""
_STATE = ("time", "qpos", "qvel", "ctrl", "history", "qacc_warmstart")


class CpuPhysics(Physics):
    """Worlds that share out CPU cores. `batch` holds MuJoCo's worlds, of which all arrays are views.

    Args:
        world, cfg, motion_scale, num_envs: see `Physics`.
        num_threads: 0 for all cores; changes no result.
    """

    def __init__(
        self, world: World, cfg: SimConfig, motion_scale: float, num_envs: int, num_threads: int
    ) -> None:
        # MuJoCo would write a log file into the working folder; broken worlds are counted instead.
        mujoco.set_mju_user_warning(_log_warning)
        self.batch = Batch(world.model, num_envs, num_threads)
        self._fresh_state = self.batch.state[0].copy()
        self._substeps = world.physics.substeps
        self.qpos = self.batch.bind("qpos")
        self.qvel = self.batch.bind("qvel")
        self.ctrl = self.batch.bind("ctrl")
        self.sensordata = self.batch.bind("sensordata")
        self._history = self.batch.bind("history")
        self._history_values, self._history_ctrl = _history_layout(world.model)
        self._arm_touched = _sensor_history(world.model)
        super().__init__(world, cfg, motion_scale, num_envs)

    def expand(self, name: str) -> np.ndarray:
        return self.batch.expand(name)

    def reset(self, ids: Int[np.ndarray, "n"]) -> None:
        """Do in the worlds `ids` what `Batch.reset` would, without waking its threads."""
        self.batch.state[ids] = self._fresh_state
        self.batch.warning[ids] = 0
        self.broken[ids] = False

    def state(self) -> dict[str, np.ndarray]:
        return {f"batch.{name}": self.batch.bind(name) for name in _STATE}

    def contact_torques(self) -> Float[np.ndarray, "env joint"]:
        """Return the torques; kept from the first call on, so that call itself returns those of no step."""
        return self.batch.bind("qfrc_constraint")[:, self._robot.arm_dofs].copy()

    def _arm_touches(self) -> Bool[np.ndarray, "env object"]:
        return np.asarray((self._history[:, self._arm_touched] > 0).any(-1))

    def _advance(self, moving: Int[np.ndarray, "n"] | None) -> None:
        self.batch.step(moving, nstep=self._substeps)

    def _warned(self) -> Bool[np.ndarray, "env"]:
        return (self.batch.warning[:, _BAD_STATE_WARNINGS, 1] > 0).any(1)

    def _settle(self, ids: Int[np.ndarray, "n"]) -> None:
        # The delay line starts at the controls, not at zero, else the arm is pulled to the origin at first.
        self._history[ids[:, None], self._history_values] = self.ctrl[ids][:, self._history_ctrl]


def _log_warning(message: str) -> None:
    logging.getLogger(__name__).debug("MuJoCo: %s", message)


def _sensor_history(model: mujoco.MjModel) -> Int[np.ndarray, "sensor sample"]:
    """Return where `history` holds the values of sensors that keep those of all time steps of a control step."""
    kept = np.flatnonzero(model.sensor_historyadr >= 0)
    first = model.sensor_historyadr[kept] + 2 + model.sensor_history[kept, 0]
    return first[:, None] + np.arange(model.sensor_history[kept[0], 0])


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
