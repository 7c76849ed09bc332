"""A student acts in many worlds, takes episodes in, and goes on from what it saved."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_dataset import (
    GREYS,
    MASK,
    REPO_ID,
    STATE,
    are_equal,
    config,
    weights,
    write_dataset,
)

from policies.bc.student import STATE_STD_FLOOR, DatasetPlace, Student
from policies.bc.trainer import TrainerConfig

HOW = TrainerConfig(steps=3, batch_size=4, precision="float32")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("student") / "small"
    write_dataset(root)
    return root


def student(dataset: Path, cache: Path, *, seed: int = 0, **settings) -> Student:
    cfg = config(num_labels=3, **{"preset": "small", **settings})
    place = DatasetPlace(folder=dataset, repo_id=REPO_ID, cache=cache)
    return Student.of_dataset(place, cfg, seed=seed, action_limit=1.0)


def worlds(seed: int, n: int = 3) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 3, (n, 8, 8)).astype(np.uint8).repeat(8, 1).repeat(8, 2)
    return labels, rng.normal(size=(n, 3)).astype(np.float32)


def test_a_world_is_acted_in_as_if_it_were_the_only_one(dataset: Path, tmp_path: Path):
    pupil = student(dataset, tmp_path).for_task("push the box")
    pupil.reset(3)
    together = np.stack([pupil.act(*worlds(k)) for k in range(3)])

    for world in range(3):
        pupil.reset(1)
        alone = [pupil.act(*(a[world : world + 1] for a in worlds(k))) for k in range(3)]
        np.testing.assert_allclose(together[:, world], np.concatenate(alone), atol=1e-6)
    assert (np.abs(together) <= 1).all()
    assert len(np.unique(together)) > 9


def test_its_episodes_are_the_same_frames_as_those_of_a_dataset(dataset: Path, tmp_path: Path):
    """The greys of a video and the labels of a simulator are one thing to it."""
    pupil = student(dataset, tmp_path, preset="custom")
    labels, state = worlds(0, 5)
    greys = torch.from_numpy(GREYS[labels])[:, None, None].expand(-1, -1, 3, -1, -1) / 255
    expected = pupil.policy.net.prepare(MASK, greys)
    before = len(pupil.table)

    pupil.add(labels, state, np.zeros((5, 2), np.float32), "new words", [3, 2])

    added = torch.arange(before, before + 5)
    batch = pupil.table.batch(added, [0], [0, 1])
    assert are_equal(batch[MASK], expected)
    assert torch.equal(batch[STATE][:, 0], torch.from_numpy(state))
    assert batch["task"] == ["new words"] * 5
    assert batch["action_is_pad"][:, 1].tolist() == [False, False, True, False, True]


@pytest.mark.parametrize("encoder", ["none", "resnet18"])
def test_a_student_that_was_saved_and_loaded_trains_on_to_the_same_weights(
    dataset: Path, tmp_path: Path, encoder: str
):
    """A backbone that started from random weights trains at the full rate, also from a checkpoint."""
    settings = {"preset": "custom", "encoder": encoder}
    first = student(dataset, tmp_path / "cache", **settings)
    first.train(HOW, tmp_path / "1", seed=1)
    first.save(tmp_path / "saved")
    first.act(*worlds(0))
    first.train(HOW, tmp_path / "2", seed=2)

    second = student(dataset, tmp_path / "cache", seed=7, **settings)
    second.load(tmp_path / "saved")
    second.train(HOW, tmp_path / "3", seed=2)

    assert are_equal(weights(second.policy), weights(first.policy))


def test_a_saved_student_replaces_the_one_before(dataset: Path, tmp_path: Path):
    pupil = student(dataset, tmp_path / "cache")
    pupil.save(tmp_path / "saved")
    (tmp_path / "saved.tmp").mkdir()
    (tmp_path / "saved.tmp" / "left").write_text("by a kill")
    pupil.train(HOW, tmp_path / "out", seed=1)

    pupil.save(tmp_path / "saved")

    place = DatasetPlace(folder=dataset, repo_id=REPO_ID, cache=tmp_path / "cache")
    again = Student.of_dataset(place, config(), seed=0, start_from=tmp_path / "saved")
    assert are_equal(weights(again.policy), weights(pupil.policy))
    assert not (tmp_path / "saved.tmp").exists()
    assert not (tmp_path / "saved" / "left").exists()


def test_another_number_of_threads_is_put_back(dataset: Path, tmp_path: Path):
    before = torch.get_num_threads()
    pupil = replace(student(dataset, tmp_path / "cache"), num_threads=before + 1)

    pupil.train(HOW, tmp_path / "out", seed=1)

    assert torch.get_num_threads() == before


def test_actions_reach_their_limit_and_states_that_hardly_vary_stay_small(
    dataset: Path, tmp_path: Path
):
    pupil = student(dataset, tmp_path)
    action = pupil.processors.after(torch.tensor([[1.0, -1.0]]))
    still = pupil.processors.before({STATE: torch.zeros(1, 3)})[STATE]
    moved = pupil.processors.before({STATE: torch.full((1, 3), STATE_STD_FLOOR)})[STATE]

    torch.testing.assert_close(action, torch.tensor([[1.0, -1.0]]))
    assert (moved - still <= 1.0 + 1e-5).all()
