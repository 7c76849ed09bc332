"""Code in a task folder runs in the confined child before it runs here, whoever made the folder.

What has passed is noted by a digest of code and objects, in this process and in this machine's
cache, outside of any task folder: so each task is tried once per machine, and no folder can claim
that it was. What this engine writes itself is noted when it is tried while it is made.
"""

import hashlib
import json
from dataclasses import asdict
from pathlib import Path

import torch

from v2p_data.errors import V2PError
from v2p_data.scene.scene import Scene
from v2p_data.task.cache import cache_folder
from v2p_data.task.sandbox.smoke import smoke_run
from v2p_data.task.task import CODE_FILE, TaskBundle

VERSION = 3
"""Raise it when the trial run asks for more."""
FOLDER = "tried"

_passed: set[str] = set()


def demand_trial(bundle: TaskBundle) -> None:
    """Let the code of a task that was loaded from a folder run in the confined child, unless it has done so before.

    Raises:
        V2PError: it is refused, or does not work there.
    """
    if bundle.folder == Path():
        return  # written in this process, which tries what it writes
    key = _key(bundle.code, bundle.scene)
    if key in _passed:
        return
    entry = cache_folder(FOLDER) / key
    if not entry.is_file():
        result = smoke_run(bundle.code, bundle.scene)
        if not result.runnable:
            raise V2PError(
                f"{bundle.folder / CODE_FILE} is not run here, because its trial in a confined process failed: "
                f"{result.error}"
            )
        _note(key)
    _passed.add(key)


def note_passed(code: str, scene: Scene) -> None:
    """Note that code has passed its trial run in this scene."""
    _passed.add(key := _key(code, scene))
    _note(key)


def _note(key: str) -> None:
    entry = cache_folder(FOLDER) / key
    try:
        entry.parent.mkdir(parents=True, exist_ok=True)
        entry.touch()
    except OSError:  # it is tried again next time
        return


def _key(code: str, scene: Scene) -> str:
    objects = [asdict(thing) for thing in scene.objects]
    text = json.dumps([VERSION, torch.__version__, code, scene.title, objects], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
