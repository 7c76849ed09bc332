"""Every Python block of README and docs runs, with small real things in the place of a reader's own.

A block is run as it stands, in a process and a folder of its own, after the lines that make what it takes for granted
and before lines that look at what it made.
"""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from v2p_data.errors import V2PError

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
EPISODES = ROOT / "tests" / "episodes"
BLOCK = re.compile(r"^```python\n(.*?)^```", re.S | re.M)


@dataclass(frozen=True, kw_only=True)
class Around:
    """What a page's block stands between."""

    before: str = ""
    after: str
    own_words: tuple[str, str] = ("", "")
    """What a reader puts his own name in the place of, and the name here."""


A_TOY = """
import numpy as np
from toy_task import PushTask, bundle as toy
from v2p_data.sim.batch_env import BatchEnv

bundle, world = toy(), 1
env = BatchEnv(bundle, num_envs=2, seed=3, num_threads=1, task=PushTask)
snapshots = [env.snapshot(np.arange(2))]
env.step(np.ones((2, 7)))
snapshots.append(env.snapshot(np.arange(2)))
"""
RUN = {
    "docs/masks.md": Around(
        before=A_TOY,
        after="""
assert labels.shape == (2, 256, 256) and labels.dtype == np.uint8
assert {0, 1, 2} <= set(np.unique(labels).tolist())
assert (labels[0] != labels[1]).any()
assert picture.shape == (256, 256, 3) and len(np.unique(picture)) > 50
""",
    ),
    "docs/safety.md": Around(
        before="from pathlib import Path; Path('outputs/candidate').mkdir(parents=True)",
        after="""
assert held[0] == "limits", held
Path("outputs/candidate/made").write_text("mine")
if "landlock" in held:
    try:
        Path("outputs/outside").write_text("mine")
    except OSError:
        pass
    else:
        raise AssertionError("a file was made outside the folder")
import socket
try:
    socket.create_connection(("127.0.0.1", 9), timeout=1)
except OSError:
    pass
else:
    raise AssertionError("a socket was opened")
""",
    ),
    "docs/workers.md": Around(
        after="""
assert result.arrays["depth_m"].shape == (1, 48, 64)
assert result.fields == {"metric": True}
""",
    ),
    "docs/datasets.md": Around(
        after="""
import sys
assert {suite: list(tasks) for suite, tasks in envs.items()} == {"v2p": [0, 1]}
observation, info = envs["v2p"][1].reset(seed=[1, 2, 3, 4])
assert observation["pixels"]["mask"].shape == (4, 256, 256, 3)
assert "v2p_data" not in sys.modules or "snapshots" in sys.modules["v2p_data"].__file__
""",
        own_words=("USER/TASKS", "user/tasks"),
    ),
}
"""Per page, for its only block."""
NOT_RUN: dict[tuple[str, int], str] = {}
"""Page and number of a block that needs a GPU, a robot or the internet -> which of them."""


def blocks() -> list[tuple[str, int, str]]:
    return [
        (str(page.relative_to(ROOT)), number, code)
        for page in PAGES
        for number, code in enumerate(BLOCK.findall(page.read_text()))
    ]


@contextmanager
def tasks_on_a_hub(folder: Path) -> Iterator[dict[str, str]]:
    """Push two toy tasks to a Hub on the loopback; give the variables by which LeRobot finds it."""
    from hub_server import TOKEN, running_hub
    from toy_task import write_task

    from v2p_data.episodes.envhub import write_envhub
    from v2p_data.episodes.hub import push_envhub

    for title in ("first", "second"):
        write_task(folder / "run" / "task" / title, title)
    with running_hub() as hub, pytest.MonkeyPatch.context() as patch:
        patch.setenv("HF_ENDPOINT", hub.url)
        patch.setenv("HF_TOKEN", TOKEN)
        written = write_envhub(folder / "run", "user/tasks", folder / "hub")
        push_envhub(written.folder, "user/tasks", tag="v1.0")
        yield {
            "HF_ENDPOINT": hub.url,
            "HF_TOKEN": TOKEN,
            "HF_HOME": str(folder / "hf"),
            "HF_HUB_OFFLINE": "0",
            "HF_HUB_DISABLE_PROGRESS_BARS": "1",
        }


def needs_opengl() -> None:
    from toy_task import bundle

    from v2p_data.sim.masks import MaskRenderer

    with MaskRenderer(bundle(), 64) as renderer:
        try:
            renderer._gl("this page")
        except V2PError as error:
            pytest.skip(str(error))


def test_a_page_has_one_python_block_and_we_know_how_to_run_it():
    found = [(page, number) for page, number, _ in blocks()]

    assert found == sorted([*((page, 0) for page in RUN), *NOT_RUN])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "number", "code"), blocks(), ids=[f"{page}-{number}" for page, number, _ in blocks()]
)
def test_a_block_runs_as_it_stands(
    page: str, number: int, code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    if (page, number) in NOT_RUN:
        pytest.skip(NOT_RUN[page, number])
    around = RUN[page]
    monkeypatch.syspath_prepend(str(EPISODES))
    if page == "docs/masks.md":
        needs_opengl()
    (tmp_path / "scripts").symlink_to(ROOT / "scripts")  # readers are in the repository's root
    script = tmp_path / "block.py"
    script.write_text("\n".join([around.before, code.replace(*around.own_words), around.after]))
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    hub = tasks_on_a_hub(tmp_path) if page == "docs/datasets.md" else no_hub()

    with hub as more:
        done = subprocess.run(
            [sys.executable, str(script)],
            cwd=tmp_path,
            env=os.environ | {"PATH": path, "PYTHONPATH": f"{ROOT}{os.pathsep}{EPISODES}"} | more,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )

    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-3000:]


@contextmanager
def no_hub() -> Iterator[dict[str, str]]:
    yield {}
