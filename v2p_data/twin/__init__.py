"""A second simulator of the same robot and scene that gives only what a robot gives: RGB pictures and joint readings.

In: a `TaskBundle` and drawn `parameters.TwinParameters`. Out: `robot.TwinRobot`, and rates of a policy in it (`judge`).
Nothing lies on disk. Mechanisms differ from the training simulator `sim`: contact geometry, integrator, joint-level
control, gripper stroke, latency, lens. Truth leaves this room only for the referee and for true masks.
"""

import v2p_data.sim  # noqa: F401 - MuJoCo is imported there, whatever MUJOCO_GL says
