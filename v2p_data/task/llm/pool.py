"""The paper's curriculum: tasks that were solved become examples for the next one.

A pool is a folder with one task per sub-folder, without meshes and pictures, and `solved.json` beside it: how often its
expert succeeds. It starts empty; the two basic examples are shown in any case.
"""

import json
import tempfile
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from v2p_data.errors import V2PError
from v2p_data.json_files import read_object
from v2p_data.scene.scene import Scene
from v2p_data.task.likeness import likeness
from v2p_data.task.llm.example_tasks import BASIC_EXAMPLES, Example
from v2p_data.task.task import TaskBundle

SOLVED_FILE = "solved.json"
MIN_SUCCESS = 0.5
"""A task whose expert fails more often than it succeeds teaches more of its faults than of its ways."""


def add_solved(pool: Path, bundle: TaskBundle, success: float) -> Path | None:
    """Put a task that an expert learned into the pool; return where, None if it is not good enough.

    A task of the same title that is there already is replaced unless it was solved better.

    Args:
        pool: the folder; made if need be.
        bundle: the task, its code the one that was learned with.
        success: share of the expert's episodes that succeeded, 0 to 1.
    """
    if success < MIN_SUCCESS:
        return None
    home = pool / bundle.title
    if home.is_dir() and _success(home) > success:
        return home
    pool.mkdir(parents=True, exist_ok=True)
    with (
        tempfile.TemporaryDirectory() as bare,
        tempfile.TemporaryDirectory(dir=pool, prefix=".") as place,
    ):
        bundle.scene.save(Path(bare))  # the scene's words and numbers, none of its files
        made = Path(place) / "task"
        made.mkdir()
        replace(bundle, scene=replace(bundle.scene, folder=Path(bare))).save(made)
        (made / SOLVED_FILE).write_text(json.dumps({"success": success}), encoding="utf-8")
        if home.is_dir():
            home.rename(Path(place) / "before")
        with suppress(OSError):  # another process put its own there in between
            made.rename(home)
    return home


def read_pool(*pools: Path) -> list[TaskBundle]:
    """Return the solved tasks of some pools, sorted by title; the better solved one where two have the same code."""
    found: dict[str, tuple[float, TaskBundle]] = {}
    for pool in pools:
        for path in sorted(pool.glob(f"[!.]*/{SOLVED_FILE}")):
            try:
                bundle, success = TaskBundle.load(path.parent), _success(path.parent)
            except (OSError, ValueError, TypeError, KeyError, V2PError) as error:
                raise V2PError(
                    f"{path.parent} in the pool of solved tasks cannot be read ({type(error).__name__}: {error}); "
                    "delete the folder, or name another pool"
                ) from error
            if bundle.code not in found or found[bundle.code][0] < success:
                found[bundle.code] = (success, bundle)
    return sorted((b for _, b in found.values()), key=lambda b: b.title)


def examples_for(scene: Scene, solved: list[TaskBundle], count: int) -> list[Example]:
    """Return the basic examples and `count` solved tasks, the one most like the scene last, nearest to the question.

    The scene's own task is not among them: its answer would only be copied.
    """
    new = TaskBundle(
        title=scene.title,
        description=scene.description,
        kind=scene.kind,
        class_name="",
        code="",
        scene=scene,
    )
    others = [s for s in solved if s.title != scene.title]
    nearest = sorted(others, key=lambda s: (-likeness(new, s), s.title))[:count]
    return [*BASIC_EXAMPLES, *(_example(s) for s in reversed(nearest))]


def _example(bundle: TaskBundle) -> Example:
    things = ", ".join(
        f"{o.name} ({o.role}, {o.shape}, {' x '.join(f'{100 * s:.1f}' for s in o.size_m)} cm)"
        for o in bundle.scene.objects
    )
    return Example(
        task=f"{bundle.description}. Objects: {things}.",
        thoughts=(
            "This code was trained on, and its expert solves the task; the thoughts stand in the reward's docstring."
        ),
        code=bundle.code,
        source=bundle.title,
    )


def _success(folder: Path) -> float:
    return float(read_object(folder / SOLVED_FILE, "remove its folder from the pool")["success"])
