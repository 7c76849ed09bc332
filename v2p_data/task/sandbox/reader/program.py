"""The frame of a program: statements at module level, imports, the one class, the heads of functions."""

import ast

from v2p_data.task.sandbox import allowed
from v2p_data.task.sandbox.reader.bodies import Bodies
from v2p_data.task.sandbox.reader.names import Names, targets_of
from v2p_data.task.sandbox.reader.refusal import Here, TaskCodeError
from v2p_data.task.sandbox.reader.values import Values


def read_program(tree: ast.Module) -> None:
    """Read a whole program.

    Raises:
        TaskCodeError: something in it is not on the allow-list.
    """
    _Program(tree).read()


class _Program:
    """Reads the statements outside the bodies of functions."""

    def __init__(self, tree: ast.Module) -> None:
        self.tree = tree
        self.here = Here()
        self.names = Names(self.here)
        self.values = Values(self.here)
        self.bodies = Bodies(self.here, self.names, self.values)

    def read(self) -> None:
        classes = [n for n in self.tree.body if isinstance(n, ast.ClassDef)]
        if len(classes) != 1:
            raise TaskCodeError(
                f"it must define exactly one class, derived from Task, but defines {len(classes)}"
            )
        # Names first: a function may use what comes after it.
        for node in self.tree.body:
            self.here.move_to(node)
            self._collect_names(node)
        self.names.collect_own(classes[0])
        for node in self.tree.body:
            self.here.move_to(node)
            match node:
                case ast.Import() | ast.ImportFrom():
                    self._read_import(node)
                case ast.ClassDef():
                    self._read_class(node)
                case ast.FunctionDef():
                    self._read_function(node)
                case ast.Assign() | ast.AnnAssign():
                    self._read_constant_value(node)
                case ast.Expr():
                    self._read_docstring(node)

    # -- module and class

    def _collect_names(self, node: ast.stmt) -> None:
        if not isinstance(node, allowed.AT_MODULE_LEVEL):
            self.here.refuse(
                f"{type(node).__name__} is not allowed at module level; only imports, constants, "
                "functions and the class are"
            )
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            self.names.demand_free(node.name)
            self.names.top.add(node.name)
        if isinstance(node, ast.Assign | ast.AnnAssign):
            self.names.top.update(self._constant_names(node, "at module level"))

    def _constant_names(self, node: ast.Assign | ast.AnnAssign, where: str) -> list[str]:
        names: list[str] = []
        for target in targets_of(node):
            if not isinstance(target, ast.Name):
                self.here.refuse(f"only plain names are assigned {where}")
            self.names.demand_free(target.id)
            names.append(target.id)
        return names

    def _read_constant_value(self, node: ast.Assign | ast.AnnAssign) -> None:
        if isinstance(node, ast.AnnAssign):
            self.values.read_annotation(node.annotation)
        if node.value is not None:
            self.values.read_literal(node.value)

    def _read_import(self, node: ast.Import | ast.ImportFrom) -> None:
        names = [a.name for a in node.names]
        if any(a.asname for a in node.names):
            self.here.refuse("'import ... as' is not allowed; keep the names torch and math")
        if isinstance(node, ast.Import):
            for name in names:
                if name not in allowed.MODULES:
                    self.here.refuse(f"import {name} is not allowed; torch, math and typing are")
            return
        known = None if node.level else allowed.IMPORTS.get(str(node.module))
        if known is None:
            self.here.refuse(
                f"import from {node.module} is not allowed; from typing and factory.tasks.task it is"
            )
        for name in names:
            if name not in known:
                self.here.refuse(f"importing {name} from {node.module} is not allowed")

    def _read_class(self, node: ast.ClassDef) -> None:
        base = node.bases[0] if len(node.bases) == 1 else None
        if not (isinstance(base, ast.Name) and base.id == "Task") or node.keywords:
            self.here.refuse("the class must derive from Task and nothing else")
        if node.decorator_list:
            self.here.refuse("decorators on the class are not allowed")
        if node.type_params:
            self.here.refuse("type parameters are not allowed")
        for item in node.body:
            self.here.move_to(item)
            match item:
                case ast.FunctionDef():
                    self.names.in_class = True
                    self._read_function(item)
                    self.names.in_class = False
                case ast.Assign() | ast.AnnAssign():
                    self._constant_names(item, "in the class body")
                    self._read_constant_value(item)
                case ast.Expr():
                    self._read_docstring(item)
                case ast.Pass():
                    pass
                case _:
                    self.here.refuse(f"{type(item).__name__} is not allowed in the class body")

    def _read_docstring(self, node: ast.stmt) -> None:
        value = node.value if isinstance(node, ast.Expr) else None
        if not (isinstance(value, ast.Constant) and isinstance(value.value, str)):
            self.here.refuse("only a docstring may stand here")

    # -- functions

    def _read_function(self, node: ast.FunctionDef) -> None:
        a = node.args
        if node.type_params:
            self.here.refuse("type parameters are not allowed")
        if a.vararg or a.kwarg or a.posonlyargs or a.kwonlyargs:
            self.here.refuse("'*' and '**' parameters are not allowed")
        is_static = self._read_decorators(node)
        self.here.move_to(node)
        for default in a.defaults:
            self.values.read_literal(default)
        self.names.function = node.name
        self._read_parameters(node, is_static)
        self._collect_local_names(node)
        body = node.body
        if ast.get_docstring(node, clean=False) is not None:
            self._read_docstring(body[0])
            body = body[1:]
        for statement in body:
            self.bodies.read(statement)
        self.names.local = set()

    def _read_decorators(self, node: ast.FunctionDef) -> bool:
        """Read them; return whether the function is a static method."""
        is_static = False
        for decorator in node.decorator_list:
            self.here.move_to(decorator)
            name = ast.unparse(decorator)
            if name == allowed.STATIC_DECORATOR and self.names.in_class:
                is_static = True
            elif name != allowed.SCRIPT_DECORATOR:
                self.here.refuse(
                    f"decorator {name[:60]!a} is not allowed; torch.jit.script is, and staticmethod on a method"
                )
        return is_static

    def _read_parameters(self, node: ast.FunctionDef, is_static: bool) -> None:
        names = [p.arg for p in node.args.args]
        is_method = self.names.in_class and not is_static
        if is_static and node.name in allowed.TASK_METHODS:
            self.here.refuse(f"{node.name} cannot be a staticmethod")
        if is_method and (not names or names[0] != "self"):
            self.here.refuse(f"the first parameter of method {node.name} must be self")
        for name in names[1:] if is_method else names:
            self.names.demand_free(name)
        for annotation in [p.annotation for p in node.args.args] + [node.returns]:
            if annotation is not None:
                self.values.read_annotation(annotation)

    def _collect_local_names(self, node: ast.FunctionDef) -> None:
        self.names.local = {p.arg for p in node.args.args}
        for child in ast.walk(ast.Module(body=node.body, type_ignores=[])):
            if isinstance(child, ast.Name) and isinstance(child.ctx, ast.Store):
                self.here.move_to(child)
                self.names.demand_free(child.id)
                self.names.local.add(child.id)
