"""What LeRobot's own tools do to a dataset of ours is told from damage, and what they leave out can be brought back."""

import json
import shutil
from pathlib import Path

import pytest

from v2p_data.cli import run
from v2p_data.commands.run import _record_to_train
from v2p_data.episodes.dataset.about import CARRIED_TASKS, TASK_PARTS, read_about
from v2p_data.episodes.dataset.edited import changed_files
from v2p_data.episodes.dataset.verify import verify
from v2p_data.episodes.dataset.writer import pack
from v2p_data.episodes.staging import Episode
from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import Record, write_record
from v2p_data.pipeline.contents import list_files

pytestmark = pytest.mark.slow
LIFT = "lift the toy up"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, staged: list[Path]) -> Path:
    """A dataset of three episodes with a task and a record, as `v2p generate` leaves it."""
    root = tmp_path_factory.mktemp("made") / "toys"
    pack(staged, "user/toys", root, provenance={"items": {"toy": {"stage": "episodes"}}})
    for part in TASK_PARTS:
        file = root / CARRIED_TASKS / "toy" / part
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(part)
    record = Record(
        stage="dataset", item="toys", version=1, fingerprint="0" * 8, recipe={}, inputs={}, seconds=1.0,
        counts={"repo_id": "user/toys"}, files=list_files(root),
    )  # fmt: skip
    write_record(root, record)
    return root


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "copy"))


def opened(root: Path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("user/toys", root=root)


def ids(root: Path) -> list[str]:
    about = read_about(root)
    assert about is not None
    return [entry["id"] for entry in about["episodes"]]


def test_renamed_tasks_are_a_note(copy: Path, tmp_path: Path):
    from lerobot.datasets.dataset_tools import modify_tasks

    modify_tasks(opened(copy), task_replacements={LIFT: "pick the toy up"})
    report = verify(copy)

    assert report.is_good, report.summary()
    assert [note.check for note in report.notes] == ["edited"] * 2
    assert "2 of 3 episodes have another instruction" in " ".join(n.detail for n in report.notes)
    record, is_as_made = _record_to_train(copy, tmp_path)
    assert (record.counts["repo_id"], is_as_made) == ("user/toys", False)


def test_statistics_by_lerobot_are_an_edit_with_averaged_quantiles(copy: Path):
    from lerobot.datasets.dataset_tools import recompute_stats

    recompute_stats(opened(copy))
    report = verify(copy)

    assert {problem.check for problem in report.problems} == {"quantiles"}
    assert [note.where for note in report.notes] == ["meta/stats.json"]


def test_lossy_masks_are_one_line_for_all_episodes(copy: Path):
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.dataset_tools import reencode_dataset

    reencode_dataset(opened(copy), rgb_encoder=RGBEncoderConfig(vcodec="h264", crf=40))
    report = verify(copy)

    lines = [line for line in report.lines() if line.startswith("problem")]
    assert {problem.check for problem in report.problems} == {"palette"}
    assert len(lines) == 1
    assert "episode 0 and 2 more like it" in lines[0]


def test_what_lerobot_merged_is_ours_still(made: Path, tmp_path: Path, make_episode):
    from lerobot.datasets.dataset_tools import merge_datasets

    pack([make_episode(7).save(tmp_path / "staged")], "user/more", tmp_path / "more")
    both = tmp_path / "both"
    merge_datasets([opened(made), opened(tmp_path / "more")], "user/both", output_dir=both)

    assert not (both / "meta/v2p.json").exists()
    assert ids(both) == [f"toy_{k:05d}" for k in (0, 1, 2, 7)]
    report = verify(both)
    assert report.is_ours
    assert {problem.check for problem in report.problems} == {"quantiles"}
    assert _record_to_train(both, tmp_path)[0].item == "both"


def test_what_a_deletion_left_out_comes_back_from_the_original(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    from lerobot.datasets.dataset_tools import delete_episodes

    few, whole = tmp_path / "few", tmp_path / "whole"
    delete_episodes(opened(made), [1], output_dir=few, repo_id="user/few")
    assert read_about(few) is None
    with pytest.raises(V2PError, match="--from ORIGINAL"):
        _record_to_train(few, tmp_path)

    words = ["merge", str(few), "--out", str(whole), "--repo-id", "user/whole", "--from"]
    assert run([*words, str(made)]) == 0
    assert ids(whole) == ["toy_00000", "toy_00002"]
    assert (whole / CARRIED_TASKS / "toy" / TASK_PARTS[0]).is_file()
    assert verify(whole).is_good
    assert run([*words[:3], str(tmp_path / "x"), *words[4:], str(whole)]) == 0
    assert (
        run(["merge", str(made), str(few), "--out", str(tmp_path / "y"), "--repo-id", "user/y"])
        == 2
    )
    assert "--from" in capsys.readouterr().err


def test_episodes_are_dropped_by_their_numbers(made: Path, tmp_path: Path, staged: list[Path]):
    out = tmp_path / "less"

    assert run(["drop", str(made), "--episodes", "0", "1", "--out", str(out)]) == 0

    assert ids(out) == [Episode.load(staged[2]).id]
    assert json.loads((out / "meta/v2p.json").read_text())["provenance"]["edits"][0][
        "numbers"
    ] == [0, 1]
    assert run(["drop", str(made), "--episodes", "3", "--out", str(tmp_path / "no")]) == 2


@pytest.mark.parametrize(
    "name",
    ["data/chunk-000/file-000.parquet", "meta/tasks.parquet", "meta/info.json", "meta/v2p.json"],
)
def test_a_flipped_byte_is_no_edit(copy: Path, name: str):
    data = bytearray((copy / name).read_bytes())
    data[len(data) // 2] ^= 0x41
    (copy / name).write_bytes(bytes(data))

    assert [d.path for d in changed_files(copy).damaged] == [copy / name]
