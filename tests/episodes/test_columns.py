"""What a simulator knows of an episode is true, no policy is given it, and damage to it is named."""

from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from test_collect import SMALL
from test_dataset import copied, edit_table
from toy_task import collect_toys

from v2p_data.episodes.collect import staged_episodes
from v2p_data.episodes.dataset.card import dataset_card
from v2p_data.episodes.dataset.edit import merge
from v2p_data.episodes.dataset.features import (
    COLUMNS,
    FRAMES,
    SIMULATED,
    SLOTS,
    STATE_NAMES,
    action_column,
    features,
    state_column,
    state_names,
)
from v2p_data.episodes.dataset.tables import read_info
from v2p_data.episodes.dataset.verify import verify
from v2p_data.episodes.dataset.writer import pack
from v2p_data.episodes.staging import Episode
from v2p_data.errors import V2PError
from v2p_data.sim.env.ranges import RandomizationConfig
from v2p_data.sim.render.masks import FIRST_OBJECT, PALETTE
from v2p_data.sim.robot.action_names import Actions, action_names


@pytest.fixture(scope="module")
def toys(tmp_path_factory: pytest.TempPathFactory) -> list[Episode]:
    """Episodes of a task with one cube, seen by cameras that differ from episode to episode."""
    out = tmp_path_factory.mktemp("collected")
    moved = replace(
        RandomizationConfig(), camera_pos_m=0.1, camera_angle_rad=0.05, camera_fovy_deg=5.0
    )
    collect_toys(out, replace(SMALL, randomization=moved))
    return [Episode.load(path) for path in staged_episodes(out)]


def test_an_objects_centre_is_seen_by_the_camera_in_the_middle_of_its_mask(toys: list[Episode]):
    for episode in toys:
        known = {k: v.astype(float) for k, v in episode.simulated.items()}
        centre = known["privileged.object_pose"][0, :3]
        fx, fy, cx, cy = known["camera.intrinsics"][0]
        w, x, y, z = known["camera.pose"][0, 3:]
        right = np.array([w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)])
        down = np.array([2 * (x * y - w * z), w * w - x * x + y * y - z * z, 2 * (y * z + w * x)])
        away = centre - known["camera.pose"][0, :3]
        depth = away @ np.cross(right, down)
        rows, columns = np.nonzero(episode.labels[0] == 2)

        assert abs(fx * (away @ right) / depth + cx - (columns.mean() + 0.5)) < 1
        assert abs(fy * (away @ down) / depth + cy - (rows.mean() + 0.5)) < 1
    assert len({tuple(e.simulated["camera.intrinsics"][0]) for e in toys}) == len(toys)


def test_rewards_are_those_of_what_the_action_led_to(toys: list[Episode]):
    for episode in toys:
        left = episode.state[1:, 1]  # the task's reward is the tool's y in the next row, per 100
        wanted = left / 100 + (left > 0.08)
        assert np.allclose(episode.simulated["next.reward"][:-1], wanted, atol=1e-6)


def test_every_object_that_masks_tell_apart_has_a_slot_and_free_ones_hold_nothing(
    toys: list[Episode],
):
    assert len(PALETTE) == FIRST_OBJECT + SLOTS
    assert not toys[0].simulated["privileged.object_pose"][:, 7:].any()
    assert not toys[0].simulated["privileged.contact"].any()  # it never comes near the cube


def test_no_policy_is_given_what_a_camera_would_not_see():
    from lerobot.processor.converters import batch_to_transition, transition_to_batch
    from lerobot.utils.feature_utils import dataset_to_policy_features

    table = features(64, has_handovers=True, is_simulated=True)

    batch: dict[str, Any] = transition_to_batch(batch_to_transition(dict.fromkeys(table)))
    assert set(dataset_to_policy_features(table)) == {
        "observation.images.mask",
        "observation.state",
        "action",
    }
    assert not {k for k in batch if k.startswith(("privileged", "camera"))}
    assert set(SIMULATED) <= set(table)


@pytest.mark.slow
def test_every_column_comes_through_packing(packed: Path, staged: list[Path]):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset: Any = LeRobotDataset("user/toys", root=packed)
    rows = [dataset[i] for i in range(12)]

    for key, values in Episode.load(staged[0]).simulated.items():
        assert np.array_equal(np.stack([np.asarray(r[key]) for r in rows]), values), key
    assert [bool(r["next.done"]) for r in rows] == [False] * 11 + [True]


@pytest.mark.slow
def test_damage_is_named_with_its_column(packed: Path, tmp_path: Path):
    root = copied(packed, tmp_path)
    spoiled = {
        "next.reward": (float("nan"), "finite"),
        "next.done": (True, "done"),
        "privileged.object_pose": ([0.1] * 49, "poses"),
        "camera.pose": ([0.0] * 7, "poses"),
        "camera.intrinsics": ([0.0] * 4, "poses"),
    }
    for column, (value, _) in spoiled.items():
        edit_table(root, "data/*/*.parquet", lambda r, c=column, v=value: r[c].__setitem__(5, v))

    found = [(p.check, p.detail) for p in verify(root).problems]

    for column, (_, check) in spoiled.items():
        assert any(check == c and column in detail for c, detail in found), column


@pytest.mark.parametrize("narrow", [False, True])
def test_no_column_is_dropped_in_silence(make_episode, tmp_path: Path, narrow: bool):
    """Staged by an earlier version: without a column, or with contacts of the pads alone; then a robot's recording."""
    new = make_episode(7)
    columns = dict(new.simulated)
    lost = "privileged.contact" if narrow else "next.reward"
    told = columns.pop(lost)
    if narrow:
        columns[lost] = told[:, :14]
    old, robots = (
        replace(make_episode(8), simulated=columns),
        replace(make_episode(9), simulated={}),
    )

    for others, words in (
        ([old], rf"toy_00008.npz is of another version: it has no {lost} as this one records it"),
        ([new, old], rf"toy_00008.npz is of another version: it has no {lost}"),
        ([new, robots], "one has the columns of a simulator and one has none"),
        ([robots, new], "one has the columns of a simulator and one has none"),
    ):
        paths = [e.save(tmp_path / "staged") for e in others]
        with pytest.raises(V2PError, match=words):
            pack(paths, "user/mixed", tmp_path / "mixed")
    assert not (tmp_path / "mixed").exists()


@pytest.mark.slow
def test_a_robots_recordings_have_no_columns_of_a_simulator(
    make_episode, packed: Path, tmp_path: Path
):
    paths = [replace(make_episode(k), simulated={}).save(tmp_path / "staged") for k in (7, 8)]

    pack(paths, "user/robot", tmp_path / "robot")

    assert not set(SIMULATED) & set(read_info(tmp_path / "robot")["features"])
    assert verify(tmp_path / "robot", paths).is_good
    with pytest.raises(V2PError, match="do not go together: the list of columns"):
        merge([packed, tmp_path / "robot"], "user/both", tmp_path / "both")


@pytest.mark.parametrize("actions", get_args(Actions))
def test_info_card_and_docs_say_the_same_of_every_entry(actions: Actions):
    states, names = state_names(18), action_names(actions)
    table = features(64, states=states, actions=names, has_handovers=True, is_simulated=True)
    episode = {"item": "toy", "task": "lift it", "length": 1500, "labels": {}, "params": {}}
    about = {"episodes": [episode], "palette": {}, "provenance": {}}
    info = {"features": table, "total_frames": 1500, "fps": 20}
    card = dataset_card(about, info, "user/toys")
    docs = (Path(__file__).parents[2] / "docs/datasets.md").read_text("utf-8")

    told = {
        **COLUMNS,
        "observation.state": state_column(STATE_NAMES),
        "action": action_column(names),
    }
    for key, column in told.items():
        if key in table:
            assert column.entries in card, key
            assert column.entries in docs, key
    for key in {*table} - {"observation.images.mask"}:
        width, said = table[key]["shape"][0], table[key]["info"]
        assert said["meaning"] in card
        if table[key]["names"] is not None:
            assert {len(table[key]["names"]), len(said["units"]), len(said["frames"])} == {width}
            assert {*said["frames"]} <= {*FRAMES, ""}
    assert "size_categories:\n- 1K<n<10K" in card
