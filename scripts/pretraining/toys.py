"""Random tasks of one kind: the moved object and the other one, in many sizes and forms.

Task `number` of a kind follows from the seed, the kind and the number alone. Sizes are drawn without a look at the
gripper. The simulator refuses objects that do not suit the robot, as it does those of videos.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from numpy.random import Generator

from v2p_data.geometry.mesh import Size, mesh_for, parts_for, write_obj
from v2p_data.kinds import KINDS, Kind
from v2p_data.scene.scene import FLOOR_MAX_M, SceneObject
from v2p_data.seeds import rng_for
from v2p_data.sim.model.world import WALL_MAX_M
from v2p_data.task.benchmark import load_benchmark, task_of
from v2p_data.task.task import TaskBundle

OPENING_M = 0.083
"""What fits between the open pads."""
Form = Literal["box", "cylinder", "sphere", "cup", "bin", "ring", "stack", "bottle", "rod", "bent"]


@dataclass(frozen=True, kw_only=True)
class Body:
    """One object's shape, upright."""

    form: Form
    size_m: Size
    bore: float = 0.0
    """Of a ring: share of its diameter."""


def random_task(kind: Kind, number: int, seed: int, folder: Path) -> TaskBundle:
    """Return one task; its meshes are written into a folder of its own under `folder`."""
    rng = rng_for(seed, "pretraining", kind, number)
    title = f"{kind}_{number:04d}"
    thing, other = _BODIES[kind](rng)
    base = load_benchmark("lift_up" if kind == "place_onto" else kind).scene
    objects = [_object(thing, "thing", _roles(kind)[0], rng, folder / title)]
    if other is not None:
        objects.append(_object(other, "other", _roles(kind)[1], rng, folder / title))
    ways = _ways(kind, objects, rng)
    objects = [_moved(o, way, kind) for o, way in zip(objects, ways, strict=True)]
    scene = replace(
        base,
        title=title,
        video="",
        description=_WORDS[kind],
        kind=kind,
        objects=tuple(objects),
        num_frames=max(len(w) for w in ways),
        folder=folder / title,
    )
    return task_of(scene)


_WORDS: dict[Kind, str] = {
    "lift_up": "Lifting a thing up",
    "push_left": "Pushing a thing from right to left",
    "push_right": "Pushing a thing from left to right",
    "tip_over": "Tipping a thing over",
    "push_next_to": "Pushing a thing next to an other",
    "cover": "Covering an other with a thing",
    "uncover": "Uncovering an other",
    "push_with": "Pushing a thing with an other",
    "drop_in_front_of": "Dropping a thing in front of an other",
    "insert": "Putting a thing into an other",
    "slide_to": "Sliding a thing to an other",
    "throw_into": "Throwing a thing into an other",
    "place_onto": "Putting a thing onto an other",
}


def _roles(kind: Kind) -> tuple[str, str]:
    if KINDS[kind].has_cover:
        return "cover", "reference"
    if KINDS[kind].hides:
        return "manipulated", "container"
    return "manipulated", "tool" if KINDS[kind].grasps == "tool" else "reference"


# --- shapes --------------------------------------------------------------------------------------------------


def _u(rng: Generator, low: float, high: float) -> float:
    """Return a number, evenly spread on the logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(max(high, low)))))


def _graspable(rng: Generator, longest: float = 0.2, tallest: float = 0.22) -> Body:
    shares = {"box": 0.26, "cylinder": 0.14, "sphere": 0.06, "stack": 0.12, "cup": 0.1}
    shares |= {"ring": 0.04, "bottle": 0.08, "rod": 0.1, "bent": 0.1}
    form = str(rng.choice(list(shares), p=list(shares.values())))
    if form == "rod":  # a cylinder that lies: a marker, a candle
        d = _u(rng, 0.012, 0.06)
        return Body(form="rod", size_m=(_u(rng, max(1.5 * d, 0.05), max(longest, 2 * d)), d, d))
    if form == "bent":  # a banana, a pair of scissors, a spoon
        deep = _u(rng, 0.012, 0.04)
        return Body(
            form="bent", size_m=(_u(rng, 0.07, max(longest, 0.08)), deep, _u(rng, 0.01, 0.035))
        )
    if form == "box":
        narrow = _u(rng, 0.012, 0.08)
        long = _u(rng, max(narrow, 0.02), max(longest, narrow))
        high = _u(rng, 0.01, 0.02 if rng.random() < 0.3 else min(tallest, 5 * narrow))
        pair = (long, narrow) if rng.random() < 0.5 else (narrow, long)
        return Body(form="box", size_m=(*pair, high))
    if form == "sphere":
        d = _u(rng, 0.025, 0.08)
        return Body(form="sphere", size_m=(d, d, d))
    if form == "cup":
        d = _u(rng, 0.05, min(0.16, longest))
        return Body(form="cup", size_m=(d, d, _u(rng, 0.04, min(0.13, tallest))))
    if form == "ring":
        d = _u(rng, 0.04, min(0.1, longest))
        return Body(
            form="ring", size_m=(d, d, _u(rng, 0.012, 0.04)), bore=float(rng.uniform(0.35, 0.7))
        )
    if form == "stack":
        wide, deep = _u(rng, 0.02, 0.08), _u(rng, 0.02, 0.08)
        return Body(form="stack", size_m=(wide, deep, _u(rng, 0.03, min(tallest, 0.16))))
    if form == "bottle":
        d = _u(rng, 0.04, 0.08)
        return Body(form="bottle", size_m=(d, d, _u(rng, min(0.09, tallest), tallest)))
    d = _u(rng, 0.018, 0.08)
    return Body(form="cylinder", size_m=(d, d, _u(rng, 0.015, min(tallest, 4 * d))))


def _stood(
    rng: Generator, low: float, high: float, steep: float = 2.0, tallest: float = 0.2
) -> Body:
    """Return the shape of an object that is pushed: a box, a cylinder, a cup or a bin."""
    forms = ["box", "cylinder", "cup", "bin"]
    form: Form = str(rng.choice(forms, p=[0.5, 0.3, 0.12, 0.08]))  # type: ignore[assignment]
    a, b = _u(rng, low, high), _u(rng, low, high)
    if form in ("cylinder", "cup"):
        b = a = max(a, 0.045 if form == "cup" else 0.0)
    if form == "bin":
        b = a = max(a, 0.06)
    return Body(form=form, size_m=(a, b, _u(rng, 0.02, min(steep * min(a, b), tallest))))


def _container(rng: Generator, inner: float, low: float, high: float) -> Body:
    d = float(np.clip(inner * rng.uniform(1.35, 2.1), low, high))
    form: Form = "cup" if rng.random() < 0.6 else "bin"
    return Body(form=form, size_m=(d, d, _u(rng, 0.03, 0.12)))


def _pushed(rng: Generator) -> tuple[Body, None]:
    return _stood(rng, 0.03, 0.15), None


def _tipped(rng: Generator) -> tuple[Body, None]:
    a, b = _u(rng, 0.03, 0.08), _u(rng, 0.03, 0.08)
    form: Form = "box"
    if rng.random() < 0.4:
        form, b = "cylinder", a
    return Body(
        form=form, size_m=(a, b, float(np.clip(max(a, b) * rng.uniform(1.7, 3.5), 0.08, 0.24)))
    ), None


def _beside(rng: Generator) -> tuple[Body, Body]:
    return _stood(rng, 0.035, 0.1), _stood(rng, 0.05, 0.11, steep=1.5)


def _slid(rng: Generator) -> tuple[Body, Body]:
    wide = _u(rng, 0.02, 0.07)
    size = (_u(rng, wide, 0.18), wide, _u(rng, 0.015, min(0.06, 1.2 * wide)))
    form: Form = "box"
    if rng.random() < 0.25:
        form, size = "cylinder", (wide, wide, size[2])
    return Body(form=form, size_m=size), _stood(rng, 0.05, 0.11, steep=1.2)


def _covering(rng: Generator) -> tuple[Body, Body]:
    """Return a cover and an object that fits under it, for all sizes that an episode may draw."""
    d, high = _u(rng, 0.064, 0.08), _u(rng, 0.055, 0.14)
    room = 0.45 * d - WALL_MAX_M
    form: Form = str(rng.choice(["box", "cylinder", "sphere"]))  # type: ignore[assignment]
    wide = room * rng.uniform(0.75, 0.95) * (1.25 if form == "box" else 1.75)
    most = 0.7 * (0.9 * high - FLOOR_MAX_M)
    tall = wide if form == "sphere" else float(np.clip(wide * rng.uniform(0.7, 1.4), 0.015, most))
    if tall > most:  # a ball under a low cover
        high = (tall / 0.7 + FLOOR_MAX_M) / 0.9
    cover: Form = "cup" if rng.random() < 0.7 else "bin"
    return Body(form=cover, size_m=(d, d, high)), Body(form=form, size_m=(wide, wide, tall))


def _with_stick(rng: Generator) -> tuple[Body, Body]:
    stick = (_u(rng, 0.12, 0.26), _u(rng, 0.016, 0.04), _u(rng, 0.016, 0.04))
    return _stood(rng, 0.03, 0.09, steep=1.4), Body(form="box", size_m=stick)


def _in_front(rng: Generator) -> tuple[Body, Body]:
    return _graspable(rng, 0.12, 0.12), _stood(rng, 0.05, 0.12, steep=1.8)


def _inserted(rng: Generator) -> tuple[Body, Body]:
    thing = _graspable(rng, 0.14, 0.1)
    return thing, _container(rng, max(thing.size_m[:2]), 0.09, 0.24)


def _thrown(rng: Generator) -> tuple[Body, Body]:
    d, d2, d3 = (_u(rng, 0.025, 0.06) for _ in range(3))
    form: Form = str(rng.choice(["sphere", "box", "cylinder"]))  # type: ignore[assignment]
    size = {"sphere": (d, d, d), "box": (d, d2, d3), "cylinder": (d, d, d2)}[form]
    wide = float(rng.uniform(0.19, 0.28))
    bowl: Form = "cup" if rng.random() < 0.7 else "bin"
    return Body(form=form, size_m=size), Body(
        form=bowl, size_m=(wide, wide, float(rng.uniform(0.06, 0.12)))
    )


def _placed(rng: Generator) -> tuple[Body, Body]:
    thing = _graspable(rng, 0.13, 0.15)
    wide = float(np.clip(max(thing.size_m[:2]) * rng.uniform(1.0, 1.8), 0.08, 0.18))
    form: Form = "box" if rng.random() < 0.7 else "cylinder"
    deep = (
        wide if form == "cylinder" else float(np.clip(wide * rng.uniform(0.8, 1.25), 0.08, 0.18))
    )
    return thing, Body(form=form, size_m=(wide, deep, _u(rng, 0.015, 0.09)))


_BODIES = {
    "lift_up": lambda rng: (_graspable(rng), None),
    "push_left": _pushed,
    "push_right": _pushed,
    "tip_over": _tipped,
    "push_next_to": _beside,
    "slide_to": _slid,
    "cover": _covering,
    "uncover": _covering,
    "push_with": _with_stick,
    "drop_in_front_of": _in_front,
    "insert": _inserted,
    "throw_into": _thrown,
    "place_onto": _placed,
}


def _object(body: Body, name: str, role: str, rng: Generator, folder: Path) -> SceneObject:
    """Return the object with drawn density and friction, its mesh and parts in files where it is no primitive."""
    kind = {"cup": "cylinder", "bin": "box"}.get(body.form, body.form)
    hollow = body.form in ("cup", "bin")
    mesh, files, size = "", (), body.size_m
    if kind in ("ring", "stack", "bottle", "rod", "bent"):
        whole, parts = _pieces(body, rng)
        middle = whole.bounds.mean(0)
        x, y, z = (float(v) for v in whole.extents)
        size = (x, y, z)
        (folder / "meshes").mkdir(parents=True, exist_ok=True)
        mesh = f"meshes/{name}.obj"
        write_obj(whole.apply_translation(-middle), folder / mesh)
        files = tuple(f"meshes/{name}_part_{k:02d}.obj" for k in range(len(parts)))
        for part, file in zip(parts, files, strict=True):
            write_obj(part.apply_translation(-middle), folder / file)
        volume, kind = sum(abs(p.volume) for p in parts), "mesh"
    else:
        volume = sum(abs(p.volume) for p in parts_for(kind, size, hollow=hollow))
    density = _u(rng, 150, 900)
    return SceneObject(
        name=name,
        label=name,
        role=role,  # pyright: ignore[reportArgumentType]
        shape=kind,  # pyright: ignore[reportArgumentType]
        size_m=size,
        mass_kg=float(np.clip(density * volume, 0.01, 0.6)),
        friction=float(rng.uniform(0.4, 0.8)),
        hollow=hollow,
        mesh=mesh,
        parts=files if len(files) > 1 else (),
        source=dict.fromkeys(("size", "mass", "friction"), "drawn"),
    )


def _pieces(body: Body, rng: Generator) -> tuple[trimesh.Trimesh, list[trimesh.Trimesh]]:
    """Return a closed mesh of several pieces, one upon the other, and their convex parts."""
    if body.form == "ring":
        shape = {"bore": body.bore}
        return mesh_for("cylinder", body.size_m, **shape), list(
            parts_for("cylinder", body.size_m, **shape)
        )
    if body.form in ("rod", "bent"):
        return _lying(body, rng)
    wide, deep, high = body.size_m
    if body.form == "bottle":
        neck, share = wide * float(rng.uniform(0.3, 0.6)), float(rng.uniform(0.55, 0.8))
        pieces = [
            ("cylinder", (wide, wide, share * high)),
            ("cylinder", (neck, neck, (1 - share) * high)),
        ]
    else:
        cuts = (
            np.diff([0.0, *sorted(rng.uniform(0.25, 0.75, int(rng.integers(1, 3)))), 1.0]) * high
        )
        pieces = []
        for cut in cuts:
            a, b = wide * rng.uniform(0.5, 1.0), deep * rng.uniform(0.5, 1.0)
            form = "box" if rng.random() < 0.5 else "cylinder"
            pieces.append((form, (a, b if form == "box" else a, float(cut))))
    meshes, parts, top = [], [], 0.0
    for form, size in pieces:
        lift = [0.0, 0.0, top + size[2] / 2]
        meshes.append(mesh_for(form, size).apply_translation(lift))
        parts += [p.apply_translation(lift) for p in parts_for(form, size)]
        top += size[2]
    whole = trimesh.util.concatenate(meshes)
    assert isinstance(whole, trimesh.Trimesh)
    return whole, parts


def _lying(body: Body, rng: Generator) -> tuple[trimesh.Trimesh, list[trimesh.Trimesh]]:
    """Return a cylinder on its side, or two bars that meet at an angle, perhaps with a bowl at the end."""
    long, deep, high = body.size_m
    if body.form == "rod":
        side = trimesh.transformations.rotation_matrix(np.pi / 2, [0.0, 1.0, 0.0])
        whole = mesh_for("cylinder", (deep, deep, long)).apply_transform(side)
        return whole, [whole.convex_hull]
    parts = []
    angle, share = float(rng.uniform(0.2, 1.2)), float(rng.uniform(0.35, 0.65))
    for turn, length in ((0.0, share * long), (angle, (1 - share) * long)):
        bar = mesh_for("box", (length + deep / 2, deep, high * float(rng.uniform(0.7, 1.0))))
        bar.apply_translation([length / 2 if turn else -length / 2, 0.0, bar.extents[2] / 2])
        parts.append(bar.apply_transform(trimesh.transformations.rotation_matrix(turn, [0, 0, 1])))
    whole = trimesh.util.concatenate([p.copy() for p in parts])
    assert isinstance(whole, trimesh.Trimesh)
    return whole, parts


# --- ways ----------------------------------------------------------------------------------------------------

Way = list[tuple[float, float, float, float]]
"""Points x, y, height of the bottom [m], and yaw [rad]."""


def _ways(kind: Kind, objects: list[SceneObject], rng: Generator) -> list[Way]:
    """Return how each object moved in a video that nobody took."""
    x, y = float(rng.uniform(-0.02, 0.04)), float(rng.uniform(0.14, 0.24))
    sizes = [o.size_m for o in objects]
    top = sizes[-1][2]
    at = (x, y, 0.0, 0.0)
    still = [at, at]
    start = (0.0, 0.0, 0.0, 0.0)
    room = (max(sizes[0][:2]) + max(sizes[-1][:2])) / 2
    match kind:
        case "lift_up":
            return [[start, (0.0, 0.0, float(rng.uniform(0.12, 0.18)), 0.0)]]
        case "push_left" | "push_right":
            sign = 1 if kind == "push_left" else -1
            # As far as any task of this kind asks: how far one asks is nothing that the expert sees.
            return [[start, (x / 2, sign * 0.25, 0.0, 0.0)]]
        case "tip_over":
            return [[start, (0.0, 0.11, 0.0, 0.0)]]
        case "push_next_to" | "slide_to":
            far = room + float(rng.uniform(0.06, 0.12))
            there = (x, far, 0.0, 0.0)
            return [[start, (x, far - room - 0.005, 0.0, 0.0)], [there, there]]
        case "uncover":
            return [[start, (0.0, 0.0, float(rng.uniform(0.12, 0.17)), 0.0)], [start, start]]
        case "push_with":
            gap = max(sizes[0][:2]) / 2 + sizes[1][0] / 2 + 0.06
            return [
                [start, (0.02, float(rng.uniform(0.1, 0.16)), 0.0, 0.0)],
                [(-0.02, -gap, 0.0, np.pi / 2), (0.0, 0.13 - gap, 0.0, np.pi / 2)],
            ]
        case "drop_in_front_of":
            there = (room + 0.02, y, 0.0, 0.0)
            return [[start, (0.02, y / 2, 0.12, 0.0), (0.0, y, 0.0, 0.0)], [there, there]]
        case "throw_into":
            far = (float(rng.uniform(0.45, 0.55)), 0.0, 0.0, 0.0)
            return [[start, (0.2, 0.0, 0.25, 0.0), (far[0], 0.0, 0.02, 0.0)], [far, far]]
        case "place_onto":
            return [[start, (x / 2, y / 2, top + 0.1, 0.0), (x, y, top, 0.0)], still]
        case "insert":
            return [[start, (x / 2, y / 2, top + 0.1, 0.0), (x, y, 0.02, 0.0)], still]
        case "cover":
            return [[start, (x / 2, y / 2, top + 0.1, 0.0), at], still]
        case _:
            raise ValueError(f"no way of a task of kind '{kind}'")


def _moved(thing: SceneObject, way: Way, kind: Kind) -> SceneObject:
    """Return the object on its way; what is tipped ends on its side."""
    poses = [
        (x, y, z + thing.size_m[2] / 2, float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2)))
        for x, y, z, yaw in way
    ]
    if kind == "tip_over":
        last = poses[-1]
        side = float(np.sqrt(0.5))
        poses[-1] = (last[0], last[1], thing.size_m[1] / 2, side, -side, 0.0, 0.0)
    return replace(
        thing,
        frames=tuple(range(len(poses))),
        poses_world=tuple(poses),
        confidences=(1.0,) * len(poses),
        observed=("full",) * len(poses),
    )
