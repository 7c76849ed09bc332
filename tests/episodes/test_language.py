"""Words follow from numbers: what is done when, how the robot moves, what is asked, and LeRobot reads them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from v2p_data.episodes.dataset.edit import merge
from v2p_data.episodes.dataset.language import direction, motions, paraphrases, subtasks
from v2p_data.episodes.dataset.verify import verify
from v2p_data.episodes.dataset.writer import pack
from v2p_data.errors import V2PError
from v2p_data.geometry.rotation import product


@pytest.mark.parametrize(
    ("caption", "asked"),
    [
        ("Lifting the red cup up.", "lift the red cup up"),
        ("placing a lid onto the pot", "place a lid onto the pot"),
        ("Dropping cube", "drop cube"),
        ("pulling a drawer", "pull a drawer"),
        ("push the ring to the left", "push the ring to the left"),
    ],
)
def test_a_caption_is_asked_for_in_ten_ways(caption: str, asked: str):
    ways = paraphrases(caption)

    assert ways[:2] == [asked, f"please {asked}"]
    assert len(set(ways)) == 10


def test_parts_begin_where_contacts_and_places_say():
    poses = np.tile([0.0, 0, 0, 1, 0, 0, 0], (10, 1))
    poses[5:, 2] = [0.004, 0.006, 0.1, 0.1, 0.1]
    touches = np.zeros((10, 3), bool)
    touches[3:9, [0, 2]] = touches[4:9, 1] = True

    found = subtasks("cup", poses, touches, np.arange(10) >= 8)

    assert list(found.items()) == [
        (0, "reach for the cup"),
        (3, "grasp the cup"),
        (6, "carry the cup up"),
        (9, "stay"),
    ]
    assert subtasks("cup", poses, touches, np.zeros(10, bool))[9] == "let go of the cup"
    pushed = poses[:, [2, 1, 0, 3, 4, 5, 6]]
    for parts in ([True, False, True], [False, False, True]):  # a pad, the palm alone
        found = subtasks("cup", pushed, touches & parts, np.zeros(10, bool))
        assert list(found.values())[1:3] == ["touch the cup", "push the cup forward"]


@pytest.mark.parametrize(
    ("turn", "height_m", "does"),
    [
        ([0.7071, 0.7071, 0, 0], 0.03, "tip the carton left"),  # a quarter turn about x
        ([0.7071, 0, 0, 0.7071], 0.03, "push the carton left"),  # turned on the spot
        ([0.9659, 0.2588, 0, 0], 0.03, "push the carton left"),  # leans by 30 degrees
        ([0.7071, 0.7071, 0, 0], 0.05, "push the carton left"),  # a ball rolls: as high as before
    ],
)
def test_what_ends_on_another_side_was_tipped_also_by_the_palm_alone(turn, height_m, does):
    """The carton stood turned by 90 degrees about z, and falls on after the hand has left it."""
    stood = np.array([0.7071, 0, 0, 0.7071])
    poses = np.tile([0.5, 0, 0.05, *stood], (12, 1))
    poses[4:6, 1] = [0.01, 0.02]
    lies = product(np.array(turn)[:, None], stood[:, None])[:, 0]
    poses[6:] = [0.5, 0.06, height_m, *lies]
    touches = np.zeros((12, 3), bool)
    touches[3:6, 2] = True

    found = subtasks("carton", poses, touches, np.arange(12) >= 8)

    assert list(found.values()) == [
        "reach for the carton",
        "touch the carton",
        does,
        "let go of the carton",
        "stay",
    ]


def test_motions_are_named_from_the_row_in_which_they_begin():
    state = np.zeros((9, 11))
    state[:, 2] = -0.01 * np.minimum(np.arange(9), 4)
    state[:, 6] = 1 - 0.1 * np.maximum(np.arange(9) - 6, 0)

    assert motions(state) == {0: "move down", 4: "hold still", 6: "close the gripper"}
    assert direction(np.array([0.1, -0.3, 0.2])) == "right and up"


def test_a_knock_whose_effect_comes_after_it_has_its_word():
    poses = np.tile([0.5, 0, 0.05, 1, 0, 0, 0], (9, 1))
    poses[3:, 0], poses[4:, 0] = 0.502, 0.52
    touches = np.zeros((9, 3), bool)
    touches[3, 2] = True

    found = subtasks("can", poses, touches, np.zeros(9, bool))

    assert list(found.values())[1:] == ["touch the can", "push the can forward"]


@pytest.mark.slow
def test_lerobot_reads_the_words_and_a_recipe_of_its_own_uses_them(packed: Path, tmp_path: Path):
    from lerobot.configs.recipe import MessageTurn, TrainingRecipe
    from lerobot.datasets.language_render import render_sample
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = tmp_path / "words"
    merge([packed], "user/words", root, language=True)
    dataset: Any = LeRobotDataset("user/words", root=root)
    rows = [dataset[i] for i in range(12)]
    recipe = TrainingRecipe(
        messages=[
            MessageTurn(role="user", content="${task}", stream="high_level"),
            MessageTurn(role="assistant", content="${subtask}", stream="high_level", target=True),
        ]
    )
    told = [
        render_sample(
            recipe=recipe,
            persistent=row["language_persistent"],
            events=row["language_events"],
            t=float(row["timestamp"]),
            sample_idx=k,
            task=row["task"],
        )
        for k, row in enumerate(rows)
    ]

    said = [t["messages"][1]["content"] for t in told if t]
    assert said[5] == "reach for the toy"  # both pads touch it from row 6 on
    assert said[6].startswith("carry the toy ")
    assert all(t["messages"][0]["content"] in paraphrases("lift the toy up") for t in told if t)
    events = {r["style"]: r["content"] for r in rows[0]["language_events"] if r["role"] != "user"}
    x, y, z = np.asarray(rows[0]["privileged.object_pose"][:3], float)
    point = [32 + 70 * (x - 0.5) / (1 - z), 32 - 70 * y / (1 - z)]  # seen from 1 m above
    assert np.allclose(json.loads(events["vqa"])["point"], point, atol=0.06)
    assert verify(root).is_good


@pytest.mark.slow
def test_without_contacts_there_are_no_words(make_episode, tmp_path: Path):
    pack([replace(make_episode(1), simulated={}).save(tmp_path)], "user/old", tmp_path / "old")

    with pytest.raises(V2PError, match=r"names no column privileged.contact"):
        merge([tmp_path / "old"], "user/words", tmp_path / "words", language=True)
