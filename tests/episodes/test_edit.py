"""Merging and dropping change no pixel and no number, and refuse what does not go together."""

import json
import resource
import shutil
import tempfile
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from v2p_data.cli import run
from v2p_data.episodes.dataset.about import CARRIED_TASKS, TASK_PARTS
from v2p_data.episodes.dataset.edit import drop, merge
from v2p_data.episodes.dataset.features import EPISODE_COLUMN
from v2p_data.episodes.dataset.tables import episodes_of
from v2p_data.episodes.dataset.verify import verify
from v2p_data.episodes.dataset.writer import pack
from v2p_data.episodes.staging import Episode
from v2p_data.errors import V2PError
from v2p_data.pipeline.artifact import Record, write_record
from v2p_data.pipeline.contents import list_files
from v2p_data.sim.render.masks import PALETTE

pytestmark = pytest.mark.slow
LIFT, PUSH = "lift the toy up", "push the toy to the left"


@pytest.fixture
def file_limit() -> Callable[[int], AbstractContextManager[None]]:
    """No file may grow beyond so many bytes: a real failure of the system, as on a full disk."""

    @contextmanager
    def limited(size: int) -> Generator[None]:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    return limited


@pytest.fixture(scope="module")
def more_staged(tmp_path_factory: pytest.TempPathFactory, make_episode) -> list[Path]:
    folder = tmp_path_factory.mktemp("more")
    return [make_episode(k, num_frames=8 + k).save(folder) for k in (3, 4)]


@pytest.fixture(scope="module")
def more(tmp_path_factory: pytest.TempPathFactory, more_staged: list[Path]) -> Path:
    root = tmp_path_factory.mktemp("dataset") / "more"
    pack(more_staged, "user/more", root, provenance={"items": {"toy": {"stage": "episodes"}}})
    for part in TASK_PARTS:
        file = root / CARRIED_TASKS / "toy" / part
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("")
    return root


@pytest.fixture(scope="module")
def merged(tmp_path_factory: pytest.TempPathFactory, packed: Path, more: Path) -> Path:
    root = tmp_path_factory.mktemp("dataset") / "both"
    merge([packed, more], "user/both", root)
    return root


def assert_holds(root: Path, staged: list[Path]) -> None:
    """Compare every pixel and number that LeRobot reads with the recorded episodes."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("user/x", root=root, return_uint8=True)
    at = 0
    for number, path in enumerate(staged):
        episode = Episode.load(path)
        for t in range(episode.num_frames):
            row = dataset[at]
            grey = np.asarray(PALETTE)[episode.labels[t]]
            assert (np.asarray(row["observation.images.mask"]) == grey[None]).all()
            assert np.array_equal(row["observation.state"], episode.state[t])
            assert np.array_equal(row["action"], episode.action[t])
            assert bool(row["next.success"]) == episode.success[t]
            assert (int(row["episode_index"]), int(row["index"])) == (number, at)
            assert row["task"] == episode.task
            at += 1
    assert len(dataset) == at


def about(root: Path) -> dict:
    return json.loads((root / "meta/v2p.json").read_text())


def test_a_merged_dataset_holds_every_pixel_of_both(
    merged: Path, staged: list[Path], more_staged: list[Path]
):
    assert_holds(merged, [*staged, *more_staged])
    report = verify(merged, [*staged, *more_staged])
    assert report.is_good, report.summary()
    assert sorted(p.name for p in merged.parent.iterdir()) == ["both"]


def test_the_quantiles_are_those_of_all_rows(
    packed: Path, merged: Path, staged: list[Path], more_staged: list[Path], tmp_path: Path
):
    """The first percentile of 101 rows or fewer lies between the two smallest."""
    less = drop(merged, [PUSH], tmp_path / "less").root
    both = [*staged, *more_staged]

    for root, paths in ((packed, staged), (merged, both), (less, [both[k] for k in (0, 2, 4)])):
        stats = json.loads((root / "meta/stats.json").read_text())
        for key in ("state", "action"):
            rows = np.sort(np.concatenate([getattr(Episode.load(p), key) for p in paths]), axis=0)
            said = stats["action" if key == "action" else "observation.state"]
            middle = len(rows) // 2, (len(rows) - 1) // 2
            assert (rows[0] <= said["q01"]).all()
            assert (said["q01"] <= rows[1]).all()
            assert np.allclose(said["q50"], rows[list(middle)].mean(0))
            assert (rows[-2] <= said["q99"]).all()
            assert (said["q99"] <= rows[-1]).all()
            assert said["count"] == [len(rows)]


def test_provenance_of_both_is_kept(merged: Path):
    told = about(merged)

    assert [e["id"] for e in told["episodes"]] == [f"toy_{k:05d}" for k in range(5)]
    assert [e["from"] for e in told["episodes"]] == ["user/toys"] * 3 + ["user/more"] * 2
    assert told["provenance"]["items"] == {"toy": {"stage": "episodes"}}
    (edit,) = told["provenance"]["edits"]
    assert [s["repo_id"] for s in edit["sources"]] == ["user/toys", "user/more"]
    assert edit["sources"][0]["commit"] == "abc"
    assert "user/both" in (merged / "README.md").read_text()


def test_the_family_of_an_episode_is_in_the_table_and_stays_through_merging(
    packed: Path, make_episode, tmp_path: Path
):
    cousin = replace(
        make_episode(7), id="toy_cousin_002_00007", item="toy_cousin_002", family="toy"
    )
    path = cousin.save(tmp_path)
    pack([path], "user/cousins", tmp_path / "cousins", provenance={})

    merged = merge([packed, tmp_path / "cousins"], "user/both", tmp_path / "both").root

    assert Episode.load(path).family == "toy"
    assert [e["family"] for e in about(merged)["episodes"]] == ["toy"] * 4
    column = episodes_of(merged).column(EPISODE_COLUMN).to_pylist()
    assert [json.loads(text)["family"] for text in column] == ["toy"] * 4


def test_dropping_a_task_leaves_the_others_pixel_by_pixel(
    merged: Path, staged: list[Path], more_staged: list[Path], tmp_path: Path
):
    every = [*staged, *more_staged]

    edited = drop(merged, [LIFT], tmp_path / "pushes")

    left = [path for path in every if Episode.load(path).task == PUSH]
    assert (edited.num_episodes, edited.tasks) == (2, (PUSH,))
    assert_holds(edited.root, left)
    report = verify(edited.root, left)
    assert report.is_good, report.summary()
    assert [e["id"] for e in about(edited.root)["episodes"]] == ["toy_00001", "toy_00003"]
    video = Path("videos/observation.images.mask/chunk-000/file-000.mp4")
    assert (edited.root / video).stat().st_size < 0.7 * (merged / video).stat().st_size


def test_a_task_dropped_can_be_added_again_and_tasks_of_other_code_stay_apart(
    merged: Path, packed: Path, staged: list[Path], more_staged: list[Path], tmp_path: Path
):
    """The first part was merged and cut, so its files are of several origins."""
    pushes = drop(carrying(merged, tmp_path / "both", "first"), [LIFT], tmp_path / "pushes").root
    lifts = carrying(packed, tmp_path / "toys", "second")

    out = merge([drop(lifts, [PUSH], tmp_path / "lifts").root, pushes], "user/x", tmp_path / "x")

    assert_holds(out.root, [staged[0], staged[2], staged[1], more_staged[0]])
    code = {p.parent.name: p.read_text() for p in out.root.glob("v2p/tasks/*/task.py")}
    assert code == {"toy": "second", "toy-2": "first"}
    assert [e["item"] for e in about(out.root)["episodes"]] == ["toy"] * 2 + ["toy-2"] * 2


def carrying(root: Path, copy: Path, code: str) -> Path:
    """Return a copy of the dataset that carries its task."""
    shutil.copytree(root, copy)
    (copy / "v2p/tasks/toy").mkdir(parents=True, exist_ok=True)
    (copy / "v2p/tasks/toy/task.py").write_text(code)
    return copy


def test_a_task_that_holds_a_link_is_not_merged(packed: Path, more: Path, tmp_path: Path):
    first = carrying(packed, tmp_path / "a", "first")
    (first / "v2p/tasks/toy/notes.txt").symlink_to("/etc/passwd")

    with pytest.raises(V2PError, match=r"notes\.txt is a link"):
        merge([first, more], "user/both", tmp_path / "both")

    assert sorted(p.name for p in tmp_path.iterdir()) == ["a"]


@pytest.mark.parametrize("item", ["../../../outside", "/etc", "", 7])
def test_an_item_that_is_no_plain_name_is_refused(packed: Path, tmp_path: Path, item: object):
    root = Path(shutil.copytree(packed, tmp_path / "copy"))
    told = about(root)
    told["episodes"][0]["item"] = item
    (root / "meta/v2p.json").write_text(json.dumps(told))

    with pytest.raises(V2PError, match=r"v2p\.json is damaged: 'item'.* of episode 0"):
        drop(root, [PUSH], tmp_path / "less")


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("palette", {"0": 0, "1": 200}, "palette"),
        ("action", ["x.pos"], "action"),
    ],
)
def test_datasets_of_other_meaning_do_not_go_together(
    packed: Path, more: Path, tmp_path: Path, field: str, value: object, words: str
):
    other = Path(shutil.copytree(more, tmp_path / "other"))
    (other / "meta/v2p.json").write_text(json.dumps(about(other) | {field: value}))

    with pytest.raises(V2PError, match=f"do not go together: the {words} in meta/v2p.json"):
        merge([packed, other], "user/both", tmp_path / "both")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["other"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda i: i.update(robot_type="so101"),
            "robot_type is v2p_franka in the first and so101",
        ),
        (
            lambda i: i["features"]["action"].update(names=list("abcdefg")),
            r"names of action is \['delta_x.pos', .* in the first and \['a', 'b', 'c', 'd', 'e', 'f', 'g'\] in the",
        ),
        (
            lambda i: i["features"]["action"].update(dtype="float64"),
            "dtype of action is float32 in the first",
        ),
        (lambda i: i["features"].pop("next.success"), "the list of columns"),
    ],
)
def test_the_first_field_that_differs_is_named_with_both_values(
    packed: Path, more: Path, tmp_path: Path, change, words: str
):
    other = rewritten(more, tmp_path / "other", change)

    with pytest.raises(V2PError, match=words):
        merge([packed, other], "user/both", tmp_path / "both")


def rewritten(root: Path, copy: Path, change: Callable[[dict], object]) -> Path:
    """Return a copy of the dataset whose `meta/info.json` was changed."""
    shutil.copytree(root, copy)
    info = json.loads((copy / "meta/info.json").read_text())
    change(info)
    (copy / "meta/info.json").write_text(json.dumps(info))
    return copy


def test_no_episode_is_merged_twice(packed: Path, tmp_path: Path):
    with pytest.raises(V2PError, match=r"episode 0 of .* is episode 0 of .* once more"):
        merge([packed, packed], "user/both", tmp_path / "both")


def test_nothing_is_overwritten(packed: Path, more: Path, tmp_path: Path):
    (tmp_path / "both").mkdir()

    with pytest.raises(V2PError, match="exists already; nothing is overwritten"):
        merge([packed, more], "user/both", tmp_path / "both")
    with pytest.raises(V2PError, match="exists already; nothing is overwritten"):
        drop(packed, [LIFT], tmp_path / "both")


def test_a_dataset_is_written_to_another_file_system(staged: list[Path], packed: Path):
    """Where temporary files lie elsewhere, nothing can be renamed from there into its place."""
    memory = Path("/dev/shm")
    if not memory.is_dir() or memory.stat().st_dev == packed.stat().st_dev:
        pytest.skip("this machine has no second file system")
    with tempfile.TemporaryDirectory(dir=memory) as place:
        pack(staged, "user/toys", Path(place) / "packed")
        drop(Path(place) / "packed", [PUSH], Path(place) / "less")

        assert_holds(Path(place) / "packed", staged)
        assert_holds(Path(place) / "less", staged[::2])


def test_nothing_is_written_into_a_source(packed: Path, more: Path):
    before = sorted(packed.rglob("*"))

    with pytest.raises(V2PError, match=r"--out .* lies in .*, which is to stay as it is"):
        drop(packed, [LIFT], packed / "inside")
    with pytest.raises(V2PError, match="lies in"):
        merge([more, packed], "user/both", packed / "v2p" / ".." / "inside")

    assert sorted(packed.rglob("*")) == before


def test_an_unknown_task_is_named_with_the_known_ones(packed: Path, tmp_path: Path):
    with pytest.raises(V2PError, match=f"no task 'lift the toy'.*Known: {LIFT}, {PUSH}, toy"):
        drop(packed, ["lift the toy"], tmp_path / "out")
    with pytest.raises(V2PError, match="without an episode"):
        drop(packed, ["toy"], tmp_path / "out")


def test_a_write_that_the_system_refuses_leaves_nothing_behind(
    merged: Path, tmp_path: Path, file_limit: Callable[[int], AbstractContextManager[None]]
):
    with file_limit(4000), pytest.raises(V2PError, match=r"cannot write .*out .*File too large"):
        drop(merged, [LIFT], tmp_path / "out")

    assert list(tmp_path.iterdir()) == []


def encoded_anew(root: Path, copy: Path, key_every: int) -> Path:
    """Return a copy of the dataset whose video was encoded anew, lossily, with a key frame every so many frames."""
    import av

    shutil.copytree(root, copy)
    (path,) = copy.glob("videos/*/*/*.mp4")
    with av.open(str(path)) as video:
        frames = [frame.to_ndarray(format="yuv420p") for frame in video.decode(video=0)]
    options = {"crf": "30", "g": str(key_every), "bf": "0", "sc_threshold": "0"}
    with av.open(str(path), "w") as made:
        stream = made.add_stream("h264", rate=20, options=options)
        stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
        for frame in frames:
            made.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="yuv420p")))
        made.mux(stream.encode())
    return copy


def test_files_of_unlike_encoders_stay_apart_and_no_pixel_is_altered(
    packed: Path, more: Path, tmp_path: Path
):
    """Packets of both in one file would be decoded by the settings of the first."""
    lossy = encoded_anew(packed, tmp_path / "lossy", key_every=2)

    out = merge([more, lossy], "user/both", tmp_path / "both").root  # compares every pixel

    assert len(list(out.glob("videos/*/*/*.mp4"))) == 2


def test_a_video_whose_episodes_cannot_be_told_apart_is_named(more: Path, tmp_path: Path):
    """The second episode begins at frame 11, which is no key frame after another tool encoded the file anew."""
    root = encoded_anew(more, tmp_path / "lossy", key_every=250)

    with pytest.raises(V2PError, match=r"file-000\.mp4 has no key frame .*lerobot-edit-dataset"):
        drop(root, [PUSH], tmp_path / "out")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["lossy"]


def test_episodes_are_dropped_by_their_numbers(packed: Path, tmp_path: Path):
    out = tmp_path / "less"

    assert run(["drop", str(packed), "--episodes", "0", "1", "--out", str(out)]) == 0

    assert [e["id"] for e in about(out)["episodes"]] == ["toy_00002"]
    assert about(out)["provenance"]["edits"][0]["numbers"] == [0, 1]
    assert run(["drop", str(packed), "--episodes", "3", "--out", str(tmp_path / "no")]) == 2


@pytest.mark.parametrize("gone", ["meta/v2p.json", "meta/tasks.parquet"])
def test_what_another_tool_left_out_or_changed_is_named_with_what_helps(
    packed: Path, tmp_path: Path, gone: str
):
    root = Path(shutil.copytree(packed, tmp_path / "copy"))
    write_record(
        root,
        Record(
            stage="dataset",
            item="toys",
            version=1,
            fingerprint="0" * 8,
            recipe={},
            inputs={},
            seconds=1.0,
            files={"meta/tasks.parquet": list_files(root)["meta/tasks.parquet"]},
        ),
    )
    (root / gone).unlink()

    with pytest.raises(V2PError, match=rf"{gone} is missing.*lerobot-edit-dataset"):
        drop(root, [LIFT], tmp_path / "out")
