"""The physics of thousands of worlds on MuJoCo Warp, for training on a GPU. The only file that imports Warp.

Needs the extra `gpu` (mujoco-warp 4.0, warp-lang 1.19 go with mujoco 4.0). Warp's arrays are float32 and live on one
device, `cuda:0` or `cpu`; on CUDA a control step is one captured graph. Each control step copies positions, velocities
and commands there, and positions, velocities and touches back: 50 numbers a world. Model fields go there when a world
starts anew. For a seed starts and noise are those of the CPU's worlds.

What our model uses, and what becomes of it here:

| feature | MuJoCo Warp 4.0 | here |
|---|---|---|
| integrator `discrete`, elliptic cones, impratio, joint equality, tendon | yes | as it is |
| position servos with `refsite` | yes | as they are |
| contact sensors `reduce="netforce"`, `data="found"` | yes | as they are |
| sizes, masses, friction, meshes (`geom_dataid`), servo gains per world | yes | as they are |
| `orientation` servo | no (`mjTRN_SO3`) | three rotational position servos, see `_control` |
| delayed controls | yes, in float32 time | the command of the control step before, until the delay is over: the same time steps |
| reset of a world that diverges | no | `BatchEnv` ends it |
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
from jaxtyping import Bool, Float, Int

from v2p_data.errors import V2PError
from v2p_data.sim.env.physics import Physics, SimConfig
from v2p_data.sim.model.world import World
from v2p_data.sim.robot.robot import NUM_CONTROLS

try:
    import mujoco_warp as mjw
    import warp as wp
except ImportError as error:
    raise V2PError(
        f"the backend 'warp' needs MuJoCo Warp, which is not installed ({error}); run 'make setup' in the "
        "repository, or use the backend 'cpu'"
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


class WarpPhysics(Physics):
    """Worlds on one device: a CUDA device, or `cpu` to check the GPU's model (slowly).

    Args:
        world, cfg, motion_scale, num_envs: see `Physics`.

    Raises:
        V2PError: there is no such device.
    """

    def __init__(self, world: World, cfg: SimConfig, motion_scale: float, num_envs: int) -> None:
        self.device = _present(cfg.device)

        self._scene, self._substeps = world.scene.title, world.physics.substeps
        self._timestep_s, self._original = world.physics.timestep_s, world.model
        self._expanded: dict[str, np.ndarray] = {}
        self.qpos = np.tile(world.model.qpos0, (num_envs, 1))
        self.qvel = np.zeros((num_envs, world.model.nv))
        self.ctrl = np.zeros((num_envs, NUM_CONTROLS))
        self._ctrl_before = np.zeros_like(self.ctrl)
        self.sensordata = np.zeros((num_envs, world.model.nsensordata))
        self._is_fresh = np.ones(num_envs, bool)
        """Which worlds were reset since the last step: the device does not know it yet."""
        self._model = _without_orientation_servo(world)
        self._servo_ids = np.array([world.model.actuator(name).id for name in SERVOS])
        self._wp_device = wp.get_device(str(self.device))
        self._graph: wp.Graph | None = None
        with wp.ScopedDevice(self._wp_device):
            self._allocate(num_envs)
        super().__init__(world, cfg, motion_scale, num_envs)

    def expand(self, name: str) -> np.ndarray:
        value = np.asarray(getattr(self._original, name))
        self._expanded[name] = np.repeat(value[None], self.num_envs, axis=0)
        return self._expanded[name]

    def reset(self, ids: Int[np.ndarray, "n"]) -> None:
        self.qpos[ids] = self._original.qpos0
        self.qvel[ids] = 0
        self.sensordata[ids] = 0
        self.broken[ids] = False
        self._is_fresh[ids] = True

    def state(self) -> dict[str, np.ndarray]:
        for name, there in self._kept.items():
            self._kept_here[name][:] = there.cpu().numpy()
        return {
            "warp.qpos": self.qpos,
            "warp.qvel": self.qvel,
            "warp.ctrl_before": self._ctrl_before,
            "warp.sensordata": self.sensordata,
            "warp.is_fresh": self._is_fresh,
            **{f"warp.{name}": array for name, array in self._kept_here.items()},
        }

    def resume(self) -> None:
        for name, there in self._kept.items():
            there.copy_(torch.from_numpy(self._kept_here[name]))
        self._write_fields(np.arange(self.num_envs))
        super().resume()

    def contact_torques(self) -> Float[np.ndarray, "env joint"]:
        forces = wp.to_torch(self._d.qfrc_constraint).cpu().numpy()
        return forces[:, self._robot.arm_dofs].astype(float)

    # -- inside

    def _allocate(self, num_envs: int) -> None:
        per_world: dict[str, int] = dict.fromkeys(
            (*PER_WORLD_FIELDS, "actuator_forcerange"), num_envs
        )
        self._m = mjw.put_model(self._model, batch_sizes=per_world)
        self._m.opt.warn_overflow = 0
        self._d = mjw.make_data(
            self._model,
            nworld=num_envs,
            nconmax=CONTACTS_PER_WORLD,
            njmax=4 * CONTACTS_PER_WORLD + 20,
        )
        self._fields = {name: wp.to_torch(getattr(self._m, name)) for name in PER_WORLD_FIELDS}
        self._commands = torch.zeros(2, num_envs, NUM_CONTROLS, device=self.device)
        """Of the control step before, and of this one."""
        self._first_substep = torch.zeros(num_envs, dtype=torch.int32, device=self.device)
        kept = ("time", "qacc_warmstart")
        self._kept = {name: wp.to_torch(getattr(self._d, name)) for name in kept}
        self._kept_here = {name: array.cpu().numpy().copy() for name, array in self._kept.items()}
        self._overflow = wp.to_torch(self._d.overflow)
        self._m.callback.control = self._control_law()

    def _advance(self, moving: Int[np.ndarray, "n"] | None) -> None:
        del moving  # time passes in all of them
        with wp.ScopedDevice(self._wp_device):
            self._begin(np.flatnonzero(self._is_fresh))
            self._commands.copy_(torch.from_numpy(np.stack([self._ctrl_before, self.ctrl])))
            for name in ("qpos", "qvel"):
                there = wp.to_torch(getattr(self._d, name))
                there.copy_(torch.from_numpy(getattr(self, name)))
            self._run()
            for name in ("qpos", "qvel", "sensordata"):
                there = wp.to_torch(getattr(self._d, name))
                getattr(self, name)[:] = there.cpu().numpy()
        self._ctrl_before[:] = self.ctrl
        dropped = mjw.OverflowType.BROADPHASE | mjw.OverflowType.NARROWPHASE | mjw.OverflowType.CCD
        if bool((self._overflow & int(dropped)).any()):
            raise V2PError(
                f"the worlds of scene '{self._scene}' have more contacts than the backend 'warp' has room "
                f"for ({CONTACTS_PER_WORLD} a world on average); raise CONTACTS_PER_WORLD in sim/env/warp_physics.py "
                "or simplify the scene's objects"
            )

    def _warned(self) -> Bool[np.ndarray, "env"]:
        bits = int(mjw.OverflowType.NEFC | mjw.OverflowType.NJMAX_NNZ)
        near = (np.abs(self.qpos) < DIVERGED).all(1) & (np.abs(self.qvel) < DIVERGED).all(1)
        return ~near | ((self._overflow & bits) != 0).cpu().numpy()

    def _settle(self, ids: Int[np.ndarray, "n"]) -> None:
        self._ctrl_before[ids] = self.ctrl[ids]

    def _begin(self, ids: Int[np.ndarray, "n"]) -> None:
        """Clear worlds on the device, and write there what was drawn for them."""
        if not len(ids):
            return
        cleared = torch.from_numpy(self._is_fresh).to(self.device)
        mjw.reset_data(self._m, self._d, reset=wp.from_torch(cleared))
        self._is_fresh[:] = False
        self._write_fields(ids)

    def _write_fields(self, ids: Int[np.ndarray, "n"]) -> None:
        rows = torch.from_numpy(ids).to(self.device)
        for name, there in self._fields.items():
            values = self._expanded[name][ids]
            if name.startswith("actuator_"):
                values = values[:, self._servo_ids]
            values = torch.from_numpy(values).to(self.device, there.dtype)
            there[rows] = values.reshape(len(ids), *there.shape[1:])
        # A command takes effect from the first time step that begins no earlier than its delay after it.
        delay = self._expanded["actuator_delay"][ids, 0] / self._timestep_s
        first = torch.from_numpy(np.ceil(delay - 1e-6).astype(np.int32))
        self._first_substep[rows] = first.to(self.device)

    def _control_law(self):  # noqa: ANN202
        servo = int(self._original.actuator("servo_rotation").id)
        before, now = (wp.from_torch(command) for command in self._commands)
        constants = (
            int(self._model.site_bodyid[self._model.site("tcp").id]),
            int(self._model.actuator("servo_turn_0").id),
            float(self._original.actuator_forcerange[servo, 1]),
            wp.from_torch(self._fields["actuator_gainprm"]),
            wp.from_torch(self._fields["actuator_biasprm"]),
        )
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

    def _run(self) -> None:
        """Do all time steps of a control step; on CUDA they are recorded, after a run that compiles the kernels."""
        if self._graph is not None:
            wp.capture_launch(self._graph)
            return
        self._time_steps()
        if self._wp_device.is_cuda:
            with wp.ScopedCapture() as capture:
                self._time_steps()
            self._graph = capture.graph

    def _time_steps(self) -> None:
        for substep in range(self._substeps):
            self._substep = substep  # read by the control law; a captured graph keeps each value
            mjw.step(self._m, self._d)


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


def _without_orientation_servo(world: World) -> mujoco.MjModel:
    """Return the model with three rotational servos about the world's axes instead, and without delay lines."""
    spec = world.spec.copy()
    servo = spec.actuator("servo_rotation")
    original = world.model.actuator("servo_rotation").id
    kp = float(world.model.actuator_gainprm[original, 0])
    kv = float(-world.model.actuator_biasprm[original, 2])
    spec.delete(servo)
    for actuator in spec.actuators:
        actuator.nsample, actuator.delay = 0, 0.0
    for sensor in spec.sensors:
        sensor.nsample = 0
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
