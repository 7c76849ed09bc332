import json
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from v2p_data.task.audit.audit import Audit, Check
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.generate import TaskConfig, generate_task
from v2p_data.task.llm.client import BudgetError, UnusableAnswersError, VlmClient
from v2p_data.task.llm.example_refinements import REFINEMENTS
from v2p_data.task.llm.example_tasks import GRASP_A_BLOCK, REACH_A_BLOCK, block_scene
from v2p_data.task.llm.pool import add_solved, examples_for
from v2p_data.task.llm.writer import ModelWriter, pick_sample, write_samples
from v2p_data.task.sandbox.smoke import SmokeResult
from v2p_data.task.sandbox.splice import rest_part, reward_part, reward_source
from v2p_data.task.task import TaskBundle
from v2p_data.task.templates.write import write_samples as write_by_template

pytestmark = pytest.mark.slow

WRONG_LINE = "distance = torch.nrom(states['block_pos'] - states['eef_pos'], dim=-1)"
CHOICE = {"index": 2, "correctness": "held and raised", "reasonability": "r", "efficiency": "e"}


def fenced(code):
    return f"First I think.\n\n```python\n{code}\n```"


def text_of(request):
    """Return all words of a request, one string per message."""
    said = []
    for message in request["messages"]:
        content = message["content"]
        said.append(
            content if isinstance(content, str) else " ".join(p.get("text", "") for p in content)
        )
    return said


def lifting_scene():
    return replace(
        block_scene(), kind="lift_up", description="lift up the block", title="lift_block"
    )


@pytest.fixture(scope="module")
def written(serve, settings, say, tmp_path_factory):
    """A task written by a model that errs: one sample calls what does not exist, one succeeds too early, and its first
    choice is no sample at all."""
    folder = tmp_path_factory.mktemp("task")
    scene_folder = folder / "scene"
    scene_folder.mkdir()
    lifting_scene().save(scene_folder)
    scene = type(block_scene()).load(scene_folder)
    (template,) = write_by_template(scene, 1)
    server = serve()

    def answer(request):
        said = text_of(request)
        if "Compare the codes" in said[0]:
            wrong = json.dumps(CHOICE | {"index": 7})
            return say(wrong if len(said) == 1 else f"Code 2 it is.\n{json.dumps(CHOICE)}")
        if "This is sample 1 of 3" in said[1]:
            return say(fenced(REACH_A_BLOCK))
        if "This is sample 2 of 3" in said[1]:
            fixed = "This code does not run" in said[-1]
            right = 'distance = torch.norm(states["block_pos"] - states["eef_pos"], dim=-1)'
            return say(
                fenced(GRASP_A_BLOCK if fixed else GRASP_A_BLOCK.replace(right, WRONG_LINE))
            )
        return say(fenced(template))

    server.otherwise = answer
    cfg = TaskConfig(writer="vlm", num_samples=3, vlm=settings(server, max_tokens=4000))
    made = generate_task(scene, cfg, 5, calls=folder / "calls")
    made.save(folder / "task")
    return SimpleNamespace(
        server=server,
        scene=scene,
        cfg=cfg,
        made=made,
        folder=folder,
        audit=json.loads((folder / "task" / "audit.json").read_text()),
    )


def test_samples_that_do_not_run_go_back_with_their_error_and_line_until_they_run(written):
    asked = [r for r in written.server.requests if "sample 2 of 3" in " ".join(text_of(r)[:2])]

    assert [s.runnable for s in written.made.first] == [True, False, True]
    assert [s.runnable for s in written.made.samples] == [True, True, True]
    assert len(asked) == 2
    assert "nrom" in text_of(asked[1])[-1]
    assert f"That line is: `{WRONG_LINE}`" in text_of(asked[1])[-1]
    assert [m["role"] for m in asked[1]["messages"]] == ["system", "user", "assistant", "user"]


def test_the_two_basic_examples_run_in_the_sandbox(written):
    assert written.made.samples[0].code == REACH_A_BLOCK
    assert written.made.samples[1].code == GRASP_A_BLOCK
    assert written.made.samples[0].runnable
    assert written.made.samples[1].runnable


def test_the_model_chooses_with_the_audit_before_it_among_what_the_audit_accepts(written):
    first, second = [r for r in written.server.requests if "Compare the codes" in text_of(r)[0]]

    question = text_of(first)[0]
    assert "## Code 0" not in question  # reaching is true at the video's first pose
    assert "## Code 1" in question
    assert "| false when it flies past? | yes |" in question
    assert "Index 7 is none of the codes; choose one of 1, 2" in text_of(second)[-1]
    assert written.made.picked == written.audit["picked"] == 2
    assert written.audit["pick"]["by"] == "vlm"
    assert written.audit["pick"]["reasons"]["correctness"] == "held and raised"
    # Code 1 asks for 3 cm, which is less than a third of the way.
    assert written.audit["pick"]["audits_pick"] == 2
    assert TaskBundle.load(written.folder / "task").code == written.made.samples[2].code


def test_useless_samples_are_counted_before_and_after_sending_back(written):
    rates = written.audit["rates"]

    assert rates["first_answers"] == {
        "samples": 3,
        "non_runnable": 0.3333,
        "zero_score": 0.3333,
        "hallucination": 0.6667,
    }
    assert (rates["before_pick"]["non_runnable"], rates["before_pick"]["zero_score"]) == (
        0,
        0.3333,
    )
    assert written.audit["writer"] == "vlm"
    assert written.audit["codes_asked_for"] == 4
    assert written.audit["spent"]["calls"] == len(written.server.requests) == 6


def test_the_scene_is_told_in_words_and_numbers(written):
    system, question = text_of(written.server.requests[0])[:2]

    assert "| `block_grasped` | (env,) | 0 or 1 |" in system
    assert "class GraspABlock(Task):" in system
    assert '"lift up the block"' in question
    assert "| `block` | block | manipulated | box | 0.050, 0.050, 0.050 | 0.10 |" in question
    assert "| `block` | 4 | 0.000, 0.000, 0.125 | 1.000, 0.000, 0.000, 0.000 |" in question
    assert (
        "| `block` | difference | 0.000, 0.000, 0.100, 0.100 in all | turned by 0 degrees"
        in question
    )


def test_everything_that_was_said_is_kept_and_can_be_said_again(written, settings):
    written.server.close()
    kept = written.folder / "calls"
    assert len(list(kept.glob("*.json"))) == 6
    nobody = SimpleNamespace(url="http://127.0.0.1:9/v1")
    client = VlmClient(
        settings(nobody, max_tokens=4000, mode="replay", calls=kept), written.folder / "none", 5
    )

    def known(codes):
        return [
            SmokeResult(runnable="nrom" not in c, error="" if "nrom" not in c else broken.error)
            for c in codes
        ]

    broken = written.made.first[1]
    again = write_samples(
        client, written.scene, 3, examples_for(written.scene, [], 2), known, no_objection
    )
    pick = pick_sample(
        client, written.scene, [(s.code, s.audit) for s in written.made.samples], audits_pick=1
    )

    assert [c for c, _ in again.final] == [s.code for s in written.made.samples]
    assert again.answers == 4
    assert (pick.index, pick.by) == (2, "vlm")


# --- the pick ------------------------------------------------------------------------------------------------

GOOD = Audit(
    checks=(Check(name="n", asks="good?", passed=True, share=0.0, weight=1.0),), score=0.9
)
VETOED = replace(GOOD, vetoed="its success is always true")


def test_a_choice_that_cannot_be_used_falls_back_on_the_audit_and_says_so(chat, client, say):
    chat.otherwise = say('{"index": 0, "correctness": "I like it"}')

    pick = pick_sample(
        client(), lifting_scene(), [("a", VETOED), ("b", GOOD), ("c", GOOD)], audits_pick=2
    )

    assert (pick.index, pick.by) == (2, "audit")
    assert "no usable choice" in pick.reasons["why"]
    assert "Index 0 is none of the codes" in pick.reasons["why"]
    assert len(chat.requests) == 3


@pytest.mark.parametrize(
    "words", ["I take the second.", "{'index': 1}", '{"index": true}', '{"index": "1"}']
)
def test_a_choice_must_be_json_with_a_number(words, chat, client, say):
    chat.otherwise = say(words)

    pick = pick_sample(client(), lifting_scene(), [("a", GOOD), ("b", GOOD)], audits_pick=0)

    assert (pick.index, pick.by) == (0, "audit")


def test_nothing_is_asked_where_there_is_nothing_to_choose(chat, client):
    alone = pick_sample(client(), lifting_scene(), [("a", VETOED), ("b", GOOD)], audits_pick=1)
    ours = pick_sample(
        client(pick="audit"), lifting_scene(), [("a", GOOD), ("b", GOOD)], audits_pick=1
    )

    assert (alone.index, alone.by) == (ours.index, ours.by) == (1, "audit")
    assert chat.requests == []


# --- writing -------------------------------------------------------------------------------------------------


def runs(codes):
    return [SmokeResult(runnable=True) for _ in codes]


def no_objection(written):
    return [""] * len(written)


def never_runs(codes):
    return [SmokeResult(runnable=False, error="line 2: it hangs") for _ in codes]


@pytest.mark.parametrize(
    ("bad", "told"),
    [
        ("Here is how I would do it.", "There is no code in your answer"),
        ("```json\n{}\n```", "There is no code in your answer"),
        (fenced(GRASP_A_BLOCK.replace("compute_success", "success")), "lacks compute_success"),
        (fenced(GRASP_A_BLOCK.split("# REWARD")[0]), "lacks reward_function at module level"),
    ],
)
def test_an_answer_without_all_six_parts_is_asked_for_again(bad, told, chat, client, say):
    chat.script = [say(bad), say(fenced(GRASP_A_BLOCK))]

    made = write_samples(client(), lifting_scene(), 1, [], runs, no_objection)

    assert made.final[0][0] == GRASP_A_BLOCK
    assert told in text_of(chat.requests[1])[-1]


def test_sending_back_has_an_end(chat, client, say):
    chat.otherwise = say(fenced(GRASP_A_BLOCK))

    made = write_samples(
        client(max_regenerations=2), lifting_scene(), 2, [], never_runs, no_objection
    )

    assert made.answers == len(chat.requests) == 6
    assert not any(r.runnable for _, r in made.final)


@pytest.mark.parametrize(
    ("faults", "asked"), [(["too early", "too late"], 4), (["too early", ""], 2)]
)
def test_where_the_audit_accepts_none_all_go_back_once_with_its_table(
    faults, asked, chat, client, say
):
    chat.otherwise = say(fenced(GRASP_A_BLOCK))

    made = write_samples(client(), lifting_scene(), 2, [], runs, lambda written: faults)

    assert made.answers == len(chat.requests) == asked
    last = [text_of(r)[-1] for r in chat.requests[2:]]
    assert sorted(f for f in ("too early", "too late") if any(f in t for t in last)) == (
        sorted(faults) if asked == 4 else []
    )


def test_a_budget_ends_the_writing(chat, client, say):
    chat.otherwise = say(fenced(GRASP_A_BLOCK))

    with pytest.raises(BudgetError, match="max-total-tokens"):
        write_samples(
            client(max_total_tokens=3000, parallel=1), lifting_scene(), 8, [], runs, no_objection
        )

    assert len(chat.requests) == 2


def test_without_visual_information_only_the_caption_and_the_objects_are_told(chat, client, say):
    chat.otherwise = say(fenced(GRASP_A_BLOCK))

    write_samples(client(tracking=False, images=False), lifting_scene(), 1, [], runs, no_objection)

    question = text_of(chat.requests[0])[1]
    assert "lift up the block" in question
    assert "| `block` | block | manipulated |" in question
    # Its size, shape and mass, its motion, and how far an audit says that it went.
    for told in ("0.05", "box", "0.10", "Tracked poses", "0.100", "audit"):
        assert told not in question, told
    assert "image_url" not in json.dumps(chat.requests)


def test_without_visual_information_the_audit_that_knows_the_video_is_not_told_of_either(
    chat, client, say
):
    chat.script = [
        say(fenced(GRASP_A_BLOCK)),
        say(fenced(GRASP_A_BLOCK)),
        say(json.dumps(CHOICE | {"index": 1})),
    ]
    blind = client(tracking=False, images=False)

    write_samples(blind, lifting_scene(), 2, [], runs, lambda written: ["it went 0.1 m"] * 2)
    pick = pick_sample(blind, lifting_scene(), [("a", GOOD), ("b", GOOD)], audits_pick=0)

    assert len(chat.requests) == 3
    (question,) = text_of(chat.requests[2])
    assert (pick.index, pick.by) == (1, "vlm")
    for told in ("Audit: score", "the table of an audit", "0.05", "box", "Tracked poses"):
        assert told not in question, told


def test_a_model_without_eyes_is_still_told_sizes_and_poses(chat, client, say):
    chat.otherwise = say(fenced(GRASP_A_BLOCK))

    write_samples(client(images=False), lifting_scene(), 1, [], runs, no_objection)

    question = text_of(chat.requests[0])[1]
    assert "| `block` | block | manipulated | box | 0.050, 0.050, 0.050 | 0.10 |" in question
    assert "Tracked poses" in question


# --- rewards -------------------------------------------------------------------------------------------------


def a_reward(body):
    return f"Thoughts.\n```python\ndef reward_function(actions, states):\n    r = {body}\n    return r, {{'r': r}}\n```"


def test_better_rewards_come_as_whole_tasks_that_run_and_whose_success_is_the_parents(
    chat, client, say
):
    def answer(request):
        said = text_of(request)
        if "sample 1 of 2" in said[1]:
            return say(a_reward("states['block_pos'][:, 2]"))
        if "without a" not in said[-1] and len(said) == 2:
            return say(fenced(GRASP_A_BLOCK))  # the parent's own reward
        return say(a_reward("-torch.norm(states['block_pos'] - states['eef_pos'], dim=-1)"))

    chat.otherwise = answer

    made = ModelWriter(client=client()).better_rewards(
        lifting_task(), GRASP_A_BLOCK, "raise: 0.00 in all episodes", 2, 1
    )

    assert len(made) == len({reward_part(c) for c in [*made, GRASP_A_BLOCK]}) - 1 == 2
    assert all(rest_part(c) == rest_part(GRASP_A_BLOCK) for c in made)
    asked = [text_of(r) for r in chat.requests]
    assert all("raise: 0.00 in all episodes" in a[1] for a in asked)
    assert [a[-1] for a in asked if len(a) > 2] == [
        "This is the reward that was there before. Write another one."
    ]


def lifting_task(scene=None):
    return TaskBundle(
        title="lift",
        description="lift up the block",
        kind="lift_up",
        class_name="GraspABlock",
        code=GRASP_A_BLOCK,
        scene=scene or lifting_scene(),
    )


def test_questions_for_rewards_show_the_scene_its_pictures_a_refinement_and_rewards_of_solved_tasks(
    chat, client, say, tmp_path
):
    chat.otherwise = say(a_reward("states['block_pos'][:, 2]"))
    solved = load_benchmark("push_left")
    add_solved(tmp_path / "pool", solved, 0.9)
    folder = tmp_path / "scene"
    folder.mkdir()
    lifting_scene().save(folder)
    cv2.imwrite(str(folder / "frame_first.jpg"), np.zeros((8, 8, 3), np.uint8))
    task = lifting_task(type(block_scene()).load(folder))
    writer = ModelWriter(client=client(), pools=(tmp_path / "pool",))

    writer.first_rewards(task, 1)
    writer.better_rewards(task, GRASP_A_BLOCK, "raise: 0.00 in all episodes", 1, 1)

    for request in chat.requests:
        system, question = text_of(request)[:2]
        assert f"Example 3: {solved.description}" in system
        assert reward_source(solved.code) in system
        assert "def compute_success" not in system.partition("Example 1")[2]
        (refined,) = REFINEMENTS
        assert all(
            part.strip() in system for part in (refined.before, refined.seen, refined.after)
        )
        assert "Tracked poses" in question
        assert "the first frame of the video" in question
        assert any("image_url" in part for part in request["messages"][1]["content"])
    assert "raise: 0.00 in all episodes" in text_of(chat.requests[1])[1]


def test_a_later_round_gets_new_rewards_where_the_best_one_is_still_the_same(chat, client, say):
    chat.otherwise = say(a_reward("states['block_pos'][:, 2]"))
    writer = ModelWriter(client=client())

    for iteration in (1, 1, 2):
        writer.better_rewards(lifting_task(), GRASP_A_BLOCK, "raise: 0.00", 1, iteration)

    assert len(chat.requests) == 2


def test_a_model_without_a_usable_answer_is_named_with_its_fault(chat, client, say):
    chat.otherwise = say("I would rather not.")
    writer = ModelWriter(client=client(max_regenerations=0, max_reasks=0))

    with pytest.raises(
        UnusableAnswersError, match=r"no first reward for 'lift' could be used; .*no code"
    ):
        writer.first_rewards(lifting_task(), 2)
