"""A reward as parts that can be changed, and its text: the rest of the task code stays byte for byte as it is.

What is understood is a `reward_function` that computes, line by line, a total and a dict of named components
(`function_body`, `components`, `summands`). Lines that parts need are kept as they were written, comments included; only
the end of the function is laid out anew.
"""

import ast
import copy
from collections.abc import Callable, Iterator
from dataclasses import replace

from v2p_data.reward.code.components import Components
from v2p_data.reward.code.expressions import (
    copy_with_number,
    free_name,
    names_in,
    number,
    stored_names,
    times,
    with_number,
)
from v2p_data.reward.code.function_body import Body, UnreadableError
from v2p_data.reward.code.terms import Part, returned, taken_apart


class Reward:
    """The reward of some task code, taken apart.

    Args:
        source: the task code.

    Raises:
        UnreadableError: its structure is not understood.
    """

    def __init__(self, source: str) -> None:
        self.source = source
        readers = [0]
        while readers:
            self._body = Body(source)
            total, holder = returned(self._body)
            components = Components(self._body, holder)
            self.dict_name = components.dict_name
            readers = components.stale_readers()
            if not readers:
                self.scale, self.parts = taken_apart(self._body, total, components)
                # The dict is made anew below these lines.
                readers = components.readers(self._needed())
            if readers:
                source = components.written_out(readers)

    # -- what it says

    def part(self, name: str) -> Part | None:
        """Return a part by its name."""
        return next((p for p in self.parts if p.name == name), None)

    def written(self, part: Part) -> Iterator[tuple[int, ast.AST]]:
        """Yield what a part is made of, definitions followed, each node with the statement it stands in.

        The statement is -1 for nodes of the part's own text.
        """
        expr = part.expr
        yield from ((-1, node) for node in ast.walk(expr))
        yield from self._body.followed(expr, part.position)

    def states_of(self, part: Part) -> set[str]:
        """Return the keys of `states` that a part's value depends on, and `actions`."""
        return self._body.states_of(part.expr, part.position)

    def inlined(self, expr: ast.expr, position: int) -> ast.expr:
        """Return a copy in which every name with a plain definition is replaced by it."""
        return self._body.inlined(expr, position)

    def definition(self, name: str, position: int) -> tuple[int, ast.expr] | None:
        """Return the last definition before a statement; None for names that are changed in place."""
        return self._body.definition(name, position)

    def lasting_definition(self, name: str, position: int) -> ast.expr | None:
        """Return what a name stands for, if that can be said at a statement without it; None otherwise."""
        made = self._body.definition(name, position)
        if made is None:
            return None
        at, value = made
        again = any(self._body.is_set_between(n, at, position) for n in names_in(value))
        return None if again else value

    # -- changes

    def scaled(self, name: str, factor: float, note: str) -> "Reward":
        """Return it with one part multiplied."""
        return self._changed(name, lambda p: replace(p, text=times(p.text, factor), note=note))

    def rewritten(self, name: str, text: str, note: str) -> "Reward":
        """Return it with another expression for one part."""
        return self._changed(name, lambda p: replace(p, text=text, note=note))

    def noted(self, name: str, note: str) -> "Reward":
        """Return it with a comment on one part."""
        return self._changed(name, lambda p: replace(p, note=note))

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
        part = Part(name=name, text=text, position=len(self._body.lines), note=note)
        return self._with(parts=(*self.parts, part))

    def with_scale(self, factor: float) -> "Reward":
        """Return it with the whole total multiplied."""
        return self._with(scale=self.scale * factor)

    def with_constant(self, name: str, statement: int, node: ast.AST, value: float) -> "Reward":
        """Return it with a number exchanged that `written` yielded for the part `name`."""
        part = self.part(name)
        assert part is not None
        if statement < 0:
            return self.rewritten(name, with_number(part.text.strip(), node, value), part.note)
        new = copy_with_number(self._body.lines[statement].node, node, value)
        changed = Reward(self._with(body=self._body.with_statement(statement, new)).code())
        notes = {p.name: p.note for p in self.parts}
        return changed._with(
            parts=tuple(replace(p, note=notes.get(p.name, "")) for p in changed.parts)
        )

    def _changed(self, name: str, change: Callable[[Part], Part]) -> "Reward":
        return self._with(parts=tuple(change(p) if p.name == name else p for p in self.parts))

    def _with(
        self,
        *,
        parts: tuple[Part, ...] | None = None,
        scale: float | None = None,
        body: Body | None = None,
    ) -> "Reward":
        other = copy.copy(self)
        other.parts = self.parts if parts is None else parts
        other.scale = self.scale if scale is None else scale
        other._body = self._body if body is None else body
        return other

    # -- text

    def code(self) -> str:
        """Return the whole task code with this reward."""
        return self._body.code_with(self.text())

    def text(self) -> str:
        """Return the reward function."""
        pad = self._body.pad
        lines = self._body.lines_for(self._needed(), besides=self.dict_name)
        rows = [self._body.header([p.name for p in self.parts])]
        rows += [line.text for line in lines]
        rows.append(f"{pad}{self.dict_name} = {{}}\n")
        for part in self.parts:
            if part.note:
                rows.append(f"{pad}# {part.note}\n")
            rows.append(f'{pad}{self.dict_name}["{part.name}"] = {part.text}\n')
        paid = " + ".join(f'{self.dict_name}["{p.name}"]' for p in self.parts if p.is_paid)
        taken = {n for line in lines for n in stored_names(line.node)} | {self.dict_name}
        total = free_name("total", taken)
        rows.append(
            f"{pad}{total} = {paid if self.scale == 1 else f'{number(self.scale)} * ({paid})'}\n"
        )
        rows.append(f"{pad}return {total}, {self.dict_name}\n")
        return "".join(rows)

    def _needed(self) -> list[str]:
        return [name for p in self.parts for name in names_in(p.expr)]
