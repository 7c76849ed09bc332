"""Two rounds by a stand-in for a model: parents, refusals, what the model is told, what the page shows.

The given reward is constant. The model adds two rewards, one of them without bounds, and then will
not; a template fills the round. In the second round it answers twice, from what training with the
best one showed.
"""

import json
import runpy
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from v2p_data.cli import parse
from v2p_data.pipeline.artifact import read_record
from v2p_data.pipeline.runner import Runtime, make_stage
from v2p_data.report.page import NO_BREAK, write_page
from v2p_data.report.rewards import AUTHORS
from v2p_data.stages import EngineConfig, chain
from v2p_data.task.sandbox.splice import rest_part, reward_part, with_reward
from v2p_data.task.task import REWARD_SEARCH_FOLDER, TaskBundle
from v2p_data.video.captions import VideoItem

pytestmark = pytest.mark.slow
TESTS = Path(__file__).parents[1]
_chat = runpy.run_path(str(TESTS / "task" / "vlm" / "conftest.py"))
ChatServer, said = _chat["ChatServer"], _chat["said"]
Outline = runpy.run_path(str(TESTS / "report" / "test_page.py"))["Outline"]

NUM_ENVS, EVAL_WORLDS = 24, 16
TINY = (
    f"--reward.steps={16 * NUM_ENVS}",
    "--reward.rungs",
    "1.0",
    f"--reward.num-envs={NUM_ENVS}",
    f"--reward.eval-worlds={EVAL_WORLDS}",
    "--reward.iterations=2",
    "--reward.candidates=4",
    "--reward.target-success=1.0",
    "--task.writer=vlm",
    "--task.vlm.key-env=",
    "--task.vlm.max-reasks=0",
    "--task.vlm.max-regenerations=0",
)
BY_CHANCE = "(states['tea_box_start_pos'][:, 1] < 0) & (states['progress'] > 0.06)"
"""From the second step on, where the box happens to lie decides: successes and failures without any training."""
FLAT = "0 * states['eef_pos'][:, 2] + 5"
UPWARDS, HUGE = "states['eef_pos'][:, 2]", "1e6 * states['eef_pos'][:, 0]"
LYING = "states['tea_box_start_pos'][:, 1]"
HONEST = "-torch.tanh(states['tea_box_start_pos'][:, 1]) - 0.1 * (actions**2).sum(dim=-1)"
REWARD = """
def reward_function(actions, states):
    side = {}
    return side, {{"side": side}}
"""


def words_of(request) -> str:
    """Return the question of a request without its pictures."""
    return "\n".join(p.get("text", "") for p in request["messages"][-1]["content"])


@dataclass(frozen=True)
class Searched:
    root: Path
    result: Path
    rows: list[dict]
    found: dict
    requests: list[dict]

    def round(self, iteration: int) -> list[dict]:
        return [row for row in self.rows if row["iteration"] == iteration]


@pytest.fixture(scope="module")
def searched(lifting: Callable[..., TaskBundle], tmp_path_factory) -> Searched:
    root = tmp_path_factory.mktemp("two_rounds")
    server = ChatServer()

    def answer(request):
        question = words_of(request)
        formulas = (LYING, HONEST) if "A policy was trained" in question else (UPWARDS, HUGE)
        for number, formula in enumerate(formulas, 1):
            if f"sample {number} of" in question:
                return said(f"Thoughts.\n```python\nimport torch\n{REWARD.format(formula)}```\n")
        return said("I would rather not.")

    server.otherwise = answer
    bundle = lifting(BY_CHANCE)
    bundle = replace(bundle, code=with_reward(bundle.code, REWARD.format(FLAT)))
    (root / "clip.mp4").write_bytes(b"x")
    video = VideoItem(item="clip", path=root / "clip.mp4", caption="lifting a box")
    cfg = parse(EngineConfig, [*TINY, f"--task.vlm.base-url={server.url}"], "reward")
    stage = chain(video, cfg).inputs["task"]
    task = stage.inputs["task"].folder(root)
    task.mkdir(parents=True)
    bundle.save(task)
    cv2.imwrite(str(task / "scene" / "frame_first.jpg"), np.zeros((8, 8, 3), np.uint8))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NO_PROXY", "127.0.0.1")
        outcome = make_stage(stage, Runtime(root=root))
    server.close()
    assert outcome.status == "made", outcome.detail
    table = json.loads((outcome.folder / REWARD_SEARCH_FOLDER / "search.json").read_text())
    return Searched(root, outcome.folder, table["candidates"], table["found"], server.requests)


@pytest.mark.long
def test_the_second_round_descends_from_the_best_of_the_first(searched: Searched):
    first, second = searched.round(0), searched.round(1)
    best = max(first, key=lambda row: row["results"][-1]["rank"] if row["results"] else -1)

    assert [row["origin"] for row in first] == ["given", "model", "model", "template"]
    assert [row["why"].partition(":")[0] for row in first] == [
        "reward_constant",
        "",
        "reward_unbounded",
        "",
    ]
    assert [(row["origin"], row["parent"]) for row in second] == [("model", best["number"])] * 2
    assert "the model gave 2 of 3 rewards that could be used" in first[3]["reasons"][0]
    assert len({reward_part(row["code"]) for row in searched.rows}) == 6
    assert len({rest_part(row["code"]) for row in searched.rows}) == 1


@pytest.mark.long
def test_the_result_is_the_task_with_the_chosen_reward(searched: Searched):
    chosen = next(row for row in searched.rows if row["number"] == searched.found["chosen"])
    record = read_record(searched.result)

    assert TaskBundle.load(searched.result).code == chosen["code"]
    assert record is not None
    assert record.counts == searched.found
    assert record.counts["success"] == chosen["results"][-1]["success"]


@pytest.mark.long
def test_the_model_is_told_what_each_component_did_and_shown_pictures_and_examples(
    searched: Searched,
):
    told = [r for r in searched.requests if "A policy was trained" in words_of(r)]
    parent = searched.rows[searched.round(1)[0]["parent"]]
    folder = searched.result / REWARD_SEARCH_FOLDER / "candidate" / parent["results"][-1]["folder"]
    record = read_record(folder)

    assert record is not None
    assert len(told) == 4
    for request in told:
        question = words_of(request)
        assert parent["code"].strip() in question
        assert record.counts["feedback_text"].strip() in question
        assert "successful trajectories" in question
        assert "image_url" in json.dumps(request["messages"][-1])
        assert "Thoughts:" in json.dumps(request["messages"][0])  # an example of a refinement
    assert len(list((searched.result / "calls").glob("*.json"))) == len(searched.requests) == 3 + 4


@pytest.mark.long
def test_the_page_shows_the_search(searched: Searched):
    html = write_page(searched.root, searched.root / "page.html").read_text()
    page = Outline(html)
    text = page.text.replace(NO_BREAK, " ")

    found = searched.found
    for words in (
        f"Candidate {found['chosen']} of 6 was chosen (written by {AUTHORS[found['origin']]})",
        "6 rewards in 2 rounds",
        "trained to the end",
        "not by the model: the model gave 2 of 3 rewards",
        f"a language model, from {searched.round(1)[0]['parent']}",
        f"Of {EVAL_WORLDS} episodes of its last policy",
    ):
        assert words in text
    charts = [str(a["aria-label"]) for a in page.of("svg") if a.get("role") == "img"]
    assert any(words.startswith("Success after each round: best so far") for words in charts)
