"""The statements of a reward function, and what its names stand for at each of them.

Comments before a statement are part of its text, so that what is kept stays byte for byte as it was written.
"""

import ast
import copy
import re
from collections.abc import Iterator
from dataclasses import dataclass
from textwrap import indent
from typing import cast, override

from v2p_data.errors import V2PError
from v2p_data.reward.code.expressions import names_in, stored_names

FUNCTION = "reward_function"
MAX_REPLACED_NODES = 20_000
"""Doubling lines (`b = a + a`) would otherwise grow without limit when names are replaced by what they stand for."""
MAX_REPLACED_DEPTH = 100
"""Python's own limit on recursion must not be what ends a long chain of lines (`b = a + 1`, `c = b + 1`, ...)."""
_INERT = {"zeros_like", "ones_like", "full_like", "zeros", "ones", "full"}
"""Calls whose value does not depend on the values of their arguments."""


class UnreadableError(V2PError):
    """A reward whose structure is not understood; the sentence says why."""


def function_of(source: str) -> ast.FunctionDef:
    """Return the reward function in some task code.

    Raises:
        UnreadableError: there is none of the usual name.
    """
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef) and node.name == FUNCTION:
            return node
    raise UnreadableError(f"it has no function '{FUNCTION}' of its own")


def rows_of(function: ast.FunctionDef) -> tuple[int, int]:
    """Return the first row of a function, decorators included, and the row after its last, from 0."""
    first = min([function.lineno, *(d.lineno for d in function.decorator_list)])
    return first - 1, function.end_lineno or function.lineno


@dataclass(frozen=True)
class Line:
    """A statement and the whole lines it takes, comments before it included."""

    node: ast.stmt
    text: str


class Body:
    """The body of the reward function in some task code; positions count its statements.

    Args:
        source: the task code.

    Raises:
        UnreadableError: it has no such function, or one that is not written line by line.
    """

    def __init__(self, source: str) -> None:
        self.source = source
        self.function = function_of(source)
        self._rows = source.splitlines(keepends=True)
        self.pad = self._indentation()
        self._header_end, self.lines = self._split()
        self._definitions: dict[str, list[tuple[int, ast.expr]]] = {}
        self._unclear: set[str] = set()
        self._read_statements()

    # -- what names stand for

    def definition(self, name: str, position: int) -> tuple[int, ast.expr] | None:
        """Return the last definition before a statement; None for names that are changed in place."""
        if name in self._unclear:
            return None
        before = [d for d in self._definitions.get(name, []) if d[0] < position]
        return before[-1] if before else None

    def definitions(self, name: str, position: int) -> list[tuple[int, ast.AST]]:
        """Return what a name was made of before a statement, changes in place included."""
        plain = [d for d in self._definitions.get(name, []) if d[0] < position]
        in_place = [
            (at, line.node)
            for at, line in enumerate(self.lines[:position])
            if not isinstance(line.node, ast.Return)
            and name in stored_names(line.node)
            and all(at != p for p, _ in plain)
        ]
        if name in self._unclear:
            return [*plain, *in_place]
        return list(plain[-1:])

    def inlined(self, expr: ast.expr, position: int) -> ast.expr:
        """Return a copy in which every name with a plain definition is replaced by it."""
        return _Inliner(self, position).replaced(expr)

    def is_set_between(self, name: str, first: int, end: int) -> bool:
        """Return whether a statement from `first` on, before `end`, sets a name or changes it in place."""
        return any(name in stored_names(line.node) for line in self.lines[first:end])

    def followed(self, expr: ast.expr, position: int) -> Iterator[tuple[int, ast.AST]]:
        """Yield the nodes of all definitions that an expression builds on, each with its statement's position."""
        seen: set[int] = set()
        ahead = self._made_of(expr, position)
        while ahead:
            at, value = ahead.pop()
            if id(value) not in seen:
                seen.add(id(value))
                yield from ((at, node) for node in ast.walk(value))
                ahead += self._made_of(value, at)

    def _made_of(self, node: ast.AST, position: int) -> list[tuple[int, ast.AST]]:
        """Return the definitions of the names in a node, the first name's last."""
        return [d for name in names_in(node) for d in self.definitions(name, position)][::-1]

    def states_of(self, expr: ast.expr, position: int) -> set[str]:
        """Return the keys of `states` that an expression's value depends on, and `actions`."""
        keys: set[str] = set()
        seen: set[int] = set()
        ahead: list[tuple[int, ast.AST]] = [(position, expr)]
        while ahead:
            at, node = ahead.pop()
            match node:
                case ast.Call(func=ast.Attribute(attr=attr)) if attr in _INERT:
                    continue
                case ast.Subscript(value=ast.Name(id="states"), slice=key):
                    keys.add(str(key.value) if isinstance(key, ast.Constant) else "?")
                    continue
                case ast.Attribute(attr="shape" | "device" | "dtype"):
                    continue
                case ast.Name(id="actions"):
                    keys.add("actions")
                case ast.Name(id=name, ctx=ast.Load()):
                    made = [d for d in self.definitions(name, at) if id(d[1]) not in seen]
                    seen |= {id(value) for _, value in made}
                    ahead += made
                case _:
                    pass
            ahead += [(at, child) for child in ast.iter_child_nodes(node)]
        return keys

    # -- text

    def lines_for(self, names: list[str], besides: str) -> list[Line]:
        """Return the statements that names need, one name left out with what it alone needs."""
        needed: set[int] = set()
        wanted, done = list(names), {besides}
        while wanted:
            name = wanted.pop()
            if name in done:
                continue
            done.add(name)
            for at, line in enumerate(self.lines):
                if name in stored_names(line.node):
                    needed.add(at)
                    wanted += names_in(line.node)
        return [line for at, line in enumerate(self.lines) if at in needed]

    def header(self, components: list[str]) -> str:
        """Return decorators, signature and docstring, with the docstring's list of components renewed."""
        text = "".join(self._rows[rows_of(self.function)[0] : self._header_end])
        listed = re.search(r"(?m)^([ \t]*)# Reward Components:\n(?:[ \t]*\d+\..*\n)+", text)
        if listed is None:
            return text
        pad = listed[1]
        names = "".join(f"{pad}{i}. {name}\n" for i, name in enumerate(components, 1))
        return (
            text[: listed.start()] + f"{pad}# Reward Components:\n{names}" + text[listed.end() :]
        )

    def code_with(self, function: str) -> str:
        """Return the whole task code with another text for the function."""
        first, end = rows_of(self.function)
        return "".join(self._rows[:first]) + function + "".join(self._rows[end:])

    def code(self) -> str:
        """Return the whole task code."""
        head = "".join(self._rows[rows_of(self.function)[0] : self._header_end])
        return self.code_with(head + "".join(line.text for line in self.lines))

    def with_statement(self, position: int, node: ast.stmt) -> "Body":
        """Return a copy with a statement's text renewed, comments before it kept; what names stand for stays."""
        old = self.lines[position]
        own_rows = (old.node.end_lineno or old.node.lineno) - old.node.lineno + 1
        comments = "".join(old.text.splitlines(keepends=True)[:-own_rows])
        text = f"{comments}{indent(ast.unparse(node), self.pad)}\n"
        other = copy.copy(self)
        other.lines = [*self.lines[:position], Line(old.node, text), *self.lines[position + 1 :]]
        return other

    # -- reading

    def _split(self) -> tuple[int, list[Line]]:
        """Return the row after the header, and the statements."""
        body = self.function.body
        if ast.get_docstring(self.function, clean=False) is not None:
            header_end = body[0].end_lineno or body[0].lineno
            body = body[1:]
        else:
            # Comments such as jit's type comment belong to the header.
            header_end = body[0].lineno - 1
        lines: list[Line] = []
        end = header_end
        for node in body:
            last = node.end_lineno or node.lineno
            if node.lineno <= end:
                raise UnreadableError(f"line {node.lineno} holds two statements")
            lines.append(Line(node, "".join(self._rows[end:last])))
            end = last
        return header_end, lines

    def _indentation(self) -> str:
        first = self.function.body[0]
        before = self._rows[first.lineno - 1].encode()[: first.col_offset].decode()
        if before.strip():
            raise UnreadableError("its body begins on the line of its name")
        return before

    def _read_statements(self) -> None:
        for position, line in enumerate(self.lines):
            match line.node:
                case (
                    ast.Assign(targets=[ast.Name(id=name)], value=value)
                    | ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value)
                ):
                    self._definitions.setdefault(name, []).append((position, value))
                case ast.AugAssign(target=ast.Name(id=name), op=op, value=value) if (
                    self.definition(name, position) is not None
                ):
                    self._definitions[name].append(
                        (position, ast.BinOp(ast.Name(name, ast.Load()), op, value))
                    )
                case ast.Return():
                    if position != len(self.lines) - 1:
                        raise UnreadableError("it returns from the middle")
                case _:
                    self._unclear |= stored_names(line.node)


class Replacer(ast.NodeTransformer):
    """Replaces nodes by what they stand for, and gives up before that outgrows what can be read."""

    def __init__(self) -> None:
        self.count = self.depth = 0

    def replaced[N: (ast.expr, ast.stmt)](self, node: N) -> N:
        """Return a copy of an expression or statement with everything in it replaced.

        Raises:
            UnreadableError: it grows too large.
        """
        return cast(N, self.visit(copy.deepcopy(node)))

    @override
    def visit(self, node: ast.AST) -> ast.AST:
        self.count += 1
        if self.count > MAX_REPLACED_NODES:
            raise UnreadableError("its lines build on each other too often")
        if self.depth == MAX_REPLACED_DEPTH:
            raise UnreadableError("too many of its lines build on each other")
        self.depth += 1
        result = super().visit(node)
        self.depth -= 1
        return result


class _Inliner(Replacer):
    """Replaces names by their definitions."""

    def __init__(self, body: Body, position: int) -> None:
        super().__init__()
        self.body, self.position = body, position

    def visit_Name(self, node: ast.Name) -> ast.AST:
        made = self.body.definition(node.id, self.position)
        if made is None or not isinstance(node.ctx, ast.Load):
            return node
        before, self.position = self.position, made[0]
        result = self.visit(copy.deepcopy(made[1]))
        self.position = before
        return result
