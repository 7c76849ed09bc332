"""What a user gets without a clone: the wheel, installed beside its dependencies only, runs and lacks nothing."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("v2p_data", "policies", "lerobot_policy_v2p")
SAMPLES = ROOT / "datasets" / "sample_videos"
pytestmark = pytest.mark.slow


def call(*command: object, cwd: Path, code: int = 0) -> str:
    """Return all output; the repository is not on the child's path."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "COV_"))}
    done = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env={**environment, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert done.returncode == code, done.stdout
    return done.stdout


def shipped() -> list[Path]:
    """Return our packages' files; what a build or a run left behind is none of them."""
    found = [path for name in PACKAGES for path in (ROOT / name).rglob("*") if path.is_file()]
    return [p.relative_to(ROOT) for p in found if "__pycache__" not in p.parts]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built in a copy: a build writes beside the sources."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for path in shipped():
        (source / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / path, source / path)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    build = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
    call(sys.executable, "-c", build, out, cwd=source)
    (made,) = out.glob("*.whl")
    return made


@pytest.fixture(scope="module")
def v2p(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The command of a fresh environment that sees our dependencies, but not the repository."""
    home = tmp_path_factory.mktemp("environment")
    call(
        sys.executable,
        "-m",
        "virtualenv",
        "--quiet",
        "--no-download",
        "--no-periodic-update",
        home,
        cwd=home,
    )
    python = home / "bin" / "python"
    options = ("--quiet", "--no-index", "--no-deps", "--disable-pip-version-check")
    call(python, "-m", "pip", "install", *options, wheel, cwd=home)
    (packages,) = home.glob("lib/python*/site-packages")
    # Only added to the path: the link to the repository in there would need its own .pth file read.
    (packages / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"])
    where = call(python, "-c", "import v2p_data; print(v2p_data.__file__)", cwd=home)
    assert where.strip() == str(packages / "v2p_data" / "__init__.py")
    return home / "bin" / "v2p"


def test_the_wheel_holds_every_file_of_our_packages_and_nothing_else(wheel: Path):
    inside = [name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name]

    assert sorted(inside) == sorted(str(path) for path in shipped())
    data = {Path(name).suffix for name in inside if not name.endswith(".py")}
    assert data >= {".html", ".json", ".safetensors", ".tsv", ".typed", ".yaml"}


def test_help_and_version_are_there_without_a_clone(v2p: Path, tmp_path: Path):
    assert "v2p generate VIDEOS" in call(v2p, "--help", cwd=tmp_path)
    assert "--workers" in call(v2p, "demo", "--help", cwd=tmp_path)
    assert call(v2p, "--version", cwd=tmp_path).startswith("v2p ")


def test_the_demo_needs_a_clone_and_says_so(v2p: Path, tmp_path: Path):
    said = call(v2p, "demo", cwd=tmp_path, code=2)

    sentences = [line for line in said.strip().splitlines() if line != "v2p: loading libraries"]
    assert len(sentences) == 1
    assert "run the demo from a clone of the repository" in sentences[0]
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_a_video_becomes_a_scene_a_task_and_a_page_without_a_clone(v2p: Path, tmp_path: Path):
    name = "tip_green_carton.mp4"
    caption = json.loads((SAMPLES / "captions.json").read_text())[name]
    (tmp_path / "videos").mkdir()
    shutil.copy(SAMPLES / name, tmp_path / "videos")
    (tmp_path / "videos" / "captions.json").write_text(json.dumps({name: caption}))

    call(
        v2p,
        "task",
        "videos",
        "--out",
        "run",
        "--task.num-samples",
        1,
        "--workers",
        1,
        cwd=tmp_path,
    )

    (task,) = tmp_path.glob("run/task/*/task.json")
    assert json.loads(task.read_text())["kind"] == "tip_over"
    assert "tip_green_carton" in (tmp_path / "run" / "report.html").read_text()
