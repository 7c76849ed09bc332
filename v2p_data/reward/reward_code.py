"""Takes the reward of some task code apart and puts it together again; the rest stays byte for byte as it is.

What is understood is a `reward_function` that computes, line by line, a total and a dict of named components. The
total is followed to its summands and each is matched with a component, so `parts` are what is really paid: `total =
scale * (part + part + ...)`. Lines that parts need are kept as they were written, comments included; only the
end of the function is laid out anew.
"""

import ast
import copy
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from v2p_data.errors import V2PError

FUNCTION = "reward_function"
MAX_INLINED_NODES = 20_000
"""Doubling lines (`b = a + a`) would otherwise grow without limit when names are replaced by what they stand for."""
_INERT = {"zeros_like", "ones_like", "full_like", "zeros", "ones", "full"}
"""Calls whose value does not depend on the values of their arguments."""


class UnreadableError(V2PError):
    """A reward whose structure is not understood; the sentence says why."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """One summand of the total."""

    name: str
    text: str
    """Its expression, weight included."""
    position: int
    """Where it stood in the function; names mean what they meant there."""
    is_paid: bool = True
    """Otherwise it is logged only."""
    note: str = ""
    """Why it was changed; becomes a comment."""

    @property
    def expr(self) -> ast.expr:
        """Its expression, parsed."""
        return ast.parse(self.text.strip(), mode="eval").body

    @property
    def weight(self) -> float:
        """The constant in front of its expression."""
        return split_constant(self.expr)[0]


@dataclass(frozen=True)
class _Line:
    """A statement and the whole lines it takes, comments before it included."""

    node: ast.stmt
    text: str


class Reward:
    """The reward of some task code, taken apart.

    Args:
        source: the task code.

    Raises:
        UnreadableError: its structure is not understood.
    """

    def __init__(self, source: str) -> None:
        self.source = source
        self.function = function_of(source)
        self._rows = source.splitlines(keepends=True)
        self._split_lines()
        self._definitions: dict[str, list[tuple[int, ast.expr]]] = {}
        self._unclear: set[str] = set()
        self._read_statements()
        total, holder = self._returned()
        self.dict_name = holder.id if isinstance(holder, ast.Name) else "reward_components"
        self._found = self._found_components(holder)
        if not self._found:
            raise UnreadableError("no component of the reward has a plain name")
        self.scale, self.parts = self._take_apart(total)

    # -- what it says

    def part(self, name: str) -> Part | None:
        """Return a part by its name."""
        return next((p for p in self.parts if p.name == name), None)

    def written(self, part: Part) -> Iterator[tuple[int, ast.AST]]:
        """Yield what a part is made of, definitions followed, each node with the statement it stands in.

        The statement is -1 for nodes of the part's own text.
        """
        for node in ast.walk(part.expr):
            yield -1, node
        yield from self._defined(part.expr, part.position, set())

    def states_of(self, part: Part) -> set[str]:
        """Return the keys of `states` that a part's value depends on, and `actions`."""
        keys: set[str] = set()
        self._collect_states(part.expr, part.position, keys, set())
        return keys

    def inlined(self, expr: ast.expr, position: int) -> ast.expr:
        """Return a copy in which every name with a plain definition is replaced by it."""
        result = _Inliner(self, position).visit(copy.deepcopy(expr))
        assert isinstance(result, ast.expr)
        return result

    def definition(self, name: str, position: int) -> tuple[int, ast.expr] | None:
        """Return the last definition before a statement; None for names that are changed in place."""
        if name in self._unclear:
            return None
        before = [d for d in self._definitions.get(name, []) if d[0] < position]
        return before[-1] if before else None

    # -- changes

    def scaled(self, name: str, factor: float, note: str) -> "Reward":
        """Return it with one part multiplied."""
        return self._changed(name, lambda p: replace(p, text=times(p.text, factor), note=note))

    def rewritten(self, name: str, text: str, note: str) -> "Reward":
        """Return it with another expression for one part."""
        return self._changed(name, lambda p: replace(p, text=text, note=note))

    def without(self, name: str) -> "Reward":
        """Return it without one part.

        Raises:
            UnreadableError: there is no other one.
        """
        kept = tuple(p for p in self.parts if p.name != name)
        if not any(p.is_paid for p in kept):
            raise UnreadableError(f"'{name}' is all that the reward pays")
        return self._with(parts=kept)

    def with_part(self, name: str, text: str, note: str) -> "Reward":
        """Return it with one more part, in terms of `states` alone."""
        taken = {p.name for p in self.parts}
        while name in taken:
            name += "_again"
        part = Part(name=name, text=text, position=len(self.lines), note=note)
        return self._with(parts=(*self.parts, part))

    def with_scale(self, factor: float) -> "Reward":
        """Return it with the whole total multiplied."""
        return self._with(scale=self.scale * factor)

    def with_constant(self, name: str, statement: int, node: ast.AST, value: float) -> "Reward":
        """Return it with a number exchanged that `written` yielded for the part `name`."""
        part = self.part(name)
        assert part is not None
        if statement < 0:
            text = part.text.strip()
            start, end = _span(text, node)
            return self.rewritten(name, text[:start] + number(value) + text[end:], part.note)
        line = self.lines[statement]
        tree = copy.deepcopy(line.node)
        for new, old in zip(ast.walk(tree), ast.walk(line.node), strict=True):
            if old is node:
                _put(tree, new, value)
        own_rows = (line.node.end_lineno or line.node.lineno) - line.node.lineno + 1
        comments = "".join(line.text.splitlines(keepends=True)[:-own_rows])
        pad = " " * line.node.col_offset
        other = self._with()
        other.lines = list(self.lines)
        other.lines[statement] = _Line(
            line.node, f"{comments}{pad}{ast.unparse(ast.fix_missing_locations(tree))}\n"
        )
        changed = Reward(other.code())
        notes = {p.name: p.note for p in self.parts}
        return changed._with(
            parts=tuple(replace(p, note=notes.get(p.name, "")) for p in changed.parts)
        )

    def noted(self, name: str, note: str) -> "Reward":
        """Return it with a comment on one part."""
        return self._changed(name, lambda p: replace(p, note=note))

    def code(self) -> str:
        """Return the whole task code with this reward."""
        first = min([self.function.lineno, *(d.lineno for d in self.function.decorator_list)])
        before = "".join(self._rows[: first - 1])
        after = "".join(self._rows[(self.function.end_lineno or first) :])
        return before + self.text() + after

    def text(self) -> str:
        """Return the reward function."""
        pad = " " * self.function.body[0].col_offset
        needed = self._needed_lines()
        rows = [self._header()]
        rows += [line.text for i, line in enumerate(self.lines) if i in needed]
        rows.append(f"{pad}{self.dict_name} = {{}}\n")
        for part in self.parts:
            if part.note:
                rows.append(f"{pad}# {part.note}\n")
            rows.append(f'{pad}{self.dict_name}["{part.name}"] = {part.text}\n')
        sum_ = " + ".join(f'{self.dict_name}["{p.name}"]' for p in self.parts if p.is_paid)
        name = _free("total", self._all_names())
        rows.append(
            f"{pad}{name} = {sum_ if self.scale == 1 else f'{number(self.scale)} * ({sum_})'}\n"
        )
        rows.append(f"{pad}return {name}, {self.dict_name}\n")
        return "".join(rows)

    # -- inside: reading

    def _split_lines(self) -> None:
        body = self.function.body
        if ast.get_docstring(self.function, clean=False) is not None:
            body = body[1:]
        self.lines: list[_Line] = []
        end = self.function.body[0].end_lineno if body is not self.function.body else None
        if end is None:
            # Comments such as jit's type comment belong to the header.
            end = body[0].lineno - 1
        self._header_end = end
        for node in body:
            last = node.end_lineno or node.lineno
            if node.lineno <= end:
                raise UnreadableError(f"line {node.lineno} holds two statements")
            self.lines.append(_Line(node, "".join(self._rows[end:last])))
            end = last

    def _read_statements(self) -> None:
        for position, line in enumerate(self.lines):
            match line.node:
                case ast.Assign(targets=[ast.Name(id=name)], value=value):
                    self._definitions.setdefault(name, []).append((position, value))
                case ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value):
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
                    self._unclear |= _stored_names(line.node)

    def _returned(self) -> tuple[ast.expr, ast.expr]:
        match self.lines[-1].node:
            case ast.Return(value=ast.Tuple(elts=[total, holder])):
                return total, holder
        raise UnreadableError("it does not end by returning a total and its components")

    def _found_components(self, holder: ast.expr) -> dict[str, tuple[int, ast.expr]]:
        last = len(self.lines) - 1
        if isinstance(holder, ast.Dict):
            return _entries(holder, last)
        if not isinstance(holder, ast.Name):
            raise UnreadableError("the components are not in a dict with a name")
        found: dict[str, tuple[int, ast.expr]] = {}
        for position, line in enumerate(self.lines):
            match line.node:
                case (
                    ast.Assign(targets=[ast.Name(id=name)], value=made)
                    | ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as made)
                ) if name == holder.id:
                    if not isinstance(made, ast.Dict):
                        raise UnreadableError("its dict of components is not written out")
                    found = _entries(made, position)
                case ast.Assign(
                    targets=[
                        ast.Subscript(
                            value=ast.Name(id=name), slice=ast.Constant(value=str() as key)
                        )
                    ],
                    value=value,
                ) if name == holder.id:
                    found[key] = (position, value)
                case ast.Return():
                    pass
                case other:
                    if holder.id in _stored_names(other):
                        raise UnreadableError(f"line {other.lineno} changes its dict")
        return found

    def _take_apart(self, total: ast.expr) -> tuple[float, tuple[Part, ...]]:
        last = len(self.lines) - 1
        cores = {
            name: split_constant(self.inlined(expr, position))
            for name, (position, expr) in self._found.items()
        }
        known = {name: (factor, ast.dump(core)) for name, (factor, core) in cores.items()}
        aggregates: set[str] = set()
        for name, (position, expr) in self._found.items():
            others = {k: v for k, v in known.items() if k != name}
            inside = self._terms(expr, position, others)
            if len(inside) > 1 and any(t.name for t in inside):
                aggregates.add(name)
        terms = self._terms(total, last, {k: v for k, v in known.items() if k not in aggregates})
        outers = [t.outer for t in terms]
        scale = max(set(outers), key=outers.count) if terms else 1.0
        parts: list[Part] = []
        for name, (position, expr) in self._found.items():
            if name in aggregates:
                continue
            mine = [t for t in terms if t.name == name]
            text = self._expression_text(expr)
            factor = sum(t.factor for t in mine) / scale
            if mine and abs(factor - 1) > 1e-9:
                text = times(text, factor)
            parts.append(Part(name=name, text=text, position=position, is_paid=bool(mine)))
        for i, term in enumerate(t for t in terms if t.name is None):
            text = self._expression_text(term.node)
            if constant(term.node) is not None:
                text = f"torch.full_like({parts[0].text}, {text})" if parts else text
            factor = term.factor / scale
            parts.append(
                Part(
                    name=_free("rest" if i == 0 else f"rest_{i}", set(self._found)),
                    text=text if abs(factor - 1) < 1e-9 else times(text, factor),
                    position=term.position,
                )
            )
        if not any(p.is_paid for p in parts):
            raise UnreadableError("the total is made of none of its components")
        self._check_names(parts)
        return scale, tuple(parts)

    def _terms(
        self, expr: ast.expr, position: int, known: dict[str, tuple[float, str]]
    ) -> list["_Term"]:
        """Return the summands of an expression, each with the component that it is."""
        terms: list[_Term] = []

        def component_of(node: ast.expr, at: int) -> tuple[str, float] | None:
            key = self._entry(node)
            if key in known:
                return key, 1.0
            factor, core = split_constant(self.inlined(node, at))
            if isinstance(core, ast.Constant):
                return None
            dump = ast.dump(core)
            for name, (weight, other) in known.items():
                if dump == other and weight:
                    return name, factor / weight
            return None

        def visit(node: ast.expr, at: int, factor: float) -> None:
            found = component_of(node, at)
            if found is not None:
                name, share = found
                # The factor in front is what remains if the components carry their own weights.
                terms.append(_Term(node, at, name, factor * share, factor * share))
                return
            match node:
                case ast.BinOp(left=left, op=ast.Add() | ast.Sub() as op, right=right):
                    visit(left, at, factor)
                    visit(right, at, -factor if isinstance(op, ast.Sub) else factor)
                    return
                case ast.BinOp(left=left, op=ast.Mult(), right=right):
                    for one, rest in ((left, right), (right, left)):
                        value = constant(one)
                        if value is not None:
                            visit(rest, at, factor * value)
                            return
                case ast.BinOp(left=left, op=ast.Div(), right=right) if constant(right):
                    visit(left, at, factor / (constant(right) or 1.0))
                    return
                case ast.UnaryOp(op=ast.USub(), operand=inner):
                    visit(inner, at, -factor)
                    return
                case ast.Name(id=name):
                    made = self.definition(name, at)
                    if made is not None and _is_sum(made[1]):
                        visit(made[1], made[0], factor)
                        return
            value = constant(node)
            if value is None or value:
                terms.append(_Term(node, at, None, factor, factor))

        visit(expr, position, 1.0)
        return [t for t in terms if not _is_zeros(self.inlined(t.node, t.position))]

    def _expression_text(self, expr: ast.expr) -> str:
        """Return an expression as it was written, with what it reads from the dict written out."""
        reads = [n for n in ast.walk(expr) if self._entry(n) in self._found]
        text = ast.get_source_segment(self.source, expr) if hasattr(expr, "lineno") else None
        if text is None or reads or "\n" in text or "#" in text:
            expr = _Entries(self).visit(copy.deepcopy(expr))
            text = ast.unparse(ast.fix_missing_locations(expr))
        return text

    def _entry(self, node: ast.AST) -> str | None:
        match node:
            case ast.Subscript(
                value=ast.Name(id=name), slice=ast.Constant(value=str() as key)
            ) if name == self.dict_name:
                return key
        return None

    def _check_names(self, parts: list[Part]) -> None:
        """Refuse rewards in which a name means one thing to a part and another at the end."""
        for part in parts:
            for node in ast.walk(part.expr):
                if isinstance(node, ast.Name):
                    later = [p for p, _ in self._all_definitions(node.id, len(self.lines))]
                    if any(p > part.position for p in later):
                        raise UnreadableError(f"it gives '{node.id}' two meanings")

    def _defined(
        self, node: ast.AST, position: int, seen: set[int]
    ) -> Iterator[tuple[int, ast.AST]]:
        for name in _loaded_names(node):
            for at, value in self._all_definitions(name, position):
                if id(value) not in seen:
                    seen.add(id(value))
                    yield from ((at, n) for n in ast.walk(value))
                    yield from self._defined(value, at, seen)

    def _all_definitions(self, name: str, position: int) -> list[tuple[int, ast.AST]]:
        """Return what a name was made of before a statement, changes in place included."""
        plain = [d for d in self._definitions.get(name, []) if d[0] < position]
        in_place = [
            (at, line.node)
            for at, line in enumerate(self.lines[:position])
            if not isinstance(line.node, ast.Return)
            and name in _stored_names(line.node)
            and all(at != p for p, _ in plain)
        ]
        if name in self._unclear:
            return [*plain, *in_place]
        return list(plain[-1:])

    def _collect_states(
        self, node: ast.AST, position: int, keys: set[str], seen: set[int]
    ) -> None:
        match node:
            case ast.Call(func=ast.Attribute(attr=attr)) if attr in _INERT:
                return
            case ast.Subscript(value=ast.Name(id="states"), slice=key):
                keys.add(str(key.value) if isinstance(key, ast.Constant) else "?")
                return
            case ast.Attribute(attr="shape" | "device" | "dtype"):
                return
            case ast.Name(id="actions"):
                keys.add("actions")
            case ast.Name(id=name, ctx=ast.Load()):
                for at, value in self._all_definitions(name, position):
                    if id(value) not in seen:
                        seen.add(id(value))
                        self._collect_states(value, at, keys, seen)
        for child in ast.iter_child_nodes(node):
            self._collect_states(child, position, keys, seen)

    # -- inside: writing

    def _with(
        self, *, parts: tuple[Part, ...] | None = None, scale: float | None = None
    ) -> "Reward":
        other = copy.copy(self)
        other.parts = self.parts if parts is None else parts
        other.scale = self.scale if scale is None else scale
        return other

    def _changed(self, name: str, change: Callable[[Part], Part]) -> "Reward":
        return self._with(parts=tuple(change(p) if p.name == name else p for p in self.parts))

    def _needed_lines(self) -> set[int]:
        """Return the statements that the parts need, those of the old ending left out."""
        needed: set[int] = set()
        wanted = [n for p in self.parts for n in _loaded_names(p.expr)]
        done: set[str] = set()
        while wanted:
            name = wanted.pop()
            if name in done or name == self.dict_name:
                continue
            done.add(name)
            for at, line in enumerate(self.lines):
                if name in _stored_names(line.node):
                    needed.add(at)
                    wanted += _loaded_names(line.node)
        return needed

    def _all_names(self) -> set[str]:
        needed = self._needed_lines()
        return {n for i in needed for n in _stored_names(self.lines[i].node)}

    def _header(self) -> str:
        """Return decorators, signature and docstring, with the docstring's list of components renewed."""
        first = min([self.function.lineno, *(d.lineno for d in self.function.decorator_list)])
        text = "".join(self._rows[first - 1 : self._header_end])
        listed = re.search(r"(?m)^([ \t]*)# Reward Components:\n(?:[ \t]*\d+\..*\n)+", text)
        if listed is None:
            return text
        pad = listed[1]
        names = "".join(f"{pad}{i}. {p.name}\n" for i, p in enumerate(self.parts, 1))
        return (
            text[: listed.start()] + f"{pad}# Reward Components:\n{names}" + text[listed.end() :]
        )


@dataclass(frozen=True)
class _Term:
    """A summand of the total."""

    node: ast.expr
    position: int
    name: str | None
    """The component that it is."""
    factor: float
    outer: float


class _Inliner(ast.NodeTransformer):
    """Replaces names by their definitions."""

    def __init__(self, reward: Reward, position: int) -> None:
        self.reward, self.position = reward, position
        self.count = 0

    def visit(self, node: ast.AST) -> ast.AST:
        self.count += 1
        if self.count > MAX_INLINED_NODES:
            raise UnreadableError("its lines build on each other too often")
        return super().visit(node)

    def visit_Name(self, node: ast.Name) -> ast.AST:
        made = self.reward.definition(node.id, self.position)
        if made is None or not isinstance(node.ctx, ast.Load):
            return node
        before, self.position = self.position, made[0]
        result = self.visit(copy.deepcopy(made[1]))
        self.position = before
        return result


class _Entries(ast.NodeTransformer):
    """Replaces what is read from the dict of components by the components' expressions."""

    def __init__(self, reward: Reward) -> None:
        self.reward = reward

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        key = self.reward._entry(node)
        if key in self.reward._found:
            return self.visit(copy.deepcopy(self.reward._found[key][1]))
        return self.generic_visit(node)


def function_of(source: str) -> ast.FunctionDef:
    """Return the reward function in some task code.

    Raises:
        UnreadableError: there is none of the usual name.
    """
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef) and node.name == FUNCTION:
            return node
    raise UnreadableError(f"it has no function '{FUNCTION}' of its own")


def split_constant(expr: ast.expr) -> tuple[float, ast.expr]:
    """Return the constant factors of a product, multiplied, and the rest."""
    match expr:
        case ast.UnaryOp(op=ast.USub(), operand=inner):
            factor, rest = split_constant(inner)
            return -factor, rest
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            for one, other in ((left, right), (right, left)):
                value = constant(one)
                if value is not None:
                    factor, rest = split_constant(other)
                    return value * factor, rest
            factor, rest = split_constant(left)
            if factor != 1.0:
                return factor, ast.BinOp(rest, ast.Mult(), right)
        case ast.BinOp(left=left, op=ast.Div(), right=right):
            factor, rest = split_constant(left)
            if factor != 1.0:
                return factor, ast.BinOp(rest, ast.Div(), right)
    return 1.0, expr


def constant(node: ast.AST) -> float | None:
    """Return the number that an expression is."""
    match node:
        case ast.Constant(value=bool()):
            return None
        case ast.Constant(value=int() | float() as value):
            return float(value)
        case ast.UnaryOp(op=ast.USub(), operand=inner):
            value = constant(inner)
            return None if value is None else -value
    return None


def number(value: float) -> str:
    """Return a number as it stands in code."""
    text = repr(float(f"{value:.4g}"))
    return text.removesuffix("e+00")


def times(text: str, factor: float) -> str:
    """Return an expression multiplied, in its leading constant where it has one."""
    expr = ast.parse(text.strip(), mode="eval").body
    node = expr
    while True:
        match node:
            case ast.BinOp(op=ast.Mult(), right=right) if constant(right) is not None:
                start, end = _span(text.strip(), right)
                value = number((constant(right) or 0.0) * factor)
                return text.strip()[:start] + value + text.strip()[end:]
            case ast.BinOp(left=left, op=ast.Mult() | ast.Div()) if constant(left) is None:
                node = left
            case ast.BinOp(left=left, op=ast.Mult()):
                start, end = _span(text.strip(), left)
                value = number((constant(left) or 0.0) * factor)
                return text.strip()[:start] + value + text.strip()[end:]
            case _:
                break
    if constant(expr) is not None:
        return number((constant(expr) or 0.0) * factor)
    is_whole = isinstance(expr, ast.Name | ast.Call | ast.Subscript | ast.Attribute)
    return f"{number(factor)} * {text.strip() if is_whole else f'({text.strip()})'}"


def _span(text: str, node: ast.AST) -> tuple[int, int]:
    """Return where a node stands in a text of one line, in characters."""
    data = text.encode()
    begin, end = getattr(node, "col_offset", 0), getattr(node, "end_col_offset", 0)
    return len(data[:begin].decode()), len(data[:end].decode())


def _put(tree: ast.AST, node: ast.AST, value: float) -> None:
    """Exchange a node of a tree for a number."""
    for parent in ast.walk(tree):
        for field, old in ast.iter_fields(parent):
            new = ast.parse(number(value), mode="eval").body
            if old is node:
                setattr(parent, field, new)
            elif isinstance(old, list) and any(o is node for o in old):
                setattr(parent, field, [new if o is node else o for o in old])


def _entries(made: ast.Dict, position: int) -> dict[str, tuple[int, ast.expr]]:
    found: dict[str, tuple[int, ast.expr]] = {}
    for key, value in zip(made.keys, made.values, strict=True):
        if not (isinstance(key, ast.Constant) and isinstance(key.value, str)):
            raise UnreadableError("a component of the reward has no plain name")
        found[key.value] = (position, value)
    return found


def _stored_names(node: ast.AST) -> set[str]:
    """Return the names that a statement sets or changes in place."""
    names = {
        n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
    }
    for child in ast.walk(node):
        if isinstance(child, ast.Subscript | ast.Attribute) and isinstance(child.ctx, ast.Store):
            inner: ast.AST = child
            while isinstance(inner, ast.Subscript | ast.Attribute):
                inner = inner.value
            names |= {inner.id} if isinstance(inner, ast.Name) else set()
    if isinstance(node, ast.Expr):  # a call may change what it is called on: parts.update(...)
        names |= set(_loaded_names(node))
    return names


def _loaded_names(node: ast.AST) -> list[str]:
    return [n.id for n in ast.walk(node) if isinstance(n, ast.Name)]


def _is_sum(node: ast.expr) -> bool:
    """Whether an expression is worth being taken apart rather than named."""
    match node:
        case ast.BinOp(op=ast.Add() | ast.Sub()) | ast.Name():
            return True
        case ast.BinOp(left=left, op=ast.Mult() | ast.Div(), right=right):
            if constant(left) is not None:
                return _is_sum(right) or _is_entry_like(right)
            return constant(right) is not None and (_is_sum(left) or _is_entry_like(left))
        case ast.UnaryOp(op=ast.USub(), operand=inner):
            return _is_sum(inner)
    return _is_entry_like(node)


def _is_entry_like(node: ast.expr) -> bool:
    return isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant)


def _is_zeros(node: ast.expr) -> bool:
    match node:
        case ast.Call(func=ast.Attribute(attr="zeros" | "zeros_like")):
            return True
    return False


def _free(name: str, taken: set[str]) -> str:
    while name in taken:
        name += "_"
    return name
