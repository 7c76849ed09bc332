"""The same worlds on MuJoCo Warp: one model, thousands of worlds, arrays that torch shares. The only file that imports Warp.

Needs the extra `gpu` (mujoco-warp 4.0, warp-lang 1.19 go with mujoco 4.0). All arrays are float32 and live on
one device, `cuda:0` or `cpu`; on CUDA a whole control step is one captured graph.

What our model uses, and what becomes of it here:

| feature | MuJoCo Warp 4.0 | here |
|---|---|---|
| integrator `discrete`, elliptic cones, impratio, joint equality, tendon | yes | as it is |
| position servos with `refsite` | yes | as they are |
| contact sensors `reduce="netforce"`, `data="found"` | yes | as they are |
| sizes, masses, friction, meshes (`geom_dataid`), servo gains per world | yes | as they are |
| `orientation` servo | no (`mjTRN_SO3`) | three rotational position servos, see `_control` |
| delayed controls | yes, in float32 time | the command of the control step before, until the delay is over: the same time steps |
| reset of a world that diverges | no | `WarpBatchEnv` ends it |
| double precision | no | rounding, see below |

The orientation servo's law is `torque = kp log(R_wanted R^T) - kv w`, no longer than its limit; the `discrete`
integrator is implicit in it by `h^2 kp + h kv` about every axis, unless the torque is at its limit. Three servos
about the world's axes are the same: before each time step their controls are chosen such that they exert just
that torque, and at the limit their force ranges, too, because a clamped servo drops out of the integrator.

Measured on Warp's CPU device against the CPU backend, same seeds and actions, 8 worlds, largest difference:

| what | coarse step | fine step |
|---|---|---|
| speeds after one time step | 2e-5 rad/s | |
| tool, torque below its limit, 24 steps | below 0.01 mm, 0.01 degrees | below 0.01 mm, 0.01 degrees |
| tool, torque at its limit all the time, 20 steps | 10 mm, 5 degrees | 2.5 mm, 3.2 degrees |
| object dropped from 4 cm, tilted | 0.001 mm | |
| object pushed by 8 cm in 16 steps, left alone: impacts amplify every difference | 4 to 8 mm | |
| the same, each step from the CPU's state: median, largest | 0.0001 mm, 2.2 mm | |
| the 12 benchmark tasks, 10 gentle steps | observation 5e-5, reward 3e-7 | |

At its limit MuJoCo itself keeps the orientation servo in the integrator, or not, by whether the clamped torque's
norm rounds to just below the limit (seen in 4.0.0: 29.999999999999996 keeps it, 30.0 drops it). Here it is
always dropped; the targets' leash keeps the two from drifting apart.
"""

# pyright: reportAttributeAccessIssue=false, reportMissingImports=false, reportInvalidTypeForm=false, reportIndexIssue=false, reportCallIssue=false
# mujoco's classes come from a compiled module that declares none of them; Warp is an extra, with types of its own.

from typing import no_type_check

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int

from v2p_data.errors import V2PError
from v2p_data.sim.model.world import World
from v2p_data.sim.robot.robot import NUM_CONTROLS

try:
    import mujoco_warp as mjw
    import warp as wp
except ImportError as error:
    raise V2PError(
        f"the backend 'warp' needs MuJoCo Warp, which is not installed ({error}); install the extra 'gpu' "
        "(pip install 'lerobot_policy_v2p[gpu]') or use the backend 'cpu'"
    ) from error

wp.config.log_level = wp.LOG_WARNING  # else every kernel that is loaded prints a line

CONTACTS_PER_WORLD = 96
"""Room for contacts, on average over all worlds, and for each world's constraints (4 rows a contact).

A round cover at rest has 44."""
PER_WORLD_FIELDS = (
    "geom_size",
    "geom_pos",
    "geom_rbound",
    "geom_aabb",
    "geom_friction",
    "geom_dataid",
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "actuator_gainprm",
    "actuator_biasprm",
)
"""The fields of `randomize.Randomizer` that MuJoCo Warp's collisions and dynamics read."""
SERVOS = ("servo_x", "servo_y", "servo_z", "servo_gripper", *["servo_rotation"] * 3)
"""Whose gains each servo of the model here has."""
DIVERGED = 1e10
"""Positions and speeds beyond this count as broken (MuJoCo's `mjMAXVAL`)."""


@wp.func
@no_type_check
def _product(a: wp.vec4, b: wp.vec4) -> wp.vec4:
    return wp.vec4(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.kernel
@no_type_check
def _control(
    command: wp.array2d(dtype=float),
    command_before: wp.array2d(dtype=float),
    first_substep: wp.array(dtype=int),
    substep: int,
    hand: int,
    turn: int,
    limit: float,
    gain: wp.array3d(dtype=float),
    bias: wp.array3d(dtype=float),
    xquat: wp.array2d(dtype=wp.quat),
    length: wp.array2d(dtype=float),
    velocity: wp.array2d(dtype=float),
    ctrl: wp.array2d(dtype=float),
    forcerange: wp.array2d(dtype=wp.vec2),
) -> None:
    """Write the controls of one time step: delayed, and the rotation as three scalars.

    Servo k exerts `kp (ctrl_k - length_k) - kv velocity_k`; whatever its length means, `ctrl_k` follows from
    the torque it shall exert. Quaternions are wxyz, also in `xquat`, whatever Warp takes them for.
    """
    world = wp.tid()
    wanted = wp.vec4()
    for k in range(8):
        value = command_before[world, k]
        if substep >= first_substep[world]:
            value = command[world, k]
        if k < 3:
            ctrl[world, k] = value
        elif k < 7:
            wanted[k - 3] = value
        else:
            ctrl[world, 3] = value
    kp = gain[world, turn, 0]
    kv = -bias[world, turn, 2]
    raw = xquat[world, hand]
    error = _product(wanted, wp.vec4(raw[0], -raw[1], -raw[2], -raw[3]))
    if error[0] < 0.0:
        error = -error
    axis = wp.vec3(error[1], error[2], error[3])
    sine = wp.length(axis)
    scale = 2.0
    if sine > 1.0e-7:
        scale = 2.0 * wp.atan2(sine, error[0]) / sine
    spin = wp.vec3(velocity[world, turn], velocity[world, turn + 1], velocity[world, turn + 2])
    torque = kp * scale * axis - kv * spin
    size = wp.length(torque)
    for k in range(3):
        ctrl[world, turn + k] = length[world, turn + k] + (torque[k] + kv * spin[k]) / kp
        free = wp.vec2(-2.0 * size - 1.0, 2.0 * size + 1.0)
        if size > limit:
            clamped = torque[k] * (limit / size)
            free = wp.vec2(clamped, clamped)
        forcerange[world, turn + k] = free


class WarpPhysics:
    """Worlds on one device. Attributes are torch tensors that share memory with Warp's arrays.

    Args:
        world: the model, as on the CPU.
        num_envs: number of worlds.
        device: `cpu` or a CUDA device.

    Attributes:
        qpos, qvel: `(env, q)`, `(env, v)`.
        sensordata: `(env, sensor)`, of the last time step.
        command: `(env, 8)`, the controls of `robot`: `[x, y, z, qw, qx, qy, qz, finger]`.
        overflow: `(env,)`, bits of what did not fit since the world's reset.
    """

    def __init__(self, world: World, num_envs: int, device: torch.device) -> None:
        self.device = device
        self.num_envs = num_envs
        self.physics = world.physics
        self._wp_device = wp.get_device(str(device))
        self.model = _without_orientation_servo(world)
        with wp.ScopedDevice(self._wp_device):
            self._m = mjw.put_model(
                self.model,
                batch_sizes=dict.fromkeys((*PER_WORLD_FIELDS, "actuator_forcerange"), num_envs),
            )
            self._m.opt.warn_overflow = 0
            self._d = mjw.make_data(
                self.model,
                nworld=num_envs,
                nconmax=CONTACTS_PER_WORLD,
                njmax=4 * CONTACTS_PER_WORLD + 20,
            )
            self._to_reset = wp.zeros(num_envs, dtype=bool)
        d = self._d
        self.qpos, self.qvel = wp.to_torch(d.qpos), wp.to_torch(d.qvel)
        self.sensordata = wp.to_torch(d.sensordata)
        self.overflow = wp.to_torch(d.overflow)
        self.command = torch.zeros(num_envs, NUM_CONTROLS, device=device)
        self._command_before = torch.zeros_like(self.command)
        self._first_substep = torch.zeros(num_envs, dtype=torch.int32, device=device)
        self._fields = {name: wp.to_torch(getattr(self._m, name)) for name in PER_WORLD_FIELDS}
        self._servo_ids = np.array([world.model.actuator(name).id for name in SERVOS])
        self._reset_mask = wp.to_torch(self._to_reset)
        self._xpos, self._xmat = wp.to_torch(d.site_xpos), wp.to_torch(d.site_xmat)
        self._xquat, self._cvel = wp.to_torch(d.xquat), wp.to_torch(d.cvel)
        self._subtree_com = wp.to_torch(d.subtree_com)
        self._tcp = int(self.model.site("tcp").id)
        self._hand = int(self.model.site_bodyid[self._tcp])
        self._root = int(self.model.body_rootid[self._hand])
        self._m.callback.control = self._control_law(world.model)
        self._graphs: dict[str, wp.Graph] = {}
        if self._wp_device.is_cuda:
            self._capture()

    def step(self) -> None:
        """Go on by one control step under `command`, and compute the tool's pose of its end."""
        self._run("step", self._control_step)
        self._command_before.copy_(self.command)

    def refresh(self) -> None:
        """Compute the tool's pose from `qpos` and `qvel`; they may have been written to."""
        self._run("refresh", self._kinematics)

    def reset(self, ids: Int[torch.Tensor, "n"], delay_s: Float[np.ndarray, "n"]) -> None:
        """Clear the worlds `ids`; their `qpos` and `command` are to be written next, then `settle` is due."""
        self._reset_mask.zero_()
        self._reset_mask[ids] = True
        self._run("reset", self._clear)
        # A command takes effect from the first time step that begins no earlier than its delay after it.
        first = np.ceil(delay_s / self.physics.timestep_s - 1e-6).astype(np.int32)
        self._first_substep[ids] = torch.from_numpy(first).to(self.device)

    def settle(self, ids: Int[torch.Tensor, "n"]) -> None:
        """Make the command of the worlds `ids` the one they had before, so that a delay does not move them."""
        self._command_before[ids] = self.command[ids]

    def write_fields(
        self,
        fields: dict[str, np.ndarray],
        ids: Int[torch.Tensor, "n"],
        rows: Int[np.ndarray, "n"],
    ) -> None:
        """Copy `rows` of the host's model fields into the worlds `ids`, which are the same."""
        for name, shared in self._fields.items():
            values = fields[name][rows]
            if name.startswith("actuator_"):
                values = values[:, self._servo_ids]
            values = torch.from_numpy(values).to(self.device, shared.dtype)
            shared[ids] = values.reshape(len(ids), *shared.shape[1:])

    @property
    def tool_pos(self) -> Float[torch.Tensor, "env 3"]:
        return self._xpos[:, self._tcp]

    @property
    def tool_rotation(self) -> Float[torch.Tensor, "env 3 3"]:
        return self._xmat[:, self._tcp]

    @property
    def tool_quat(self) -> Float[torch.Tensor, "env 4"]:
        """`wxyz`; `tcp` is parallel to the hand."""
        return self._xquat[:, self._hand]

    @property
    def tool_vel_angular(self) -> Float[torch.Tensor, "env 3"]:
        return self._cvel[:, self._hand, :3]

    @property
    def tool_vel_linear(self) -> Float[torch.Tensor, "env 3"]:
        """MuJoCo gives velocities at the robot's centre of mass."""
        arm = self.tool_pos - self._subtree_com[:, self._root]
        return self._cvel[:, self._hand, 3:] + torch.linalg.cross(self.tool_vel_angular, arm)

    def state(self) -> dict[str, torch.Tensor]:
        """Return the live tensors on which the next step depends."""
        d = self._d
        return {
            "time": wp.to_torch(d.time),
            "qpos": self.qpos,
            "qvel": self.qvel,
            "qacc_warmstart": wp.to_torch(d.qacc_warmstart),
            "command": self.command,
            "command_before": self._command_before,
            "first_substep": self._first_substep,
            **{f"model.{name}": value for name, value in self._fields.items()},
        }

    def dropped_contacts(self) -> torch.Tensor:
        """Return whether contacts of any world were dropped because the shared buffers were full."""
        bits = mjw.OverflowType.BROADPHASE | mjw.OverflowType.NARROWPHASE | mjw.OverflowType.CCD
        return ((self.overflow & int(bits)) != 0).any()

    def broken(self) -> torch.Tensor:
        """Return the worlds whose state is not finite, or whose constraints did not fit."""
        apart = (self.qpos.abs() < DIVERGED).all(1) & (self.qvel.abs() < DIVERGED).all(1)
        bits = mjw.OverflowType.NEFC | mjw.OverflowType.NJMAX_NNZ
        return ~apart | ((self.overflow & int(bits)) != 0)

    # -- inside

    def _control_law(self, original: mujoco.MjModel):  # noqa: ANN202
        servo = int(original.actuator("servo_rotation").id)
        constants = (
            self._hand,
            int(self.model.actuator("servo_turn_0").id),
            float(original.actuator_forcerange[servo, 1]),
            wp.from_torch(self._fields["actuator_gainprm"]),
            wp.from_torch(self._fields["actuator_biasprm"]),
        )
        self._substep = 0
        before, now = wp.from_torch(self._command_before), wp.from_torch(self.command)
        first = wp.from_torch(self._first_substep)

        def control(m: mjw.Model, d: mjw.Data) -> None:
            state = (d.xquat, d.actuator_length, d.actuator_velocity)
            wp.launch(
                _control,
                dim=self.num_envs,
                inputs=[now, before, first, self._substep, *constants, *state],
                outputs=[d.ctrl, m.actuator_forcerange],
            )

        return no_type_check(control)

    def _control_step(self) -> None:
        for substep in range(self.physics.substeps):
            self._substep = substep  # read by the control law; a captured graph keeps each value
            mjw.step(self._m, self._d)
        self._kinematics()

    def _kinematics(self) -> None:
        mjw.kinematics(self._m, self._d)
        mjw.com_pos(self._m, self._d)
        mjw.com_vel(self._m, self._d)

    def _clear(self) -> None:
        mjw.reset_data(self._m, self._d, reset=self._to_reset)

    def _capture(self) -> None:
        """Record the three things that are done as CUDA graphs, each after a run that compiles its kernels."""
        for name, work in (
            ("step", self._control_step),
            ("refresh", self._kinematics),
            ("reset", self._clear),
        ):
            with wp.ScopedDevice(self._wp_device):
                work()
                with wp.ScopedCapture() as capture:
                    work()
            if capture.graph is None:
                raise RuntimeError(f"Warp captured no graph of '{name}'")
            self._graphs[name] = capture.graph

    def _run(self, name: str, work) -> None:  # noqa: ANN001
        with wp.ScopedDevice(self._wp_device):
            if name in self._graphs:
                wp.capture_launch(self._graphs[name])
            else:
                work()


def _without_orientation_servo(world: World) -> mujoco.MjModel:
    """Return the model with three rotational servos about the world's axes instead, and without delay lines."""
    spec = mujoco.MjSpec.from_string(world.xml)
    servo = spec.actuator("servo_rotation")
    original = world.model.actuator("servo_rotation").id
    kp = float(world.model.actuator_gainprm[original, 0])
    kv = float(-world.model.actuator_biasprm[original, 2])
    spec.delete(servo)
    for actuator in spec.actuators:
        actuator.nsample, actuator.delay = 0, 0.0
    for k in range(3):
        gear = np.zeros(6)
        gear[3 + k] = 1.0
        turn = spec.add_actuator(
            name=f"servo_turn_{k}",
            trntype=mujoco.mjtTrn.mjTRN_SITE,
            target="tcp",
            refsite="base",
            gear=gear,
        )
        turn.set_to_position(kp=kp, kv=kv)
        turn.forcelimited, turn.forcerange = True, (-1.0, 1.0)  # overwritten in every time step
    model = spec.compile()
    names = [model.actuator(k).name for k in range(model.nu)]
    if names != [*SERVOS[:4], "servo_turn_0", "servo_turn_1", "servo_turn_2"]:
        raise RuntimeError(f"unexpected order of servos: {names}")
    return model
