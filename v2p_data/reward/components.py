"""The dict of named components that a reward function returns beside its total."""

import ast
import copy

from v2p_data.reward.expressions import stored_names
from v2p_data.reward.function_body import Body, UnreadableError

Found = dict[str, tuple[int, ast.expr]]
"""By name, the statement in which a component is set and its expression."""


class Components:
    """The components of a reward and how the function reads them.

    Args:
        body: the reward function.
        holder: what it returns as its components.

    Raises:
        UnreadableError: they are not in a dict that is written out.
    """

    def __init__(self, body: Body, holder: ast.expr) -> None:
        self.body = body
        self.dict_name = holder.id if isinstance(holder, ast.Name) else "reward_components"
        self.found = _found(body, holder)
        if not self.found:
            raise UnreadableError("no component of the reward has a plain name")

    def entry(self, node: ast.AST) -> str | None:
        """Return the name of the component that a node reads from the dict, None for other nodes."""
        match node:
            case ast.Subscript(
                value=ast.Name(id=name), slice=ast.Constant(value=str() as key)
            ) if name == self.dict_name:
                return key
        return None

    def text_of(self, expr: ast.expr) -> str:
        """Return an expression as it was written, with what it reads from the dict written out."""
        reads = [n for n in ast.walk(expr) if self.entry(n) in self.found]
        source = self.body.source
        text = ast.get_source_segment(source, expr) if hasattr(expr, "lineno") else None
        if text is None or reads or "\n" in text or "#" in text:
            expr = _WrittenOut(self).visit(copy.deepcopy(expr))
            text = ast.unparse(ast.fix_missing_locations(expr))
        return text


class _WrittenOut(ast.NodeTransformer):
    """Replaces what is read from the dict of components by the components' expressions."""

    def __init__(self, components: Components) -> None:
        self.components = components

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        key = self.components.entry(node)
        if key in self.components.found:
            return self.visit(copy.deepcopy(self.components.found[key][1]))
        return self.generic_visit(node)


def _found(body: Body, holder: ast.expr) -> Found:
    last = len(body.lines) - 1
    if isinstance(holder, ast.Dict):
        return _entries(holder, last)
    if not isinstance(holder, ast.Name):
        raise UnreadableError("the components are not in a dict with a name")
    found: Found = {}
    for position, line in enumerate(body.lines):
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
                    ast.Subscript(value=ast.Name(id=name), slice=ast.Constant(value=str() as key))
                ],
                value=value,
            ) if name == holder.id:
                found[key] = (position, value)
            case ast.Return():
                pass
            case other:
                if holder.id in stored_names(other):
                    raise UnreadableError(f"line {other.lineno} changes its dict")
    return found


def _entries(made: ast.Dict, position: int) -> Found:
    found: Found = {}
    for key, value in zip(made.keys, made.values, strict=True):
        if not (isinstance(key, ast.Constant) and isinstance(key.value, str)):
            raise UnreadableError("a component of the reward has no plain name")
        found[key.value] = (position, value)
    return found
