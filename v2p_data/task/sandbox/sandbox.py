"""The guard between task code, whoever wrote it, and the machine.

What it covers. Three walls, one behind the other:

- `reader` reads the code without running it and refuses everything that is not on an allow-list (`allowed`): imports
  other than torch, math, typing and the task base class; names, attributes and functions that are not tensor maths;
  every underscore name except `__init__`; assignment to anything but the task's own variables and attributes; while
  loops, generators, lambdas, `try`, `with`, `global`, starred calls, decorators other than `torch.jit.script` and
  `staticmethod`, type parameters; letters that only look like ASCII, and characters that hide what a line says;
  long, deep or many-noded programs and huge constants. Every refusal names the line and the reason.
- `load_task` runs what is left with a handful of builtins and stand-ins for `torch`, `math` and `torch.Tensor`
  that hold the listed functions and nothing else. Of the environment it sees `num_envs` and copies of what
  `sample_object_poses` gives. States are copies too, and every answer is checked (`guarded`).
- `smoke.smoke_run` runs unknown code in a child process first, which has given up its rights (`confine`): no
  file, no socket, no process, no program, an empty folder and environment, and limits on time and memory. What comes
  back is JSON, read as data; nothing is ever unpickled.

What it does not cover. Nothing here is proof against a hole in CPython, torch or the kernel. Code
that has passed the smoke run is loaded into the training process, where the second wall stands
alone unless that process calls `confine` too: each call has a time limit (`time_limit`), but code
that turns large for large batches ends it. Where the kernel has neither Landlock nor seccomp the
limits of the third wall remain. Task code may also be *wrong*; that is `audit`'s business.
`docs/safety.md` says how all this is tested.
"""

import ast
import builtins
import math
import typing
from types import SimpleNamespace
from typing import Any

import torch

from v2p_data.scene.scene import Scene
from v2p_data.task.sandbox import allowed
from v2p_data.task.sandbox.guarded import GuardedTask, PlacerView
from v2p_data.task.sandbox.reader.check import checked_tree
from v2p_data.task.sandbox.reader.refusal import TaskCodeError
from v2p_data.task.sandbox.time_limit import CODE_NAME, in_time, line_in_task_code
from v2p_data.task.task import Placer, Task

MAX_RANGE = 1_000


def load_task(source: str, envs: Placer, scene: Scene, title: str = "") -> GuardedTask:
    """Return the one task class in `source`, made and guarded; its calls end in time (`time_limit`).

    Args:
        source: task code.
        envs: the environment.
        scene: whose objects the task is about.
        title: for messages; by default the scene's.

    Raises:
        TaskCodeError: the code is refused, or it does not load.
        TaskCodeTooSlowError: loading it takes too long.
    """
    judge, rewarder = in_time(lambda: _made(source, envs, str(scene.folder)), "loading")
    return GuardedTask(*judge, title or scene.title, rewarder=rewarder, is_limited=True)


def make_task(source: str, envs: Placer, urdf_assets_root: str) -> GuardedTask:
    """Return the one task class in `source`, made and guarded; nothing ends a call that takes too long.

    Raises:
        TaskCodeError: the code is refused, or it does not load.
    """
    judge, rewarder = _made(source, envs, urdf_assets_root)
    return GuardedTask(*judge, rewarder=rewarder)


def _made(source: str, envs: Placer, urdf_assets_root: str) -> list[tuple[Task, PlacerView]]:
    """Return the task, made as the paper makes it, and what it sees of the environment: twice, with nothing shared."""
    tree = _Strip().visit(checked_tree(source))
    ast.fix_missing_locations(tree)
    return [_copy(tree, PlacerView(envs), urdf_assets_root) for _ in range(2)]


def _copy(tree: ast.Module, view: PlacerView, urdf_assets_root: str) -> tuple[Task, PlacerView]:
    namespace = _namespace()
    try:
        exec(compile(tree, CODE_NAME, "exec", dont_inherit=True), namespace)
        made = [
            v
            for v in namespace.values()
            if isinstance(v, type) and issubclass(v, Task) and v is not Task
        ]
        return made[0](view, urdf_assets_root), view  # pyright: ignore[reportCallIssue]
    except Exception as error:
        raise TaskCodeError(
            f"it does not load: {type(error).__name__}: {error}", line_in_task_code(error)
        ) from error


def class_name(source: str) -> str:
    """Return the name of the one task class in checked code."""
    return next(n.name for n in checked_tree(source).body if isinstance(n, ast.ClassDef))


class _Strip(ast.NodeTransformer):
    """Takes away imports, whose names are in the namespace already, decorators and annotations."""

    def visit_Import(self, node: ast.Import) -> None:
        del node

    def visit_ImportFrom(self, node: ast.ImportFrom) -> None:
        del node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        node.decorator_list = [
            d for d in node.decorator_list if ast.unparse(d) == allowed.STATIC_DECORATOR
        ]
        node.returns = None
        for parameter in node.args.args:
            parameter.annotation = None
        self.generic_visit(node)
        return node

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        if node.value is None:
            return ast.copy_location(ast.Pass(), node)
        return ast.copy_location(ast.Assign(targets=[node.target], value=node.value), node)


class _TensorKind(type):
    """Answers isinstance for tensors. The class itself is one object for the whole process, not to be handed out."""

    def __instancecheck__(cls, instance: Any) -> bool:
        return isinstance(instance, torch.Tensor)

    def __call__(cls, data: Any) -> torch.Tensor:
        # torch.Tensor(5) would give five numbers of whatever the memory held before.
        if not isinstance(data, list | tuple | torch.Tensor):
            raise TypeError("a tensor is made of a list of numbers; use torch.zeros for a size")
        return torch.tensor(data, dtype=torch.float32)


class _Tensor(metaclass=_TensorKind):
    """What task code gets for `torch.Tensor` and `torch.FloatTensor`."""


def _short_range(*bounds: int) -> range:
    made = range(*bounds)
    if len(made) > MAX_RANGE:
        raise ValueError(f"range of {len(made)} steps; {MAX_RANGE} are allowed")
    return made


def _torch_module(name: str, *details: Any) -> Any:
    """Serve imports that torch's own C++ code does on behalf of the running frame; task code cannot name it."""
    if name.split(".")[0] not in {"torch", "numpy"}:
        raise ImportError(f"import of {name} is not allowed")
    return builtins.__import__(name, *details)


def _namespace() -> dict[str, Any]:
    functions: dict[str, Any] = {n: getattr(builtins, n) for n in allowed.BUILTINS}
    functions["range"] = _short_range
    functions["super"] = super
    functions["staticmethod"] = staticmethod
    functions["__build_class__"] = builtins.__build_class__
    functions["__import__"] = _torch_module
    linalg = {n: getattr(torch.linalg, n) for n in allowed.TORCH_NAMESPACES["linalg"]}
    functional = {
        n: getattr(torch.nn.functional, n) for n in allowed.TORCH_NAMESPACES["nn.functional"]
    }
    stand_ins = {"Tensor": _Tensor, "FloatTensor": _Tensor}
    torch_view = SimpleNamespace(
        **{n: getattr(torch, n) for n in allowed.TORCH if hasattr(torch, n)} | stand_ins,
        linalg=SimpleNamespace(**linalg),
        nn=SimpleNamespace(functional=SimpleNamespace(**functional)),
    )
    return {
        "__builtins__": functions,
        "__name__": "task_code",
        "torch": torch_view,
        "math": SimpleNamespace(**{n: getattr(math, n) for n in allowed.MATH}),
        "Tensor": _Tensor,
        "Task": Task,
        **{n: getattr(typing, n) for n in allowed.TYPING},
    }
