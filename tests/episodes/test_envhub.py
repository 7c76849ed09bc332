"""A pushed environment is loaded by LeRobot, by its name, with nothing of ours installed."""

import ast
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import pytest
from hub_server import TOKEN, Hub
from toy_task import bundle

from v2p_data.episodes.hub.envhub import write_envhub
from v2p_data.episodes.hub.hub import push_envhub
from v2p_data.errors import V2PError

CODE = """
from factory.tasks.task import Task

class PushTask(Task):
    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, {})
        self.task_description = "push the cube to the left"

    def compute_success(self, states):
        return states["eef_pos"][:, 1] > 0.08

    def compute_reward(self, actions, states):
        left = states["eef_pos"][:, 1]
        return left, {"left": left}
"""
PAGE = Path(__file__).parents[2] / "docs" / "datasets.md"
UNTRUSTED = """
import sys
from pathlib import Path

import numpy as np
from lerobot.envs.factory import make_env

try:
    make_env("user/tasks")
except RuntimeError as error:
    print("untrusted:", "trust_remote_code" in str(error))
"""
TRIED = """
print("tasks:", {suite: list(tasks) for suite, tasks in envs.items()})
env = envs["v2p"][1]
first, info = env.reset(seed=[5, 6, 7, 8])
again, _ = env.reset(seed=[5, 6, 7, 8])
observation, reward, terminated, truncated, info = env.step(np.zeros((4, 7), np.float32))
print("seen:", observation["pixels"]["mask"].shape, observation["agent_pos"].shape)
print("repeats:", bool((first["pixels"]["mask"] == again["pixels"]["mask"]).all()))
print("told:", env.call("task_description"), info["is_success"].tolist())
source = Path(sys.modules["v2p_data"].__file__)
print("from the cache:", source.is_relative_to(sys.argv[1]))
"""


def write_task(folder: Path, title: str) -> Path:
    scene = folder.parent / f"{title}_scene"
    scene.mkdir(parents=True)
    made = bundle()
    made.scene.save(scene)
    replace(made, code=CODE, title=title, scene=replace(made.scene, folder=scene)).save(folder)
    return folder


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    for title in ("first", "second"):
        write_task(tmp_path / "run/task" / title, title)
    return tmp_path / "run"


def test_the_repository_holds_all_that_lerobot_asks_for(run_folder: Path, tmp_path: Path):
    made = tmp_path / "hub"
    write_envhub(run_folder, "user/tasks", made)

    assert sorted(p.name for p in (made / "tasks").iterdir()) == ["first", "second"]
    names = {p.name for p in made.iterdir()}
    assert names == {"README.md", "env.py", "mjcf", "requirements.txt", "tasks", "v2p_data"}
    (function,) = [
        node
        for node in ast.parse((made / "env.py").read_text()).body
        if isinstance(node, ast.FunctionDef) and node.name == "make_env"
    ]
    assert [a.arg for a in function.args.args] == ["n_envs", "use_async_envs", "cfg"]
    model = mujoco.MjModel.from_xml_path(str(made / "mjcf/second.xml"))
    assert model.body("cube").id > 0
    required = (made / "requirements.txt").read_text().splitlines()
    assert {re.match(r"\w+", line)[0] for line in required} >= {"lerobot", "mujoco", "torch"}
    assert f"mujoco=={mujoco.__version__}" in required
    assert not [p for p in made.rglob("*") if p.name == "__pycache__"]


def test_what_does_not_belong_to_a_task_stays_and_a_link_to_outside_is_refused(
    run_folder: Path, tmp_path: Path
):
    task = run_folder / "task/first"
    (task / "notes.txt").symlink_to("/etc/passwd")
    (task / "scene/secret.obj").write_text("secret")

    made = tmp_path / "hub"
    write_envhub(run_folder, "user/tasks", made)

    files = {str(p.relative_to(made / "tasks/first")) for p in made.glob("tasks/first/**/*")}
    assert files == {"task.json", "task.py", "scene", "scene/scene.json"}
    (task / "task.py").unlink()
    (task / "task.py").symlink_to("/etc/passwd")
    with pytest.raises(V2PError, match=r"task\.py is a link"):
        write_envhub(run_folder, "user/tasks", tmp_path / "other")


def test_nothing_is_overwritten_and_a_folder_without_tasks_is_refused(
    run_folder: Path, tmp_path: Path
):
    with pytest.raises(V2PError, match="no task in"):
        write_envhub(tmp_path / "nowhere", "user/tasks", tmp_path / "hub")
    with pytest.raises(V2PError, match="exists already"):
        write_envhub(run_folder, "user/tasks", run_folder)


@pytest.mark.long
def test_lerobot_loads_a_pushed_environment_by_its_name_as_our_page_says(
    run_folder: Path, tmp_path: Path, hub: Hub, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("HF_ENDPOINT", hub.url)
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    made = tmp_path / "hub"
    write_envhub(run_folder, "user/tasks", made)
    push_envhub(made, "user/tasks", tag="v1.0")
    cache = tmp_path / "hf"
    env = os.environ | {"HF_HOME": str(cache), "HF_HUB_DISABLE_PROGRESS_BARS": "1"}
    env.pop("HF_HUB_OFFLINE", None)
    (block,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.S | re.M)
    code = UNTRUSTED + block.replace("USER/TASKS", "user/tasks") + TRIED

    done = subprocess.run(
        [sys.executable, "-c", code, str(cache)],
        cwd=tmp_path,
        env=env,
        capture_output=True,
        text=True,
        timeout=500,
    )

    assert done.returncode == 0, done.stderr[-3000:]
    assert [line for line in done.stdout.splitlines() if ": " in line] == [
        "untrusted: True",
        "tasks: {'v2p': [0, 1]}",
        "seen: (4, 256, 256, 3) (4, 11)",
        "repeats: True",
        f"told: {('push the cube to the left',) * 4} {[False] * 4}",
        "from the cache: True",
    ]
    assert set(hub.repos["models/user/tasks"].tags) == {"v1.0"}
    assert TOKEN not in done.stdout + done.stderr
