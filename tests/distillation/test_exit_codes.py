"""The exit code of a run in which some items come through and others do not."""

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from toy_run import ENGINE, agree, bundle, made, make_expert, make_task, record_of

from v2p_data.cli import run
from v2p_data.commands import run as commands
from v2p_data.commands.display import cost_line
from v2p_data.episodes import rollouts
from v2p_data.errors import ItemRejectedError
from v2p_data.pipeline.runner import Outcome, Runtime, Stage, Status
from v2p_data.stages import EngineConfig, episodes_stage
from v2p_data.video.captions import VideoItem

QUICK = replace(ENGINE, episodes=replace(ENGINE.episodes, num_episodes=1, batch_worlds=2))
CLIPS = ("cup", "mug", "blurred")


def make_scene(cfg, inputs, out: Path, runtime: Runtime, *, item: str) -> None:
    if item == "blurred":
        raise ItemRejectedError("nothing_moves", "nothing moves in it", 0.0)
    if item == "broken":
        raise RuntimeError("the model ended")
    bundle().scene.save(out)


def chain(video: VideoItem, cfg: EngineConfig) -> Stage:
    """Return the toy task's chain, with a scene before it."""
    name = video.path.stem
    scene = Stage(name="scene", item=name, config={}, make=partial(make_scene, item=name))
    task = Stage(
        name="task",
        item=name,
        config={},
        inputs={"scene": scene},
        make=partial(make_task, item=name),
    )
    learned = Stage(name="expert", item=name, config={}, inputs={"task": task}, make=make_expert)
    return episodes_stage(task, learned, QUICK)


@pytest.fixture(autouse=True)
def _toy_chain(monkeypatch: pytest.MonkeyPatch, agreeing_referee) -> None:
    monkeypatch.setattr(commands, "run_stages", made)
    monkeypatch.setattr(commands, "chain", chain)


def generate(videos: Path, root: Path) -> int:
    return run(["generate", str(videos), "--out", str(root), "--repo-id", "me/toys"])


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """Videos and a run of two whole items and a rejected one, beside each other, and its exit code.

    Do not write into it.
    """
    place = tmp_path_factory.mktemp("first")
    (place / "videos").mkdir()
    for name in CLIPS:
        (place / "videos" / f"{name}.mp4").write_bytes(name.encode())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollouts, "referee_verdict", agree)
        patch.setattr(commands, "run_stages", made)
        patch.setattr(commands, "chain", chain)
        return place, generate(place / "videos", place / "run")


@pytest.fixture
def place(first: tuple[Path, int], tmp_path: Path) -> Path:
    return Path(shutil.copytree(first[0], tmp_path / "copy"))


def datasets(root: Path) -> dict[str, list[str]]:
    """Return which items each dataset is made of, by folder name."""
    return {p.name: sorted(record_of(p).inputs) for p in (root / "dataset").glob("toys-*")}


def record_of_scene(root: Path, item: str) -> Path:
    (path,) = root.glob(f"scene/{item}-*/record.json")
    return path


def test_a_rejected_video_is_an_answer_and_leaves_0(first: tuple[Path, int]):
    place, code = first

    assert code == 0
    assert list(datasets(place / "run").values()) == [["cup", "mug"]]


def test_beside_a_damaged_record_the_finished_dataset_stays_and_the_code_is_3(capsys, place: Path):
    before = datasets(place / "run")
    damaged = record_of_scene(place / "run", "mug")
    damaged.write_text("{")

    assert generate(place / "videos", place / "run") == 3

    said = capsys.readouterr()
    assert str(damaged) in said.err
    assert next(iter(before)) in said.out
    assert datasets(place / "run") == before


@pytest.mark.parametrize("pattern", ["scene/mug-*/record.json", "task/mug-*/task.py"])
def test_a_damaged_file_of_one_item_leaves_a_dataset_of_the_others_and_3(
    capsys, place: Path, pattern: str
):
    shutil.rmtree(place / "run" / "dataset")
    (damaged,) = (place / "run").glob(pattern)
    damaged.write_text("{")

    assert generate(place / "videos", place / "run") == 3

    assert str(damaged) in capsys.readouterr().err
    assert list(datasets(place / "run").values()) == [["cup"]]


def test_a_dataset_without_its_page_leaves_3(capsys, place: Path):
    (place / "run" / "report.html.tmp").symlink_to("/dev/full")

    assert generate(place / "videos", place / "run") == 3

    assert "no space is left on the disk" in capsys.readouterr().err


def test_a_failed_item_beside_whole_ones_leaves_3(place: Path):
    (place / "videos" / "broken.mp4").write_bytes(b"x")

    assert generate(place / "videos", place / "run") == 3


def test_a_failed_scene_beside_whole_ones_leaves_3_and_alone_2(
    place: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(
        commands,
        "scene_stage",
        lambda video, cfg: chain(video, cfg).inputs["task"].inputs["scene"],
    )
    (place / "videos" / "broken.mp4").write_bytes(b"x")

    assert run(["scene", str(place / "videos"), "--out", str(place / "run")]) == 3

    for name in CLIPS:
        (place / "videos" / f"{name}.mp4").unlink()
    assert run(["scene", str(place / "videos"), "--out", str(place / "run")]) == 2


def test_a_run_says_what_a_usable_task_cost(tmp_path: Path):
    def outcome(stage: str, item: str, seconds: float, status: Status = "made") -> Outcome:
        return Outcome(stage=stage, item=item, status=status, folder=tmp_path, seconds=seconds)

    said = cost_line(
        [
            outcome("scene", "cup", 60.0),
            outcome("episodes", "cup", 120.0, "kept"),
            outcome("scene", "blurred", 120.0, "rejected"),
        ]
    )

    assert (
        said == "5.0 minutes of worker time for 1 usable tasks, 5.0 each: scene 60%, episodes 40%"
    )
    assert cost_line([outcome("scene", "blurred", 60.0, "rejected")]).endswith(
        "for 0 usable tasks: scene 100%"
    )
