"""The paper's figures are those of `docs/paper_tables.json`, wherever pages, scripts and settings show them."""

import json
import re

import pytest

import paper_tables
from paper_tables import FILE, PAGES, papers_value
from policies.bc.configuration_v2p_bc import V2PBCConfig
from policies.bc.modeling_v2p_bc import PRETRAINED_BACKBONE_LR
from results_table import ROOT
from studies.programs import EVERY_STEPS
from v2p_data.episodes.config import EpisodesConfig
from v2p_data.experts.config import ExpertConfig
from v2p_data.policy.config import PAPER_BATCH_SIZE, PAPER_EPOCHS
from v2p_data.reward.config import RewardConfig
from v2p_data.scene.backends.config import SegmentConfig
from v2p_data.sim.env.batch_env import SimConfig
from v2p_data.sim.env.ranges import RandomizationConfig
from v2p_data.task.benchmark import benchmark_names
from v2p_data.task.generate import TaskConfig

DATA = json.loads(FILE.read_text())
TABLES = {name: table["rows"] for name, table in DATA["tables"].items()}
LIKE_THE_PAPER = {
    "recipe/codes": TaskConfig().num_samples,
    "recipe/rewards": RewardConfig().candidates,
    "recipe/lambda": ExpertConfig().taught_bonus_factor,
    "recipe/positive points": SegmentConfig().num_points,
    "recipe/steps between code policies": EVERY_STEPS,
    "recipe/trajectories": EpisodesConfig().num_episodes,
    "recipe/epochs": PAPER_EPOCHS,
    "recipe/batch": PAPER_BATCH_SIZE,
    "recipe/frames": V2PBCConfig(device="cpu", preset="paper").n_obs_steps,
    "recipe/image size": V2PBCConfig(device="cpu", preset="paper").input_size_px,
    "recipe/head size": V2PBCConfig(device="cpu", preset="paper").head_dim,
    "recipe/state size": V2PBCConfig(device="cpu", preset="paper").state_dim,
    "recipe/head learning rate": V2PBCConfig(device="cpu", preset="paper").optimizer_lr,
    "recipe/backbone learning rate": PRETRAINED_BACKBONE_LR,
    "recipe/rotation scale": SimConfig().rotation_step_rad,
    "recipe/action noise": RandomizationConfig().action_noise,
    "recipe/delay": list(RandomizationConfig().delay_s),
}
"""Settings that say they are the paper's."""
QUOTES = [
    (
        "v2p_data/reward/config.py",
        "the paper takes {recipe/iterations}, and {recipe/iterations self-collected} for hard",
    ),
    ("v2p_data/task/task.py", "the paper gives {recipe/horizon} steps"),
    ("v2p_data/task/schema.py", "the paper's episodes have {recipe/horizon} steps"),
    ("v2p_data/episodes/config.py", "the paper's policies learn from {recipe/trajectories}"),
    ("v2p_data/policy/config.py", "{recipe/epochs} epochs of batch {recipe/batch}"),
    ("configs/paper.yaml", "{recipe/epochs} epochs of batch {recipe/batch}"),
]
"""Sentences of code and settings that quote the paper."""


@pytest.mark.parametrize("page", PAGES)
def test_a_page_shows_the_paper_s_figures(page: str):
    text = (ROOT / page).read_text()

    assert PAGES[page](text) == text, "run scripts/paper_tables.py --write"


def test_a_marked_figure_is_the_paper_s():
    marked = [
        found
        for page in (ROOT / "docs").rglob("*.md")
        for found in re.findall(r"(\S+(?: %)?)<!-- paper: (.+?) -->", page.read_text())
    ]

    assert len(marked) >= 2
    for shown, where in marked:
        number = float(re.sub(r"[^\d.]", "", shown))
        assert number == pytest.approx(papers_value(where) * (100 if "%" in shown else 1)), where


@pytest.mark.parametrize("where", LIKE_THE_PAPER)
def test_a_setting_that_says_it_is_the_paper_s_is(where: str):
    assert LIKE_THE_PAPER[where] == papers_value(where)


@pytest.mark.parametrize(("file", "sentence"), QUOTES)
def test_a_sentence_in_the_code_quotes_the_paper(file: str, sentence: str):
    quoted = re.sub(r"{(.+?)}", lambda found: str(papers_value(found[1])), sentence)

    assert quoted in (ROOT / file).read_text()


def test_table_1_has_a_row_for_each_task_of_the_benchmark():
    assert set(TABLES["table 1"]) == {*benchmark_names(), "average"}


def test_every_table_can_be_shown():
    shown = paper_tables.tables()

    assert "| cover | Cover sth. with sth. |" in shown
    assert "| Eureka | 0.83 ± 0.13 | 0.63 ± 0.38 | 0.37 ± 0.29 | 0.61 |" in shown
    assert shown.count("section") == len(DATA["tables"]) + len(DATA["figures"])
