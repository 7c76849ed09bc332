"""The dict of named components that a reward function returns beside its total.

A component may be set more than once and read in between: what a line reads is what was set last before it. Such lines
can be written out, so that in the end each component is what its last setting says.
"""

import ast
from typing import override

from v2p_data.reward.code.expressions import free_name, names_in, stored_names
from v2p_data.reward.code.function_body import Body, Replacer, UnreadableError

Setting = tuple[int, ast.expr]
"""The statement in which a component is set and its expression."""


class Components:
    """The components of a reward and how the function reads them.

    Args:
        body: the reward function.
        holder: what it returns as its components.

    Raises:
        UnreadableError: they are not in a dict that is written out, or one is read before it is set.
    """

    def __init__(self, body: Body, holder: ast.expr) -> None:
        self.body = body
        if isinstance(holder, ast.Name):
            self.dict_name = holder.id
        else:
            self.dict_name = free_name("reward_components", set(names_in(body.function)))
        self._settings: dict[str, list[Setting]] = {}
        self.found: dict[str, Setting] = {}
        self._read_settings(holder)
        if not self.found:
            raise UnreadableError("no component of the reward has a plain name")

    def entry(self, node: ast.AST) -> str | None:
        """Return the name of the component that a node reads from the dict, None for other nodes."""
        match node:
            case ast.Subscript(
                value=ast.Name(id=name), slice=ast.Constant(value=str() as key), ctx=ast.Load()
            ) if name == self.dict_name:
                return key
        return None

    def reads(self, node: ast.AST) -> set[str]:
        """Return the components that an expression or statement reads from the dict."""
        return {key for n in ast.walk(node) if (key := self.entry(n)) is not None}

    def setting(self, key: str, position: int) -> Setting:
        """Return how a component was set last before a statement.

        Raises:
            UnreadableError: it was not.
        """
        before = [s for s in self._settings.get(key, []) if s[0] < position]
        if not before:
            line = self.body.lines[min(position, len(self.body.lines) - 1)].node.lineno
            raise UnreadableError(f"line {line} reads the component '{key}' before it is set")
        return before[-1]

    def settings_before(self, position: int) -> list[Setting]:
        """Return how each component was set last before a statement."""
        before = [[s for s in made if s[0] < position] for made in self._settings.values()]
        return [made[-1] for made in before if made]

    def text_of(self, expr: ast.expr, position: int) -> str:
        """Return an expression as it was written, with what it reads from the dict written out.

        Raises:
            UnreadableError: the dict is used in another way, or what it holds has another meaning by then.
        """
        source = self.body.source
        text = ast.get_source_segment(source, expr) if hasattr(expr, "lineno") else None
        if text is None or self.reads(expr) or "\n" in text or "#" in text:
            expr = _WrittenOut(self, position, position).replaced(expr)
            text = ast.unparse(ast.fix_missing_locations(expr))
        if self.dict_name in names_in(expr):
            raise UnreadableError("its total is made of its dict as a whole")
        return text

    # -- lines that read the dict

    def stale_readers(self) -> list[int]:
        """Return the statements that read what a component was before it was set anew."""
        return [
            at
            for at, line in enumerate(self.body.lines)
            if any(self.setting(k, at) != self.found.get(k) for k in self.reads(line.node))
        ]

    def readers(self, names: list[str]) -> list[int]:
        """Return the statements that read the dict among those that names need.

        Raises:
            UnreadableError: one of them uses it in another way.
        """
        found: list[int] = []
        needed = {id(line.node) for line in self.body.lines_for(names, besides=self.dict_name)}
        for at, line in enumerate(self.body.lines):
            uses = names_in(line.node).count(self.dict_name) if id(line.node) in needed else 0
            reads = sum(self.entry(n) is not None for n in ast.walk(line.node))
            if uses > reads:
                raise UnreadableError(f"line {line.node.lineno} uses its dict as a whole")
            if uses:
                found.append(at)
        return found

    def written_out(self, statements: list[int]) -> str:
        """Return the whole task code in which these statements read nothing from the dict.

        Raises:
            UnreadableError: what they read cannot be said there, for a name has another meaning by then.
        """
        body = self.body
        for at in statements:
            node = body.lines[at].node
            # What a loop changes has changed when it reads again.
            end = at + 1 if hasattr(node, "body") else at
            new = _WrittenOut(self, at, end).replaced(node)
            body = body.with_statement(at, ast.fix_missing_locations(new))
        return body.code()

    # -- reading

    def _read_settings(self, holder: ast.expr) -> None:
        last = len(self.body.lines) - 1
        if isinstance(holder, ast.Dict):
            self._set_all(holder, last)
            return
        if not isinstance(holder, ast.Name):
            raise UnreadableError("the components are not in a dict with a name")
        for position, line in enumerate(self.body.lines):
            match line.node:
                case (
                    ast.Assign(targets=[ast.Name(id=name)], value=made)
                    | ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as made)
                ) if name == holder.id:
                    if not isinstance(made, ast.Dict):
                        raise UnreadableError("its dict of components is not written out")
                    self.found = {}
                    self._set_all(made, position)
                case ast.Assign(
                    targets=[
                        ast.Subscript(
                            value=ast.Name(id=name), slice=ast.Constant(value=str() as key)
                        )
                    ],
                    value=value,
                ) if name == holder.id:
                    self._set(key, position, value)
                case ast.Return():
                    pass
                case other:
                    if holder.id in stored_names(other):
                        raise UnreadableError(f"line {other.lineno} changes its dict")

    def _set_all(self, made: ast.Dict, position: int) -> None:
        for key, value in zip(made.keys, made.values, strict=True):
            if not (isinstance(key, ast.Constant) and isinstance(key.value, str)):
                raise UnreadableError("a component of the reward has no plain name")
            self._set(key.value, position, value)

    def _set(self, key: str, position: int, value: ast.expr) -> None:
        self.found[key] = (position, value)
        self._settings.setdefault(key, []).append((position, value))


class _WrittenOut(Replacer):
    """Replaces what is read from the dict of components by the components' expressions.

    Args:
        components: the components.
        position: the statement that reads.
        end: names must not be set anew before this statement.
    """

    def __init__(self, components: Components, position: int, end: int) -> None:
        super().__init__()
        self.components, self.position, self.end = components, position, end

    @override
    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        key = self.components.entry(node)
        if key is None:
            return self.generic_visit(node)
        at, value = self.components.setting(key, self.position)
        for name in set(names_in(value)) - {self.components.dict_name}:
            if self.components.body.is_set_between(name, at, self.end):
                raise UnreadableError(f"it gives '{name}' two meanings")
        before, self.position = self.position, at
        result = self.replaced(value)
        self.position = before
        return result
