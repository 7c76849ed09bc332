"""`v2p demo` from its clips to its page: the real command, on the toy task instead of what the clips show.

What a clip becomes is the business of `tests/test_chain.py`; here are the parts after it, and how they hang together.
"""

import shutil
from pathlib import Path

import pytest
import toy_run
from toy_run import made, record_of

from policies.bc.configuration_v2p_bc import V2PBCConfig
from policies.bc.modeling_v2p_bc import PRETRAINED_BACKBONE_LR
from v2p_data.cli import run
from v2p_data.commands import run as commands
from v2p_data.pipeline.settings import load_settings
from v2p_data.policy.config import PolicyConfig
from v2p_data.stages import EngineConfig

ROOT = Path(__file__).parents[2]
SAMPLES = ROOT / "datasets" / "sample_videos"
SEEN, UNSEEN = "tip_green_carton", "lift_orange_can"
SETTINGS = """
episodes: {num_episodes: 2, batch_worlds: 6, max_batches: 3, size_px: 48}
distillation: {rounds: 1, episodes: 2, worlds: 3, takeover: [0.1, 0.5], first_steps: 2}
policy: {preset: small, steps: 3, batch_size: 8}
evaluation: {episodes: 2, worlds: 2}
"""


@pytest.fixture
def clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, agreeing_referee) -> Path:
    """A clone with one clip to learn from and one that is unseen, and with small settings."""
    clone = tmp_path / "clone"
    (clone / "configs").mkdir(parents=True)
    (clone / "configs" / "demo.yaml").write_text(SETTINGS)
    samples = clone / "datasets" / "sample_videos"
    (samples / "unseen").mkdir(parents=True)
    shutil.copy(SAMPLES / f"{SEEN}.mp4", samples)
    shutil.copy(SAMPLES / "unseen" / f"{UNSEEN}.mp4", samples / "unseen")
    monkeypatch.setattr(commands, "__file__", str(clone / "v2p_data" / "commands" / "run.py"))
    monkeypatch.setattr(commands, "run_stages", made)  # in this process
    monkeypatch.setattr(commands, "chain", lambda video, cfg: toy_run.chain(video.item, cfg))
    monkeypatch.setattr(commands, "scene_stage", lambda video, cfg: video)
    monkeypatch.setattr(commands, "task_stage", lambda video, cfg: toy_run.task_stage(video.item))
    return clone


def finished(out: Path) -> dict[str, int]:
    return {str(p.relative_to(out)): p.stat().st_mtime_ns for p in out.glob("*/*/record.json")}


@pytest.mark.slow
@pytest.mark.e2e
def test_the_demo_ends_with_a_policy_judged_on_seen_and_unseen_tasks(
    capsys, clone: Path, tmp_path: Path
):
    out = tmp_path / "out"

    assert run(["demo", "--out", str(out), "--workers", "1"]) == 0

    said = capsys.readouterr().out
    assert f"Made {out / 'report.html'}" in said
    rows = [line.split()[:2] for line in said.splitlines() if "% interval" in line]
    assert rows == [[SEEN, "seen"], [UNSEEN, "unseen"]]
    counts = {
        stage: record_of(next(out.glob(f"{stage}/*"))).counts
        for stage in ("dataset", "distillation", "policy", "evaluation")
    }
    assert (counts["dataset"]["repo_id"], counts["dataset"]["episodes"]) == ("v2p/demo", 2)
    assert counts["policy"]["frames"] == sum(
        counts[stage]["frames"] for stage in ("dataset", "distillation")
    )
    assert [row["trials"] for row in counts["evaluation"]["rows"]] == [2, 2]
    assert SEEN in (out / "report.html").read_text()
    card = next(out.glob("policy/*/policy/README.md")).read_text()
    assert f"| {SEEN} | yes |" in card
    assert f"| {UNSEEN} | no |" in card

    before = finished(out)
    assert run(["demo", "--out", str(out), "--workers", "1"]) == 0

    assert len(before) == 8  # two tasks, and one of each stage after them
    assert finished(out) == before
    again = capsys.readouterr().out
    assert [line.split()[:2] for line in again.splitlines() if "% interval" in line] == rows


def test_without_the_sample_clips_the_demo_says_what_it_needs(capsys, clone: Path, tmp_path: Path):
    shutil.rmtree(clone / "datasets")

    assert run(["demo", "--out", str(tmp_path / "out")]) == 2

    assert "run the demo from a clone of the repository" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("*.yaml")), ids=lambda p: p.stem)
def test_the_settings_files_that_we_give_are_settings(path: Path):
    assert load_settings(path, EngineConfig) != EngineConfig()


def test_the_papers_settings_are_the_papers_numbers():
    cfg = load_settings(ROOT / "configs" / "paper.yaml", EngineConfig)

    assert (cfg.task.num_samples, cfg.task.vlm.pick) == (8, "vlm")
    assert (cfg.reward.iterations, cfg.reward.candidates, cfg.reward.bonus_ratio) == (5, 8, 100)
    assert cfg.expert.start == "none"
    assert (cfg.episodes.num_episodes, cfg.distillation.rounds) == (100, 0)
    # What `v2p train` reads of it is the preset, whatever stands before the dataset.
    assert cfg.policy == PolicyConfig(preset="paper")
    assert (cfg.policy.resolved.epochs, cfg.policy.resolved.batch_size) == (30, 1024)
    network = V2PBCConfig(**cfg.policy.network())
    assert (network.encoder, network.input_size_px, network.n_obs_steps) == ("resnet18", 256, 2)
    assert (network.head, network.state_dim, network.head_dim) == ("regression", 256, 512)
    assert (network.optimizer_lr, PRETRAINED_BACKBONE_LR) == (3e-4, 3e-5)
