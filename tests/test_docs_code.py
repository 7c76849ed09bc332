"""Every Python block of README and docs runs, with small real things in the place of a reader's own.

A block is run as it stands, in a process and a folder of its own, after the lines that make what it takes for granted
and before lines that look at what it made.
"""

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
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


A_TOY = """
import numpy as np
from toy_task import PushTask, bundle as toy
from v2p_data.sim.env.batch_env import BatchEnv

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
}
"""Per page, for its only block."""
ELSEWHERE = {
    "docs/datasets.md": "tests/episodes/test_envhub.py",
    "docs/python_api.md": "tests/test_chain.py",
}
"""Pages whose blocks are run, as they stand, by another test: with a Hub at hand, or one after the other."""


def blocks() -> list[tuple[str, str]]:
    """Return page and code of every block."""
    return [
        (str(page.relative_to(ROOT)), code)
        for page in PAGES
        for code in BLOCK.findall(page.read_text())
    ]


def needs_opengl() -> None:
    from toy_task import PushTask, bundle

    from v2p_data.sim.env.batch_env import BatchEnv
    from v2p_data.sim.render.masks import MaskRenderer

    worlds = BatchEnv(bundle(), num_envs=1, seed=3, num_threads=1, task=PushTask)
    with MaskRenderer(bundle(), 64) as renderer:
        try:
            renderer.draw_rgb(worlds.snapshot(np.arange(1)), 0)
        except V2PError as error:
            pytest.skip(str(error))


def test_a_page_with_python_blocks_has_a_test_that_runs_them():
    pages = [page for page, _ in blocks()]
    assert sorted(set(pages)) == sorted([*RUN, *ELSEWHERE])
    assert {page: pages.count(page) for page in RUN} == dict.fromkeys(RUN, 1)
    for page, test in ELSEWHERE.items():
        assert f'"{Path(page).name}"' in (ROOT / test).read_text()


@pytest.mark.slow
@pytest.mark.parametrize("page", RUN)
def test_a_block_runs_as_it_stands(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(EPISODES))
    if "draw_rgb" in dict(blocks())[page]:
        needs_opengl()
    (tmp_path / "scripts").symlink_to(ROOT / "scripts")  # readers are in the repository's root
    script = tmp_path / "block.py"
    script.write_text("\n".join([RUN[page].before, dict(blocks())[page], RUN[page].after]))
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"

    done = subprocess.run(
        [sys.executable, str(script)],
        cwd=tmp_path,
        env=os.environ | {"PATH": path, "PYTHONPATH": f"{ROOT}{os.pathsep}{EPISODES}"},
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )

    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-3000:]
