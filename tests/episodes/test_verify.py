"""Faults that are put into datasets of LeRobot's own making are found, each by its name."""

import json
import re
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
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
from v2p_data.seeds import rng_for

pytestmark = pytest.mark.slow
FPS, FRAMES, EPISODES = 10, 12, 3
FRONT, WRIST = "observation.images.front", "observation.images.wrist"
DATA = "data/chunk-000/file-000.parquet"
TABLE = "meta/episodes/chunk-000/file-000.parquet"
VIDEO = f"videos/{FRONT}/chunk-000/file-000.mp4"
Change = Callable[[Path], None]


def record(root: Path, *, freeze_from: int = FRAMES, black: bool = False) -> Path:
    """Let LeRobot write what another robot might record: two cameras, one as video, and degrees."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    joints = [f"joint_{k}" for k in range(6)]
    dataset = LeRobotDataset.create(
        "somebody/else",
        fps=FPS,
        root=root,
        robot_type="so101",
        features={
            FRONT: {"dtype": "video", "shape": (48, 64, 3), "names": ["height", "width", "channels"]},
            WRIST: {"dtype": "image", "shape": (32, 32, 3), "names": ["height", "width", "channels"]},
            "observation.state": {"dtype": "float32", "shape": (6,), "names": joints},
            "action": {"dtype": "float32", "shape": (6,), "names": joints},
        },
    )  # fmt: skip
    for episode in range(EPISODES):
        rng = rng_for(5, "foreign", episode)
        for t in range(FRAMES):
            shown = min(t, freeze_from)
            front = np.full((48, 64, 3), 40, np.uint8)
            front[10:30, 4 * shown : 4 * shown + 16] = (200, 120, 60 + 20 * episode)
            wrist = rng_for(6, "wrist", episode, t).integers(0, 255, (32, 32, 3), np.uint8)
            dataset.add_frame(
                {
                    FRONT: front,
                    WRIST: np.zeros_like(wrist) if black else wrist,
                    "observation.state": np.linspace(t, 90, 6, dtype=np.float32),
                    "action": rng.uniform(-180, 180, 6).astype(np.float32),
                    "task": "open the drawer" if episode else "close the drawer",
                }
            )
        with ThreadPoolExecutor(1) as own:  # as root, SVT-AV1 makes its caller real-time
            own.submit(dataset.save_episode).result()
    dataset.finalize()
    return root


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("foreign") / "drawers")


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


def test_a_dataset_of_others_is_good_and_what_was_skipped_is_said(foreign: Path):
    report = verify(foreign)

    assert report.is_good, report.summary()
    assert (report.num_episodes, report.num_frames) == (EPISODES, EPISODES * FRAMES)
    assert not report.is_ours
    said = " ".join(report.skipped)
    assert all(words in said for words in ("palette", "action bounds", "success at the end"))


@pytest.mark.parametrize(
    ("check", "where", "fault"),
    [
        ("finite", "episode 0", rows(DATA, put("action", 3, [float("nan")] * 6))),
        ("statistics", "meta/stats.json", rows(DATA, put("action", 3, [999.0] * 6))),
        ("statistics", "meta/stats.json", entry("meta/stats.json", lambda s: s["action"].update(mean=[0.0] * 6))),
        ("statistics", "meta/stats.json", entry("meta/stats.json", lambda s: s.pop("observation.state"))),
        ("statistics", "meta/stats.json", entry("meta/stats.json", lambda s: s[FRONT].update(mean=[[[0.9]]] * 3, max=[[[1.0]]] * 3))),
        ("index", "episode 1", rows(DATA, put("frame_index", 15, 7))),
        ("index", "episode 2", rows(TABLE, put("dataset_from_index", 2, 20))),
        ("index", "meta/episodes", rows(TABLE, put("episode_index", 2, 5))),
        ("index", "meta/tasks.parquet", rows("meta/tasks.parquet", lambda t: t["task_index"].reverse())),
        ("task", DATA, rows(DATA, put("task_index", 0, 9))),
        ("length", "episode 0", rows(DATA, put("episode_index", 0, 1))),
        ("missing_rows", "episode 1", rows(DATA, lambda c: c.update(episode_index=[2 if k == 1 else k for k in c["episode_index"]]))),
        ("video_times", "episode 1", rows(TABLE, put(f"videos/{FRONT}/to_timestamp", 1, 9.0))),
        ("video_times", "episode 2", rows(TABLE, lambda c: (put(f"videos/{FRONT}/from_timestamp", 2, 1.2)(c), put(f"videos/{FRONT}/to_timestamp", 2, 2.4)(c)))),
        ("does_not_read", "episode 0", rows(DATA, put("timestamp", 5, 0.53))),
        ("does_not_read", "episode 2", cut_short(VIDEO)),
        ("unreadable_file", DATA, cut_short(DATA)),
        ("unreadable_file", TABLE, cut_short(TABLE)),
        ("unreadable_file", "meta/stats.json", cut_short("meta/stats.json")),
        ("missing_file", "meta/tasks.parquet", lambda root: (root / "meta/tasks.parquet").unlink()),
        ("missing_file", f"videos/{FRONT}/*/*.mp4", lambda root: (root / VIDEO).unlink()),
        ("missing_file", "data/chunk-000/file-003.parquet", rows(TABLE, put("data/file_index", 1, 3))),
        ("counts", "meta/info.json", entry("meta/info.json", lambda i: i.update(total_frames=99))),
        ("counts", "meta/info.json", entry("meta/info.json", lambda i: i.update(total_tasks=5))),
        ("duplicate", "episode 2", rows(DATA, lambda c: [c[k].__setitem__(slice(24, 36), c[k][12:24]) for k in ("action", "observation.state")])),
    ],
)  # fmt: skip
def test_each_fault_is_found_by_its_name(
    foreign: Path, tmp_path: Path, check: str, where: str, fault: Change
):
    root = Path(shutil.copytree(foreign, tmp_path / "copy"))
    fault(root)

    found = {(problem.check, problem.where) for problem in verify(root).problems}

    assert (check, where) in found


def test_frozen_and_black_cameras_are_dead(tmp_path: Path):
    report = verify(record(tmp_path / "dead", freeze_from=1, black=True))

    # Lossy video takes a frame or two to come to rest.
    found = {re.sub(r"frame \d+ ", "", p.detail) for p in report.problems}
    assert {p.check for p in report.problems} == {"dead_camera"}
    assert found == {
        f"{FRONT} stands still from to 11 while the robot moves",
        f"{WRIST} never changes",
    }


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
    foreign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    bad = Path(shutil.copytree(foreign, tmp_path / "bad"))
    (bad / "meta/tasks.parquet").unlink()
    (tmp_path / "none").mkdir()

    codes = [
        run(["verify", str(root), "--json", str(tmp_path / f"{root.name}.json")])
        for root in (foreign, bad, tmp_path / "none")
    ]

    assert codes == [0, 1, 2]
    (problem,) = json.loads((tmp_path / "bad.json").read_text())["problems"]
    assert problem["check"] == "missing_file"
    assert json.loads((tmp_path / "drawers.json").read_text())["num_frames"] == 36
    assert "meta/tasks.parquet" in capsys.readouterr().out


def test_an_older_format_is_named(foreign: Path, tmp_path: Path):
    root = Path(shutil.copytree(foreign, tmp_path / "copy"))
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
