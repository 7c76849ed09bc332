"""What differs between worlds and episodes: sizes, masses, friction, servo gains, delay, poses, view.

Every value drawn is kept per world (`Randomizer.drawn`), so that an episode can say what it was recorded
under. Values are written into the batch's per-simulation model fields; nothing is recompiled.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from v2p_data.errors import ItemRejectedError
from v2p_data.geometry.rotation import product, quats_about_z
from v2p_data.kinds import KINDS
from v2p_data.scene.scene import FLOOR_MAX_M
from v2p_data.sim.env.layout import drawn_layouts
from v2p_data.sim.env.physics import Physics
from v2p_data.sim.env.ranges import RandomizationConfig
from v2p_data.sim.env.scaling import Draw, FieldWriter
from v2p_data.sim.model.suitability import GRIP_MARGIN_M
from v2p_data.sim.model.world import CAMERA, MESH_SCALES, WALL_MAX_M, ObjectModel, World, cover_of
from v2p_data.sim.robot.grips import LEVEL

START_BANK = 256
PREPARED = 128
"""Draws made at once: a few worlds start anew at most steps, and drawing for a few costs as much as for many."""


class Randomizer:
    """Draws values for worlds and writes them into their physics.

    Args:
        world: the model.
        physics: of the worlds; the fields that vary are expanded here, once.
        cfg: the ranges.
        rng: fills the bank of start poses; later draws get their own generator.

    Attributes:
        size_m: full extents, `(env, object, 3)`.
        mass_kg, friction: `(env, object)`.
        delay_s: `(env,)`.
        servo_gain: factors of the servos' stiffness and damping, `(env, 2)`.
        camera_pos, camera_quat, camera_fovy_deg: of the camera `view`, `(env, 3)`, `(env, 4)`, `(env,)`.
    """

    def __init__(
        self,
        world: World,
        physics: Physics,
        cfg: RandomizationConfig,
        rng: np.random.Generator,
    ) -> None:
        self.world = world
        self.cfg = cfg
        n, objects = physics.num_envs, world.objects
        self.size_m = np.tile(np.array([o.size_m for o in objects]), (n, 1, 1))
        self.mass_kg = np.tile(np.array([o.mass_kg for o in objects]), (n, 1))
        self.friction = np.tile(np.array([o.friction for o in objects]), (n, 1))
        self.delay_s = np.zeros(n)
        self.servo_gain = np.ones((n, 2))
        view = world.model.camera(CAMERA)
        self.camera_pos = np.tile(view.pos, (n, 1))
        self.camera_quat = np.tile(view.quat, (n, 1))
        self.camera_fovy_deg = np.full(n, float(view.fovy[0]))
        self._view = (
            self.camera_pos[0].copy(),
            self.camera_quat[0].copy(),
            self.camera_fovy_deg[0],
        )
        self._height_above_table = np.zeros((n, len(objects)))
        self._radius = np.zeros((n, len(objects)))
        self._fields = {
            name: physics.expand(name)
            for name in [
                "geom_size",
                "geom_pos",
                "geom_rbound",
                "geom_aabb",
                "geom_friction",
                "geom_dataid",
                "bvh_aabb",
                "body_mass",
                "body_inertia",
                "body_ipos",
                "body_subtreemass",
                "body_invweight0",
                "dof_invweight0",
                "dof_M0",
                "actuator_delay",
                "actuator_gainprm",
                "actuator_biasprm",
            ]
        }
        self._base = {name: array[0].copy() for name, array in self._fields.items()}
        self._writer = FieldWriter(world, self._base)
        self._rest = self._writer.rest
        self._largest_scale = [self._largest_scale_of(k, o) for k, o in enumerate(objects)]
        self.start_tool_pos, self.start_yaw, self.start_qpos = self._start_bank(rng)
        self._live = {**self._fields, **self.per_world_arrays()}
        self._prepared = {
            name: np.repeat(array[:1], PREPARED, axis=0) for name, array in self._live.items()
        }
        self._num_used = np.array([PREPARED])

    def draw(self, ids: Int[np.ndarray, "n"], rng: np.random.Generator) -> None:
        """Draw sizes, masses, friction, delay, servo gains and cameras for the worlds `ids`."""
        n = len(ids)
        if n > PREPARED:
            self._draw_into(self._live, ids, rng)
            return
        if self._num_used[0] + n > PREPARED:
            self._draw_into(self._prepared, np.arange(PREPARED), rng)
            self._num_used[0] = 0
        rows = slice(int(self._num_used[0]), int(self._num_used[0]) + n)
        self._num_used[0] += n
        for name, array in self._live.items():
            array[ids] = self._prepared[name][rows]

    def forget_prepared(self) -> None:
        """Let the next draw come from the generator it is given, whatever was prepared with another one."""
        self._num_used[0] = PREPARED

    def _draw_into(
        self, into: dict[str, np.ndarray], rows: np.ndarray, rng: np.random.Generator
    ) -> None:
        cfg, n = self.cfg, len(rows)
        for k, obj in enumerate(self.world.objects):
            most = self._largest_scale[k]
            scale = rng.uniform(cfg.size_scale[0], most, (n, 3))
            mesh_idx = np.full(n, MESH_SCALES.index(1.0))
            if obj.is_round:
                scale[:, 1] = scale[:, 0]
            elif obj.kind == "sphere":
                scale[:] = scale[:, :1]
            elif obj.kind == "mesh":
                library = np.asarray(MESH_SCALES)
                if most[0] < cfg.size_scale[1]:
                    library = library[: max(1, int(np.searchsorted(library, most[0], "right")))]
                mesh_idx = np.abs(library - scale[:, :1]).argmin(1)
                scale = np.repeat(library[mesh_idx, None], 3, axis=1)
            mass = obj.mass_kg * rng.uniform(*cfg.mass_scale, n)
            friction = obj.friction * rng.uniform(*cfg.friction_scale, n)
            draw = Draw(scale=scale, mass=mass, friction=friction, mesh_idx=mesh_idx)
            self._writer.write(into, rows, k, draw)
        into["delay_s"][rows] = rng.uniform(*cfg.delay_s, n)
        into["actuator_delay"][rows] = into["delay_s"][rows, None]
        gain = into["servo_gain"][rows] = rng.uniform(*cfg.servo_gain_scale, (n, 2))
        # A servo's force is gain[0] * control + bias[1] * position + bias[2] * speed.
        for name, first, factor in (
            ("actuator_gainprm", 0, gain[:, :1]),
            ("actuator_biasprm", 1, gain[:, :1]),
            ("actuator_biasprm", 2, gain[:, 1:]),
        ):
            into[name][rows, :, first] = self._base[name][:, first] * factor
        shift = rng.uniform(-1.0, 1.0, (n, 7))  # in any case: a moved camera changes nothing else
        pos, quat, fovy_deg = self._view
        into["camera_pos"][rows] = pos + cfg.camera_pos_m * shift[:, :3]
        into["camera_fovy_deg"][rows] = fovy_deg + cfg.camera_fovy_deg * shift[:, 6]
        if cfg.camera_angle_rad:
            turn = Rotation.from_rotvec(cfg.camera_angle_rad * shift[:, 3:6])
            turned = Rotation.from_quat(quat, scalar_first=True) * turn
            into["camera_quat"][rows] = turned.as_quat(scalar_first=True)

    def place(
        self, ids: Int[np.ndarray, "n"], rng: np.random.Generator
    ) -> Float[np.ndarray, "n object 7"]:
        """Return poses of all objects at rest on the table, apart from each other and within reach.

        Raises:
            ItemRejectedError: the objects do not fit on the table together, or under the cover.
        """
        pair = self._cover_pair()
        if pair is not None:
            self._check_covered_fits(ids, *pair)
        xy = drawn_layouts(self.world.scene, self._radius[ids], pair, self.cfg, rng)
        return self._poses(ids, xy, rng)

    def start_arm(
        self, count: int, rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, "n joint"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
        """Return joint angles, tool positions and yaws of `count` start poses."""
        k = rng.integers(0, len(self.start_qpos), count)
        return self.start_qpos[k], self.start_tool_pos[k], self.start_yaw[k]

    def fields(self) -> dict[str, np.ndarray]:
        """Return the model fields that differ between worlds; live arrays."""
        return self._fields

    def drawn_arrays(self) -> dict[str, np.ndarray]:
        """Return all drawn values, what follows from them, and what is drawn already; live arrays."""
        prepared = {f"prepared_{name}": array for name, array in self._prepared.items()}
        return {**self.per_world_arrays(), **prepared, "num_used": self._num_used}

    def per_world_arrays(self) -> dict[str, np.ndarray]:
        """Return drawn values and what follows from them, each with a row per world; live arrays."""
        return {
            "size_m": self.size_m,
            "mass_kg": self.mass_kg,
            "friction": self.friction,
            "delay_s": self.delay_s,
            "servo_gain": self.servo_gain,
            "camera_pos": self.camera_pos,
            "camera_quat": self.camera_quat,
            "camera_fovy_deg": self.camera_fovy_deg,
            "height_above_table": self._height_above_table,
            "radius": self._radius,
        }

    def drawn(self, env: int) -> dict[str, object]:
        """Return the values world `env` has now, for JSON."""
        objects = {
            o.name: {
                "size_m": np.round(self.size_m[env, k], 5).tolist(),
                "mass_kg": round(float(self.mass_kg[env, k]), 5),
                "friction": round(float(self.friction[env, k]), 4),
            }
            for k, o in enumerate(self.world.objects)
        }
        return {
            "objects": objects,
            "action_delay_ms": round(float(self.delay_s[env]) * 1e3, 3),
            "action_noise": self.cfg.action_noise,
            "servo_stiffness_scale": round(float(self.servo_gain[env, 0]), 4),
            "servo_damping_scale": round(float(self.servo_gain[env, 1]), 4),
            "camera": {
                "pos_m": np.round(self.camera_pos[env], 5).tolist(),
                "quat_wxyz": np.round(self.camera_quat[env], 6).tolist(),
                "fovy_deg": round(float(self.camera_fovy_deg[env]), 4),
            },
        }

    def _poses(self, ids: np.ndarray, xy: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        n, cfg = len(ids), self.cfg
        poses = np.zeros((n, len(self.world.objects), 7))
        poses[:, :, :2] = xy
        poses[:, :, 2] = self._height_above_table[ids] + 5e-4
        for k, obj in enumerate(self.world.objects):
            yaw = rng.uniform(-cfg.yaw_rad, cfg.yaw_rad, n)
            rest = np.tile(np.array([obj.rest_quat]).T, n)
            poses[:, k, 3:] = product(quats_about_z(yaw), rest).T
        return poses

    def _cover_pair(self) -> tuple[int, int] | None:
        """Return cover and what it covers, in tasks about covering."""
        scene = self.world.scene
        cover = cover_of(scene)
        if not KINDS[scene.kind].has_cover or cover is None:
            return None
        return cover, 1 if cover == 0 else 0

    def _check_covered_fits(self, ids: np.ndarray, cover: int, covered: int) -> None:
        obj = self.world.objects[cover]
        size = self.size_m[ids, cover]
        room = size[:, :2].min(1) / 2 - WALL_MAX_M
        too_big = self._radius[ids, covered] - room
        too_tall = 2 * self._height_above_table[ids, covered] - (size[:, 2] - FLOOR_MAX_M)
        excess = float(np.maximum(too_big, too_tall).max())
        if excess > 0:
            raise ItemRejectedError(
                "does_not_fit_under_cover",
                f"'{self.world.objects[covered].name}' does not fit under '{obj.name}' in scene "
                f"'{self.world.scene.title}': {excess * 1000:.0f} mm too large",
                excess,
            )

    def _largest_scale_of(self, k: int, obj: ObjectModel) -> Float[np.ndarray, "3"]:
        """Return the largest factor of each own axis: what must be grasped stays within the open pads, where it can."""
        low, high = self.cfg.size_scale
        most = np.full(3, high)
        if k or not KINDS[self.world.scene.kind].must_grasp:
            return most
        size = np.where(np.abs(self._rest[k][2]) < LEVEL, obj.size_m, np.inf)
        fits = (2 * self.world.robot.finger_travel_m - GRIP_MARGIN_M) / size.min()
        if fits >= low:
            shared = obj.kind in {"mesh", "sphere"}
            narrow = slice(3) if shared else slice(2) if obj.is_round else int(size.argmin())
            most[narrow] = min(high, fits)
        return most

    def _start_bank(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return tool positions, yaws and joint angles of arm poses above the tallest object."""
        tallest = max(
            float(np.ptp(o.hull @ self._rest[k].T, axis=0)[2])
            for k, o in enumerate(self.world.objects)
        )
        reach = np.asarray(self.cfg.arm_pos_m)
        lowest = max(0.195, tallest * self.cfg.size_scale[1] + 0.05 + reach[2])
        home = np.array([0.51, 0.0, min(lowest, 0.42)])
        pos = home + rng.uniform(-1, 1, (START_BANK, 3)) * reach
        yaw = rng.uniform(-self.cfg.arm_yaw_rad, self.cfg.arm_yaw_rad, START_BANK)
        return pos, yaw, self.world.robot.qpos_for(pos, yaw)
