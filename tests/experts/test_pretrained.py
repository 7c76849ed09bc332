"""The experts that come with the package: asked first, kept where they succeed, gone on from by PPO elsewhere."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from policies.ppo.config import ActorConfig
from policies.ppo.policy import WEIGHTS_FILE, ActorCritic, Expert
from v2p_data.errors import V2PError
from v2p_data.experts.learning import Worlds, ask_pretrained, learn
from v2p_data.experts.pretrained import CARD_FILE, FOLDER, card, pretrained_for
from v2p_data.kinds import KINDS
from v2p_data.pipeline.fingerprint import file_digest
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.task import TaskBundle

from .test_learning import TINY, actor_in

CFG = replace(TINY, start="pretrained", trial_worlds=16)


@pytest.fixture(scope="module")
def bundle() -> TaskBundle:
    return load_benchmark("tip_over")


def test_every_kind_but_the_generic_one_has_an_expert_within_five_megabytes() -> None:
    assert sorted(card()) == sorted(k for k in KINDS if k != "generic")
    assert sum(p.stat().st_size for p in FOLDER.rglob("*") if p.is_file()) < 5_000_000


def test_the_package_s_expert_is_the_task_s_without_any_training(bundle, tmp_path) -> None:
    learned = learn(Worlds(bundle=bundle, seed=3), CFG, tmp_path)
    assert (learned.kept, learned.actor_updates, learned.teacher) == ("pretrained", 0, "")
    assert learned.steps == CFG.trial_worlds * bundle.horizon_steps
    shipped = actor_in(FOLDER / "tip_over")
    assert all(torch.equal(shipped[k], v) for k, v in actor_in(tmp_path).items())


def test_ppo_goes_on_from_it_where_it_is_not_enough(bundle, tmp_path) -> None:
    cfg = replace(CFG, pretrained_is_enough=1.1)
    learned = learn(Worlds(bundle=bundle, seed=3), cfg, tmp_path)
    assert learned.kept in ("ppo", "pretrained")
    assert learned.comparison is not None
    last, shipped = actor_in(tmp_path / "last"), actor_in(FOLDER / "tip_over")
    assert any(not torch.equal(shipped[k], v) for k, v in last.items())


def foreign(folder: Path, seed: int = 0) -> Path:
    """Return a folder with an expert of random weights for tipping, which its card names."""
    generator = torch.Generator().manual_seed(seed)
    Expert(ActorCritic(90, 7, ActorConfig(), generator)).save(folder / "tip_over")
    digest = file_digest(folder / "tip_over" / WEIGHTS_FILE)
    (folder / CARD_FILE).write_text(json.dumps({"tip_over": {"digest": digest}}))
    return folder


def test_one_that_fails_is_not_started_from(bundle, tmp_path) -> None:
    worlds = Worlds(bundle=bundle, seed=3)
    assert ask_pretrained(worlds, CFG, tmp_path / "out", foreign(tmp_path / "random")) is None
    assert not (tmp_path / "out").exists()


def test_what_it_never_learned_has_none(bundle) -> None:
    three = replace(bundle.scene, objects=bundle.scene.objects * 3)
    assert pretrained_for(replace(bundle, kind="generic")) is None
    assert pretrained_for(replace(bundle, scene=three)) is None
    assert pretrained_for(replace(bundle, robot={"path": "arm.xml"})) is None


@pytest.mark.parametrize("damage", ["other weights", "cut", "gone"])
def test_weights_that_are_not_the_card_s_are_refused(bundle, tmp_path, damage) -> None:
    folder = foreign(tmp_path / "mine")
    path = folder / "tip_over" / WEIGHTS_FILE
    if damage == "other weights":
        shutil.copy(foreign(tmp_path / "other", seed=1) / "tip_over" / WEIGHTS_FILE, path)
    elif damage == "cut":
        path.write_bytes(path.read_bytes()[:-100])
    else:
        path.unlink()
    with pytest.raises(V2PError, match="install the package anew, or learn without it"):
        pretrained_for(bundle, folder)
