"""`v2p demo` from clips to page, the real command on one clip of each kind and with small sizes."""

import json
import shutil
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent / "distillation"))
sys.path.insert(0, str(Path(__file__).parent / "episodes"))

from toy_run import made, record_of

from v2p_data.cli import run
from v2p_data.commands import run as commands
from v2p_data.pipeline.settings import load_settings
from v2p_data.stages import EngineConfig

ROOT = Path(__file__).parents[1]
SAMPLES = ROOT / "datasets" / "sample_videos"
SEEN, UNSEEN = "push_blue_box_left", "unseen/lift_orange_can"
SETTINGS = """
video: {max_side_px: 320, max_frames: 40}
task: {num_samples: 1}
expert:
  num_envs: 32
  trial_worlds: 16
  eval_episodes: 4
  min_success: 0.0
  imitation: {rounds: 5, least_rounds: 4, target_success: 0.5}
  ppo: {total_steps: 1024, window_episodes: 8, min_window_episodes: 4, num_deterministic: 8, eval_episodes: 8}
episodes: {num_episodes: 2, batch_worlds: 16, size_px: 48}
distillation: {rounds: 1, episodes: 2, worlds: 4, first_steps: 2}
policy: {preset: small, steps: 3, batch_size: 8}
evaluation: {episodes: 2, worlds: 2}
"""


@pytest.fixture
def clone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A clone of few clips and small settings; stages run in this process."""
    clone = tmp_path / "clone"
    (clone / "configs").mkdir(parents=True)
    (clone / "configs" / "demo.yaml").write_text(SETTINGS)
    for clip in (SEEN, UNSEEN):
        source, folder = SAMPLES / f"{clip}.mp4", clone / "datasets/sample_videos" / clip
        folder.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(source, folder.parent)
        captions = json.loads((source.parent / "captions.json").read_text())
        (folder.parent / "captions.json").write_text(
            json.dumps({source.name: captions[source.name]})
        )
    monkeypatch.setattr(commands, "__file__", str(clone / "v2p_data" / "commands" / "run.py"))
    monkeypatch.setattr(commands, "run_stages", made)
    return clone


def finished(out: Path) -> dict[str, int]:
    return {str(p.relative_to(out)): p.stat().st_mtime_ns for p in out.glob("*/*/record.json")}


@pytest.mark.slow
@pytest.mark.e2e
def test_the_demo_goes_from_clips_to_a_policy_judged_on_seen_and_unseen_tasks(
    capsys, clone: Path, tmp_path: Path
):
    out = tmp_path / "out"

    assert run(["demo", "--out", str(out), "--workers", "1"]) == 0

    said = capsys.readouterr().out
    assert f"Made {out / 'report.html'}" in said
    lines = [line.split() for line in said.splitlines() if "% interval" in line]
    assert [words[:2] for words in lines] == [
        ["push_blue_box_left", "seen"],
        ["lift_orange_can", "unseen"],
    ]
    made_of = {folder.parent.name: record_of(folder) for folder in out.glob("*/*") if folder.parent.name in ("dataset", "distillation", "policy", "evaluation")}  # fmt: skip
    assert made_of["dataset"].counts["repo_id"] == "v2p/demo"
    assert made_of["dataset"].counts["episodes"] == 2
    assert made_of["policy"].counts["frames"] == (
        made_of["dataset"].counts["frames"] + made_of["distillation"].counts["frames"]
    )
    assert [row["trials"] for row in made_of["evaluation"].counts["rows"]] == [2, 2]
    page = (out / "report.html").read_text()
    assert "push_blue_box_left" in page
    assert "lift_orange_can" in page

    before = finished(out)
    assert run(["demo", "--out", str(out), "--workers", "1"]) == 0

    assert finished(out) == before
    assert "Made" in capsys.readouterr().out


def test_without_the_sample_clips_the_demo_says_what_it_needs(capsys, clone: Path, tmp_path: Path):
    shutil.rmtree(clone / "datasets")

    assert run(["demo", "--out", str(tmp_path / "out")]) == 2

    assert "run the demo from a clone of the repository" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("path", sorted((ROOT / "configs").glob("*.yaml")), ids=lambda p: p.stem)
def test_the_settings_files_that_we_give_are_settings(path: Path):
    assert load_settings(path, EngineConfig) != EngineConfig()
