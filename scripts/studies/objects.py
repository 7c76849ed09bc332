"""Where the study's objects come from: clips that the engine reconstructs, random toys, and meshes nobody trains on.

Each becomes a scene, the scene a task by the engine's own stage, and the task gets the one instruction of the study, so
that a policy cannot tell objects by words. Objects of the evaluation live in a run folder of their own;
`demand_apart` compares meshes by what they are, not by their names.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float

from drawn_clips.clips import drawing_code, random_spec, render
from drawn_clips.props import NOUNS, prop_called, shape_of
from drawn_clips.truth import write
from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera
from v2p_data.geometry.mesh import Size, mesh_for, parts_for, write_obj
from v2p_data.kinds import Kind
from v2p_data.pipeline.fingerprint import file_digest
from v2p_data.pipeline.runner import Runtime, Stage
from v2p_data.scene.scene import Scene, SceneObject
from v2p_data.seeds import rng_for
from v2p_data.sim.model.solids import read_mesh
from v2p_data.stages import EngineConfig, expert_stage, scene_stage, task_stage
from v2p_data.video.captions import CAPTIONS_FILE, VideoItem, find_videos
from v2p_data.video.meaning import parse_caption

from .config import ASKED, PoolConfig, UnseenConfig

MESH_FILE = "textured.obj"
MASSES_FILES = "*mass.json"
DENSITY_KG_M3 = 300.0
"""Of an object whose mass nobody says, relative to its hull: between a full carton and a wooden block."""
FRICTION = 0.6
"""Of objects that no clip showed; the middle of the engine's table of nouns."""
SAME_MESH = 1e-4
"""Relative: what writing coordinates as text changes is far less."""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One object that may be trained on."""

    scene: Stage
    task: Stage
    """With the study's instruction."""
    expert: Stage

    @property
    def item(self) -> str:
        return self.task.item


def candidate_of(scene: Stage, engine: EngineConfig, kind: Kind) -> Candidate:
    """Return the stages that make an expert of a scene."""
    task = instructed_stage(task_stage(scene, engine), kind)
    return Candidate(scene=scene, task=task, expert=expert_stage(task, engine))


def instructed_stage(task: Stage, kind: Kind) -> Stage:
    """Return the stage that gives a task the study's instruction."""
    return Stage(
        name="instruction",
        item=task.item,
        config={"kind": kind, "instruction": ASKED[kind].instruction},
        inputs={"task": task},
        make=make_instructed,
    )


def make_instructed(
    cfg: dict[str, str], inputs: Mapping[str, Path], out: Path, runtime: Runtime
) -> dict[str, Any]:
    """Write the task with other words; a task of another kind is refused."""
    from v2p_data.errors import ItemRejectedError
    from v2p_data.task.task import TaskBundle

    del runtime
    bundle = TaskBundle.load(inputs["task"])
    if bundle.kind != cfg["kind"]:
        raise ItemRejectedError("other_kind", f"'{bundle.description}' is '{bundle.kind}'")
    replace(bundle, description=cfg["instruction"]).save(out)
    return {"caption": bundle.description}


# --- clips ---------------------------------------------------------------------------------------------------


def is_held_out(words: str, held_out: Iterable[str]) -> str | None:
    """Return which held-out category the words name, singular or plural, if any."""
    padded = f" {' '.join(words.lower().replace(',', ' ').split())} "
    return next((w for w in held_out if f" {w} " in padded or f" {w}s " in padded), None)


def clip_stage(number: int, pool: PoolConfig) -> Stage:
    """Return the stage that draws one clip: noun, shape, texture, room, hand and camera at random."""
    return Stage(
        name="clip",
        item=f"clip_{number:04d}",
        config={
            "seed": pool.seed,
            "fps": pool.fps,
            "held_out": list(pool.held_out),
            "kind": pool.kind,
        },
        sources={"drawing": drawing_code()},
        make=make_clip,
    )


def make_clip(
    cfg: dict[str, Any], inputs: Mapping[str, Path], out: Path, runtime: Runtime
) -> dict[str, Any]:
    """Draw the clip and write it with its caption; the truth beside it is for whoever wants to look."""
    del inputs, runtime
    item = out.name.split("-")[0]
    for attempt in range(100):
        rng = rng_for(cfg["seed"], "study_lifting", item, attempt)
        try:
            spec = random_spec(item, cfg["kind"], rng)
        except ValueError:  # no camera sees all of it: other draws
            continue
        if is_held_out(spec.story.actors[0].prop.noun, cfg["held_out"]) is None:
            break
    else:
        raise V2PError(
            f"no clip that may be trained on after 100 draws: {cfg['held_out']} leave no noun"
        )
    path = write(render(replace(spec, fps=cfg["fps"])), out)
    (out / CAPTIONS_FILE).write_text(json.dumps({path.name: spec.caption}), encoding="utf-8")
    return {"caption": spec.caption, "noun": spec.story.actors[0].prop.noun}


def scene_of_clip(folder: Path, engine: EngineConfig) -> Stage:
    """Return the scene stage of a drawn clip: `v2p scene` of it, gate and all."""
    (video,) = find_videos(folder)
    return scene_stage(video, engine)


def clips_of_kind(folder: Path, pool: PoolConfig) -> tuple[list[VideoItem], dict[str, str]]:
    """Return the clips of a folder whose captions tell of the pool's kind of task, and why others are not taken.

    Raises:
        V2PError: there is no such folder, or its captions cannot be used.
    """
    taken: list[VideoItem] = []
    refused: dict[str, str] = {}
    for video in find_videos(folder):
        word = is_held_out(video.caption, pool.held_out)
        if parse_caption(video.caption).kind != pool.kind:
            refused[video.path.name] = "other_kind"
        elif word is not None:
            refused[video.path.name] = f"held_out: {word}"
        else:
            taken.append(replace(video, item=f"real_{video.item}"))
    return taken, refused


# --- toys ----------------------------------------------------------------------------------------------------


TOY_FORMS = ("box", "cylinder", "sphere", "ring", "cup")


def toy_stage(number: int, pool: PoolConfig) -> Stage:
    """Return the stage that makes a random toy: a cup, or up to three boxes, cylinders, balls and rings."""
    return Stage(
        name="scene",
        item=f"toy_{number:04d}",
        config={"seed": pool.seed, "kind": pool.kind},
        version=3,
        make=make_toy,
    )


def make_toy(
    cfg: dict[str, Any], inputs: Mapping[str, Path], out: Path, runtime: Runtime
) -> dict[str, Any]:
    """Write a toy's scene. Sizes are drawn blindly.

    What no gripper takes, the task stage refuses as it does videos'.
    """
    del inputs, runtime
    item = out.name.split("-")[0]
    rng = rng_for(cfg["seed"], "study_lifting", item)
    forms, meshes, parts = _stack(rng)
    whole = meshes[0] if len(meshes) == 1 else trimesh.util.concatenate(meshes)
    assert isinstance(whole, trimesh.Trimesh)
    middle = whole.bounds.mean(0)
    whole.apply_translation(-middle)
    parts = [p.apply_translation(-middle) for p in parts]
    density = float(np.exp(rng.uniform(np.log(150), np.log(900))))
    single = forms[0] if len(forms) == 1 and forms[0] not in ("ring", "cup") else None
    thing = SceneObject(
        name="toy",
        label="toy",
        role="manipulated",
        shape=single or "mesh",  # pyright: ignore[reportArgumentType]
        size_m=_size(whole.extents),
        mass_kg=float(np.clip(density * sum(p.volume for p in parts), 0.01, 0.6)),
        friction=float(rng.uniform(0.4, 0.8)),
        source={"size": "drawn", "mass": "drawn", "friction": "drawn"},
    )
    _write_scene(thing, whole, parts, out, cfg["kind"])
    return {"forms": forms}


def _stack(
    rng: np.random.Generator,
) -> tuple[list[str], list[trimesh.Trimesh], list[trimesh.Trimesh]]:
    """Return the forms of a stack's pieces, their meshes and their convex parts."""
    forms = [str(f) for f in rng.choice(TOY_FORMS, rng.integers(1, 4))]
    forms = ["cup"] if forms[0] == "cup" else [f for f in forms if f != "cup"]
    parts: list[trimesh.Trimesh] = []
    meshes: list[trimesh.Trimesh] = []
    top = 0.0
    for form in forms:
        kind = "cylinder" if form in ("ring", "cup") else form
        size = _toy_size(form, rng)
        bore = float(rng.uniform(0.35, 0.7)) if form == "ring" else 0.0
        taper = float(rng.uniform(0.6, 1.0)) if form == "cup" else 1.0
        shape = {"bore": bore, "hollow": form == "cup", "taper": taper}
        lift = [0.0, 0.0, top + size[2] / 2]
        meshes.append(mesh_for(kind, size, **shape).apply_translation(lift))
        parts += [p.apply_translation(lift) for p in parts_for(kind, size, **shape)]
        top += size[2]
    return forms, meshes, parts


def _toy_size(form: str, rng: np.random.Generator) -> Size:
    wide, deep, high = (float(v) for v in np.exp(rng.uniform(np.log(0.02), np.log(0.11), 3)))
    if form == "box":
        return wide, deep, high
    if form == "sphere":
        return wide, wide, wide
    return wide, wide, min(high, 0.04) if form == "ring" else high


# --- objects of the evaluation ----------------------------------------------------------------------------------


def draw_unseen(cfg: UnseenConfig, held_out: Iterable[str], folder: Path) -> UnseenConfig:
    """Write drawn meshes in the layout of a folder of scans, where nobody has any; return their names.

    Raises:
        V2PError: a product is not known, or clips may be about a category that is to be new.
    """
    products = {word: noun for noun in NOUNS for word in noun.words}
    wanted = (*cfg.drawn_shapes, *cfg.drawn_categories)
    if unknown := [word for word in wanted if word not in products]:
        raise V2PError(
            f"unseen.drawn names {unknown}, which cannot be drawn; known: {', '.join(sorted(products))}"
        )
    if seen := [word for word in cfg.drawn_categories if is_held_out(word, held_out) is None]:
        raise V2PError(
            f"unseen.drawn_categories names {seen}, which clips may be about; add them to pool.held_out"
        )
    for word in wanted:
        out = folder / word.replace(" ", "_")
        if not (out / MESH_FILE).is_file():
            out.mkdir(parents=True, exist_ok=True)
            prop = prop_called(products[word], rng_for(0, "study_lifting", "unseen", word))
            shape = shape_of(prop)
            write_obj(trimesh.Trimesh(shape.vertices, shape.faces), out / MESH_FILE)
    return replace(
        cfg,
        shapes=tuple(w.replace(" ", "_") for w in cfg.drawn_shapes),
        categories=tuple(w.replace(" ", "_") for w in cfg.drawn_categories),
    )


def unseen_meshes(folder: Path, cfg: UnseenConfig) -> dict[str, Path]:
    """Return the mesh files of the evaluation's objects.

    Raises:
        V2PError: one is not there.
    """
    found = {name: folder / name / MESH_FILE for name in cfg.names}
    missing = [name for name, path in found.items() if not path.is_file()]
    if missing:
        known = sorted(p.parent.name for p in folder.glob(f"*/{MESH_FILE}"))
        raise V2PError(
            f"{folder} holds no {MESH_FILE} of {', '.join(missing)}; it has {', '.join(known) or 'none'}. Name others "
            "in unseen.shapes and unseen.categories"
        )
    return found


def unseen_stage(name: str, mesh: Path, mass_kg: float | None, kind: Kind) -> Stage:
    """Return the stage that makes a scene of a scanned mesh, which stands on the table as it stands in its file."""
    return Stage(
        name="scene",
        item=f"unseen_{name}",
        config={"mass_kg": mass_kg, "friction": FRICTION, "kind": kind},
        sources={"mesh": file_digest(mesh)},
        make=partial(make_unseen, mesh=mesh),
    )


def make_unseen(
    cfg: dict[str, Any], inputs: Mapping[str, Path], out: Path, runtime: Runtime, *, mesh: Path
) -> dict[str, Any]:
    """Write the scene of a mesh: true shape, mass if it is known, no video."""
    del inputs, runtime
    name = mesh.parent.name
    whole = turned_square(mended(read_mesh(mesh, name)))
    mass = cfg["mass_kg"]
    estimate = float(np.clip(DENSITY_KG_M3 * whole.convex_hull.volume, 0.01, 0.6))
    thing = SceneObject(
        name=name if name.isidentifier() else "thing",
        label=name.replace("_", " "),
        role="manipulated",
        shape="mesh",
        size_m=_size(whole.extents),
        mass_kg=estimate if mass is None else float(mass),
        friction=cfg["friction"],
        source={
            "size": "mesh file",
            "mass": "estimate" if mass is None else "file of masses",
            "friction": "estimate",
        },
    )
    _write_scene(thing, whole, [], out, cfg["kind"])
    return {"size_m": list(thing.size_m), "mass_kg": thing.mass_kg}


def mended(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the mesh without its texture's seams and a scanner's slips, closed where that is simple.

    Seams part vertices that are one; slips are specks and the few faces where more than two meet at an edge.
    """
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    for _ in range(5):
        if mesh.is_watertight:
            break
        mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
        mesh = max(mesh.split(only_watertight=False), key=lambda body: len(body.faces))
        _, edge, count = np.unique(
            mesh.edges_sorted, axis=0, return_inverse=True, return_counts=True
        )
        mesh.update_faces(~(count[edge] > 2).reshape(-1, 3).any(1))
        mesh.remove_unreferenced_vertices()
        mesh.fill_holes()
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_normals(mesh)
    return mesh


def turned_square(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the mesh about its bounding box's middle, turned about the vertical until that box is smallest.

    Reconstructed objects lie along their own axes; a scanner's axes are anyhow, and features of how an object lies
    between the pads are told along them.
    """
    out = mesh.copy()
    out.apply_transform(square_turn(mesh))
    out.apply_translation(-out.bounds.mean(0))
    return out


def square_turn(mesh: trimesh.Trimesh) -> Float[np.ndarray, "4 4"]:
    """Return the turn about the vertical after which the mesh's bounding box is smallest."""
    T_flat, _ = trimesh.bounds.oriented_bounds_2D(np.asarray(mesh.vertices)[:, :2])
    turn = np.eye(4)
    turn[:2, :2] = T_flat[:2, :2]
    return turn


def masses_in(folder: Path) -> dict[str, float]:
    """Return the masses [kg] that a folder of scans states; none where it has no such file."""
    path = next(iter(sorted(folder.glob(MASSES_FILES))), None)
    return {} if path is None else json.loads(path.read_text(encoding="utf-8"))


def _write_scene(
    thing: SceneObject,
    mesh: trimesh.Trimesh,
    parts: list[trimesh.Trimesh],
    out: Path,
    kind: Kind,
) -> None:
    asked = ASKED[kind]
    (out / "meshes").mkdir(parents=True)
    file = f"meshes/{thing.name}.obj"
    write_obj(mesh, out / file)
    files = tuple(f"meshes/{thing.name}_part_{k:02d}.obj" for k in range(len(parts)))
    for part, path in zip(parts, files, strict=True):
        write_obj(part, out / path)
    thing = _between(thing, (0.0, 0.0, 0.0), asked.move_m)
    thing = replace(thing, mesh=file, parts=files if len(files) > 1 else ())
    things = [thing]
    if asked.onto_m is not None:
        block = SceneObject(
            name="block",
            label="block",
            role="reference",
            shape="box",
            size_m=asked.onto_m,
            mass_kg=0.4,
            friction=FRICTION,
            source=dict.fromkeys(("size", "mass", "friction"), "stated"),
        )
        under = (*asked.move_m[:2], 0.0)
        things.append(_between(block, under, under))
    Scene(
        title=out.name.split("-")[0],
        video="",
        description=asked.caption.format(thing.label),
        kind=kind,
        objects=tuple(things),
        camera=Camera(
            width_px=640,
            height_px=480,
            K=np.array([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]]),
            T_world_cam=np.eye(4),
        ),
        fps=20.0,
        num_frames=2,
        confidence=1.0,
        folder=out,
    ).save(out)


def _between(thing: SceneObject, *bottoms_m: tuple[float, float, float]) -> SceneObject:
    """Return the object as seen upright with the middle of its bottom at these points."""
    up = thing.size_m[2] / 2
    return replace(
        thing,
        frames=tuple(range(len(bottoms_m))),
        poses_world=tuple((x, y, z + up, 1.0, 0.0, 0.0, 0.0) for x, y, z in bottoms_m),
        confidences=(1.0,) * len(bottoms_m),
        observed=("full",) * len(bottoms_m),
    )


def _size(extents: np.ndarray) -> Size:
    x, y, z = (float(v) for v in extents)
    return x, y, z


# --- apart ---------------------------------------------------------------------------------------------------


def mesh_signature(path: Path) -> tuple[int, Float[np.ndarray, "5"]]:
    """Return what stays of a mesh when it is moved, turned and written anew.

    That is the number of its vertices, and their mean distance, its standard deviation and the principal spreads about
    their centroid [m].
    """
    vertices = np.asarray(mended(read_mesh(path, path.stem)).vertices, float)
    centred = vertices - vertices.mean(0)
    reach = np.linalg.norm(centred, axis=1)
    spreads = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(centred))
    return len(vertices), np.array([reach.mean(), reach.std(), *spreads])


def demand_apart(training: Iterable[Path], unseen: Mapping[str, Path]) -> None:
    """Demand that no mesh under the training's folders is one of the evaluation's, moved, turned or renamed.

    Args:
        training: folders of tasks, episodes or datasets.
        unseen: mesh files by name.

    Raises:
        V2PError: names the file and the object.
    """
    forbidden = {name: mesh_signature(path) for name, path in unseen.items()}
    for folder in training:
        for path in sorted(folder.rglob("*.obj")):
            count, spread = mesh_signature(path)
            for name, (other_count, other) in forbidden.items():
                if count == other_count and np.allclose(spread, other, rtol=SAME_MESH, atol=0):
                    raise V2PError(
                        f"{path} is the unseen object '{name}': nothing may be trained on it"
                    )
