"""The sim-to-sim study: correlations and rank violations by hand, faults that do what they say, lines that are kept."""

import argparse
import importlib
import json
import math
from pathlib import Path

import numpy as np
import pytest

from v2p_data.errors import V2PError
from v2p_data.sim.render.masks import BACKGROUND, FIRST_OBJECT, ROBOT
from v2p_data.twin.parameters import nominal


@pytest.fixture(scope="module")
def study(load_script):
    return load_script("study_sim_to_sim")


@pytest.fixture(scope="module")
def parts(study):
    names = ("agreement", "results", "sweeps", "sim_to_sim", "sim_to_sim_figure")
    return argparse.Namespace(**{n: importlib.import_module(f"studies.{n}") for n in names})


def row(policy: str, place: str, once: str, value: float | None = None, **more):
    return {
        "policy": policy,
        "task": "lift",
        "place": place,
        "value": value,
        "once": once,
        "failures": {},
    } | more


def test_the_same_rates_agree_wholly(parts):
    x = np.array([0.1, 0.5, 0.9])

    value = parts.agreement.agreement(x, x - 0.1)

    assert value.pearson == pytest.approx(1)
    assert value.spearman == pytest.approx(1)
    assert value.mmrv == 0
    assert value.mean_gap == pytest.approx(0.1)


def test_a_violated_rank_costs_what_the_twins_rates_differ_by(parts):
    # Policies 1 and 2 change places; their rates in the twin differ by 0.2. Policy 0 is in order with both.
    x, y = np.array([0.1, 0.5, 0.6]), np.array([0.0, 0.7, 0.5])

    assert parts.agreement.mmrv(x, y) == pytest.approx((0 + 0.2 + 0.2) / 3)


def test_a_tie_of_one_simulator_only_is_a_violation(parts):
    x, y = np.array([0.5, 0.5, 0.9]), np.array([0.2, 0.4, 0.9])

    assert parts.agreement.mmrv(x, y) == pytest.approx((0.2 + 0.2 + 0) / 3)


def test_equal_rates_have_no_correlation(parts):
    value = parts.agreement.agreement(np.full(3, 0.5), np.array([0.1, 0.2, 0.3]))

    assert math.isnan(value.pearson)


def test_the_bootstraps_interval_holds_the_value_and_shrinks_with_episodes(parts):
    rates = np.linspace(0.1, 0.9, 8)

    def width(episodes: int) -> float:
        flags = [[np.arange(episodes) < r * episodes] for r in rates]
        rng = np.random.default_rng(0)
        low, high = parts.agreement.bootstrap(
            flags, [[np.roll(f[0], 3)] for f in flags], rng, draws=200
        )["mean_gap"]
        assert low <= 0 <= high
        return high - low

    assert width(400) < width(10)


def labels() -> np.ndarray:
    out = np.full((256, 256), BACKGROUND, np.uint8)
    out[100:140, 100:140] = FIRST_OBJECT
    out[:50, :50] = ROBOT
    return out


def test_erosion_takes_the_border_and_dilation_adds_one(parts):
    rng = np.random.default_rng(0)

    small, large = parts.sweeps.eroded(labels(), 4, rng), parts.sweeps.dilated(labels(), 4, rng)

    assert (small == FIRST_OBJECT).sum() == 32 * 32
    assert 46 * 46 < (large == FIRST_OBJECT).sum() <= 48 * 48
    for out in (small, large):
        np.testing.assert_array_equal(out == ROBOT, labels() == ROBOT)


def test_a_dropped_mask_is_background_and_a_swapped_one_partly_robot(parts):
    rng = np.random.default_rng(0)

    gone, swapped = (
        parts.sweeps.dropped(labels(), 1.0, rng),
        parts.sweeps.swapped(labels(), 8, rng),
    )

    assert not (gone == FIRST_OBJECT).any()
    changed = swapped != labels()
    assert 0 < changed.sum() < 40 * 40
    assert (swapped[changed] == ROBOT).all()


def test_no_fault_is_no_change(parts):
    rng = np.random.default_rng(0)
    for fault in ("eroded", "dilated", "dropped", "swapped"):
        np.testing.assert_array_equal(getattr(parts.sweeps, fault)(labels(), 0, rng), labels())


def test_every_sweep_of_the_twin_gives_twins_that_differ(parts):
    for sweep in parts.sweeps.SWEEPS.values():
        assert (sweep.parameters is None) != (sweep.fault is None)
        if sweep.parameters is not None:
            digests = [sweep.parameters(float(v)).digest() for v in sweep.values]
            assert len(set(digests)) == len(sweep.values)


def test_the_placement_of_scale_one_is_the_nominal_twin(parts):
    assert parts.sweeps.SWEEPS["placement"].parameters(1.0).digest() == nominal().digest()


def test_tables_and_figure_show_every_line_and_say_sim_to_sim(parts, tmp_path: Path):
    rows = []
    for k, name in enumerate("abcd"):
        wins = "1" * (2 * k) + "0" * (8 - 2 * k)
        rows += [
            row(name, "training", wins, at_end=wins),
            row(name, "twin", wins, at_end=wins),
        ]
    rows += [row("d", "latency", "1100", 0.1), row("d", "erosion", "1110", 2.0, iou=0.8)]

    text = parts.sim_to_sim.table(rows)
    parts.sim_to_sim_figure.write_figure(rows, tmp_path / "figure.svg")

    assert text.count("Sim-to-sim") == 3
    assert "| Pearson r | 1.000 |" in text
    assert "0.1: 2 of 4" in text
    assert "2 (IoU 0.80): 3 of 4" in text
    assert "6 of 8 [" in text
    assert (tmp_path / "figure.svg").stat().st_size > 5_000


def test_lines_that_are_there_are_kept_and_a_cut_line_is_played_again(
    study, parts, tmp_path: Path, monkeypatch
):
    (tmp_path / "results.jsonl").write_text(
        json.dumps(row("a", "training", "11") | {"task": "lift"}) + "\n" + '{"policy": "a", "ta'
    )
    played = []
    monkeypatch.setattr(
        study, "_played", lambda asked, place, value: played.append(place) or {"once": "10", "failures": {}}
    )  # fmt: skip
    monkeypatch.setattr(study.TaskBundle, "load", lambda folder: argparse.Namespace(title="lift"))
    args = argparse.Namespace(
        policies=["a=somewhere"], tasks=[tmp_path], places=["training", "twin"], sweeps=[], episodes=2,
        first_seed=7, out=tmp_path,
    )  # fmt: skip

    study.play(args)

    assert played == ["twin"]
    assert [r["place"] for r in parts.results.results_in(tmp_path)] == ["training", "twin"]


def test_a_policy_without_a_name_is_refused(study, tmp_path: Path):
    args = argparse.Namespace(
        policies=["somewhere"],
        tasks=[],
        places=[],
        sweeps=[],
        episodes=2,
        first_seed=7,
        out=tmp_path,
    )

    with pytest.raises(V2PError, match="NAME=FOLDER"):
        study.play(args)
