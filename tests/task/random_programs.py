"""Random task programs: real ones and escapes taken apart and put together anew, and ones grown from a grammar."""

import ast
import copy
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from escapes import CONTAINED, REFUSED, program
from harmless import ACCEPTED

SAFE_NAMES = [
    "x",
    "states",
    "actions",
    "r",
    "self",
    "Tensor",
    "len",
    "range",
    "dict",
    "list",
    "str",
    "max",
    "sorted",
]
SAFE_ATTRIBUTES = [
    "T",
    "norm",
    "clone",
    "sum",
    "shape",
    "device",
    "dtype",
    "values",
    "keys",
    "get",
    "pop",
    "update",
    "to",
    "view",
    "tolist",
    "item",
    "fill_",
    "append",
    "envs",
    "scene_info",
    "sample_object_poses",
    "urdf_assets_root",
    "type",
]
HOSTILE_NAMES = [
    "open",
    "eval",
    "exec",
    "compile",
    "__import__",
    "getattr",
    "setattr",
    "globals",
    "vars",
    "type",
    "object",
    "super",
    "torch",
    "math",
    "__builtins__",
    "print",
    "input",
    "breakpoint",
    "Task",
    "os",
    "sys",
]
HOSTILE_ATTRIBUTES = [
    "__class__",
    "__globals__",
    "__dict__",
    "__init__",
    "__subclasses__",
    "__mro__",
    "f_back",
    "gi_frame",
    "numpy",
    "tofile",
    "data",
    "storage",
    "untyped_storage",
    "load",
    "save",
    "ops",
    "hub",
    "utils",
    "system",
    "format",
    "bundle",
    "_envs",
    "register_hook",
    "data_ptr",
    "share_memory_",
    "from_file",
    "__reduce__",
]
STATES = [
    "box_pos",
    "eef_pos",
    "box_size",
    "table_height",
    "box_grasped",
    "base_observation",
    "nothing",
]


class Maker:
    """Makes programs, one after the other.

    Args:
        real: task code that works, to start from.
        path: a file that hostile programs try to open.
        rng: what to draw from.
    """

    def __init__(self, real: list[str], path: str, rng: np.random.Generator) -> None:
        self._rng = rng
        self._path = path
        escapes = [*REFUSED.values(), *(source for source, _ in CONTAINED.values())]
        self._real = _trees([*real, *ACCEPTED.values()])
        self._strange = _trees(escapes)
        self._pool: dict[bool, tuple[list[ast.expr], list[ast.stmt]]] = {
            hostile: _parts(trees)
            for hostile, trees in ((False, self._real), (True, self._strange))
        }

    def make(self) -> str:
        """Return one program; most of what it is made of is harmless, or nothing would get past the reader."""
        if self._rng.random() < 0.3:
            body = "\n".join(
                ast.unparse(self._statement(2)) for _ in range(self._rng.integers(1, 5))
            )
            return program(body, str(self._pick(["BODY", "FUNCTION", "REWARD", "INIT"])))
        trees = self._real if self._rng.random() < 0.85 else self._strange
        tree = copy.deepcopy(trees[self._rng.integers(len(trees))])
        for _ in range(self._rng.integers(1, 4)):
            self._mutate(tree)
        try:
            return ast.unparse(ast.fix_missing_locations(tree))
        except (ValueError, RecursionError):  # a tree that no text stands for
            return self.make()

    def _mutate(self, tree: ast.AST) -> None:
        """Replace one expression or insert one statement, anywhere."""
        if self._rng.random() < 0.4:
            bodies = [
                n.body for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.For | ast.If)
            ]
            if bodies:
                body = bodies[self._rng.integers(len(bodies))]
                body.insert(int(self._rng.integers(len(body) + 1)), self._statement(2))
            return
        places = [
            (node, name, k)
            for node in ast.walk(tree)
            for name, value in ast.iter_fields(node)
            for k, child in enumerate(value if isinstance(value, list) else [value])
            if isinstance(child, ast.expr)
            and isinstance(getattr(child, "ctx", ast.Load()), ast.Load)
        ]
        if not places:
            return
        node, name, k = places[self._rng.integers(len(places))]
        if isinstance(getattr(node, name), list):
            getattr(node, name)[k] = self._expression(3)
        else:
            setattr(node, name, self._expression(3))

    def _statement(self, depth: int) -> ast.stmt:
        draw = self._rng.random()
        if draw < 0.35:
            return copy.deepcopy(self._any(1))
        value = ast.unparse(self._expression(3))
        texts = [
            f"y = {value}",
            f"{value}",
            f"x[:, 0] = {value}",
            f"states['{self._pick(STATES)}'] = {value}",
            f"self.{self._pick(['kept', 'height', *HOSTILE_ATTRIBUTES])} = {value}",
            f"y += {value}",
            f"return {value}",
            f"Tensor.{self._pick(SAFE_ATTRIBUTES)} = {value}",
            f"for i in {value}:\n    y = i",
        ]
        try:
            return ast.parse(str(self._pick(texts))).body[0]
        except SyntaxError:
            return self._statement(depth - 1) if depth else ast.Pass()

    def _expression(self, depth: int) -> ast.expr:
        if depth == 0 or self._rng.random() < 0.4:
            return copy.deepcopy(self._any(0)) if self._rng.random() < 0.5 else self._atom()
        a, b = self._expression(depth - 1), self._expression(depth - 1)
        match int(self._rng.integers(7)):
            case 0:
                return ast.BinOp(
                    a,
                    self._pick(
                        [ast.Add(), ast.Mult(), ast.Pow(), ast.Mod(), ast.Div(), ast.BitOr()]
                    ),
                    b,
                )
            case 1:
                return ast.Attribute(
                    a, self._word(SAFE_ATTRIBUTES, HOSTILE_ATTRIBUTES), ast.Load()
                )
            case 2:
                return ast.Call(
                    ast.Attribute(a, self._word(SAFE_ATTRIBUTES, HOSTILE_ATTRIBUTES), ast.Load()),
                    [b],
                    [],
                )
            case 3:
                return ast.Subscript(a, b, ast.Load())
            case 4:
                return ast.Call(
                    ast.Name(self._word(SAFE_NAMES, HOSTILE_NAMES), ast.Load()), [a], []
                )
            case 5:
                return ast.ListComp(a, [ast.comprehension(ast.Name("i", ast.Store()), b, [], 0)])
            case _:
                return ast.Tuple([a, b], ast.Load())

    def _atom(self) -> ast.expr:
        match int(self._rng.integers(4)):
            case 0:
                return ast.Name(self._word(SAFE_NAMES, HOSTILE_NAMES), ast.Load())
            case 1:
                return ast.Subscript(
                    ast.Name("states", ast.Load()),
                    ast.Constant(str(self._pick(STATES))),
                    ast.Load(),
                )
            case 2:
                return ast.Constant(
                    self._pick([0, 1, -1, 0.5, 7, 999_999, self._path, "%s", True, None])
                )
            case _:
                safe, hostile = (
                    ["norm", "where", "zeros", "cat", "exp"],
                    ["load", "save", "ops", "hub"],
                )
                return ast.parse(f"torch.{self._word(safe, hostile)}", mode="eval").body

    def _any(self, kind: int) -> Any:
        parts = self._pool[bool(self._rng.random() < 0.06)][kind]
        return parts[self._rng.integers(len(parts))]

    def _word(self, safe: list[str], hostile: list[str]) -> str:
        return str(self._pick(hostile if self._rng.random() < 0.05 else safe))

    def _pick(self, things: list[Any]) -> Any:
        return things[self._rng.integers(len(things))]


def _trees(sources: list[str]) -> list[ast.Module]:
    return [tree for tree in map(_tree, sources) if tree is not None]


def _tree(source: str) -> ast.Module | None:
    try:
        tree = ast.parse(source)
        ast.unparse(tree)
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        return None
    return tree if sum(1 for _ in ast.walk(tree)) < 3_000 else None


def _parts(trees: list[ast.Module]) -> tuple[list[ast.expr], list[ast.stmt]]:
    expressions, statements = [], []
    for tree in trees:
        for node in ast.walk(tree):
            if isinstance(node, ast.expr) and isinstance(
                getattr(node, "ctx", ast.Load()), ast.Load
            ):
                expressions.append(node)
            if isinstance(
                node, ast.Assign | ast.AugAssign | ast.Expr | ast.For | ast.If | ast.Return
            ):
                statements.append(node)
    return expressions, statements
