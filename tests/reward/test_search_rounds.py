"""Two rounds written by a model and by rule: who descends from whom, what is turned away untrained, what the page shows.

The first round's given reward is not finite. The model adds two, one of them constant, and then will not; templates write
the rest. Two of these have children. For the first parent the model answers twice, once with a reward that pays for
failing, and for the second without code.
"""

import json
import re
import runpy
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from v2p_data.cli import parse
from v2p_data.json_files import json_or_none
from v2p_data.pipeline.runner import Runtime, Stage, make_stage
from v2p_data.report.page import NO_BREAK, write_page
from v2p_data.report.reading import read_curve
from v2p_data.report.rewards import AUTHORS
from v2p_data.reward.candidate import Candidate, Fault, load_candidates
from v2p_data.reward.feedback import Feedback
from v2p_data.reward.jobs import HEARTBEAT_FILE, Jobs
from v2p_data.reward.methods import in_place_of_reward, save_bundle, told
from v2p_data.reward.reflect import proposals
from v2p_data.reward.search import How, search_reward
from v2p_data.reward.worker import run_job
from v2p_data.stages import EngineConfig, chain
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.llm.client import VlmClient
from v2p_data.task.llm.writer import ModelWriter
from v2p_data.task.sandbox.splice import rest_part, reward_part, with_reward
from v2p_data.task.task import REWARD_SEARCH_FOLDER, TaskBundle
from v2p_data.video.captions import VideoItem

TESTS = Path(__file__).parents[1]
_chat = runpy.run_path(str(TESTS / "task" / "vlm" / "conftest.py"))
ChatServer, said = _chat["ChatServer"], _chat["said"]
Outline = runpy.run_path(str(TESTS / "report" / "test_page.py"))["Outline"]

HORIZON = 20
NUM_ENVS = 24
EVAL_WORLDS = 16
STEPS = 16 * NUM_ENVS
"""One batch of PPO."""
TINY = (
    f"--reward.steps={STEPS}", "--reward.rungs", "1.0", f"--reward.num-envs={NUM_ENVS}",
    f"--reward.eval-worlds={EVAL_WORLDS}", "--reward.confirm-seeds=1", "--reward.evaluations=1",
)  # fmt: skip
BY_CHANCE = "(states['tea_box_start_pos'][:, 1] < 0) & (states['progress'] > 0.06)"
"""From the second step on, where the box happens to lie decides: successes and failures without any training."""
NOT_FINITE = "states['eef_pos'][:, 0] * float('1e30') * 1e30"
TINY_EXPERT = (
    "--expert.teacher=none", f"--expert.num-envs={NUM_ENVS}", f"--expert.ppo.total-steps={8 * STEPS}",
    "--expert.ppo.window-episodes=8", "--expert.ppo.min-window-episodes=4", "--expert.ppo.num-deterministic=4",
    "--expert.eval-episodes=2", "--expert.min-success=0.0",
)  # fmt: skip
UPWARDS, FLAT = "states['eef_pos'][:, 2]", "0 * states['eef_pos'][:, 2] + 5"
LYING = "states['tea_box_start_pos'][:, 1]"
HONEST = "-torch.tanh(states['tea_box_start_pos'][:, 1]) - 0.1 * (actions**2).sum(dim=-1)"
ANY_GRIP = "(states['gripper_width'] < 0.08) & (states['progress'] > 0.06)"
"""False at the first step, and true for much of what an untrained arm does."""
REWARD = """
def reward_function(actions, states):
    side = {}
    return side, {{"side": side}}
"""
ANSWER = f"The parts say little.\n```python\nimport torch\n{REWARD}```\n"


def words_of(request) -> str:
    """Return the question of a request without its pictures."""
    return "\n".join(p.get("text", "") for p in request["messages"][-1]["content"])


def bundle_with(success: str) -> TaskBundle:
    """A task whose success is this expression."""
    bundle = replace(load_benchmark("lift_up"), horizon_steps=HORIZON)
    body = re.compile(r"(def compute_success\(self, states\):\n).*?(?=\n    def )", re.DOTALL)
    return replace(bundle, code=body.sub(rf"\g<1>        return {success}\n", bundle.code))


def expert_of(root: Path, *flags: str) -> Stage:
    """Return the expert's stage of a run with these flags."""
    path = root / "clip.mp4"
    path.write_bytes(b"x")
    item = VideoItem(item="clip", path=path, caption="lifting a box")
    return chain(item, parse(EngineConfig, list(flags), "reward")).inputs["expert"]


def searched(root: Path, bundle: TaskBundle, *flags: str) -> Path:
    """Return where the search lies that a run with these flags makes of this task."""
    stage = expert_of(root, *flags).inputs["task"]
    save_bundle(bundle, stage.inputs["task"].folder(root))
    outcome = make_stage(stage, Runtime(root=root))
    assert outcome.status == "made", outcome.detail
    return outcome.folder / REWARD_SEARCH_FOLDER


@dataclass(frozen=True)
class TwoRounds:
    root: Path
    search: Path
    table: dict
    candidates: dict[int, Candidate]
    questions: list[str]

    def rows(self, iteration: int) -> list[dict]:
        return [row for row in self.table["candidates"] if row["round"] == iteration]

    @property
    def elites(self) -> list[int]:
        ranked = sorted(self.rows(0), key=lambda row: (-row["rank"], row["number"]))
        return [row["number"] for row in ranked[:2]]


@pytest.fixture(scope="module")
def two_rounds(tmp_path_factory) -> TwoRounds:
    """What the module's docstring tells of, by `--task.writer=vlm` and a server on this machine."""
    root = tmp_path_factory.mktemp("two_rounds")
    server = ChatServer()
    parents: list[str] = []

    def answer(request):
        question = words_of(request)
        parent, trained, _ = question.partition("A policy was trained")
        if trained and parent not in parents:
            parents.append(parent)
        is_first_parent = not trained or parents.index(parent) == 0
        for number, formula in enumerate((LYING, HONEST) if trained else (UPWARDS, FLAT), 1):
            if is_first_parent and f"sample {number} of" in question:
                return said(ANSWER.format(formula))
        return said("I would rather not.")

    server.otherwise = answer
    bundle = bundle_with(BY_CHANCE)
    bundle = replace(bundle, code=with_reward(bundle.code, REWARD.format(NOT_FINITE)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NO_PROXY", "127.0.0.1")
        search = searched(
            root, bundle, *TINY,
            "--reward.iterations=2", "--reward.candidates=5", "--reward.elites=2",
            "--reward.target-success=1.0", "--task.writer=vlm", f"--task.vlm.base-url={server.url}",
            "--task.vlm.key-env=", "--task.vlm.max-reasks=0", "--task.vlm.max-regenerations=0",
        )  # fmt: skip
    server.close()
    return TwoRounds(
        root=root,
        search=search,
        table=json.loads((search / "search.json").read_text()),
        candidates={c.number: c for c in load_candidates(search)},
        questions=[words_of(r) for r in server.requests],
    )


# --- who descends from whom ------------------------------------------------------------------------------------


def test_the_second_round_descends_from_the_best_of_the_first(two_rounds: TwoRounds):
    children = two_rounds.rows(1)

    assert [row["parent"] for row in two_rounds.rows(0)] == [None] * 5
    assert [(row["origin"], row["state"]) for row in two_rounds.rows(0)] == [
        ("given", "refused"),
        ("model", "finished"),
        ("model", "prescreened"),
        ("template", "finished"),
        ("template", "finished"),
    ]
    first, second = two_rounds.elites
    assert [row["parent"] for row in children] == [first] * 3 + [second] * 2
    assert 0 not in two_rounds.elites
    assert json.loads((two_rounds.search / "rounds" / "1.json").read_text()) == [5, 6, 7, 8, 9]
    assert len(children) == 5


def test_no_reward_is_tried_twice_and_nothing_but_rewards_changes(two_rounds: TwoRounds):
    codes = [c.code for c in two_rounds.candidates.values()]

    assert len({reward_part(code) for code in codes}) == 10
    assert len({rest_part(code) for code in codes}) == 1


def test_who_is_written_by_rule_says_why(two_rounds: TwoRounds):
    by_rule = [row for row in two_rounds.rows(1) if row["origin"] == "reflection"]

    assert len(by_rule) == 3
    first, second = two_rounds.elites
    missing = [f"not by the model: the model gave {k} rewards that could be used" for k in ("2 of 3", "0 of 2")]  # fmt: skip
    assert [row["reasons"][0].startswith(missing[row["parent"] == second]) for row in by_rule] == [True] * 3  # fmt: skip
    assert all(len(row["reasons"]) > 1 for row in by_rule)
    by_template = [row for row in two_rounds.rows(0) if row["origin"] == "template"]
    assert all("the model gave 2 of 4 rewards" in row["reasons"][0] for row in by_template)
    assert {row["parent"] for row in by_rule} == {first, second}


class Played(Jobs):
    """Lets each candidate have come to what one of another search came to."""

    def __init__(self, training: Path) -> None:
        super().__init__()
        self.training = training

    def run(self, jobs, on_settled=lambda job: None, on_wait=lambda jobs: None):
        for job in jobs:
            shutil.copytree(
                self.training,
                job.folder,
                ignore=shutil.ignore_patterns("trajectories.npz"),
                dirs_exist_ok=True,
            )


def test_a_round_is_full_also_where_its_parents_first_ideas_were_tried(
    two_rounds: TwoRounds, tmp_path: Path
):
    flags = [*TINY, "--reward.iterations=2", "--reward.candidates=2", "--reward.elites=1"]
    cfg = parse(EngineConfig, [*flags, "--reward.target-success=2.0"], "reward").reward
    bundle = bundle_with(BY_CHANCE)
    feedback = Feedback.from_dict(
        json_or_none(folder(two_rounds, two_rounds.elites[0]) / "feedback.json")
    )
    parent = two_rounds.candidates[1].code
    offered = proposals(bundle, parent, feedback, np.random.default_rng(0))
    tried = [child.code for child, _ in zip(offered, range(4), strict=False)]
    for number, code in enumerate([parent, *tried]):
        candidate = Candidate(
            folder=tmp_path / "candidates" / f"{number:03d}", number=number, iteration=0,
            code=in_place_of_reward(bundle.code, code), origin="template",
        )  # fmt: skip
        candidate.save()
        if number > 0:
            candidate.fail(Fault(kind="refused", reason="so that the first is the best"))
    (tmp_path / "rounds").mkdir()
    (tmp_path / "rounds" / "0.json").write_text(json.dumps(list(range(1 + len(tried)))))

    played = Played(folder(two_rounds, two_rounds.elites[0]))
    search_reward(bundle, cfg, tmp_path, seed=3, how=How(jobs=played))

    made = load_candidates(tmp_path)
    children = [c for c in made if c.iteration == 1]
    before = {reward_part(c.code) for c in made if c.iteration == 0}
    assert [c.parent for c in children] == [0, 0]
    assert len(before | {reward_part(c.code) for c in children}) == len(before) + 2


# --- the model -------------------------------------------------------------------------------------------------


def test_the_model_writes_a_parents_children_from_what_training_showed(
    two_rounds: TwoRounds,
):
    first, second = two_rounds.elites
    of_model = [row for row in two_rounds.rows(1) if row["origin"] == "model"]

    assert [row["parent"] for row in of_model] == [first, first]
    assert "torch.tanh" in two_rounds.candidates[of_model[1]["number"]].code
    for number, count in ((first, 3), (second, 2)):
        feedback = json.loads((folder(two_rounds, number) / "feedback.json").read_text())
        rate = f"success rate: {feedback['num_successes'] / EVAL_WORLDS:.3f}"
        code = two_rounds.candidates[number].code.strip()
        told = [q for q in two_rounds.questions if code in q and "A policy was trained" in q]
        assert len(told) == count
        assert all(rate in question for question in told)


def test_every_call_of_the_model_is_kept_with_the_result(two_rounds: TwoRounds):
    stored = list((two_rounds.search.parent / "calls").glob("*.json"))

    assert len(stored) == len(two_rounds.questions) == 4 + 3 + 2


def folder(two_rounds: TwoRounds, number: int) -> Path:
    return two_rounds.candidates[number].training_folder()


# --- what is turned away ---------------------------------------------------------------------------------------


def test_a_reward_that_pays_for_failing_is_turned_away_untrained_and_says_so(
    two_rounds: TwoRounds,
):
    (flat,) = [r for r in two_rounds.rows(0) if r["state"] == "prescreened"]
    (row,) = [r for r in two_rounds.rows(1) if r["state"] == "prescreened"]
    elites = [folder(two_rounds, number) / "feedback.json" for number in two_rounds.elites]
    stored = [json.loads(path.read_text()) for path in elites]
    wins = sum(f["num_successes"] for f in stored)

    assert flat["why"] == "constant: it is 5 in each of 64 states that were tried, so that nothing can be learned from it"  # fmt: skip
    assert LYING in two_rounds.candidates[row["number"]].code
    assert row["why"] == (
        "ranks_failures_first: a success earns more than a failure with probability 0.00 "
        f"({wins} stored successes, {2 * EVAL_WORLDS - wins} failures), wanted at least 0.40"
    )
    assert row["marks"] == 0
    assert sorted(p.name for p in folder(two_rounds, row["number"]).iterdir()) == ["fault.json"]


def test_what_is_turned_away_costs_nothing_and_counts_nothing(two_rounds: TwoRounds):
    found = two_rounds.table["found"]

    assert [row["marks"] for row in two_rounds.rows(1)] == [0, 1, 1, 1, 1]
    assert found["trained_steps"] == 7 * STEPS
    assert found["full_steps"] == 7 * (STEPS + EVAL_WORLDS * HORIZON)
    assert found["faults"] == {"refused": 1, "prescreened": 2}


# --- the page --------------------------------------------------------------------------------------------------


def test_the_page_shows_the_search(two_rounds: TwoRounds):
    html = write_page(two_rounds.root, two_rounds.root / "page.html").read_text()
    text = Outline(html).text.replace(NO_BREAK, " ")

    found = two_rounds.table["found"]
    mean = f"{found['success']:.0%}".replace("%", " %")
    for words in (
        f"Candidate {found['chosen']} of 10 was chosen (written by {AUTHORS[found['origin']]}): {mean} success",
        "10 rewards in 2 rounds",
        "trained to the end",
        "turned away untrained",
        "refused untrained",
        "not by the model: the model gave 0 of 2 rewards that could be used",
        "wanted at least 0.40",
        f"a language model, from {two_rounds.elites[0]}",
        f"Of {EVAL_WORLDS} episodes of its last policy",
        "This success function was not held against the video.",
    ):
        assert words in text
    assert two_rounds.candidates[found["chosen"]].code.split()[-1] in text


# --- what is hidden from a model ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("flags", "hidden", "kept"),
    [
        (["--reward.method=eureka"], ("Tracked poses", "0.060, 0.042, 0.050"), ()),
        (["--reward.without", "tracking"], ("Tracked poses",), ("size x, y, z [m]",)),
        (["--reward.without", "pick"], (), ("Tracked poses", "size x, y, z [m]")),
    ],
)
def test_a_method_that_hides_the_video_has_the_model_write_the_task_anew_without_it(
    flags: list[str],
    hidden: tuple[str, ...],
    kept: tuple[str, ...],
    two_rounds: TwoRounds,
    tmp_path: Path,
):
    bundle = bundle_with(BY_CHANCE)
    anew = bundle_with(BY_CHANCE.replace("[:, 1] < 0)", "[:, 1] < 0.05)"))
    server = ChatServer()

    def answer(request):
        is_task = "Its code:" not in words_of(request)
        return said(f"```python\n{anew.code}\n```" if is_task else ANSWER.format(UPWARDS))

    server.otherwise = answer
    cfg = parse(
        EngineConfig,
        [
            *TINY, "--reward.iterations=1", "--reward.candidates=2", *flags,
            f"--task.vlm.base-url={server.url}", "--task.vlm.key-env=",
        ],
        "reward",
    )  # fmt: skip
    client = VlmClient(told(cfg.task.vlm, cfg.reward), tmp_path / "calls", seed=3)
    played = Played(folder(two_rounds, two_rounds.elites[0]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NO_PROXY", "127.0.0.1")
        writer, how = ModelWriter(client=client), How(jobs=played)
        search_reward(bundle, cfg.reward, tmp_path / "search", seed=3, how=how, writer=writer)
    server.close()

    candidates = load_candidates(tmp_path / "search")
    assert [c.origin for c in candidates] == ["model", "model"]
    assert {rest_part(c.code) for c in candidates} == {rest_part(anew.code)} != {rest_part(bundle.code)}  # fmt: skip
    questions = [words_of(r) for r in server.requests]
    assert len(questions) == 2
    for question in questions:
        assert [words for words in hidden if words in question] == []
        assert [words for words in kept if words not in question] == []


# --- RoboGen ---------------------------------------------------------------------------------------------------


class Here(Jobs):
    """Trains candidates in this process, which has the libraries already."""

    def run(self, jobs, on_settled=lambda job: None, on_wait=lambda jobs: None):
        for job in jobs:
            job.folder.mkdir(parents=True)
            (job.folder / HEARTBEAT_FILE).touch()
            run_job({**job.request, "mark": job.mark}, job.folder)


def test_robogen_trains_one_reward_without_the_bonus_for_success(tmp_path: Path):
    bundle = bundle_with(ANY_GRIP)
    first: dict[str, dict[str, float]] = {}
    for method in ("robogen", "v2p"):
        flags = [
            f"--reward.method={method}",
            "--reward.iterations=2",
            "--reward.without",
            "iteration",
            "samples",
        ]
        cfg = parse(EngineConfig, [*TINY, *flags], "reward").reward
        found = search_reward(bundle, cfg, tmp_path / method, seed=3, how=How(jobs=Here()))
        (candidate,) = load_candidates(tmp_path / method)
        assert found.chosen == candidate.number
        first[method] = first_batch(candidate.training_folder() / "train")

    # Both play the same episodes at first; each step of success pays one full reward.
    assert first["v2p"]["success_stochastic"] == first["robogen"]["success_stochastic"] > 0.3
    assert first["robogen"]["return"] < 2.0
    assert first["v2p"]["return"] - first["robogen"]["return"] > 0.3 * HORIZON / 2


def test_the_expert_goes_without_the_bonus_that_its_reward_went_without(tmp_path: Path):
    expert = expert_of(tmp_path, "--reward.iterations=1", "--reward.method=robogen", *TINY_EXPERT)
    save_bundle(bundle_with(ANY_GRIP), expert.inputs["task"].folder(tmp_path))

    made = make_stage(expert, Runtime(root=tmp_path))

    assert made.status == "made", made.detail
    assert first_batch(made.folder)["success_stochastic"] > 0.3
    assert first_batch(made.folder)["return"] < 2.0


def test_a_task_whose_reward_was_edited_to_a_constant_gets_no_expert_and_one_sentence(
    tmp_path: Path,
):
    expert = expert_of(tmp_path, *TINY_EXPERT)
    bundle = bundle_with(ANY_GRIP)
    edited = replace(bundle, code=with_reward(bundle.code, REWARD.format(FLAT)))
    save_bundle(edited, expert.inputs["task"].folder(tmp_path))

    made = make_stage(expert, Runtime(root=tmp_path))

    assert made.status == "rejected"
    assert "reward of task 'lift_up' (lift_up) is 5 in each of" in made.detail
    assert not list(made.folder.rglob("*.safetensors"))


def test_the_ratio_of_the_bonus_is_one_setting_for_search_and_expert(tmp_path: Path):
    searched = expert_of(tmp_path, "--reward.iterations=1", "--reward.bonus-ratio=7")
    plain = expert_of(tmp_path, "--reward.bonus-ratio=7")

    assert searched.sources == plain.sources == {"bonus ratio": "7"}
    assert searched.inputs["task"].config.config.bonus_ratio == 7


def test_only_a_missing_bonus_makes_the_expert_another_recipe(tmp_path: Path):
    methods = ("v2p", "eureka", "robogen")
    experts = [
        expert_of(tmp_path, "--reward.iterations=1", f"--reward.method={m}") for m in methods
    ]
    plain = expert_of(tmp_path)

    assert [e.sources for e in (plain, *experts)] == [{}, {}, {}, {"bonus ratio": "0"}]


def first_batch(folder: Path) -> dict[str, float]:
    return {name: float(values[0]) for name, values in read_curve(folder / "curve.csv").items()}
