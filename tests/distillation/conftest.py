"""Toy tasks of `tests/episodes`, and a run folder with task, expert, episodes and dataset."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "episodes"))

import toy_run

from v2p_data.episodes import rollouts
from v2p_data.sim.env import verdict


@pytest.fixture
def agreeing_referee(monkeypatch: pytest.MonkeyPatch) -> None:
    """The toy task is one that no referee knows: only the tool moves."""
    for module in (verdict, rollouts):
        monkeypatch.setattr(module, "referee_verdict", toy_run.agree)


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder up to its dataset; do not write into it."""
    root = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollouts, "referee_verdict", toy_run.agree)
        toy_run.make_run(root)
    return root
