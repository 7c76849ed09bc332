"""What a policy did in a batch of episodes, and how it lies on disk: one `.npz` without pickles.

The first axis is the control step, the second the world; what comes after an episode's end is NaN. States are
kept for a few moments only, enough to ask another reward what it would have paid.
"""

import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Int

from v2p_data.errors import V2PError

HELD_STEPS = 5
"""An episode succeeded if success is true for its last so many steps, as in `sim.batch_env`."""
MAX_BYTES = 2_000_000_000
"""Largest file, unpacked. It may come from a process that ran strange code."""
MAX_NAMES = 4_000
_TABLE = "table"


@dataclass(frozen=True, kw_only=True)
class Trajectories:
    """What a policy did in a batch of episodes, one per world."""

    components: dict[str, Float32[np.ndarray, "step env"]]
    """Named components of the reward, NaN after an episode's end."""
    reward: Float32[np.ndarray, "step env"]
    """The generated reward without the bonus for success, NaN after an episode's end."""
    success: Bool[np.ndarray, "step env"]
    """The task's own success per step, False after an episode's end."""
    length: Int[np.ndarray, "env"]
    """Steps that each episode took."""
    moments: Int[np.ndarray, "moment"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Steps, ascending, for which `states` and `actions` are kept: those that `reward[moments]` was paid for."""
    states: dict[str, np.ndarray] = field(default_factory=dict[str, np.ndarray])
    """`task.task.ROBOT_STATES` and `OBJECT_STATES`, each `(moment, env, ...)` float32."""
    actions: Float32[np.ndarray, "kept num act"] = field(
        default_factory=lambda: np.zeros((0, 0, 7), np.float32)
    )
    """`(moment, env, 7)`; of no length where nothing is kept."""

    def __post_init__(self) -> None:
        steps, envs = self.success.shape
        for name, part in {**self.components, "the reward": self.reward}.items():
            if part.shape != (steps, envs):
                raise V2PError(f"'{name}' has shape {part.shape}, but success has {(steps, envs)}")
        if self.length.shape != (envs,) or ((self.length < 0) | (self.length > steps)).any():
            raise V2PError(f"need one length of 0 to {steps} steps for each of {envs} episodes")
        if ((self.moments < 0) | (self.moments >= steps)).any():
            raise V2PError(f"moments must be steps from 0 to {steps - 1}")
        if len(self.moments):
            for name, state in {**self.states, "actions": self.actions}.items():
                if state.shape[:2] != (len(self.moments), envs):
                    raise V2PError(
                        f"'{name}' has shape {state.shape}; it must begin with {(len(self.moments), envs)}"
                    )

    @property
    def num_episodes(self) -> int:
        """Number of episodes."""
        return self.success.shape[1]

    @property
    def played(self) -> Bool[np.ndarray, "step env"]:
        """Which steps belong to an episode."""
        return np.arange(len(self.success))[:, None] < self.length

    @property
    def succeeded(self) -> Bool[np.ndarray, "env"]:
        """Which episodes succeeded: success held for their last `HELD_STEPS` steps."""
        steps = np.arange(len(self.success))[:, None]
        is_last = (steps >= self.length - HELD_STEPS) & self.played
        return (self.success | ~is_last).all(0) & (self.length >= HELD_STEPS)

    def save(self, path: Path) -> None:
        """Write it as `.npz`."""
        named = {f"component {k}": v for k, v in self.components.items()}
        named |= {f"state {k}": v for k, v in self.states.items()}
        named |= {
            "reward": self.reward,
            "success": self.success,
            "length": self.length,
            "moments": self.moments,
            "actions": self.actions,
        }
        # Names come from task code: they go into a table, not into the archive's own directory.
        table = {f"array_{i}": name for i, name in enumerate(named)}
        arrays = {f"array_{i}": array for i, array in enumerate(named.values())}
        arrays[_TABLE] = np.array(json.dumps(table))
        with path.open("wb") as file:
            np.savez_compressed(file, **arrays)  # pyright: ignore[reportArgumentType]

    @staticmethod
    def load(path: Path) -> "Trajectories":
        """Read what `save` wrote, as data from a stranger.

        Raises:
            V2PError: it holds no trajectories.
        """
        try:
            named = _named_arrays(path)
            groups = {
                group: {
                    k.removeprefix(group): v.astype(np.float32, copy=False)
                    for k, v in named.items()
                    if k.startswith(group)
                }
                for group in ("component ", "state ")
            }
            return Trajectories(
                components=groups["component "],
                states=groups["state "],
                reward=named["reward"].astype(np.float32, copy=False),
                success=named["success"].astype(bool, copy=False),
                length=named["length"].astype(np.int64, copy=False),
                moments=named["moments"].astype(np.int64, copy=False),
                actions=named["actions"].astype(np.float32, copy=False),
            )
        except (OSError, ValueError, TypeError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise V2PError(
                f"{path} holds no trajectories ({type(error).__name__}: {error})"
            ) from error


def _named_arrays(path: Path) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(path) as archive:
        size = sum(info.file_size for info in archive.infolist())
    if size > MAX_BYTES:
        raise ValueError(f"it would unpack to {size / 1e9:.1f} GB")
    with np.load(path, allow_pickle=False) as file:
        table = json.loads(str(file[_TABLE]))
        if not isinstance(table, dict) or len(table) > MAX_NAMES:
            raise TypeError("its table of names is broken")
        return {str(name): np.asarray(file[key]) for key, name in table.items()}
