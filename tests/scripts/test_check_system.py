"""Without FFmpeg on the system LeRobot streams with the libraries that PyAV brought."""

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np
import pytest

from v2p_data.episodes.dataset import shards
from v2p_data.episodes.dataset.writer import pack
from v2p_data.episodes.staging import Episode
from v2p_data.seeds import rng_for

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="links are made on Linux only"),
]
LENGTHS = (9, 12, 7, 10)
SHADES = (0, 1, 2)


@pytest.fixture(scope="module")
def check_system(load_script):
    return load_script("check_system")


@pytest.fixture(scope="module")
def lent(check_system, tmp_path_factory) -> Path:
    """What stands for a virtual environment, with the libraries of the real one."""
    prefix = tmp_path_factory.mktemp("venv")
    (prefix / "bin").mkdir()
    (prefix / "bin/activate").write_text(f'export VIRTUAL_ENV="{prefix}"\n')
    assert check_system.lend_ffmpeg(prefix, Path(sysconfig.get_path("platlib")) / "av.libs")
    return prefix


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    """Four episodes in shards of one, joined in one file; the shade of a frame is its number's."""
    folder, root = tmp_path_factory.mktemp("staged"), tmp_path_factory.mktemp("set") / "toys"
    paths = []
    for number, length in enumerate(LENGTHS):
        first = sum(LENGTHS[:number])
        rng = rng_for(0, "streamed", number)
        shade = (first + np.arange(length)) % len(SHADES)
        paths.append(
            Episode(
                id=f"toy_{number:05d}",
                item="toy",
                task="lift the toy up",
                seed=number,
                labels=np.repeat(shade, 64 * 64).reshape(length, 64, 64).astype(np.uint8),
                state=rng.normal(size=(length, 11)).astype(np.float32),
                action=rng.uniform(-1, 1, (length, 7)).astype(np.float32),
                success=np.arange(length) >= length - 4,
                referee=True,
                objects=("toy", "bowl"),
                params={},
            ).save(folder)
        )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shards, "SHARD_FRAMES", 1)
        pack(paths, "user/toys", root)
    return root


READ = """
import sys
from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset
from lerobot.scripts.lerobot_info import main
for row in StreamingLeRobotDataset("user/toys", root=sys.argv[1], shuffle=False):
    grey = row["observation.images.mask"] * 255
    print("row", int(row["index"]), int(row["episode_index"]), round(float(grey.min())), round(float(grey.max())))
sys.argv = sys.argv[:1]
main()
"""


@pytest.mark.long
def test_lerobot_streams_every_frame_of_joined_shards_and_reports_in_an_activated_shell(
    lent: Path, dataset: Path
):
    from v2p_data.sim.render.masks import PALETTE

    done = subprocess.run(
        [
            "bash",
            "-c",
            'source "$0/bin/activate"; exec "$@"',
            str(lent),
            sys.executable,
            "-c",
            READ,
            str(dataset),
        ],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env={**os.environ, "HF_HUB_OFFLINE": "1"},
    )

    assert done.returncode == 0, done.stderr[-2000:]
    assert "Could not load libtorchcodec" not in done.stderr
    assert "LeRobot version" in done.stdout
    rows = [
        [int(n) for n in line.split()[1:]]
        for line in done.stdout.splitlines()
        if line.startswith("row")
    ]
    episode_of = np.repeat(np.arange(len(LENGTHS)), LENGTHS)
    assert len(list(dataset.glob("videos/*/*/*.mp4"))) == 1
    assert sorted(rows) == [
        [i, episode_of[i], PALETTE[i % len(SHADES)], PALETTE[i % len(SHADES)]]
        for i in range(sum(LENGTHS))
    ]


def test_an_activation_script_is_added_to_once(check_system, tmp_path: Path):
    script = tmp_path / "activate"
    script.write_text("# theirs\n")

    check_system.name_in_activation(script)
    once = script.read_text()
    check_system.name_in_activation(script)

    assert script.read_text() == once
    assert once.startswith("# theirs\n")


def test_without_libraries_of_pyav_nothing_is_changed(check_system, tmp_path: Path):
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin/activate").write_text("")

    assert not check_system.lend_ffmpeg(tmp_path, tmp_path / "av.libs")
    assert [p.name for p in tmp_path.rglob("*")] == ["bin", "activate"]
    assert (tmp_path / "bin/activate").read_text() == ""
