"""Let a language model write success functions and ask how they agree with the referee: the paper's table 8 with a real model.

A server that speaks the chat-completions protocol is asked for `compute_success` alone, so that a small model on a CPU can
answer; the rest of the task code is the templates'. Each function is tried in the sandbox and audited like any task code,
and asked about the states of recorded episodes, which the referee has judged. `docs/lab/model_success.md` has the design.

    python scripts/study_model_success.py --base-url http://127.0.0.1:8123/v1 --model NAME --out outputs/model_success

Answers are kept in `OUT/calls`: a run that was stopped goes on, and asks nothing twice.
"""

import argparse
import ast
import logging
import textwrap
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from studies.referee_episodes import balanced_accuracy, held, played
from studies.results import commit, make_missing, results_to_show
from v2p_data.scene.scene import Scene
from v2p_data.seeds import rng_for, seed_for
from v2p_data.sim.env.batch_env import BatchEnv, SimConfig
from v2p_data.task.benchmark import benchmark_names, load_benchmark
from v2p_data.task.generate import CodeJudge, Sample, TaskConfig, best_acceptable
from v2p_data.task.llm.answers import code_with
from v2p_data.task.llm.client import FaultyAnswerError, VlmClient
from v2p_data.task.llm.config import VlmConfig
from v2p_data.task.llm.example_tasks import BASIC_EXAMPLES
from v2p_data.task.llm.prompts import Message, fault_message, scene_words, world_words
from v2p_data.task.templates.write import write_samples

TOLD = {"all": (True, True), "no_tracking": (False, True), "caption": (False, False)}
"""What the model is told -> whether tracked poses, and whether sizes and shapes. Pictures are never sent."""
SUCCESS = "compute_success"
logger = logging.getLogger(__name__)
WORSE = 0.05
"""A function that runs is wrong where its balanced accuracy is lower by this than the templates' (docs/lab/success.md)."""
BEGINNING = f"""\
You write the success function of a task for a robot arm with a parallel gripper in a physics simulator: the method
`{SUCCESS}(self, states)`, which returns a bool tensor (env,). It is asked at the end of an episode."""
QUESTION = f"""\
Write `{SUCCESS}` for this task. It must be true when the task was done as the words say, and false at the start, when the object
is merely touched, flung past, or pushed off the table. Take thresholds from the sizes of the objects. All states are
batches: never use `if`; combine conditions with & and |, and return the bool tensor (env,). Use only states of the table.
Answer with one block fenced by ```python and ``` that holds the function, and nothing else."""


def main() -> None:
    """Read the command line, ask and judge what is missing, print the table."""
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("--base-url", required=True)
    parser.add_argument("--model", required=True)
    parser.add_argument("--out", type=Path, default=Path("outputs/model_success"))
    parser.add_argument("--tasks", nargs="*", default=benchmark_names())
    parser.add_argument("--told", nargs="*", default=list(TOLD), choices=TOLD)
    parser.add_argument("--samples", type=int, default=4)
    parser.add_argument("--regenerations", type=int, default=1, help="of a code that does not run")
    parser.add_argument("--episodes", type=int, default=128, help="per task")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    vlm = VlmConfig(
        base_url=args.base_url, model=args.model, key_env="", temperature=0.7, max_tokens=500,
        timeout_s=1800, images=False, price_in_per_million=0, price_out_per_million=0,
    )  # fmt: skip
    make_missing(
        args.out,
        product(args.tasks, args.told),
        lambda row: (row["task"], row["told"]),
        lambda key: row_of(*key, VlmClient(vlm, args.out / "calls", args.seed), args),
        lambda row: f"{row['task']} {row['told']}: {[s['balanced'] for s in row['samples']]}",
    )
    print(table(results_to_show(args.out)))


def row_of(name: str, told: str, client: VlmClient, args: argparse.Namespace) -> dict[str, Any]:
    """Return a task's samples with what the sandbox, the audit and the referee's episodes say of each."""
    bundle = load_benchmark(name)
    template = write_samples(bundle.scene, 1)[0]
    seed = seed_for(args.seed, "task", name)
    judge = CodeJudge(bundle.scene, TaskConfig(), seed, reference=template)
    turns = _written(client, bundle.scene, told, template, judge, args)
    env = BatchEnv(
        bundle,
        SimConfig(fine=True),
        num_envs=args.episodes,
        seed=seed_for(args.seed, "bench_pick", name),
    )
    last, right = played(env, rng_for(args.seed, "bench_pick", "noise", name))

    def agreement(code: str) -> dict[str, Any] | None:
        said = held(env, code, last)
        if said is None:
            return None
        return {"balanced": balanced_accuracy(said, right), "rate": float(said.mean())}

    sound = agreement(template)
    if sound is None:
        raise SystemExit(f"error: the templates' success of {name} does not run")

    def judged(samples: tuple[Sample, ...]) -> list[dict[str, Any]]:
        return [
            {
                "runnable": s.runnable,
                "error": s.error,
                "acceptable": s.audit.is_acceptable,
                "score": s.score,
                "balanced": None,
                **((agreement(s.code) or {}) if s.runnable else {}),
            }
            for s in samples
        ]

    return {
        "task": name,
        "told": told,
        "model": client.cfg.model,
        "seed": args.seed,
        "commit": commit(),
        "episodes": args.episodes,
        "referee_rate": float(right.mean()),
        "template": sound,
        "picked": best_acceptable(turns[-1]),
        "first": judged(turns[0]),
        "samples": judged(turns[-1]),
        "seconds": round(sum(c.usage.seconds for c in client.used.values()), 1),
    }


def _written(
    client: VlmClient,
    scene: Scene,
    told: str,
    template: str,
    judge: CodeJudge,
    args: argparse.Namespace,
) -> list[tuple[Sample, ...]]:
    """Return the samples after each turn: what does not run goes back with its error, `--regenerations` times."""
    tracking, shapes = TOLD[told]
    names = [o.name for o in scene.objects]
    examples = [f"Example: {e.task}\n\n```python\n{_success(e.code)}\n```" for e in BASIC_EXAMPLES]
    system = "\n\n".join([BEGINNING, world_words(names), *examples])
    question = f"{scene_words(scene, tracking=tracking, shapes=shapes)}\n\n{QUESTION}"
    talks: list[list[Message]] = [
        [
            {"role": "system", "content": system},
            {"role": "user", "content": f"{question} (Sample {k + 1} of {args.samples}.)"},
        ]
        for k in range(args.samples)
    ]
    codes = [""] * args.samples
    turns: list[tuple[Sample, ...]] = []
    for turn in range(args.regenerations + 1):
        for k, talk in enumerate(talks):
            if turns and turns[-1][k].runnable:
                continue
            if turns:
                talk = [*talk, fault_message(turns[-1][k].error, codes[k])]
            try:
                answer, talks[k] = client.ask(
                    talk, f"success of {scene.title}, {told}, sample {k}, turn {turn}",
                    lambda text: code_with(text, f"def {SUCCESS}(", f"`{SUCCESS}`"),
                )  # fmt: skip
                codes[k] = with_success(template, answer)
            except FaultyAnswerError:
                logger.warning("%s, %s: sample %d is of no use", scene.title, told, k)
        turns.append(judge.tried(codes))
    return turns


def _success(code: str) -> str:
    (method,) = _methods(ast.parse(code))
    return textwrap.dedent("\n".join(code.split("\n")[method.lineno - 1 : method.end_lineno]))


def _methods(tree: ast.Module) -> list[ast.FunctionDef]:
    return [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name == SUCCESS]


def with_success(template: str, answer: str) -> str:
    """Return a task code with another success function, and with the functions and constants beside it.

    Code that is no Python is returned as it is, so that the sandbox says what is wrong with it.
    """
    try:
        offered = ast.parse(textwrap.dedent(answer))
    except (SyntaxError, ValueError):
        return answer
    methods = _methods(offered)
    if not methods:
        return answer
    tree = ast.parse(template)
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            node.body = [methods[0] if n.name == SUCCESS else n for n in node.body
                         if isinstance(n, ast.FunctionDef)]  # fmt: skip
    kept = (ast.FunctionDef, ast.Assign)
    tree.body += [n for n in offered.body if isinstance(n, kept) and n is not methods[0]]
    return ast.unparse(tree)


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the results as Markdown: shares of codes that are of no use, and what each way to choose comes to."""
    lines = [
        "| told | codes | first answers that do not run | do not run | run and are wrong | first that runs is wrong | audit's pick is wrong | nothing to pick "
        "| Pearson |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for told in TOLD:
        of_told = [r for r in rows if r["told"] == told]
        if not of_told:
            continue
        samples = [(r, s) for r in of_told for s in r["samples"]]
        broken = sum(s["balanced"] is None for _, s in samples)
        wrong = sum(s["balanced"] is not None and is_wrong(r, s) for r, s in samples)
        firsts = [
            (r, next((s for s in r["samples"] if s["balanced"] is not None), None))
            for r in of_told
        ]
        picks = [(r, r["samples"][r["picked"]]) for r in of_told if r["picked"] is not None]
        cells = [
            str(len(samples)), str(sum(s["balanced"] is None for r in of_told for s in r["first"])), str(broken), str(wrong),
            f"{sum(s is None or is_wrong(r, s) for r, s in firsts)} of {len(firsts)}",
            f"{sum(is_wrong(r, s) for r, s in picks)} of {len(picks)}",
            str(len(of_told) - len(picks)),
            f"{_pearson(samples):.2f}",
        ]  # fmt: skip
        lines.append(f"| {told} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def is_wrong(row: dict[str, Any], sample: dict[str, Any]) -> bool:
    """Return whether a sample agrees clearly less with the referee than the templates' function, or does not run."""
    return sample["balanced"] is None or sample["balanced"] < row["template"]["balanced"] - WORSE


def _pearson(samples: Sequence[tuple[dict[str, Any], dict[str, Any]]]) -> float:
    """Return the correlation of success rates by runnable functions and by the referee (the paper's figure 10)."""
    pairs = [(r["referee_rate"], s["rate"]) for r, s in samples if s["balanced"] is not None]
    return float(np.corrcoef(np.array(pairs).T)[0, 1]) if len(pairs) > 2 else float("nan")


if __name__ == "__main__":
    main()
