"""TensorBoard shows what the CSV says, every step once, however often the training was killed."""

import math
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from policies.ppo.curve import (
    CURVE_FILE,
    EVENT_FILES,
    EventMirror,
    append_row,
    cut_after,
    read_rows,
    tag_of,
)


def row(iteration: int, success: float = 0.5) -> dict[str, int | float]:
    return {
        "steps": 512 * iteration,
        "seconds": 2.0 * iteration,
        "iteration": iteration,
        "success_deterministic": success,
        "reward_is_high": 0.25 * iteration,
    }


def train(folder: Path, iterations: list[int]) -> None:
    """Write rows as a training does, and end as a kill does: without closing anything."""
    events = EventMirror(folder / CURVE_FILE)
    for k in iterations:
        append_row(folder / CURVE_FILE, row(k))
        events.add(row(k))


def scalars(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Return per tag what TensorBoard shows: (step, value)."""
    read = EventAccumulator(str(folder)).Reload()
    return {tag: [(e.step, e.value) for e in read.Scalars(tag)] for tag in read.Tags()["scalars"]}


def test_tensorboard_shows_every_column_of_the_csv_at_its_steps(tmp_path: Path):
    train(tmp_path, [1, 2, 3])

    shown = scalars(tmp_path)

    rows = read_rows(tmp_path / CURVE_FILE)
    assert shown.keys() == {tag_of(column) for column in rows[0] if column != "steps"}
    for column in rows[0].keys() - {"steps"}:
        assert shown[tag_of(column)] == [(int(r["steps"]), pytest.approx(r[column])) for r in rows]


def test_columns_are_grouped_by_what_they_are():
    assert tag_of("success_deterministic") == "success/deterministic"
    assert tag_of("reward_is_high") == "reward/is_high"
    assert tag_of("learning_rate") == "training/learning_rate"


def test_steps_after_the_checkpoint_are_shown_once_after_a_kill(tmp_path: Path):
    train(tmp_path, [1, 2, 3, 4])

    # The checkpoint was made after the second batch.
    cut_after(tmp_path / CURVE_FILE, 2 * 512)
    train(tmp_path, [3, 4, 5])

    assert [step for step, _ in scalars(tmp_path)["training/iteration"]] == [
        512 * k for k in (1, 2, 3, 4, 5)
    ]


def test_a_tensorboard_that_is_watching_drops_what_was_trained_again(tmp_path: Path):
    train(tmp_path, [1, 2, 3])
    # Files are read in the order of their names, which begin with the second they were made in.
    next(tmp_path.glob(EVENT_FILES)).rename(tmp_path / "events.out.tfevents.1000000000.earlier")
    watching = EventAccumulator(str(tmp_path)).Reload()
    assert [e.step for e in watching.Scalars("training/iteration")] == [512, 1024, 1536]

    cut_after(tmp_path / CURVE_FILE, 512)
    train(tmp_path, [2])
    watching.Reload()

    assert [e.step for e in watching.Scalars("training/iteration")] == [512, 1024]


def test_a_rate_that_does_not_exist_yet_is_left_out(tmp_path: Path):
    events = EventMirror(tmp_path / CURVE_FILE)
    events.add(row(1, success=math.nan))
    events.add(row(2, success=0.25))
    events.close()

    assert scalars(tmp_path)["success/deterministic"] == [(1024, 0.25)]


def test_relative_time_is_seconds_of_training_across_a_resumption(tmp_path: Path):
    train(tmp_path, [1, 2])
    train(tmp_path, [3])

    times = [
        e.wall_time for e in EventAccumulator(str(tmp_path)).Reload().Scalars("training/iteration")
    ]
    assert [t - times[0] for t in times] == pytest.approx([0.0, 2.0, 4.0], abs=1e-3)
