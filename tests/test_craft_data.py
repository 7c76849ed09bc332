"""What a stage reads beside its inputs is part of what it is."""

from pathlib import Path

import pytest

from v2p_data import craft_data
from v2p_data.stages import EngineConfig, scene_stage, task_stage
from v2p_data.task.generate import TaskConfig
from v2p_data.video.captions import find_videos

SAMPLES = Path(__file__).parents[1] / "datasets" / "sample_videos"
PACKAGE = craft_data.PACKAGE
SCENE_FILES = sorted(
    p.relative_to(PACKAGE / "scene").as_posix()
    for p in (PACKAGE / "scene").rglob("*.*")
    if p.suffix in (".tsv", ".safetensors", ".json")
)


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Copies of the files that stages read, to be edited."""
    for folder, names in (
        ("scene", SCENE_FILES),
        ("task/llm", craft_data.PROMPTS),
    ):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        for name in names:
            (tmp_path / folder / name).parent.mkdir(exist_ok=True)
            (tmp_path / folder / name).write_bytes((PACKAGE / folder / name).read_bytes())
    monkeypatch.setattr(craft_data, "PACKAGE", tmp_path)
    return tmp_path


def names(cfg: EngineConfig | None = None) -> tuple[str, str]:
    """Return the folder names of a video's scene and task."""
    cfg = cfg or EngineConfig()
    scene = scene_stage(find_videos(SAMPLES)[0], cfg)
    return scene.folder_name, task_stage(scene, cfg).folder_name


def edit(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"\n")


def test_all_that_reconstruction_reads_is_known():
    names = {Path(name).name for name in SCENE_FILES}

    assert {"nouns.tsv", "standing.json", "network.safetensors", "camera.safetensors"} <= names
    assert {"boxes.safetensors", "ruler.safetensors"} <= names
    assert len(names) == len(SCENE_FILES)
    assert set(craft_data.scene_data()) == {f"data scene/{name}" for name in names}


@pytest.mark.parametrize("name", SCENE_FILES)
def test_an_edited_table_or_network_makes_another_scene_and_task(package: Path, name: str):
    before = names()

    edit(package / "scene" / name)

    after = names()
    assert before[0] != after[0]
    assert before[1] != after[1]


@pytest.mark.parametrize("name", craft_data.PROMPTS)
def test_prompts_count_where_a_model_is_asked(package: Path, name: str):
    asks = EngineConfig(task=TaskConfig(writer="vlm"))
    before, asked = names(), names(asks)

    edit(package / "task/llm" / name)

    assert names() == before
    assert names(asks)[1] != asked[1]


def test_the_same_files_are_the_same_stage(package: Path):
    before = names()
    for path in package.rglob("*.*"):
        path.write_bytes(path.read_bytes())  # another time, the same content

    assert names() == before
