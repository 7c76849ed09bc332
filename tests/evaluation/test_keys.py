"""A result's key says all that the result depends on: each file that a command opens is part of it."""

import contextlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import trimesh

from v2p_data.craft_data import PACKAGE, scene_data, task_digest, tasks_by_name
from v2p_data.errors import V2PError
from v2p_data.evaluation.config import EvaluationConfig
from v2p_data.evaluation.judging import contestant, task_folders
from v2p_data.pipeline.runner import Runtime, make_stage
from v2p_data.scene.backends.config import GroundConfig, OutlineConfig, SegmentConfig
from v2p_data.scene.config import SceneConfig
from v2p_data.sim.robot.arms import RobotConfig, robot_to_json
from v2p_data.stages import (
    EngineConfig,
    SimulatorConfig,
    evaluation_stage,
    scene_stage,
    task_stage,
)
from v2p_data.task.task import TaskBundle
from v2p_data.video.captions import find_videos

REPOSITORY = PACKAGE.parent
HOOK = """
import os, sys
log = os.open(os.environ["OPENED"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
def note(event, args):
    if event == "open" and isinstance(args[0], str):
        os.write(log, (os.path.realpath(args[0]) + "\\n").encode())
sys.addaudithook(note)
"""
MAIN = """
import sys
from v2p_data.cli import run
if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
"""
CODE = (".py", ".pyc", ".pyi", ".nbi", ".nbc", ".html", ".rst", ".so", ".lock")
"""Endings of what `Stage.version` stands for, and of lists of packages."""


def opened_by(place: Path, *words: str) -> set[Path]:
    """Run a command and return the files that it and its children opened, without code and what it wrote."""
    (place / "hook").mkdir()
    (place / "hook/sitecustomize.py").write_text(HOOK)
    (place / "main.py").write_text(MAIN)
    scratch = {name: str(place / "scratch") for name in ("TMPDIR", "V2P_CACHE", "XDG_CACHE_HOME")}
    (place / "scratch").mkdir()
    env = {**os.environ, **scratch, "OPENED": str(place / "opened")}
    env["PYTHONPATH"] = os.pathsep.join([str(place / "hook"), str(REPOSITORY)])
    command = [sys.executable, str(place / "main.py"), *words, "--out", str(place / "out")]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    written = [place / name for name in ("out", "hook", "scratch", "main.py", "opened")]
    system = [
        Path(p) for p in (sys.prefix, sys.base_prefix, "/proc", "/sys", "/dev", "/usr", "/etc")
    ]
    return {
        path
        for path in map(Path, set((place / "opened").read_text().splitlines()))
        if path.is_file()
        and path.suffix not in CODE
        and not any(path.is_relative_to(folder.resolve()) for folder in (*written, *system))
    }


def change(path: Path) -> None:
    """Change what a file says as little as it can be."""
    data = path.read_bytes()
    if path.name == "captions.json":
        path.write_bytes(data.replace(b"red", b"blue"))
    elif path.suffix in (".safetensors", ".stl", ".mp4"):
        path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    else:
        path.write_bytes(data + b"\n")


def unchanged(paths: set[Path], key: Callable[[], str]) -> list[Path]:
    """Return the files whose change is not told by the key, and that are not refused either."""
    before, same = key(), []
    for path in sorted(paths):
        data = path.read_bytes()
        change(path)
        with contextlib.suppress(V2PError):
            same += [path] if key() == before else []
        path.write_bytes(data)
    assert key() == before
    return same


@pytest.fixture
def arm(tmp_path: Path) -> RobotConfig:
    """The small arm in three files: its limbs are included, its palm is a mesh."""
    sys.path.insert(0, str(REPOSITORY / "tests/sim"))
    from test_arms import ARM, SIX

    (tmp_path / "arm/meshes").mkdir(parents=True)
    trimesh.creation.box((0.06, 0.1, 0.06)).export(tmp_path / "arm/meshes/palm.stl")
    body = ARM.split("<worldbody>")[1].split("</worldbody>")[0]
    body = body.replace(
        '<geom name="palm" type="box" size="0.03 0.05 0.03"',
        '<geom name="palm" type="mesh" mesh="palm"',
    )
    (tmp_path / "arm/limbs.xml").write_text(f"<mujoco>{body}</mujoco>")
    mesh = '<asset><mesh name="palm" file="meshes/palm.stl"/></asset>'
    main = ARM.replace(
        ARM.split("<worldbody>")[1].split("</worldbody>")[0], '<include file="limbs.xml"/>'
    )
    (tmp_path / "arm/arm.xml").write_text(main.replace("<worldbody>", f"{mesh}<worldbody>"))
    return replace(SIX, path=tmp_path / "arm/arm.xml")


@pytest.fixture
def tasks(tmp_path: Path, arm: RobotConfig) -> Path:
    """A folder with one task: meshes, convex parts, another arm."""
    sys.path.insert(0, str(REPOSITORY / "tests/task"))
    import strangers

    bundle = TaskBundle.load(strangers.good_task(tmp_path / "made"))
    folder = tmp_path / "tasks" / "lift_cube-0123abcd"
    replace(bundle, horizon_steps=4, robot=robot_to_json(arm)).save(folder)
    return folder.parent


@pytest.fixture
def policy(tmp_path: Path, policy_folder: Path) -> Path:
    """A policy of LeRobot's own training: what it knows of its dataset lies in the dataset."""
    info = {"fps": 20, "features": {"action": {"names": None}}}
    (tmp_path / "dataset/meta").mkdir(parents=True)
    (tmp_path / "dataset/meta/info.json").write_text(json.dumps(info))
    folder = Path(shutil.copytree(policy_folder, tmp_path / "policy"))
    said = {"dataset": {"repo_id": "a/b", "root": str(tmp_path / "dataset")}}
    (folder / "train_config.json").write_text(json.dumps(said))
    return folder


def evaluation_key(who: Path, tasks: Path) -> str:
    named = tasks_by_name(task_folders(tasks))
    return evaluation_stage(contestant(who), named, EngineConfig(), seen=[]).fingerprint


@pytest.mark.slow
def test_each_file_that_an_evaluation_opens_is_part_of_its_key(
    policy: Path, tasks: Path, tmp_path: Path
):
    opened = opened_by(
        *(tmp_path, "eval", str(policy), "--tasks", str(tasks)),
        *("--evaluation.episodes", "1", "--evaluation.worlds", "1"),
    )

    inside = {path for path in tasks.rglob("*") if path.is_file()}
    inside |= {path for path in policy.iterdir() if path.name != "README.md"}
    assert {"info.json", "train_config.json", "task.json"} <= {path.name for path in opened}
    assert {"limbs.xml", "palm.stl", "part.stl"} <= {path.name for path in inside}
    assert unchanged(opened | inside, lambda: evaluation_key(policy, tasks)) == []


@pytest.mark.slow
def test_each_file_that_a_task_comes_from_is_part_of_its_key(arm: RobotConfig, tmp_path: Path):
    samples = REPOSITORY / "datasets/sample_videos"
    clip = next(p for p in sorted(samples.glob("*.mp4")))
    (tmp_path / "videos").mkdir()
    shutil.copy(clip, tmp_path / "videos")
    said = {clip.name: json.loads((samples / "captions.json").read_text())[clip.name]}
    (tmp_path / "videos/captions.json").write_text(json.dumps(said))
    settings = {
        "path": arm.path,
        "eef-site": arm.eef_site,
        "fingers": arm.fingers,
        "pads": arm.pads,
        "home-qpos": arm.home_qpos,
    }
    words = [
        word
        for name, value in settings.items()
        for word in (
            f"--sim.robot.{name}",
            *map(str, value if isinstance(value, tuple) else (value,)),
        )
    ]

    opened = opened_by(tmp_path, "task", str(tmp_path / "videos"), *words)

    own = {path for path in opened if path.is_relative_to(PACKAGE)}
    assert {f"data scene/{path.name}" for path in own if "scene" in path.parts} <= set(
        scene_data()
    )
    assert {path.parent.name for path in own if "scene" not in path.parts} <= {"paper_tasks"}
    own |= {path for path in opened if path.is_relative_to(REPOSITORY)}

    def key() -> str:
        (video,) = find_videos(tmp_path / "videos")
        cfg = EngineConfig(sim=SimulatorConfig(robot=arm))
        return task_stage(scene_stage(video, cfg), cfg).fingerprint

    files = {path for path in (tmp_path / "arm").rglob("*") if path.is_file()}
    assert {"captions.json", "arm.xml", "limbs.xml"} <= {path.name for path in opened - own}
    assert unchanged((opened - own) | files, key) == []


@pytest.mark.parametrize(
    ("settings", "file"),
    [
        (SceneConfig(ground=GroundConfig(model="named")), "named/model.safetensors"),
        (SceneConfig(segment=SegmentConfig(model="named")), "named/config.json"),
        (SceneConfig(outline=OutlineConfig(weights=Path("mobile_sam.pt"))), "mobile_sam.pt"),
        (
            SceneConfig(ground=GroundConfig(backend="worker", worker="python worker.py --x 1")),
            "worker.py",
        ),
    ],
)
def test_what_a_setting_names_counts_by_its_content(
    settings: SceneConfig, file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "named").mkdir()
    for name in ("named/model.safetensors", "named/config.json", "mobile_sam.pt", "worker.py"):
        (tmp_path / name).write_bytes(b"1")
    (video, *_) = find_videos(REPOSITORY / "datasets/sample_videos")

    def key() -> str:
        return scene_stage(video, EngineConfig(scene=settings)).fingerprint

    assert unchanged({tmp_path / file}, key) == []
    assert not any(" 0" in name for name in scene_stage(video, EngineConfig()).sources)


# --- whose row it is ---------------------------------------------------------------------------------------------


def made_of(task: Path, place: Path, *, mass_kg: float) -> Path:
    """Write the same task again, with a thing of another mass."""
    path = Path(shutil.copytree(task, place)) / "scene/scene.json"
    said = json.loads(path.read_text())
    said["objects"][0]["mass_kg"] = mass_kg
    path.write_text(json.dumps(said))
    return place


def test_of_a_clip_that_was_made_twice_both_tasks_are_judged_and_a_copy_once(tasks: Path):
    (first,) = tasks.iterdir()
    second = made_of(first, tasks / "lift_cube-00000000", mass_kg=0.2)
    shutil.copytree(first, tasks / "lift_cube-ffffffff")
    shutil.copytree(first, tasks / "lift_cube-11111111.partial")

    found = tasks_by_name(task_folders(tasks))

    assert sorted(found) == sorted(f"lift_cube-{task_digest(path)}" for path in (first, second))
    assert tasks_by_name([("lift_cube", first)]) == {"lift_cube": first}


@pytest.mark.slow
def test_an_unseen_task_of_a_seen_ones_name_has_a_row_of_its_own(
    policy: Path, tasks: Path, tmp_path: Path
):
    (seen,) = tasks.iterdir()
    unseen = made_of(seen, tmp_path / "other" / seen.name, mass_kg=0.2)
    copied = Path(shutil.copytree(seen, tmp_path / "elsewhere" / "lift_cube"))
    (copied / "task.py").write_text((copied / "task.py").read_text() + "# another reward\n")
    cfg = EngineConfig(evaluation=EvaluationConfig(episodes=1, worlds=1))
    named = tasks_by_name(("lift_cube", path) for path in (seen, unseen, copied))

    stage = evaluation_stage(contestant(policy), named, cfg, seen=[seen])
    outcome = make_stage(stage, Runtime(root=tmp_path / "run"))

    assert outcome.is_usable, outcome.detail
    rows = json.loads((outcome.folder / "evaluation.json").read_text())
    assert [(r["digest"], r["seen"]) for r in rows] == [
        (task_digest(seen), True),
        (task_digest(unseen), False),
        (task_digest(copied), True),  # the policy met its things and its words
    ]
    assert len({row["task"] for row in rows}) == 3
    assert all((outcome.folder / "videos" / row["task"]).is_dir() for row in rows)
