"""The names of a program: which it may give, and which it has given."""

import ast

import torch

from v2p_data.task.sandbox import allowed
from v2p_data.task.sandbox.reader.refusal import Here
from v2p_data.task.task import Task

_RESERVED = frozenset({*allowed.MODULES, "super", "self", "Task", "Tensor"})
_OF_THE_BASE_CLASS = frozenset({"envs", "scene_info", "urdf_assets_root"})


class Names:
    """What the program has named so far.

    Args:
        here: where the reading is.
    """

    def __init__(self, here: Here) -> None:
        self.here = here
        self.top: set[str] = set()
        """Functions, classes and constants of the module."""
        self.own: set[str] = set()
        """Methods, and attributes assigned on `self`."""
        self.local: set[str] = set()
        """Parameters and variables of the function being read."""
        self.in_class = False
        self.function = ""
        """Name of the function being read."""

    def demand_free(self, name: str) -> None:
        """Refuse a name that may not be given."""
        if name.startswith("_") and name != "_" and not (self.in_class and name == "__init__"):
            self.here.refuse(f"name '{name}' is not allowed; none with an underscore in front is")
        if name in _RESERVED:
            self.here.refuse(f"'{name}' cannot be redefined")
        if not name.isascii():
            self.here.refuse(f"name '{name}' is not ASCII")

    def collect_own(self, node: ast.ClassDef) -> None:
        """Find the class's methods and constants and what is assigned on `self`."""
        constants = {
            id(target)
            for item in node.body
            if isinstance(item, ast.Assign | ast.AnnAssign)
            for target in targets_of(item)
        }
        for child in ast.walk(node):
            self.here.move_to(child)
            match child:
                case ast.FunctionDef(name=name) if name in allowed.TASK_METHODS:
                    self.own.add(name)
                case ast.FunctionDef(name=name):
                    self._add_own(name)
                case ast.Name(id=name) if id(child) in constants:
                    self._add_own(name)
                case ast.Attribute(attr=name, ctx=ast.Store()):
                    if not is_on_self(child):
                        self.here.refuse("attributes can only be assigned on self")
                    if name in _OF_THE_BASE_CLASS:
                        self.here.refuse(f"self.{name} belongs to the base class")
                    if name != "task_description":
                        self._add_own(name)

    def _add_own(self, name: str) -> None:
        if name.startswith("_") or name.endswith("_"):
            self.here.refuse(f"'{name}': names with an underscore at either end are not allowed")
        # A method called on something else than self must not reach what tensors can do.
        if hasattr(torch.Tensor, name) or hasattr(Task, name) or hasattr(dict, name):
            self.here.refuse(f"'{name}' is taken; choose another name")
        self.own.add(name)


def targets_of(node: ast.Assign | ast.AnnAssign) -> list[ast.expr]:
    """Return what is assigned to."""
    return node.targets if isinstance(node, ast.Assign) else [node.target]


def is_on_self(node: ast.Attribute) -> bool:
    """Return whether it is `self.name`."""
    return isinstance(node.value, ast.Name) and node.value.id == "self"
