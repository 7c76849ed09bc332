"""One tiny dataset through LeRobot and back. LeRobot's import takes most of the time, so it happens once here."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hub_server import TOKEN, Hub

from v2p_data.episodes.dataset import shards, writer
from v2p_data.episodes.dataset.card import dataset_card, write_card
from v2p_data.episodes.dataset.encoding import encode_rgb
from v2p_data.episodes.dataset.episode_stats import rgb_stats
from v2p_data.episodes.dataset.features import EPISODE_COLUMN, features
from v2p_data.episodes.dataset.verify import verify
from v2p_data.episodes.dataset.writer import pack
from v2p_data.episodes.staging import Episode, Heading
from v2p_data.errors import V2PError
from v2p_data.json_files import json_or_none
from v2p_data.sim.render.masks import PALETTE, labels_to_rgb

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


def test_tables_and_metadata_are_what_lerobots_writer_makes(
    packed: Path, staged: list[Path], tmp_path: Path
):
    import pyarrow.parquet as pq
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = tmp_path / "lerobots"
    dataset = LeRobotDataset.create(
        "user/toys",
        fps=20,
        features=features(64, is_simulated=True),
        root=root,
        robot_type="v2p_franka",
        rgb_encoder=RGBEncoderConfig(vcodec="h264", crf=0, pix_fmt="yuv420p", g=2),
    )
    for episode in map(Episode.load, staged):
        for t, picture in enumerate(labels_to_rgb(episode.labels)):
            dataset.add_frame(
                {
                    "observation.images.mask": picture,
                    "observation.state": episode.state[t],
                    "action": episode.action[t],
                    "next.success": episode.success[t : t + 1],
                    "next.done": np.array([t == episode.num_frames - 1]),
                    **{k: np.atleast_1d(v[t]) for k, v in episode.simulated.items()},
                    "task": episode.task,
                }
            )
        dataset.save_episode(parallel_encoding=False)
    dataset.finalize()

    for name in ("data/chunk-000/file-000.parquet", "meta/tasks.parquet"):
        ours, theirs = pq.read_table(packed / name), pq.read_table(root / name)
        assert ours.schema.equals(theirs.schema)
        assert ours.equals(theirs)
        (told, told_by_them) = (  # a row of LeRobot's table has a fingerprint besides
            json.loads(t.schema.metadata.get(b"huggingface", b"{}")).get("info")
            for t in (ours, theirs)
        )
        assert told == told_by_them
    data = "data/chunk-000/file-000.parquet"
    assert (
        pq.ParquetFile(packed / data).num_row_groups == pq.ParquetFile(root / data).num_row_groups
    )
    assert json_or_none(packed / "meta/info.json") == json_or_none(root / "meta/info.json")
    ours, theirs = (
        pq.read_table(r / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
        for r in (packed, root)
    )
    assert set(ours) == {*theirs, EPISODE_COLUMN}
    for name, values in theirs.items():
        if name.startswith("stats/"):  # LeRobot adds up pixels in 32 bits
            assert np.allclose(np.array(ours[name]), np.array(values), rtol=1e-4, atol=1e-6), name
        elif "timestamp" in name:
            assert np.allclose(ours[name], values)
        else:
            assert ours[name] == values, name


@pytest.mark.parametrize("count", [3, 130])
def test_statistics_of_pictures_are_lerobots_without_its_rounding(count: int):
    """Of 130 frames LeRobot looks at 100; of 320 x 320 pixels at every second row and column."""
    from lerobot.datasets.compute_stats import get_feature_stats

    rng = np.random.default_rng(count)
    size = 320 if count < 100 else 16
    pictures = rng.integers(3, 250, (count, size, size, 3), np.uint8)
    chosen = np.round(np.linspace(0, count - 1, min(count, 100))).astype(int)
    seen = pictures[chosen][:, :: size // 150 or 1, :: size // 150 or 1]

    ours = rgb_stats(pictures)
    theirs = get_feature_stats(seen.transpose(0, 3, 1, 2), axis=(0, 2, 3), keepdims=True)

    assert set(ours) == set(theirs)
    assert ours["count"] == theirs["count"] == len(chosen)
    for name in ("min", "max", "q01", "q10", "q50", "q90", "q99"):
        assert np.allclose(ours[name] * 255, theirs[name][0], atol=1e-4), name
    assert np.allclose(ours["mean"][:, 0, 0] * 255, seen.reshape(-1, 3).mean(0, np.float64))
    assert np.allclose(ours["std"][:, 0, 0] * 255, seen.reshape(-1, 3).std(0, dtype=np.float64))


def test_a_packing_goes_on_from_its_finished_shards(
    packed: Path, staged: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(shards, "SHARD_FRAMES", 20)  # the first two episodes, then the third
    root, folder = tmp_path / "toys", tmp_path / "toys.partial/shards"
    planned = shards.plan_shards([Heading.read(path) for path in staged])
    shards.make_shards(planned, folder, num_threads=1)
    kept = (folder / "00000.mask.mp4").stat().st_ino
    (folder / "00001.json").write_text("half")
    monkeypatch.setattr(writer, "VIDEO_FILE_MB", 0)  # a file per shard

    pack(staged, "user/toys", root, num_threads=3)

    first, second = sorted(root.glob("videos/*/*/*.mp4"))
    assert first.stat().st_ino == kept
    assert verify(root, staged).is_good
    assert first.stat().st_size > second.stat().st_size


def test_shards_of_a_camera_share_a_file_that_lerobot_can_stream(
    staged: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """LeRobot takes a frame's number over the rate for its time in the file, which holds for the first one."""
    from lerobot.datasets import streaming_dataset
    from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset
    from lerobot.datasets.video_utils import decode_video_frames

    def decode(path: str, times: list[float], tolerance_s: float, **options: Any) -> Any:
        return decode_video_frames(path, times, tolerance_s, backend="pyav")

    # LeRobot's choice needs the system's FFmpeg; which times it asks for is what is tested.
    monkeypatch.setattr(streaming_dataset, "decode_video_frames_torchcodec", decode)
    monkeypatch.setattr(shards, "SHARD_FRAMES", 12)  # an episode each
    root = tmp_path / "toys"

    pack(staged, "user/toys", root)

    assert len(list(root.glob("videos/*/*/*.mp4"))) == 1
    assert verify(root, staged).is_good
    labels = np.concatenate([Episode.load(path).labels for path in staged])
    rows = list(StreamingLeRobotDataset("user/toys", root=root, shuffle=False))
    assert sorted(int(row["index"]) for row in rows) == list(range(36))
    for row in rows:
        grey = np.asarray(row["observation.images.mask"])[0] * 255
        assert np.abs(grey - np.asarray(PALETTE)[labels[int(row["index"])]]).max() < 1e-3


def test_a_video_file_ends_below_the_limit(
    staged: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(shards, "SHARD_FRAMES", 12)
    planned = shards.plan_shards([Heading.read(path) for path in staged])
    shards.make_shards(planned, tmp_path, num_threads=1)
    sizes = [s.file(tmp_path, "mask").stat().st_size for s in planned]

    def numbers(max_bytes: int) -> list[list[int]]:
        return [
            [s.number for s in g] for g in shards.plan_files(planned, tmp_path, "mask", max_bytes)
        ]

    assert numbers(sum(sizes) + 1) == [[0, 1, 2]]
    assert numbers(sum(sizes)) == [[0, 1], [2]]
    assert numbers(1) == [[0], [1], [2]]


def test_a_shard_of_other_episodes_is_not_taken(staged: list[Path], tmp_path: Path, make_episode):
    folder = tmp_path / "toys.partial/shards"
    other = make_episode(0)
    other.labels[3] = 0
    shards.make_shards(shards.plan_shards([Heading.read(other.save(tmp_path))]), folder)

    pack(staged[:1], "user/toys", tmp_path / "toys")

    assert verify(tmp_path / "toys", staged[:1]).is_good


def test_colours_and_masks_are_two_cameras_of_one_dataset(tmp_path: Path, make_episode):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    plain = make_episode(0)
    pictures = np.repeat((plain.labels * 60)[..., None], 3, axis=-1)
    both = replace(plain, cameras=("mask", "rgb"), rgb_mp4=encode_rgb(pictures).mp4)
    root = tmp_path / "toys"

    pack([both.save(tmp_path)], "user/toys", root)

    dataset = LeRobotDataset("user/toys", root=root)
    for t in (0, 5, 11):
        row = dataset[t]
        mask = np.asarray(row["observation.images.mask"])[0] * 255
        assert np.abs(mask - np.asarray(PALETTE)[plain.labels[t]]).max() < 1e-3
        colour = np.asarray(row["observation.images.rgb"]).transpose(1, 2, 0) * 255
        assert np.abs(colour - pictures[t]).mean() < 3


def test_masks_of_two_cameras_are_two_features_and_each_is_compared(tmp_path: Path, make_episode):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    table, wrist = (make_episode(k).labels for k in (0, 1))
    both = replace(
        make_episode(0),
        labels=np.concatenate([table, wrist], axis=1),
        cameras=("mask", "mask_wrist"),
    )
    staged, root = both.save(tmp_path), tmp_path / "toys"

    pack([staged], "user/toys", root)

    row = LeRobotDataset("user/toys", root=root)[7]
    for key, labels in (("mask", table), ("mask_wrist", wrist)):
        grey = np.asarray(row[f"observation.images.{key}"])[0] * 255
        assert np.abs(grey - np.asarray(PALETTE)[labels[7]]).max() < 1e-3
    assert verify(root, [staged]).is_good
    swapped = replace(both, labels=np.concatenate([wrist, table], axis=1)).save(
        tmp_path / "swapped"
    )
    assert not verify(root, [swapped]).is_good


def test_episodes_of_other_cameras_do_not_go_in(staged: list[Path], tmp_path: Path, make_episode):
    odd = replace(make_episode(7), cameras=("rgb",), rgb_mp4=b"video").save(tmp_path)

    with pytest.raises(V2PError, match="collect all episodes with one"):
        pack([*staged, odd], "user/toys", tmp_path / "toys")


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

    with pytest.raises(V2PError, match="collect all episodes with one --episodes"):
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


def test_the_card_tells_tasks_palette_and_ranges(packed: Path, tmp_path: Path):
    root = copied(packed, tmp_path)

    card = write_card(root, "user/toys").read_text()

    assert "| lift the toy up | toy | 2 | 24 |" in card
    assert "| 2 | 128 | toy |" in card
    assert "| objects toy mass_kg | 0.1 | 0.12 |" in card
    assert "license: apache-2.0" in card.split("---")[1]
    assert "- LeRobot" in card.split("---")[1]
    parts = [
        "visualize_dataset?path=user/toys",
        "## Tasks",
        'root="FOLDER"',
        "## Limits",
        "<details>",
        "mass_kg",
    ]
    assert [card.index(p) for p in parts] == sorted(card.index(p) for p in parts)


def test_the_card_of_an_older_dataset_names_its_seven_numbers(packed: Path):
    about, info = (json_or_none(packed / "meta" / name) for name in ("v2p.json", "info.json"))
    state = info["features"]["observation.state"]
    assert (state["shape"], len(state["names"])) == ([11], 11)

    info["features"]["observation.state"] = state | {"shape": [7], "names": state["names"][:7]}
    card = dataset_card(about, info, "user/toys")

    assert "gripper.pos [0 closed to 1 open] |" in card
    assert "target_gripper.pos" not in card


PUSH_AND_LOAD = """
import sys
from pathlib import Path
from v2p_data.episodes.hub.hub import push_dataset, push_policy

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


@pytest.mark.long
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
        env=env,
        capture_output=True,
        text=True,
        timeout=300,
    )

    assert done.returncode == 0, done.stderr[-3000:]
    said = dict(line.split(" ", 1) for line in done.stdout.splitlines() if " " in line)
    assert said["frames"] == "36 (3, 64, 64)"
    assert digests(Path(said["dataset"])) == digests(root)
    assert digests(Path(said["policy"])) == digests(policy)
    assert "README.md" in digests(Path(said["dataset"]))
    repo = hub.repos["datasets/user/toys"]
    assert repo.tags == {"v3.0": repo.head}
    assert TOKEN not in done.stdout + done.stderr
