import pytest

from v2p_data.errors import V2PError
from v2p_data.task.benchmark import load_benchmark
from v2p_data.task.llm.example_tasks import BASIC_EXAMPLES, GRASP_A_BLOCK
from v2p_data.task.llm.pool import add_solved, examples_for, read_pool
from v2p_data.task.llm.prompts import fault_message, rules, system_message
from v2p_data.task.sandbox.reader.check import check_code
from v2p_data.task.sandbox.reader.refusal import TaskCodeError
from v2p_data.task.task import OBJECT_STATES, ROBOT_STATES, TaskBundle

BODY = 'is_still = torch.norm(states["block_vel_linear"], dim=-1) < 0.15'


def with_line(line):
    return GRASP_A_BLOCK.replace(f"        {BODY}\n", f"        {BODY}\n        {line}\n")


@pytest.mark.parametrize(
    ("word", "line"),
    [
        ("while", "while is_still: pass"),
        ("try", "try: pass\n        finally: pass"),
        ("with", "with torch: pass"),
        ("lambda", "f = lambda x: x"),
        ("generator expression", "x = sum(i for i in [1])"),
        ("assert", "assert is_still"),
        ("raise", "raise is_still"),
        ("del", "del is_still"),
        ("global", "global scene_info"),
        (":=", "x = (y := 1)"),
        ("starred", "x = [*[1]]"),
        ("`**`", "x = 2 ** is_still"),
        ("nested functions", "def f(x): pass"),
        ("underscore", "x = is_still.__class__"),
        ("multiplied", "x = [1] * 3"),
        ("f-strings", "x = f'{is_still.shape}'"),
        ("builtins", "x = eval('1')"),
        ("torch", "x = torch.load('x')"),
        ("math", "x = math.factorial(3)"),
    ],
)
def test_what_the_rules_forbid_is_refused(word, line):
    check_code(GRASP_A_BLOCK)
    assert word in rules()

    with pytest.raises(TaskCodeError):
        check_code(with_line(line).replace("import torch\n", "import torch\nimport math\n", 1))


def test_every_state_of_every_object_is_in_the_prompt():
    content = system_message(["mug", "coaster"])["content"]

    states = [*ROBOT_STATES, *(f"{o}_{k}" for o in ("mug", "coaster") for k in OBJECT_STATES)]
    assert [s for s in states if f"| `{s}` |" not in content] == []


def test_a_fault_without_a_line_of_the_code_is_told_as_it_is():
    assert "That line" not in fault_message("it hangs", "a\nb")["content"]
    assert "That line" not in fault_message("line 3: x", "a\nb")["content"]
    assert "That line is: `b`" in fault_message("task code, line 2: x", "a\n  b")["content"]


def test_the_pool_starts_with_two_tasks_and_grows_with_every_solved_one(tmp_path):
    pool = tmp_path / "pool"
    new = load_benchmark("insert").scene
    assert examples_for(new, read_pool(pool), 2) == list(BASIC_EXAMPLES)
    assert [e.task.split(".")[0] for e in BASIC_EXAMPLES] == ["reach the block", "grasp the block"]

    for name in ("push_left", "cover", "tip_over", "insert", "slide_to"):
        add_solved(pool, load_benchmark(name), 0.8)
    shown = examples_for(new, read_pool(pool), 2)

    # Covering carries one of two things, as inserting does; sliding has two things. The task
    # itself is not its own example.
    assert [e.source for e in shown] == ["built in", "built in", "slide_to", "cover"]
    assert shown[-1].code == load_benchmark("cover").code
    assert not [p for p in pool.rglob("*") if p.suffix not in ("", ".json", ".py")]


def test_a_task_that_is_solved_better_takes_the_place_of_a_worse_one(tmp_path):
    task = load_benchmark("lift_up")

    def kept():
        return read_pool(tmp_path)[0].code

    assert add_solved(tmp_path, task, 0.3) is None
    assert read_pool(tmp_path) == []
    for code, success, best in (("a", 0.6, "a"), ("b", 0.9, "b"), ("c", 0.7, "b")):
        add_solved(tmp_path, TaskBundle(**vars(task) | {"code": code}), success)
        assert kept() == best


def test_a_pool_that_cannot_be_read_is_named(tmp_path):
    add_solved(tmp_path, load_benchmark("lift_up"), 0.9)
    (tmp_path / "lift_up" / "solved.json").write_text("{")

    with pytest.raises(V2PError, match=r"lift_up in the pool .* cannot be read"):
        read_pool(tmp_path)
