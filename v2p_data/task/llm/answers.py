"""Takes code and choices out of a model's answer, or says, in words for the model, why there is none to take."""

import ast
import json
import re

from v2p_data.task.llm.client import FaultyAnswerError
from v2p_data.task.sandbox.splice import REWARD

PARTS = (
    "reset_objects_states",
    "compute_observation_key",
    "get_observation_space",
    "compute_success",
    "compute_reward",
)
_BLOCK = re.compile(r"```[ \t]*([A-Za-z0-9_+-]*)[^\n]*\n(.*?)(?:\n[ \t]*```|\Z)", re.DOTALL)
_PYTHON = {"", "python", "py", "python3"}


def task_code_in(text: str) -> str:
    """Return the whole file in an answer.

    Raises:
        FaultyAnswerError: there is no code, or parts of the six are missing from it.
    """
    code = code_with(text, "class ", "the whole file")
    try:
        tree = ast.parse(code)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return code  # the trial run says where, and what the line is
    classes = [n for n in tree.body if isinstance(n, ast.ClassDef)]
    has = {n.name for c in classes for n in c.body if isinstance(n, ast.FunctionDef)}
    missing = [p for p in PARTS if p not in has]
    if not any(isinstance(n, ast.FunctionDef) and n.name == REWARD for n in tree.body):
        missing.append(f"{REWARD} at module level")
    if not any(
        isinstance(n, ast.Assign)
        and any(isinstance(t, ast.Name) and t.id == "scene_info" for t in n.targets)
        for n in tree.body
    ):
        missing.append("scene_info")
    if missing:
        raise FaultyAnswerError(
            f"Your code lacks {', '.join(missing)}. A task has all six parts; answer with the whole file."
        )
    return code


def reward_code_in(text: str) -> str:
    """Return the module-level code in an answer that holds `reward_function`.

    Raises:
        FaultyAnswerError: there is none.
    """
    return code_with(text, f"def {REWARD}(", f"`{REWARD}`")


def choice_in(text: str, allowed: list[int]) -> tuple[int, dict[str, str]]:
    """Return the chosen index and the reasons from the JSON at an answer's end.

    Raises:
        FaultyAnswerError: there is none, or the index is not among those allowed.
    """
    for found in reversed(list(re.finditer(r"\{", text))):
        try:
            data, _ = json.JSONDecoder().raw_decode(text[found.start() :])
        except (ValueError, RecursionError):
            continue
        if isinstance(data, dict) and "index" in data:
            index = data.pop("index")
            if isinstance(index, bool) or not isinstance(index, int) or index not in allowed:
                raise FaultyAnswerError(
                    f"Index {str(index)[:40]} is none of the codes; choose one of {', '.join(map(str, allowed))}."
                )
            return index, {str(k)[:40]: str(v)[:1000] for k, v in list(data.items())[:8]}
    raise FaultyAnswerError(
        'Your answer does not end with the line of JSON {"index": ..., "correctness": ..., "reasonability": ..., '
        '"efficiency": ...}; answer with it.'
    )


def code_with(text: str, needed: str, what: str) -> str:
    """Return the last block of an answer that holds `needed`, or the answer itself where it is nothing but code.

    Raises:
        FaultyAnswerError: there is none; `what` names it.
    """
    text = text.replace("\r\n", "\n")
    blocks = [m[2] for m in _BLOCK.finditer(text) if m[1].lower() in _PYTHON]
    whole = [b for b in blocks if needed in b]
    if whole:
        return whole[-1].strip() + "\n"
    if needed in text and not blocks and _is_python(text):
        return text.strip() + "\n"
    raise FaultyAnswerError(
        f"There is no code in your answer that holds {what}. Put it into one block fenced by ```python and ```."
    )


def _is_python(text: str) -> bool:
    try:
        ast.parse(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return False
    return True
