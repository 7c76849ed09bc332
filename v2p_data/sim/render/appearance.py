"""What a camera sees beside the task: things that stand about, light and colours. Nothing of it takes part in physics.

Pictures are drawn after the physics, from saved states, so the whole episode is known by then.
Distractors are put where nothing comes near them during the episode; had they been there all along, nothing would
have gone otherwise. In masks they are background that hides what is behind it.
"""

# pyright: reportAttributeAccessIssue=false
# mujoco's classes come from a compiled module that declares none of them.

from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from v2p_data.sim.env.batch_env import Snapshot
from v2p_data.sim.model.world import World, build_world
from v2p_data.sim.robot.arms import robot_from_json
from v2p_data.sim.robot.robot import FINE
from v2p_data.task.task import TaskBundle

ROOM_LOW_M, ROOM_HIGH_M = (0.25, -0.45), (0.85, 0.45)
"""Where on the table distractors may stand; most of it is in the camera's view."""
CLEARANCE_M = 0.01
PLACEMENT_TRIES = 30
NOWHERE = (0.0, 0.0, -5.0)
"""Under the table, where those stay that found no place."""
_SHAPES = ("box", "cylinder", "sphere")


@dataclass(frozen=True, kw_only=True)
class DistractorConfig:
    """Things on the table that the task says nothing about."""

    count: tuple[int, int] = (0, 0)
    """Fewest and most; (0, 0) is none."""
    size_m: tuple[float, float] = (0.02, 0.08)
    """Shortest and longest side or diameter."""

    def __post_init__(self) -> None:
        if not 0 <= self.count[0] <= self.count[1] <= 20:
            raise ValueError(f"need 0 <= fewest <= most <= 20 distractors, got {self.count}")
        if not 0 < self.size_m[0] <= self.size_m[1] <= 0.3:
            raise ValueError(f"distractors are up to 0.3 m in size, got {self.size_m}")


@dataclass(frozen=True, kw_only=True)
class LookConfig:
    """Light and colours of RGB pictures; masks have neither."""

    light: float = 0.0
    """Brightness of lamp and surroundings changes by up to this share, and the lamp moves by up to this many metres."""
    colour: float = 0.0
    """Every channel of every object's and the table's colour changes by up to this much, out of 1."""
    texture: float = 0.0
    """Probability that the table has a pattern of two colours."""

    def __post_init__(self) -> None:
        if min(self.light, self.colour) < 0 or not 0 <= self.texture <= 1 or self.light > 1:
            raise ValueError(
                f"light and texture lie in [0, 1] and colour is 0 or more, got {self}"
            )

    @property
    def is_off(self) -> bool:
        return not (self.light or self.colour or self.texture)


@dataclass(frozen=True, kw_only=True)
class Furnished:
    """A scene to draw one episode in."""

    world: World
    drawn: dict[str, Any]
    """What was drawn, for the episode's parameters."""
    sizes: np.ndarray
    """Half extents of the distractors' geoms, as MuJoCo has them, `(n, 3)`."""

    def moment(self, snapshot: Snapshot, world: int) -> Snapshot:
        """Return one world of a snapshot with the distractors in it; its index is 0."""
        one = snapshot.rows(np.array([world]))
        none = np.zeros((1, len(self.sizes), 3))
        return replace(
            one,
            geom_size=np.concatenate([one.geom_size, self.sizes[None]], axis=1),
            geom_pos=np.concatenate([one.geom_pos, none], axis=1),
            geom_dataid=np.concatenate(
                [one.geom_dataid, np.full((1, len(self.sizes)), -1, one.geom_dataid.dtype)], axis=1
            ),
        )


def furnish(
    bundle: TaskBundle,
    snapshots: list[Snapshot],
    index: int,
    distractors: DistractorConfig,
    look: LookConfig,
    rng: np.random.Generator,
) -> Furnished:
    """Return the task's scene with distractors and a look of its own.

    Args:
        bundle: the task.
        snapshots: moments of the episode, all that distractors must keep clear of.
        index: which world of the snapshots.
        distractors: how many, how large.
        look: light and colours.
        rng: decides everything.
    """
    plain = build_world(bundle.scene, FINE, robot=robot_from_json(bundle.robot))
    count = int(rng.integers(*distractors.count, endpoint=True))
    spec = plain.spec.copy()
    things = [_add_thing(spec, k, distractors, rng) for k in range(count)]
    drawn_look = {} if look.is_off else _paint(spec, plain, look, rng)
    world = replace(plain, model=spec.compile())
    ids = [world.model.geom(t["name"]).id for t in things]
    if ids != list(range(plain.model.ngeom, plain.model.ngeom + count)):
        raise RuntimeError(f"distractors are geoms {ids} of {world.model.ngeom}, not the last")
    sizes = world.model.geom_size[ids].copy().reshape(-1, 3)
    furnished = Furnished(world=world, drawn={}, sizes=sizes)
    _find_places(furnished, things, snapshots, index, rng)
    return replace(furnished, drawn={"distractors": things, "look": drawn_look})


def _add_thing(
    spec: Any, k: int, cfg: DistractorConfig, rng: np.random.Generator
) -> dict[str, Any]:
    shape = _SHAPES[int(rng.integers(len(_SHAPES)))]
    half = rng.uniform(*cfg.size_m, 3) / 2
    size = {"box": half, "cylinder": [half[0], half[2], 0], "sphere": [half[0], 0, 0]}[shape]
    height = {"box": half[2], "cylinder": half[2], "sphere": half[0]}[shape]
    yaw = rng.uniform(-np.pi, np.pi)
    name = f"distractor_{k}"
    colour = rng.uniform(0.1, 0.9, 3).tolist()
    body = spec.worldbody.add_body(
        name=name, pos=NOWHERE, quat=[np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    )
    # It collides with everything here, to find a place; the model is for drawing only.
    body.add_geom(
        name=name,
        type=getattr(mujoco.mjtGeom, f"mjGEOM_{shape.upper()}"),
        size=list(size),
        rgba=[*colour, 1.0],
        contype=0xFFFF,
        conaffinity=0xFFFF,
        margin=CLEARANCE_M,
    )
    return {
        "name": name,
        "shape": shape,
        "size_m": np.round(2 * np.asarray(size), 5).tolist(),
        "height_m": round(2 * float(height), 5),
        "yaw_rad": round(float(yaw), 4),
        "rgb": np.round(colour, 3).tolist(),
    }


def _find_places(
    furnished: Furnished,
    things: list[dict[str, Any]],
    snapshots: list[Snapshot],
    index: int,
    rng: np.random.Generator,
) -> None:
    """Move the distractors to where nothing touches them in any moment; note it in `things`."""
    if not things:
        return
    model = furnished.world.model
    data = mujoco.MjData(model)
    moments = [furnished.moment(s, index) for s in snapshots]
    bodies = [model.body(t["name"]).id for t in things]
    geom_of = {int(model.geom(t["name"]).id): k for k, t in enumerate(things)}
    todo = set(range(len(things)))
    for _ in range(PLACEMENT_TRIES):
        if not todo:
            break
        for k in sorted(todo):
            xy = rng.uniform(ROOM_LOW_M, ROOM_HIGH_M)
            model.body_pos[bodies[k]] = (*xy, things[k]["height_m"] / 2)
        todo = _touched(model, data, moments, geom_of, todo)
    for k in todo:
        model.body_pos[bodies[k]] = NOWHERE
    for k, thing in enumerate(things):
        there = k not in todo
        thing["pos_m"] = np.round(model.body_pos[bodies[k]], 5).tolist() if there else None


def _touched(
    model: Any, data: Any, moments: list[Snapshot], geom_of: dict[int, int], todo: set[int]
) -> set[int]:
    """Return which of `todo` something comes near to, or stand in one another."""
    touched: set[int] = set()
    bodies = {k: model.geom_bodyid[g] for g, k in geom_of.items()}
    for a in todo:
        for b in bodies:
            apart = model.body_pos[bodies[a]] - model.body_pos[bodies[b]]
            room = model.geom_rbound[[g for g, k in geom_of.items() if k in (a, b)]].sum()
            if a != b and np.linalg.norm(apart) < room + CLEARANCE_M:
                touched.add(max(a, b) if b in todo else a)  # static things have no contacts
    for moment in moments:
        moment.write(model, data, 0)
        mujoco.mj_collision(model, data)
        for contact in data.contact[: data.ncon]:
            touched |= {geom_of[int(g)] for g in contact.geom if int(g) in geom_of}
    return touched & todo


def _paint(spec: Any, plain: World, look: LookConfig, rng: np.random.Generator) -> dict[str, Any]:
    """Change light and colours; return what was drawn."""
    lamp, lit = spec.lights[0], 1 + look.light * rng.uniform(-1, 1, 2)
    lamp.pos = np.asarray(lamp.pos) + look.light * rng.uniform(-1, 1, 3)
    lamp.diffuse = np.clip(np.asarray(lamp.diffuse) * lit[0], 0, 1)
    head = spec.visual.headlight
    head.ambient = np.clip(np.asarray(head.ambient) * lit[1], 0, 1)
    colours: dict[str, list[float]] = {}

    def changed(rgba: Any) -> np.ndarray:
        return np.append(np.clip(rgba[:3] + look.colour * rng.uniform(-1, 1, 3), 0, 1), rgba[3])

    painted = {"table", *(plain.model.geom(g).name for o in plain.objects for g in o.geom_ids)}
    for geom in spec.geoms:
        if geom.name in painted:
            geom.rgba = changed(np.asarray(geom.rgba))
            colours[geom.name] = np.round(geom.rgba[:3], 3).tolist()
    textured = bool(rng.uniform() < look.texture)
    if textured:
        one, other = rng.uniform(0.1, 0.9, (2, 3))
        spec.add_texture(
            name="table_pattern",
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
            width=256,
            height=256,
            rgb1=one,
            rgb2=other,
        )
        material = spec.add_material(name="table_pattern", texrepeat=[8, 8])
        material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = "table_pattern"
        spec.geom("table").material = "table_pattern"
        spec.geom("table").rgba = [1, 1, 1, 1]
        colours["table"] = [np.round(one, 3).tolist(), np.round(other, 3).tolist()]
    return {
        "lamp_pos_m": np.round(lamp.pos, 4).tolist(),
        "lamp_scale": round(float(lit[0]), 4),
        "ambient_scale": round(float(lit[1]), 4),
        "rgb": colours,
    }
