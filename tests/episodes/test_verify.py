"""Faults that are put into a dataset are found, each by its name."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from v2p_data.cli import run
from v2p_data.episodes.dataset.encoding import encode_rgb
from v2p_data.episodes.dataset.tables import read_info
from v2p_data.episodes.dataset.verify import verify
from v2p_data.episodes.dataset.writer import pack
from v2p_data.episodes.staging import Episode
from v2p_data.errors import V2PError

pytestmark = pytest.mark.slow
FRONT = "observation.images.mask"
DATA = "data/chunk-000/file-000.parquet"
TABLE = "meta/episodes/chunk-000/file-000.parquet"
VIDEO = f"videos/{FRONT}/chunk-000/file-000.mp4"
FLOATS = ("action", "observation.state", "next.reward", "privileged.object_pose")
Change = Callable[[Path], None]


def rows(path: str, change: Callable[[dict], None]) -> Change:
    """Return what changes a parquet file and keeps its schema."""

    def apply(root: Path) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        table = pq.read_table(root / path)
        columns = table.to_pydict()
        change(columns)
        pq.write_table(pa.table(columns, schema=table.schema), root / path)

    return apply


def entry(path: str, change: Callable[[dict], None]) -> Change:
    """Return what changes a JSON file."""

    def apply(root: Path) -> None:
        data = json.loads((root / path).read_text())
        change(data)
        (root / path).write_text(json.dumps(data))

    return apply


def put(column: str, row: int, value: object) -> Callable[[dict], None]:
    return lambda columns: columns[column].__setitem__(row, value)


def cut_short(path: str) -> Change:
    return lambda root: (root / path).write_bytes((root / path).read_bytes()[:-200])


def test_a_dataset_of_another_tool_is_named_with_what_helps(packed: Path, tmp_path: Path):
    root = Path(shutil.copytree(packed, tmp_path / "copy"))
    (root / "meta/v2p.json").unlink()

    with pytest.raises(V2PError, match=r"v2p\.json is missing.*lerobot-edit-dataset"):
        verify(root)


def test_averages_of_the_episodes_quantiles_are_found(packed: Path, tmp_path: Path):
    from lerobot.datasets.dataset_tools import recompute_stats
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = Path(shutil.copytree(packed, tmp_path / "copy"))
    recompute_stats(LeRobotDataset("user/toys", root=root))

    found = [p.detail.split(" of ")[1].split()[0] for p in verify(root).problems]

    assert {"observation.state", "action", "next.reward"} <= set(found)


def test_lossy_masks_are_one_line_for_all_episodes(packed: Path, tmp_path: Path):
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.dataset_tools import reencode_dataset
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = Path(shutil.copytree(packed, tmp_path / "copy"))
    reencode_dataset(
        LeRobotDataset("user/toys", root=root),
        rgb_encoder=RGBEncoderConfig(vcodec="h264", crf=40),
    )

    (line,) = verify(root).lines()

    assert "palette" in line
    assert "episode 0 and 2 more like it" in line


@pytest.mark.parametrize(
    ("check", "where", "fault"),
    [
        ("finite", "episode 0", rows(DATA, put("action", 3, [float("nan")] * 7))),
        ("statistics", "meta/stats.json", rows(DATA, put("action", 3, [0.99] * 7))),
        (
            "statistics",
            "meta/stats.json",
            entry("meta/stats.json", lambda s: s["action"].update(mean=[0.0] * 7)),
        ),
        (
            "statistics",
            "meta/stats.json",
            entry("meta/stats.json", lambda s: s.pop("observation.state")),
        ),
        (
            "statistics",
            "meta/stats.json",
            entry(
                "meta/stats.json", lambda s: s[FRONT].update(mean=[[[0.9]]] * 3, max=[[[1.0]]] * 3)
            ),
        ),
        ("action_bounds", "episode 0", rows(DATA, put("action", 3, [1.5] * 7))),
        ("success", "episode 1", rows(DATA, put("next.success", 23, False))),
        (
            "duplicate",
            "episode 1",
            rows(DATA, lambda c: [c[k].__setitem__(slice(12, 24), c[k][:12]) for k in FLOATS]),
        ),
        ("index", "episode 1", rows(DATA, put("frame_index", 15, 7))),
        ("index", "episode 2", rows(TABLE, put("dataset_from_index", 2, 20))),
        ("index", "meta/episodes", rows(TABLE, put("episode_index", 2, 5))),
        (
            "index",
            "meta/tasks.parquet",
            rows("meta/tasks.parquet", lambda t: t["task_index"].reverse()),
        ),
        ("task", DATA, rows(DATA, put("task_index", 0, 9))),
        ("length", "episode 0", rows(DATA, put("episode_index", 0, 1))),
        (
            "missing_rows",
            "episode 1",
            rows(
                DATA,
                lambda c: c.update(episode_index=[2 if k == 1 else k for k in c["episode_index"]]),
            ),
        ),
        ("video_times", "episode 1", rows(TABLE, put(f"videos/{FRONT}/to_timestamp", 1, 9.0))),
        (
            "video_times",
            "episode 2",
            rows(
                TABLE,
                lambda c: (
                    put(f"videos/{FRONT}/from_timestamp", 2, 0.6)(c),
                    put(f"videos/{FRONT}/to_timestamp", 2, 1.2)(c),
                ),
            ),
        ),
        ("does_not_read", "episode 0", rows(DATA, put("timestamp", 5, 0.273))),
        ("does_not_read", "episode 2", cut_short(VIDEO)),
        ("unreadable_file", DATA, cut_short(DATA)),
        ("unreadable_file", TABLE, cut_short(TABLE)),
        ("unreadable_file", "meta/stats.json", cut_short("meta/stats.json")),
        (
            "missing_file",
            "meta/tasks.parquet",
            lambda root: (root / "meta/tasks.parquet").unlink(),
        ),
        ("missing_file", f"videos/{FRONT}/*/*.mp4", lambda root: (root / VIDEO).unlink()),
        (
            "missing_file",
            "data/chunk-000/file-003.parquet",
            rows(TABLE, put("data/file_index", 1, 3)),
        ),
        ("counts", "meta/info.json", entry("meta/info.json", lambda i: i.update(total_frames=99))),
        ("counts", "meta/info.json", entry("meta/info.json", lambda i: i.update(total_tasks=5))),
    ],
)
def test_each_fault_is_found_by_its_name(
    packed: Path, tmp_path: Path, check: str, where: str, fault: Change
):
    root = Path(shutil.copytree(packed, tmp_path / "copy"))
    fault(root)

    found = {(problem.check, problem.where) for problem in verify(root).problems}

    assert (check, where) in found


def test_a_camera_whose_picture_never_changes_is_dead(make_episode, tmp_path: Path):
    still, moving = make_episode(0), make_episode(1)
    still.labels[:] = still.labels[:1]
    staged = [episode.save(tmp_path / "staged") for episode in (still, moving)]
    pack(staged, "user/toys", tmp_path / "toys")

    assert [p.check for p in verify(tmp_path / "toys").problems] == ["dead_camera"]


def test_a_damaged_video_of_ours_shows_greys_that_are_no_label(packed: Path, tmp_path: Path):
    root = Path(shutil.copytree(packed, tmp_path / "copy"))
    (video,) = root.glob("videos/*/*/*.mp4")
    data = bytearray(video.read_bytes())
    start = data.index(b"mdat") + 2000
    data[start : start + 40] = bytes(40)
    video.write_bytes(data)

    found = {problem.check for problem in verify(root).problems}

    assert found & {"palette", "does_not_read"}


def test_pictures_of_ours_are_compared_with_what_was_staged(make_episode, tmp_path: Path):
    def with_pictures(number: int, brightness: int) -> Episode:
        plain = make_episode(number)
        pictures = (plain.labels[..., None] * np.array([60, 40, 70]) + brightness).astype(np.uint8)
        return replace(plain, cameras=("mask", "rgb"), rgb_mp4=encode_rgb(pictures).mp4)

    paths = [with_pictures(number, 10).save(tmp_path / "staged") for number in range(2)]
    pack(paths, "user/toys", tmp_path / "toys")
    other = with_pictures(1, 40).save(tmp_path / "other")

    assert verify(tmp_path / "toys", paths).is_good
    (problem,) = verify(tmp_path / "toys", [paths[0], other]).problems
    assert problem.detail == "12 pictures differ from what was drawn"


def test_the_exit_code_tells_good_from_bad_from_unreadable(
    packed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    bad = Path(shutil.copytree(packed, tmp_path / "bad"))
    (bad / "meta/tasks.parquet").unlink()
    (tmp_path / "none").mkdir()

    codes = [
        run(["verify", str(root), "--json", str(tmp_path / f"{root.name}.json")])
        for root in (packed, bad, tmp_path / "none")
    ]

    assert codes == [0, 1, 2]
    (problem,) = json.loads((tmp_path / "bad.json").read_text())["problems"]
    assert problem["check"] == "missing_file"
    assert json.loads((tmp_path / "toys.json").read_text())["num_frames"] == 36
    assert "meta/tasks.parquet" in capsys.readouterr().out


def test_an_older_format_is_named(packed: Path, tmp_path: Path):
    root = Path(shutil.copytree(packed, tmp_path / "copy"))
    entry("meta/info.json", lambda info: info.update(codebase_version="v2.1"))(root)

    with pytest.raises(V2PError, match=r"version 'v2.1'; only v3"):
        read_info(root)


def test_a_column_that_hardly_varies_is_not_taken_for_wrong_statistics(
    make_episode: Callable[..., Episode], tmp_path: Path
):
    """LeRobot's deviation of 0.7 throughout is 2e-4, by rounding."""
    still = make_episode(0)
    still.action[:, 1] = 0.7
    staged = [still.save(tmp_path / "staged")]
    root = tmp_path / "still"
    pack(staged, "user/still", root)
    assert verify(root, staged).is_good

    path = root / "meta/stats.json"
    stats = json.loads(path.read_text())
    stats["action"]["std"][1] = 0.01
    path.write_text(json.dumps(stats))

    (problem,) = verify(root, staged).problems
    assert problem.detail == "std of action is not that of the data"
