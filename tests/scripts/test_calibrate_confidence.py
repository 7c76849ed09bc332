"""A confidence is judged by fits that have not seen the clip, nor another one of its source."""

import json
import re

import numpy as np
import pytest


@pytest.fixture(scope="module")
def script(load_script):
    return load_script("calibrate_confidence")


def judged(name: str, confidence: float, *, right: bool, gate: str = "") -> dict:
    stages = {"camera": 1.0, "grounding": confidence, "pose": 1.0}
    return {"clip": name, "confidence": confidence, "stages": stages, "gate": gate, "right": right}


def many(right_when):
    at = np.linspace(0.05, 0.95, 24).tolist()
    return [judged(f"a__{k % 8}", c, right=right_when(k, c)) for k, c in enumerate(at)]


def table_of(script, rows, tmp_path, capsys):
    path = tmp_path / "judged.json"
    path.write_text(json.dumps(rows))
    script.main([str(path)])
    return capsys.readouterr().out


def test_a_confidence_that_tells_right_from_wrong_ranks_and_accepts(script, tmp_path, capsys):
    rows = [
        *many(lambda k, c: c > 0.5),
        judged("gone__x", 0.5, right=False) | {"confidence": None},
    ]
    out = table_of(script, rows, tmp_path, capsys)

    assert "24 of 25 clips have a confidence; sources: 8" in out
    accepted, wrong = re.search(r"calibrated \| (\d+) of 12 \| (\d+) of 12", out).groups()
    assert (int(accepted) >= 11, int(wrong) <= 1) == (True, True)
    assert "| 0.85 to 1 | 100.0 %" in out
    weights = out[out.index("weights") :]
    assert "'camera': 0.0" in weights
    assert "'grounding': 0.0" not in weights


def test_a_source_is_never_on_both_sides(script):
    rows = [judged("a__left", 0.9, right=True), judged("b__left", 0.8, right=True)]
    rows += [judged("c__right", 0.2, right=False), judged("d__right", 0.3, right=False)]
    clips = [script.judged_of(row) for row in rows]
    p = script.held_out_probability(np.zeros((4, 1)), clips)

    # Only the constant is left: each side is told what the other one is.
    assert (p[:2] < 0.01).all()
    assert (p[2:] > 0.99).all()


def test_the_bar_is_the_least_from_which_nine_of_ten_are_right_and_asks_no_clip_about_itself(
    script,
):
    rows = [judged(f"x__{k}", 0.5 + 0.04 * k, right=True) for k in range(10)]
    rows += [judged("low__y", 0.3, right=False), judged("gone__z", 0.95, right=True, gate="x")]
    clips = [script.judged_of(row) for row in rows]

    assert script.least_threshold(clips) == 0.3
    assert script.least_threshold([*clips, clips[-2]]) == 0.5
    # Without the wrong one the others ask for 0.5: it is turned away by them.
    assert script.held_out_accepted(clips).tolist() == [True] * 10 + [False, False]
