"""Which machine simulates: MuJoCo on CPU cores, or MuJoCo Warp on a GPU. Evaluation and recording always use the CPU."""

from typing import TYPE_CHECKING, Literal

from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.task.task import TaskBundle

if TYPE_CHECKING:
    from v2p_data.sim.env.warp_env import WarpBatchEnv

Backend = Literal["cpu", "warp"]


def make_batch_env(
    bundle: TaskBundle,
    cfg: SimConfig | None = None,
    *,
    num_envs: int,
    seed: int,
    num_threads: int = 0,
    backend: Backend = "cpu",
    device: str = "cuda:0",
) -> "BatchEnv | WarpBatchEnv":
    """Return worlds of a task.

    Args:
        bundle: code and scene of the task.
        cfg: how it is simulated.
        num_envs: number of worlds; about 512 on two cores, 8,192 on a GPU.
        seed: everything drawn follows from it.
        num_threads: of the backend `cpu`; 0 for all cores.
        backend: `cpu` or `warp`.
        device: of the backend `warp`.

    Raises:
        V2PError: MuJoCo Warp or the device is missing, or the task's observation is not what it says.
        ItemRejectedError: an object does not suit the robot, or the objects do not fit on the table.
    """
    if backend == "cpu":
        return BatchEnv(bundle, cfg, num_envs=num_envs, seed=seed, num_threads=num_threads)
    from v2p_data.sim.env.warp_env import WarpBatchEnv

    return WarpBatchEnv(bundle, cfg, num_envs=num_envs, seed=seed, device=device)
