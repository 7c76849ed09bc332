"""What LeRobot's own tools do to a dataset of ours is told from damage, and what they leave out can be brought back."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from v2p_data.cli import run
from v2p_data.commands.run import _record_to_train
from v2p_data.episodes.dataset.about import CARRIED_TASKS, TASK_PARTS, read_about
from v2p_data.episodes.dataset.edit import drop, merge
from v2p_data.episodes.dataset.edited import changed_files
from v2p_data.episodes.dataset.tables import read_info
from v2p_data.episodes.dataset.verify import verify
from v2p_data.episodes.dataset.writer import pack
from v2p_data.episodes.staging import Episode
from v2p_data.errors import V2PError
from v2p_data.geometry.rotation import quats_pointing_down, rotvec_from_down
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


def test_the_parts_of_a_split_come_back_from_the_original(made: Path, tmp_path: Path):
    from lerobot.datasets.dataset_tools import split_dataset

    split_dataset(opened(made), {"train": [0, 2], "val": [1]}, output_dir=tmp_path / "split")

    few, whole = tmp_path / "split/train", tmp_path / "whole"
    with pytest.raises(V2PError, match="--from ORIGINAL"):
        _record_to_train(few, tmp_path)
    merge([few], "user/whole", whole, original=made)
    assert ids(whole) == ["toy_00000", "toy_00002"]
    assert verify(whole).is_good


@pytest.mark.parametrize("gone", ["observation.images.mask", "observation.state"])
def test_a_dataset_with_a_column_less_is_ours_and_comes_back_from_the_original(
    gone: str, made: Path, tmp_path: Path
):
    from lerobot.datasets.dataset_tools import remove_feature

    less, whole, few = (tmp_path / name for name in ("less", "whole", "few"))
    remove_feature(opened(made), gone, output_dir=less, repo_id="user/less")

    report = verify(less)
    assert report.is_ours
    assert report.is_good, report.summary()
    merge([less], "user/whole", whole, original=made)
    drop(less, [], few, episodes=[0])
    assert (ids(whole), ids(few)) == ([f"toy_{k:05d}" for k in range(3)], ids(whole)[1:])
    assert (whole / CARRIED_TASKS / "toy" / TASK_PARTS[0]).is_file()
    assert verify(whole).is_good
    assert gone not in read_info(whole)["features"]


def test_a_dataset_with_a_column_more_comes_back_from_the_original(made: Path, tmp_path: Path):
    from lerobot.datasets.dataset_tools import add_features

    more, whole = tmp_path / "more", tmp_path / "whole"
    rewards = np.arange(36, dtype=np.float32)[:, None]
    column = {"dtype": "float32", "shape": (1,), "names": None}
    add_features(opened(made), {"reward": (rewards, column)}, output_dir=more, repo_id="user/more")

    found = [(p.check, p.detail) for p in verify(more).problems]
    assert found == [("statistics", "has nothing on reward")]  # LeRobot writes none
    merge([more], "user/whole", whole, original=made)
    assert ids(whole) == ids(made)
    assert verify(whole).is_good
    np.testing.assert_array_equal([float(row["reward"]) for row in opened(whole)], rewards[:, 0])


def test_lerobots_look_at_a_dataset_changes_nothing_and_its_pictures_are_videos_already(
    made: Path, tmp_path: Path
):
    from lerobot.datasets.dataset_tools import convert_image_to_video_dataset
    from lerobot.scripts.lerobot_edit_dataset import EditDatasetConfig, InfoConfig, handle_info

    before = list_files(made)
    handle_info(EditDatasetConfig(operation=InfoConfig(show_features=True), root=str(made), repo_id="user/toys"))  # fmt: skip
    with pytest.raises(ValueError, match="image datasets only"):
        convert_image_to_video_dataset(opened(made), output_dir=tmp_path / "video")

    assert list_files(made) == before


def test_a_turn_past_pi_and_its_flipped_rotation_vector_are_no_damage(
    tmp_path: Path, make_episode
):
    from lerobot.datasets.dataset_tools import delete_episodes

    yaw = np.pi + np.linspace(
        -0.05, 0.05, 12
    )  # halfway the vector's sign changes, as its angle is at most pi
    episodes = []
    for k, sign in enumerate((1, -1)):  # the same turn, by quaternions of either sign
        episode = make_episode(k)
        turns = rotvec_from_down(sign * quats_pointing_down(yaw + k / 1000)).T
        assert np.abs(np.diff(turns[:, 2])).max() > 6
        state = episode.state.copy()
        state[:, 3:6] = turns
        episodes.append(replace(episode, state=state))
    staged = [episode.save(tmp_path / "staged") for episode in episodes]
    made, few, whole, less = (tmp_path / name for name in ("made", "few", "whole", "less"))
    pack(staged, "user/turns", made)

    delete_episodes(opened(made), [0], output_dir=few, repo_id="user/few")
    merge([few], "user/whole", whole, original=made)
    drop(made, [], less, episodes=[0])

    assert verify(made, staged).is_good
    for root in (whole, less):
        assert verify(root).is_good
        rows = opened(root)
        states = np.stack([row["observation.state"].numpy() for row in rows])
        np.testing.assert_array_equal(states, episodes[1].state)
        actions = np.stack([row["action"].numpy() for row in rows])
        np.testing.assert_array_equal(actions, episodes[1].action)
        steps = (
            Rotation.from_rotvec(states[1:, 3:6]) * Rotation.from_rotvec(states[:-1, 3:6]).inv()
        )
        np.testing.assert_allclose(steps.magnitude(), 0.1 / 11, atol=1e-5)


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
