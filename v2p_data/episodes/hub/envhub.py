"""Reconstructed tasks as a repository that LeRobot loads by its name (EnvHub).

The repository holds `env.py` with `make_env(n_envs, use_async_envs)`, the tasks with their scenes
and code, a model in MJCF of each, and this engine's source, so that nothing of ours must be
installed. LeRobot fetches `env.py` alone; it fetches the rest, at the same commit.
"""

import importlib.metadata
import re
import shutil
from pathlib import Path

from v2p_data.episodes.dataset.about import CARRIED_TASKS
from v2p_data.episodes.dataset.card import LICENSE
from v2p_data.episodes.dataset.features import (
    ACTION_KEY,
    ACTION_NAMES,
    STATE_KEY,
    STATE_NAMES,
    actions_named,
)
from v2p_data.episodes.dataset.repo_id import check_repo_id
from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import demand_whole
from v2p_data.scene.files import own_file
from v2p_data.sim.model.world import build_world
from v2p_data.sim.robot.robot import FINE
from v2p_data.task.sandbox.trial import demand_trial
from v2p_data.task.task import TASK_FILE, TaskBundle, errors_naming

SOURCE = Path(__file__).parents[2]
DISTRIBUTION = "lerobot_policy_v2p"
PLACES = (Path(), CARRIED_TASKS, Path("task"))
"""Where a folder of tasks, a dataset and a run keep theirs."""
MAX_FILE_BYTES = 200_000_000


def write_envhub(source: Path, repo_id: str, out: Path) -> None:
    """Write the tasks of `source` as an EnvHub repository at `out`.

    Args:
        source: a task, a folder of tasks, a run, or a dataset that carries its tasks.
        repo_id: `user/name`, under which it will be pushed.
        out: must not exist.

    Raises:
        V2PError: there is something at `out`, no task in `source`, or a task that cannot be given away.
    """
    check_repo_id(repo_id)
    if out.exists():
        raise V2PError(f"{out} exists already; choose another place")
    from v2p_data.sim.wrappers.lerobot_env import names_of_tasks

    folders = _tasks_in(source)
    names = names_of_tasks(source, ACTION_KEY) or ACTION_NAMES
    states = names_of_tasks(source, STATE_KEY) or STATE_NAMES
    settings = {
        "actions": actions_named(names) or "delta_tool",
        "joint_state": len(states) > len(STATE_NAMES),
    }
    demand_whole(source, below=f"{CARRIED_TASKS.as_posix()}/")
    for folder in folders.values():
        demand_whole(folder)
    partial = out.with_name(out.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    rows: list[str] = []
    for name, folder in folders.items():
        bundle = TaskBundle.load(folder)
        if bundle.robot.get("path"):
            raise V2PError(
                f"task '{name}' is for the arm in {bundle.robot['path']}, a file that may not be yours to give away; "
                "only tasks of the built-in arm can be shared"
            )
        with errors_naming(folder):
            demand_trial(bundle)
            world = build_world(bundle.scene, FINE)
        _copy_task(bundle, partial / "tasks" / name)
        (partial / "mjcf").mkdir(exist_ok=True)
        (partial / "mjcf" / f"{name}.xml").write_text(world.spec.to_xml(), encoding="utf-8")
        rows.append(f"| {len(rows)} | {bundle.description} | `{name}` | {bundle.policy_steps()} |")
    shutil.copytree(SOURCE, partial / SOURCE.name, ignore=_not_source)
    (partial / "env.py").write_text(
        ENV_PY.replace("REPO_ID", repo_id).replace("SETTINGS", repr(settings)),
        encoding="utf-8",
    )
    (partial / "requirements.txt").write_text("\n".join(requirements()) + "\n", encoding="utf-8")
    (partial / "README.md").write_text(_card(repo_id, rows, states, names), encoding="utf-8")
    partial.rename(out)


def _copy_task(bundle: TaskBundle, into: Path) -> None:
    """Copy what belongs to a task and nothing else that lies in its folder; a link to outside is refused."""
    for name in bundle.files():
        (into / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(own_file(bundle.folder, name, MAX_FILE_BYTES), into / name)


def _not_source(folder: str, names: list[str]) -> list[str]:
    """Return the entries of a folder that are neither folders nor Python: networks and pages."""
    return [
        n
        for n in names
        if not n.endswith(".py") and (n == "__pycache__" or not Path(folder, n).is_dir())
    ]


def requirements() -> list[str]:
    """Return what this engine needs without extras, with the exact version of MuJoCo that runs here."""
    lines = [line for line in importlib.metadata.requires(DISTRIBUTION) or [] if ";" not in line]
    others = [line for line in lines if not re.match(r"mujoco\b", line)]
    return sorted([*others, f"mujoco=={importlib.metadata.version('mujoco')}"])


def _tasks_in(source: Path) -> dict[str, Path]:
    if (source / TASK_FILE).is_file():
        return {source.resolve().name: source}
    for place in PLACES:
        found = [
            path.parent
            for path in sorted((source / place).glob(f"*/{TASK_FILE}"))
            if path.parent.suffix != ".partial"
        ]
        if found:
            return {path.name: path for path in found}
    raise V2PError(
        f"no task in '{source}': give a task, a run folder, or a dataset that carries its tasks"
    )


def _card(repo_id: str, rows: list[str], states: tuple[str, ...], actions: tuple[str, ...]) -> str:
    tasks = "\n".join(["| number | task | folder | steps |", "|---|---|---|---|", *rows])
    state, action = (", ".join(f"`{n}`" for n in names) for names in (states, actions))
    return f"""---
library_name: lerobot
license: {LICENSE}
tags:
- lerobot
- envhub
- robotics
- simulation
- mujoco
- video2policy
---

# {repo_id}

Tabletop tasks in MuJoCo, each rebuilt from an ordinary video, for a Franka-like arm with a gripper.

```
pip install -r requirements.txt
```

```python
from lerobot.envs.factory import make_env

envs = make_env("{repo_id}", n_envs=4, use_async_envs=False, trust_remote_code=True)
env = envs["v2p"][0]
observation, info = env.reset(seed=0)
```

This runs the Python code of this repository; read it first, and name a commit (`{repo_id}@COMMIT`) to keep it as it is.

## Tasks

{tasks}

Episodes begin under the randomisation that the demonstrations were recorded under, and a seed repeats one
exactly. `info["is_success"]` is true where the task's own success has held for 0.25 s and an independent
function agrees.

## What is seen and done

| | |
|---|---|
| `pixels/mask` | 256 x 256 x 3 uint8: segmentation mask, a grey (R = G = B) per label: 0 background, 64 robot, 128 manipulated object, then 192, 255, 31, 95, 158, 222 |
| `pixels/mask_wrist`, `pixels/rgb` | masks of a camera on the hand; the first camera in colour, where there is OpenGL |
| `agent_pos` | {state} |
| action | {"each in [-1, 1], " * (actions == ACTION_NAMES)}20 Hz: {action} |

## What is in here

`env.py` is what LeRobot calls. `tasks/` holds task code and scenes (sizes, masses and frictions are estimates from
one video each), `mjcf/` a model of each task for any program that reads MJCF, `v2p_data/` the source that runs them.
"""


ENV_PY = '''"""Simulated tabletop tasks for LeRobot: `make_env("REPO_ID", trust_remote_code=True)`.

LeRobot fetches this file; it fetches the tasks and the code that runs them, of the same commit.
"""

import sys
from pathlib import Path

TASKS = "tasks"


def make_env(n_envs=1, use_async_envs=False, cfg=None):
    """Return {"v2p": {number of the task: vector of n_envs environments}}."""
    folder = _whole_repository()
    if "v2p_data" not in sys.modules:
        sys.path.insert(0, str(folder))
    from v2p_data.sim.wrappers.lerobot_env import V2PEnvConfig

    named = ("size_px", "camera_pos_m", "camera_angle_rad", "camera_fovy_deg", "horizon_scale", "wrist", "rgb")
    given = {name: getattr(cfg, name) for name in named if hasattr(cfg, name)}
    return V2PEnvConfig(tasks=str(folder / TASKS), **SETTINGS, **given).create_envs(n_envs, use_async_envs)


def _whole_repository():
    # Not resolved: in the Hub's cache the file is a link, and its folder is named after the commit.
    here = Path(__file__).absolute().parent
    if (here / TASKS).is_dir():
        return here
    from huggingface_hub import snapshot_download

    is_cache = here.parent.name == "snapshots"
    return Path(
        snapshot_download(
            "REPO_ID",
            revision=here.name if is_cache else None,
            cache_dir=here.parents[2] if is_cache else None,
        )
    )
'''
