"""What is learned of candidates is what tells the right one from the others."""

import json

import numpy as np
import pytest


@pytest.fixture(scope="module")
def trainer(load_script):
    return load_script("train_standing")


def group(rng, n=6):
    """Return candidates of which the one with the largest first cue is right.

    The second is chance, the third the same for all.
    """
    cues = np.column_stack([rng.normal(size=n), rng.normal(size=n), np.full(n, 0.7)])
    right = np.full(n, 0.02)
    right[cues[:, 0].argmax()] = 0.95
    return cues, right, np.eye(n)


@pytest.fixture
def groups():
    rng = np.random.default_rng(0)
    return [group(rng) for _ in range(60)]


def test_the_cue_that_tells_gets_the_weight(trainer, groups):
    telling, chance, constant = trainer.choosing(groups)

    assert telling > 5 * abs(chance)
    assert constant == pytest.approx(0, abs=1e-6)


def test_the_weights_of_all_cues_are_written(trainer, groups, tmp_path, monkeypatch, capsys):
    for i, (cues, right, alike) in enumerate(groups):
        np.savez(
            tmp_path / f"{i:05d}.npz", names=["a", "b", "c"], cues=cues, right=right, alike=alike
        )
    out = tmp_path / "standing.json"
    monkeypatch.setattr("sys.argv", ["train", "train", str(tmp_path), "--out", str(out)])

    trainer.main()

    learned = json.loads(out.read_text())
    assert list(learned["choice"]) == ["a", "b", "c"]
    assert list(learned["sure"]) == ["offset", "a", "b", "c", "odds"]
    assert list(learned["aside"]) == ["offset", "odds"]
    assert "60 clips" in capsys.readouterr().out
