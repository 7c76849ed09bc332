"""A task becomes thousands of simulated worlds: robot, objects, randomisation, and masks to record.

In: a `TaskBundle` (code and scene). Out: a batched environment on `mujoco.batch` (`batch_env.BatchEnv`), the
same for TorchRL (`torchrl_env.TorchRLEnv`), and segmentation masks of any moment of it (`masks.MaskRenderer`).
Nothing lies on disk. World frame: robot base at the origin, +x forward, +y to the robot's left, +z up, table
top at z = 0, workspace centre (0.5, 0).
"""

import os
from importlib import import_module


def _import_mujoco() -> None:
    """Import MuJoCo also where MUJOCO_GL names an OpenGL that is not here: physics and masks need none."""
    try:
        import_module("mujoco")
    except (
        Exception
    ):  # RuntimeError for a name that it does not know, else what the missing library makes of it
        asked = os.environ.get("MUJOCO_GL")
        if not asked:
            raise
        os.environ["MUJOCO_GL"] = "disable"
        try:
            import_module("mujoco")
        finally:
            os.environ["MUJOCO_GL"] = asked


_import_mujoco()  # before any module of this room, or above it, does
