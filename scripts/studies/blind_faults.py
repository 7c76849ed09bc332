"""Realistic mistakes to plant in a success function, written without knowing what judges them.

Each operator takes the syntax tree of one `compute_success` and makes, in one place drawn by the
generator, a mistake that a language model makes when it writes such a function: the code still runs
and gives one truth value per environment, but asks for something else than the task does. An operator
that finds no place returns False and leaves the tree as it was.
"""

import ast
from collections.abc import Callable, Iterator

import numpy as np


def _do_one(changes: list[Callable[[], None]], rng: np.random.Generator) -> bool:
    if changes:
        changes[int(rng.integers(len(changes)))]()
    return bool(changes)


def _put(body: ast.FunctionDef, old: ast.AST, source: str) -> None:
    new = ast.parse(source).body[0]
    new = new.value if isinstance(new, ast.Expr) else new
    for parent in list(ast.walk(body)):
        for field, value in ast.iter_fields(parent):
            items = [
                new if item is old else item
                for item in (value if isinstance(value, list) else [value])
            ]
            setattr(parent, field, items if isinstance(value, list) else items[0])


def _words(node: ast.AST) -> set[str]:
    return {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}


def _rename(node: ast.AST, new: dict[str, str]) -> None:
    for name in (n for n in ast.walk(node) if isinstance(n, ast.Name)):
        name.id = new.get(name.id, name.id)


def _computed(body: ast.FunctionDef) -> Iterator[tuple[ast.expr, set[str], set[str]]]:
    """The right side of each computed `name = ...`, the states it reads, and all states taken so far."""
    known: set[str] = set()
    for line in body.body:
        if isinstance(line, ast.Assign) and isinstance(line.targets[0], ast.Name):
            if _words(line.value) == {"states"}:
                known.add(line.targets[0].id)
            elif "clone" not in ast.unparse(line.value):
                yield line.value, _words(line.value) & known, set(known)


def compares_the_wrong_moment(body: ast.FunctionDef, rng: np.random.Generator) -> bool:
    """Takes a place for a shift (forgets to subtract the start), or the present where the start is meant."""
    changes: list[Callable[[], None]] = []
    for node in ast.walk(body):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub):
            starts = {word for word in _words(node.right) if word.endswith("_start")}
            if _words(node.left) & {word.replace("_start", "_pos") for word in starts}:
                changes.append(lambda n=node: _put(body, n, ast.unparse(n.left)))
    for value, words, known in _computed(body):
        for word in sorted(words):
            if (now := word.replace("_start", "_pos")) in known - words:
                changes.append(lambda v=value, m={word: now}: _rename(v, m))
    return _do_one(changes, rng)


def confuses_and_with_or(body: ast.FunctionDef, rng: np.random.Generator) -> bool:
    """One of two conditions is enough where both are meant, or the other way round."""
    joins = [
        n
        for n in ast.walk(body)
        if isinstance(n, ast.BinOp) and isinstance(n.op, ast.BitAnd | ast.BitOr)
    ]
    other = {ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd}
    return _do_one([lambda n=n: setattr(n, "op", other[type(n.op)]()) for n in joins], rng)


def takes_the_wrong_axis(body: ast.FunctionDef, rng: np.random.Generator) -> bool:
    """Mixes up forward and sideways, or thinks that y points up (so the ground is x and z)."""
    swaps = {"[:, 2]": "[:, 1]", "[:, 1]": "[:, 0]", "[:, 0]": "[:, 1]", "[:, :2]": "[:, [0, 2]]"}
    swaps |= {"[0.0, 1.0,": "[1.0, 0.0,", "[0.0, -1.0,": "[-1.0, 0.0,", "[1.0, 0.0,": "[0.0, 1.0,"}
    lines = [
        (line, ast.unparse(line)) for line in body.body if "ones_like" not in ast.unparse(line)
    ]
    made = [
        (line, t.replace(a, b))
        for line, t in lines
        for a, b in swaps.items()
        if a in t and b not in t
    ]
    return _do_one([lambda n=line, t=text: _put(body, n, t) for line, text in made], rng)


def misjudges_the_extent(body: ast.FunctionDef, rng: np.random.Generator) -> bool:
    """Measures from the centre instead of the surface, or takes the whole size for half of it."""
    changes: list[Callable[[], None]] = []
    for node in ast.walk(body):
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add | ast.Sub | ast.Div):
            words = " ".join(_words(node.left if isinstance(node.op, ast.Div) else node.right))
            if ("half" in words or "_size" in words) and "_pos" not in words:
                changes.append(lambda n=node: _put(body, n, ast.unparse(n.left)))
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "lowest_point":
            changes.append(lambda n=node: _put(body, n, f"{ast.unparse(n.args[0])}[:, 2]"))
    return _do_one(changes, rng)


def measures_the_wrong_thing(body: ast.FunctionDef, rng: np.random.Generator) -> bool:
    """Checks the other object, or the gripper in place of the object it carries."""
    changes: list[Callable[[], None]] = []
    for value, words, known in _computed(body):
        for mine, other in (("obj_", "ref_"), ("ref_", "obj_"), ("obj_pos", "eef_pos")):
            new = {w: w.replace(mine, other) for w in words if w.startswith(mine)}
            if new and set(new.values()) <= known - words:
                changes.append(lambda v=value, m=new: _rename(v, m))
    return _do_one(changes, rng)


def slips_the_decimal_point(body: ast.FunctionDef, rng: np.random.Generator) -> bool:
    """One length or speed limit is ten times too loose or too tight."""
    compared = [n.comparators[0] for n in ast.walk(body) if isinstance(n, ast.Compare)]
    limits = [
        n for c in compared if isinstance(n := getattr(c, "operand", c), ast.Constant)
    ]  # past a minus sign
    both = [
        (n, f) for n in limits if 0 < n.value <= 0.25 for f in (0.1, 10.0)
    ]  # above: cosines and flags
    return _do_one(
        [lambda n=n, f=f: setattr(n, "value", round(n.value * f, 6)) for n, f in both], rng
    )


WRONG_BLIND: tuple[Callable[[ast.FunctionDef, np.random.Generator], bool], ...] = (
    compares_the_wrong_moment,
    confuses_and_with_or,
    takes_the_wrong_axis,
    misjudges_the_extent,
    measures_the_wrong_thing,
    slips_the_decimal_point,
)
