"""Faults that a writer of success functions makes, as changes of the syntax tree: for `scripts/study_success.py`.

An operator changes the body of `compute_success` and tells whether it found a place to. `NOT_RUNNABLE` stops the code from running,
`WRONG` lets it run and mean something else. Operators of `blind_faults` were written by somebody who has read neither the audit
nor this file.
"""

import ast
from collections.abc import Callable, Sequence

import numpy as np

Operator = Callable[[ast.FunctionDef, np.random.Generator], bool]


def with_fault(
    code: str, operators: Sequence[Operator], rng: np.random.Generator
) -> tuple[str, str] | None:
    """Return the code with one fault and the operator's name, None where no operator finds a place."""
    for k in rng.permutation(len(operators)):
        tree = ast.parse(code)
        success = next(
            node
            for node in ast.walk(tree)
            if isinstance(node, ast.FunctionDef) and node.name == "compute_success"
        )
        if operators[k](success, rng):
            return ast.unparse(ast.fix_missing_locations(tree)), operators[k].__name__
    return None


def _one[T](nodes: list[T], rng: np.random.Generator) -> T | None:
    return nodes[int(rng.integers(len(nodes)))] if nodes else None


def _state_names(body: ast.FunctionDef) -> list[ast.Constant]:
    return [
        node.slice
        for node in ast.walk(body)
        if isinstance(node, ast.Subscript)
        and isinstance(node.value, ast.Name)
        and node.value.id == "states"
        and isinstance(node.slice, ast.Constant)
    ]


def _comparisons(body: ast.FunctionDef) -> list[ast.Compare]:
    return [node for node in ast.walk(body) if isinstance(node, ast.Compare)]


def _returned(body: ast.FunctionDef) -> ast.Return:
    return next(node for node in ast.walk(body) if isinstance(node, ast.Return))


# --- does not run


def unknown_state(body: ast.FunctionDef, rng: np.random.Generator) -> bool:
    name = _one(_state_names(body), rng)
    if name is not None:
        name.value = f"{name.value}_m"
    return name is not None


def wrong_dimension(body: ast.FunctionDef, rng: np.random.Generator) -> bool:
    dims = [
        word for node in ast.walk(body) if isinstance(node, ast.Call) for word in node.keywords
        if word.arg == "dim"
    ]  # fmt: skip
    dim = _one(dims, rng)
    if dim is not None:
        dim.value = ast.Constant(3)
    return dim is not None


def if_on_a_tensor(body: ast.FunctionDef, rng: np.random.Generator) -> bool:
    del rng
    last = _returned(body)
    assert last.value is not None
    branch = ast.If(test=last.value, body=[ast.Return(last.value)], orelse=[])
    body.body.insert(body.body.index(last), branch)
    return True


def undefined_name(body: ast.FunctionDef, rng: np.random.Generator) -> bool:
    del rng
    last = _returned(body)
    assert last.value is not None
    last.value = ast.BinOp(last.value, ast.BitAnd(), ast.Name("is_stable", ast.Load()))
    return True


# --- runs and is wrong


def turned_comparison(body: ast.FunctionDef, rng: np.random.Generator) -> bool:
    found = _one(_comparisons(body), rng)
    if found is not None:
        found.ops = [ast.Lt() if isinstance(found.ops[0], ast.Gt | ast.GtE) else ast.Gt()]
    return found is not None


def other_threshold(body: ast.FunctionDef, rng: np.random.Generator) -> bool:
    numbers = [
        each for node in _comparisons(body) for each in node.comparators
        if isinstance(each, ast.Constant) and isinstance(each.value, float)
    ]  # fmt: skip
    number = _one(numbers, rng)
    if number is not None:
        assert isinstance(number.value, float)
        number.value *= float(rng.choice([0.5, 2.0]))
    return number is not None


def condition_left_out(body: ast.FunctionDef, rng: np.random.Generator) -> bool:
    last = _returned(body)
    parts: list[ast.expr] = []
    rest = last.value
    while isinstance(rest, ast.BinOp) and isinstance(rest.op, ast.BitAnd):
        parts.insert(0, rest.right)
        rest = rest.left
    assert rest is not None
    parts.insert(0, rest)
    if len(parts) < 2:
        return False
    parts.pop(int(rng.integers(len(parts))))
    value = parts[0]
    for part in parts[1:]:
        value = ast.BinOp(value, ast.BitAnd(), part)
    last.value = value
    return True


def other_object(body: ast.FunctionDef, rng: np.random.Generator) -> bool:
    del rng
    names = _state_names(body)
    objects = sorted({str(n.value).removesuffix("_pos") for n in names if str(n.value).endswith("_pos")})  # fmt: skip
    objects = [o for o in objects if o != "eef" and not o.endswith("_start")]
    if len(objects) < 2:
        return False
    one, other = objects[:2]
    for name in names:
        word = str(name.value)
        if word.startswith(one):
            name.value = other + word.removeprefix(one)
        elif word.startswith(other):
            name.value = one + word.removeprefix(other)
    return True


def absolute_for_relative(body: ast.FunctionDef, rng: np.random.Generator) -> bool:
    differences = [
        node for node in ast.walk(body)
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub) and "start" in ast.unparse(node.right)
    ]  # fmt: skip
    difference = _one(differences, rng)
    if difference is not None:
        difference.op = ast.Add()
        difference.right = ast.BinOp(difference.right, ast.Mult(), ast.Constant(0.0))
    return difference is not None


def over_all_worlds(body: ast.FunctionDef, rng: np.random.Generator) -> bool:
    del rng
    last = _returned(body)
    assert last.value is not None
    text = ast.unparse(last.value)
    last.value = ast.parse(f"({text}) | (({text}).float().mean() > 0.5)", mode="eval").body
    return True


NOT_RUNNABLE: tuple[Operator, ...] = (
    unknown_state,
    wrong_dimension,
    if_on_a_tensor,
    undefined_name,
)
WRONG: tuple[Operator, ...] = (
    turned_comparison,
    other_threshold,
    condition_left_out,
    other_object,
    absolute_for_relative,
    over_all_worlds,
)
