"""Cousins of a scene's manipulated object: stretched, flattened, thinned, lengthened, leaning, on another side.

A cousin is an affine map of mesh and convex parts, so closed meshes stay closed and convex parts convex. Mass and
friction are drawn too. In turn a cousin is `alike`, `low` (under 15 mm) and `tall` (over 150 mm); the gripper can take
each. Cousin `k` follows from the seed, the scene and `k` alone, so that asking for more keeps those that are there.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from v2p_data.errors import ItemRejectedError
from v2p_data.geometry.mesh import mesh_for, parts_for
from v2p_data.kinds import KINDS, Kind
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.seeds import rng_for
from v2p_data.sim.model.solids import read_mesh, solids_of
from v2p_data.sim.model.suitability import GRIP_MARGIN_M, MIN_THICKNESS_M, narrowest_m
from v2p_data.sim.robot.arms import RobotConfig, read_arm
from v2p_data.sim.robot.robot import FINE, FINGER_TRAVEL_M, ServoConfig

Form = Literal["alike", "low", "tall"]
FORMS: tuple[Form, ...] = ("alike", "low", "tall")
LOW_M = (MIN_THICKNESS_M, 0.015)
TALL_M = (0.15, 0.22)
LONGEST_M = 0.2
LOW_LENGTH_M = 0.05
"""A low cousin is at least so long."""
NARROWEST_M = 0.012
ALIKE = (0.6, 1.7)
"""Factors of each extent of a cousin that is `alike`."""
MASS_KG = (0.01, 0.6)
DENSITY_SCALE = (0.5, 2.0)
FRICTION_SCALE = (0.75, 1.3)
FRICTION = (0.35, 1.0)
TURNED, LEANING = 0.3, 0.3
"""Shares of cousins that lie on another side, and whose upright lines lean."""
LEAN = 0.35
"""Sideways per upward, at most."""
TRIES = 40


@dataclass(frozen=True, kw_only=True)
class Cousin:
    """One relative of an object."""

    form: Form
    size_m: tuple[float, float, float]
    """Full extents along the object's own axes."""
    shape: Float[np.ndarray, "3 3"]
    """Turn and lean in the object's frame, before the result is brought to size."""
    mass_scale: float
    """Factor of the density."""
    friction: float


def opening_m_of(robot: RobotConfig) -> float:
    """Return the distance between the open pads."""
    return 2 * read_arm(robot, FINE, ServoConfig()).finger_travel_m


def demand_kind(kind: Kind) -> None:
    """Refuse kinds of task that ask for one shape.

    Raises:
        ItemRejectedError: `no_cousins`.
    """
    if KINDS[kind].needs_hollow:
        raise ItemRejectedError(
            "no_cousins",
            f"a task of kind '{kind}' asks that two objects fit each other, so a stretched one has no sense; "
            "ask for cousins of others, or leave them out with --cousins.count=0",
        )


def upright_axis(thing: SceneObject) -> int:
    """Return which own axis of an object as it stands is nearest to the vertical."""
    if not thing.poses_world:
        return 2
    R = Rotation.from_quat(thing.laid_pose[3:], scalar_first=True).as_matrix()
    return int(np.argmax(np.abs(R[2])))


def draw(thing: SceneObject, form: Form, rng: np.random.Generator, opening_m: float) -> Cousin:
    """Return a cousin that may be too wide for the gripper where it leans."""
    up = upright_axis(thing)
    sides = [a for a in range(3) if a != up]
    shape = np.eye(3)
    may_turn = not thing.hollow and thing.shape != "box"
    if may_turn and rng.random() < TURNED:
        a = sides[int(rng.integers(2))]
        shape = np.eye(3)[[a if k == up else up if k == a else k for k in range(3)]]
        shape[a] *= -1  # a turn, no mirror
    if may_turn and rng.random() < LEANING:
        lean = np.eye(3)
        lean[sides, up] = rng.uniform(-LEAN, LEAN, 2)
        shape = lean @ shape
    old = np.abs(shape) @ np.array(thing.size_m)
    widest = opening_m - 2 * GRIP_MARGIN_M
    size = np.empty(3)
    if form == "alike":
        size = old * np.exp(rng.uniform(*np.log(ALIKE), size=3))
        size[up] = max(size[up], MIN_THICKNESS_M)
    else:
        size[up] = rng.uniform(*(LOW_M if form == "low" else TALL_M))
        across, along = sides if rng.random() < 0.5 else sides[::-1]
        least = min(0.03 if form == "tall" or thing.hollow else NARROWEST_M, widest)
        size[across] = np.exp(rng.uniform(*np.log((least, widest))))
        shortest = max(size[across], LOW_LENGTH_M if form == "low" else 0.0)
        size[along] = np.exp(rng.uniform(*np.log((shortest, LONGEST_M))))
    slim = min(sides, key=lambda a: size[a])
    size[slim] = np.clip(size[slim], NARROWEST_M, widest)
    if thing.hollow:  # the simulator builds them round or square
        size[sides] = size[slim]
    x, y, z = (float(v) for v in np.minimum(size, TALL_M[1]))
    return Cousin(
        form=form,
        size_m=(x, y, z),
        shape=shape,
        mass_scale=float(np.exp(rng.uniform(*np.log(DENSITY_SCALE)))),
        friction=float(
            np.clip(thing.friction * np.exp(rng.uniform(*np.log(FRICTION_SCALE))), *FRICTION)
        ),
    )


def mapped(
    cousin: Cousin, mesh: trimesh.Trimesh, parts: tuple[trimesh.Trimesh, ...]
) -> tuple[trimesh.Trimesh, tuple[trimesh.Trimesh, ...]]:
    """Return mesh and parts turned, leaning and brought to the cousin's size, about the middle of the mesh's box."""
    turned = np.asarray(mesh.vertices) @ cousin.shape.T
    low, high = turned.min(0), turned.max(0)
    factor = np.asarray(cousin.size_m) / (high - low)
    T = np.eye(4)
    T[:3, :3] = factor[:, None] * cousin.shape
    T[:3, 3] = -factor * (low + high) / 2
    return mesh.copy().apply_transform(T), tuple(p.copy().apply_transform(T) for p in parts)


def cousin_of(
    scene: Scene, number: int, seed: int, opening_m: float = 2 * FINGER_TRAVEL_M
) -> tuple[SceneObject, trimesh.Trimesh, tuple[trimesh.Trimesh, ...]]:
    """Return cousin `number` of a scene's manipulated object, with mesh and convex parts, in the object's frame.

    Args:
        scene: whose object it is.
        number: from 0; decides the form.
        seed: of the draws.
        opening_m: distance between the open pads.

    Raises:
        ItemRejectedError: `no_cousins` of this kind, `open_mesh`, or `too_few_shapes` that the gripper takes.
    """
    demand_kind(scene.kind)
    thing = scene.manipulated
    where = f"'{thing.name}' of scene '{scene.title}'"
    mesh, parts = _solid(thing, scene)
    if not mesh.is_watertight:
        raise ItemRejectedError(
            "open_mesh",
            f"the mesh of {where} is open, so nobody knows what a stretched one weighs; close it, or leave cousins "
            "out with --cousins.count=0",
        )
    R = (
        Rotation.from_quat(thing.laid_pose[3:], scalar_first=True).as_matrix()
        if thing.poses_world
        else np.eye(3)
    )
    must_fit = KINDS[scene.kind].must_grasp and not thing.hollow
    form = FORMS[number % len(FORMS)]
    rng = rng_for(seed, "cousin", scene.title, number)
    width = NARROWEST_M
    for _ in range(TRIES if opening_m > NARROWEST_M + 2 * GRIP_MARGIN_M else 0):
        cousin = draw(thing, form, rng, opening_m)
        new_mesh, new_parts = mapped(cousin, mesh, parts)
        width = min(narrowest_m(np.asarray(p.vertices) @ R.T) for p in new_parts)
        if not must_fit or width <= opening_m - GRIP_MARGIN_M:
            break
    else:
        raise ItemRejectedError(
            "too_few_shapes",
            f"no '{form}' one of {TRIES} cousins of {where} is narrow enough for the gripper, which opens by "
            f"{opening_m * 1000:.0f} mm",
            width,
        )
    return _described(thing, cousin, new_mesh.volume / mesh.volume, R), new_mesh, new_parts


def _solid(
    thing: SceneObject, scene: Scene
) -> tuple[trimesh.Trimesh, tuple[trimesh.Trimesh, ...]]:
    """Return an object's mesh and convex parts in its own frame."""
    if not thing.mesh:
        form = {"hollow": thing.hollow}
        return mesh_for(thing.shape, thing.size_m, **form), parts_for(
            thing.shape, thing.size_m, **form
        )
    path = scene.folder / thing.mesh
    ready = [scene.folder / part for part in thing.parts]
    solids = solids_of(path, thing.name, thing.size_m, ready=ready)
    mesh = read_mesh(path, thing.name)
    mesh.apply_translation(-mesh.bounds.mean(0))
    mesh.apply_transform(np.diag([*(np.asarray(thing.size_m) / mesh.extents), 1.0]))
    return mesh, solids.parts


def _described(
    thing: SceneObject,
    cousin: Cousin,
    volume: float,
    R: Float[np.ndarray, "3 3"],
) -> SceneObject:
    """Return the cousin as an object on the original's path, with so many times its volume."""
    higher = float(np.abs(R[2]) @ (np.array(cousin.size_m) - np.array(thing.size_m))) / 2
    stays = thing.shape == "box" or (thing.hollow and thing.shape != "mesh")
    return replace(
        thing,
        shape=thing.shape if stays else "mesh",
        size_m=cousin.size_m,
        mass_kg=float(np.clip(thing.mass_kg * abs(volume) * cousin.mass_scale, *MASS_KG)),
        friction=cousin.friction,
        symmetry="box" if thing.shape == "box" else "none",
        mask_track="",
        source=dict.fromkeys(("size", "mass", "friction"), f"drawn: {cousin.form} cousin"),
        poses_world=tuple((x, y, z + higher, *q) for x, y, z, *q in thing.poses_world),
    )
