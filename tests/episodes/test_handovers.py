"""A dataset says who acted: the expert, or a student from which it took over."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from v2p_data.episodes.dataset.card import write_card
from v2p_data.episodes.dataset.edit import drop, merge
from v2p_data.episodes.dataset.explain import records_of
from v2p_data.episodes.dataset.features import features
from v2p_data.episodes.dataset.verify import verify
from v2p_data.episodes.dataset.writer import pack
from v2p_data.episodes.staging import Episode, Heading

NUM_FRAMES, TAKEN_OVER_AT = 12, 5
LIFT, PUSH = "lift the toy up", "push the toy to the left"


@pytest.fixture(scope="module")
def handover(make_episode: Callable[..., Episode]) -> Episode:
    """A student acts in the first five frames."""
    return replace(make_episode(5), intervention=np.arange(NUM_FRAMES) >= TAKEN_OVER_AT)


@pytest.fixture(scope="module")
def mixed_staged(
    tmp_path_factory: pytest.TempPathFactory,
    make_episode: Callable[..., Episode],
    handover: Episode,
) -> list[Path]:
    folder = tmp_path_factory.mktemp("mixed")
    return [make_episode(4).save(folder), handover.save(folder)]


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory, mixed_staged: list[Path]) -> Path:
    """A demonstration of lifting, then a handover of pushing; do not write into it."""
    root = tmp_path_factory.mktemp("dataset") / "mixed"
    pack(mixed_staged, "user/mixed", root)
    return root


def intervention(root: Path) -> list[bool]:
    pq = pytest.importorskip("pyarrow.parquet")
    found: list[bool] = []
    for path in sorted(root.glob("data/*/*.parquet")):
        found += pq.read_table(path).column("intervention").to_pylist()
    return found


MIXED = [True] * NUM_FRAMES + [False] * TAKEN_OVER_AT + [True] * (NUM_FRAMES - TAKEN_OVER_AT)


def test_who_acted_is_staged_and_read_back(handover: Episode, tmp_path: Path):
    path = handover.save(tmp_path)

    again = Episode.load(path, pictures=False)

    assert again.intervention is not None
    assert again.intervention.tolist() == MIXED[NUM_FRAMES:]
    assert Heading.read(path).is_handover


def test_who_acted_is_as_long_as_the_episode(handover: Episode):
    with pytest.raises((ValueError, TypeError), match=r"(?i)differ in length|type-check error"):
        replace(handover, intervention=np.ones(NUM_FRAMES - 1, bool))


@pytest.mark.slow
def test_lerobot_reads_who_acted_and_gives_it_to_no_policy(mixed: Path, handover: Episode):
    import torch
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.utils.feature_utils import dataset_to_policy_features

    dataset: Any = LeRobotDataset("user/mixed", root=mixed)
    rows = [dataset[i]["intervention"] for i in range(len(dataset))]

    assert {row.dtype for row in rows} == {torch.bool}
    assert [bool(row) for row in rows] == MIXED
    assert np.array_equal(dataset[NUM_FRAMES]["action"], handover.action[0])  # the expert's
    said = dataset.meta.features["intervention"]
    assert (said["dtype"], said["shape"], said["names"]) == ("bool", (1,), None)
    assert set(dataset_to_policy_features(dataset.meta.features)) == {
        "observation.images.mask",
        "observation.state",
        "action",
    }
    # 12 + 7 of 24 frames
    assert np.allclose(dataset.meta.stats["intervention"]["mean"], 19 / 24)


@pytest.mark.slow
def test_demonstrations_alone_have_no_such_column(packed: Path, tmp_path: Path):
    info = json.loads((packed / "meta/info.json").read_text())
    about = json.loads((packed / "meta/v2p.json").read_text())

    assert "intervention" not in info["features"]
    assert "intervention" not in features(64)
    assert not {"source", "student_frames"} & set(about["episodes"][0])
    card = write_card(Path(shutil.copytree(packed, tmp_path / "copy")), "a/b").read_text()
    assert "Who acted" not in card


@pytest.mark.slow
def test_the_file_and_the_card_tell_who_acted(mixed: Path, tmp_path: Path):
    root = Path(shutil.copytree(mixed, tmp_path / "mixed"))

    told = [
        (e["source"], e["student_frames"])
        for e in json.loads((root / "meta/v2p.json").read_text())["episodes"]
    ]
    card = write_card(root, "user/mixed").read_text()

    assert told == [("demonstration", 0), ("handover", 5)]
    assert "| demonstrations | 1 | 12 | 0 |" in card
    assert "| handovers | 1 | 7 | 5 |" in card
    assert "it is what the expert would have done there" in card
    assert "| `intervention` | [1] |" in card
    assert records_of(root, 1)["source"] == "handover"


@pytest.mark.slow
def test_a_wrong_actor_is_noticed(mixed: Path, mixed_staged: list[Path], tmp_path: Path):
    import pyarrow as pa
    import pyarrow.parquet as pq

    root = Path(shutil.copytree(mixed, tmp_path / "copy"))
    (path,) = root.glob("data/*/*.parquet")
    table = pq.read_table(path)
    rows = table.to_pydict()
    rows["intervention"][3] = False
    pq.write_table(pa.table(rows, schema=table.schema), path)

    found = {(p.check, p.where) for p in verify(root, mixed_staged).problems}

    assert found == {
        ("who_acted", "episode 0"),
        ("differs", "episode 0 (toy_00004)"),
        ("statistics", "meta/stats.json"),
    }


@pytest.mark.slow
def test_a_column_that_was_staged_and_is_missing_is_noticed(
    packed: Path, staged: list[Path], tmp_path: Path
):
    acted = replace(Episode.load(staged[2]), intervention=np.ones(NUM_FRAMES, bool)).save(tmp_path)

    (problem,) = verify(packed, [*staged[:2], acted]).problems

    assert problem.detail == "intervention was recorded and is no column"


@pytest.mark.slow
def test_a_merge_of_demonstrations_is_equal_to_packing_them_with_the_column(
    packed: Path, staged: list[Path], mixed: Path, mixed_staged: list[Path], tmp_path: Path
):
    import pyarrow.parquet as pq

    pack([*staged, *mixed_staged], "user/all", tmp_path / "packed")

    merge([packed, mixed], "user/all", tmp_path / "merged")

    made, wanted = (
        pq.read_table(tmp_path / name / "data/chunk-000/file-000.parquet")
        for name in ("merged", "packed")
    )
    assert made.to_pydict() == wanted.to_pydict()
    stats = [
        json.loads((tmp_path / name / "meta/stats.json").read_text())["intervention"]
        for name in ("merged", "packed")
    ]
    assert stats[0].keys() == stats[1].keys()
    for name, value in stats[1].items():
        assert np.allclose(stats[0][name], value), name


@pytest.mark.slow
def test_what_is_left_after_a_drop_tells_who_acted(
    mixed: Path, mixed_staged: list[Path], tmp_path: Path
):
    pushes = drop(mixed, [LIFT], tmp_path / "pushes").root
    lifts = drop(mixed, [PUSH], tmp_path / "lifts").root

    assert intervention(pushes) == MIXED[NUM_FRAMES:]
    assert intervention(lifts) == [True] * NUM_FRAMES
    assert verify(pushes, mixed_staged[1:]).is_good
    assert verify(lifts, mixed_staged[:1]).is_good
