"""Physics and masks need no OpenGL, so whatever MUJOCO_GL asks for stands in nobody's way."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
import os
import v2p_data.sim
import mujoco
assert mujoco.MjModel.from_xml_string("<mujoco/>").nbody == 1
assert os.environ["MUJOCO_GL"] == "ASKED"
"""


@pytest.mark.parametrize("asked", ["osmesa", "nonsense"])
def test_mujoco_is_there_whatever_opengl_is_asked_for(asked: str, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", asked)
    script = SCRIPT.replace("ASKED", asked)

    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)

    assert (done.returncode, done.stderr) == (0, "")


def test_every_module_that_imports_mujoco_has_the_rooms_own_import_before_it():
    root = Path(__file__).parents[2] / "v2p_data"
    late: list[str] = []
    for path in sorted(root.rglob("*.py")):
        room, text = path.relative_to(root).parts[0], path.read_text()
        if "import mujoco" not in text:
            continue
        names = [
            node.module if isinstance(node, ast.ImportFrom) else node.names[0].name
            for node in ast.parse(text).body
            if isinstance(node, ast.Import | ast.ImportFrom)
        ]
        named = [str(n).split(".")[0] for n in names]
        if "mujoco" in named and room not in ("sim", "twin"):
            first = named.index("mujoco")
            if not any(str(n).startswith("v2p_data.sim") for n in names[:first]):
                late.append(str(path))
    assert late == []
