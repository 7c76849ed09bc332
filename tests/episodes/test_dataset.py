"""One tiny dataset through LeRobot and back. LeRobot's import takes most of the time, so it happens once here."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hub_server import TOKEN, Hub

from v2p_data.episodes.card import write_card
from v2p_data.episodes.staging import Episode
from v2p_data.episodes.verify import verify
from v2p_data.episodes.writer import pack
from v2p_data.errors import V2PError
from v2p_data.sim.masks import PALETTE

pytestmark = pytest.mark.slow


def copied(packed: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(packed, tmp_path / "copy"))


def edit_table(root: Path, pattern: str, change) -> None:
    """Change the one parquet file that matches, keeping its schema."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    (path,) = root.glob(pattern)
    table = pq.read_table(path)
    rows = table.to_pydict()
    change(rows)
    pq.write_table(pa.table(rows, schema=table.schema), path)


def checks_that_fail(root: Path, staged: list[Path] | None = None) -> set[str]:
    return {problem.check for problem in verify(root, staged).problems}


def test_lerobot_reads_exactly_what_was_drawn(packed: Path, staged: list[Path]):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("user/toys", root=packed)
    episodes = [Episode.load(path) for path in staged]
    labels = np.concatenate([e.labels for e in episodes])
    rows = [dataset[i] for i in range(len(dataset))]

    assert len(rows) == len(labels) == 36
    for row, image in zip(rows, labels, strict=True):
        grey = np.asarray(row["observation.images.mask"]) * 255
        assert np.abs(grey - np.asarray(PALETTE)[image]).max() < 1e-3
    for key, name in (("observation.state", "state"), ("action", "action")):
        wanted = np.concatenate([getattr(e, name) for e in episodes])
        assert np.array_equal(np.stack([np.asarray(r[key]) for r in rows]), wanted)
    assert [r["task"] for r in rows[::12]] == [e.task for e in episodes]
    assert dataset.meta.robot_type == "v2p_franka"
    assert dataset.fps == 20


def test_a_good_dataset_is_found_good(packed: Path, staged: list[Path]):
    report = verify(packed, staged)

    assert report.is_good, report.summary()
    assert (report.num_episodes, report.num_frames) == (3, 36)
    assert json.loads(json.dumps(report.as_json()))["is_compared"] is True


def test_the_same_episodes_give_the_same_bytes(packed: Path, staged: list[Path], tmp_path: Path):
    again = tmp_path / "again"
    pack(
        staged, "user/toys", again, provenance={"commit": "abc", "packages": {"lerobot": "0.6.1"}}
    )

    assert digests(again) == digests(packed)


def digests(root: Path) -> dict[str, str]:
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


def test_nothing_is_left_of_the_work(packed: Path):
    assert sorted(p.name for p in packed.iterdir()) == ["data", "meta", "videos"]
    assert not packed.with_name("toys.partial").exists()


def test_an_existing_dataset_is_left_alone(packed: Path, staged: list[Path]):
    before = digests(packed)

    with pytest.raises(V2PError, match=r"exists already; delete it .* or choose another"):
        pack(staged, "user/toys", packed)
    assert digests(packed) == before


def test_half_a_dataset_is_written_anew(staged: list[Path], tmp_path: Path):
    root = tmp_path / "toys"
    (tmp_path / "toys.partial/meta").mkdir(parents=True)
    (tmp_path / "toys.partial/meta/info.json").write_text("{}")

    pack(staged[:1], "user/toys", root)

    assert verify(root, staged[:1]).is_good


def test_episodes_of_another_size_do_not_go_in(staged: list[Path], tmp_path: Path, make_episode):
    odd = make_episode(7, size_px=32).save(tmp_path)

    with pytest.raises(V2PError, match="collect all episodes at one size"):
        pack([*staged[:1], odd], "user/toys", tmp_path / "toys")
    assert not (tmp_path / "toys").exists()


def test_one_other_pixel_is_noticed(packed: Path, staged: list[Path], tmp_path: Path):
    episode = Episode.load(staged[1])
    episode.labels[5, 20, 30] ^= 1
    altered = [staged[0], episode.save(tmp_path), staged[2]]

    (problem,) = verify(packed, altered).problems

    assert problem.check == "differs"
    assert problem.detail == "1 mask pixels differ from what was drawn"


def test_a_missing_recorded_episode_is_noticed(packed: Path, staged: list[Path]):
    assert "counts" in checks_that_fail(packed, staged[:2])


def test_a_lost_video_is_named(packed: Path, tmp_path: Path):
    root = copied(packed, tmp_path)
    shutil.rmtree(root / "videos")

    (problem,) = verify(root).problems

    assert (problem.check, problem.where) == (
        "missing_file",
        "videos/observation.images.mask/*/*.mp4",
    )


def test_wrong_numbers_are_noticed(packed: Path, tmp_path: Path):
    root = copied(packed, tmp_path)

    def spoil(rows: dict) -> None:
        rows["action"][3] = [1.5] * 7
        rows["observation.state"][13][0] = float("nan")
        rows["timestamp"][30] += 0.02
        rows["next.success"][23] = False

    edit_table(root, "data/*/*.parquet", spoil)

    found = checks_that_fail(root)

    assert {"action_bounds", "finite", "success", "statistics"} <= found
    assert found & {"timestamps", "does_not_read"}


def test_a_repeated_episode_is_noticed(packed: Path, tmp_path: Path):
    root = copied(packed, tmp_path)

    def repeat(rows: dict) -> None:
        for key in ("action", "observation.state"):
            rows[key][12:24] = rows[key][:12]

    edit_table(root, "data/*/*.parquet", repeat)

    assert "duplicate" in checks_that_fail(root)


def test_a_dead_camera_and_foreign_greys_are_noticed(tmp_path: Path, make_episode):
    still, moving = make_episode(0), make_episode(1)
    still.labels[:] = still.labels[:1]
    folder = tmp_path / "staged"
    root = tmp_path / "toys"
    pack([still.save(folder), moving.save(folder)], "user/toys", root)

    assert checks_that_fail(root) == {"dead_camera"}


def test_the_card_tells_tasks_palette_and_ranges(packed: Path, tmp_path: Path):
    root = copied(packed, tmp_path)

    card = write_card(root, "user/toys").read_text()

    assert "| lift the toy up | toy | 2 | 24 |" in card
    assert "| 2 | 128 | toy |" in card
    assert "| objects toy mass_kg | 0.1 | 0.12 |" in card
    assert "license: apache-2.0" in card.split("---")[1]
    assert "- LeRobot" in card.split("---")[1]


PUSH_AND_LOAD = """
import sys
from pathlib import Path
from v2p_data.episodes.hub import push_dataset, push_policy

root, policy = Path(sys.argv[1]), Path(sys.argv[2])
push_dataset(root, "user/toys")
push_dataset(root, "user/toys")  # again: everything is there, the tag moves
push_policy(policy, "user/policy")

from huggingface_hub import snapshot_download
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("user/toys")
print("dataset", dataset.root)
print("frames", len(dataset), tuple(dataset[0]["observation.images.mask"].shape))
print("policy", snapshot_download("user/policy"))
"""


def test_what_is_pushed_is_loaded_back_equal(packed: Path, tmp_path: Path, hub: Hub):
    root = copied(packed, tmp_path)
    policy = tmp_path / "policy"
    policy.mkdir()
    (policy / "config.json").write_text('{"type": "v2p_bc"}')
    (policy / "model.safetensors").write_bytes(bytes(range(256)) * 100)
    env = os.environ | {
        "HF_ENDPOINT": hub.url,
        "HF_TOKEN": TOKEN,
        "HF_HOME": str(tmp_path / "hf"),
        "HF_LEROBOT_HOME": str(tmp_path / "lerobot"),
        "HF_HUB_DISABLE_XET": "1",
        "HF_HUB_DISABLE_TELEMETRY": "1",
        "HF_HUB_DISABLE_PROGRESS_BARS": "1",
    }
    env.pop("HF_HUB_OFFLINE", None)

    done = subprocess.run(
        [sys.executable, "-c", PUSH_AND_LOAD, str(root), str(policy)],
        env=env, capture_output=True, text=True, timeout=300,
    )  # fmt: skip

    assert done.returncode == 0, done.stderr[-3000:]
    said = dict(line.split(" ", 1) for line in done.stdout.splitlines() if " " in line)
    assert said["frames"] == "36 (3, 64, 64)"
    assert digests(Path(said["dataset"])) == digests(root)
    assert digests(Path(said["policy"])) == digests(policy)
    assert "README.md" in digests(Path(said["dataset"]))
    repo = hub.repos["datasets/user/toys"]
    assert repo.tags == {"v3.0": repo.head}
    assert TOKEN not in done.stdout + done.stderr
