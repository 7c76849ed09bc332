"""A task becomes thousands of simulated worlds: robot, objects, randomisation, and masks to record.

In: a `TaskBundle` (code and scene). Out: a batched environment on `mujoco.batch` (`batch_env.BatchEnv`), the
same for TorchRL (`torchrl_env.TorchRLEnv`), and segmentation masks of any moment of it (`masks.MaskRenderer`).
Nothing lies on disk. World frame: robot base at the origin, +x forward, +y to the robot's left, +z up, table
top at z = 0, workspace centre (0.5, 0).
"""
