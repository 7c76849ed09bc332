"""Attempts to get out of task code: what the reader refuses, and what only the child can hold."""

SKELETON = '''
import torch
import math
#TOP
scene_info = {"task_class_name": "Lift"}

class Lift(Task):
    """Lifts."""
    #MEMBER
    def __init__(self, envs, urdf_assets_root):
        super().__init__(envs, urdf_assets_root, scene_info)
        #INIT
    def compute_success(self, states):
        x = states["box_pos"]
        #BODY
        return x[:, 2] > 0.1
    def compute_reward(self, actions, states):
        #REWARD
        return reward_function(actions, states)

def reward_function(actions, states):
    r = 1 - torch.tanh(torch.norm(states["box_pos"] - states["eef_pos"], dim=-1))
    #FUNCTION
    return r, {"reach": r}
'''
INDENT = {"TOP": "", "MEMBER": 4, "INIT": 8, "BODY": 8, "REWARD": 8, "FUNCTION": 4}


def program(text: str, place: str = "BODY") -> str:
    """Return the skeleton with `text` at a place."""
    indent = " " * int(INDENT[place] or 0)
    return SKELETON.replace(f"#{place}", text.replace("\n", "\n" + indent))


DUNDER_WALKS = {
    "the class of a tensor": "y = x.__class__.__mro__",
    "the subclasses of object": "y = ().__class__.__bases__[0].__subclasses__()",
    "the globals of a method": "y = self.compute_success.__globals__",
    "the function under a method": "y = self.compute_success.__func__",
    "the code of a function": "y = reward_function.__code__",
    "the closure of a function": "y = reward_function.__closure__",
    "the builtins of a function": "y = reward_function.__builtins__",
    "the default values of a function": "reward_function.__defaults__ = (1,)",
    "the module of the class": "y = Lift.__module__",
    "the dict of self": "y = self.__dict__",
    "another class for self": "self.__class__ = Tensor",
    "the bases of the class": "Lift.__bases__ = (Tensor,)",
    "the frame of a generator": "y = [v for v in x].gi_frame",
    "the frame of a function": "y = reward_function.f_back",
    "a traceback's frame": "y = x.tb_frame.f_globals",
    "an exception's context": "y = x.__context__.__traceback__",
    "the reduce of a tensor": "y = x.__reduce_ex__(2)",
    "the array interface": "y = x.__array_interface__",
    "the dunder dict by subscript": "y = __builtins__['open']",
    "the module's loader": "y = __loader__",
    "the module's spec": "y = __spec__",
    "the name of the module": "y = __name__",
    "a private name of torch": "y = torch._C",
    "a private attribute": "self.envs._envs.bundle",
}
BUILTINS = {
    "import by name": "y = __import__('os')",
    "open": "y = open('/etc/passwd')",
    "eval": "y = eval('1')",
    "exec through a list": "y = [exec][0]('1')",
    "compile": "y = compile('1', 'a', 'eval')",
    "getattr": "y = getattr(x, 'data')",
    "setattr": "setattr(x, 'data', 1)",
    "delattr": "delattr(self, 'envs')",
    "hasattr": "y = hasattr(x, '__class__')",
    "vars": "y = vars(self)",
    "dir": "y = dir(self)",
    "globals": "y = globals()",
    "locals": "y = locals()",
    "type": "y = type(x)",
    "a class made by type": "y = type('A', (), {})",
    "object": "y = object()",
    "super with arguments": "super(Lift, self).compute_success(states)",
    "super as a value": "y = super()",
    "super's attribute": "y = super().scene_info",
    "the base class made anew": "super().__init__(states, 1)",
    "super's private method": "super().__setattr__('envs', 1)",
    "input": "y = input()",
    "breakpoint": "breakpoint()",
    "help": "help()",
    "print": "print(x)",
    "memoryview": "y = memoryview(x)",
    "bytes": "y = bytes(10)",
    "bytearray": "y = bytearray(10)",
    "bytes constant": "y = b'abc'",
    "id": "y = id(x)",
    "iter": "y = iter(int, 1)",
    "map": "y = map(eval, ['1'])",
    "filter": "y = filter(None, [1])",
    "chr": "y = chr(95)",
    "exit": "exit()",
    "a built-in exception": "y = ValueError('x')",
    "classmethod": "y = classmethod(reward_function)",
    "property": "y = property(reward_function)",
}
TORCH = {
    "torch.load": "y = torch.load('x')",
    "torch.save": "torch.save(x, 'x')",
    "torch.ops": "torch.ops.aten.add(x, x)",
    "torch.ops.load_library": "torch.ops.load_library('x.so')",
    "torch.classes": "torch.classes.load_library('x.so')",
    "torch.hub": "torch.hub.load('a', 'b')",
    "torch.jit.load": "torch.jit.load('x')",
    "torch.jit.script of a text": "torch.jit.CompilationUnit('def f(): pass')",
    "torch.utils.cpp_extension": "torch.utils.cpp_extension.load('x')",
    "torch.utils.data": "torch.utils.data.DataLoader([1], num_workers=9)",
    "torch.compile": "y = torch.compile(reward_function)",
    "torch.multiprocessing": "torch.multiprocessing.spawn(reward_function)",
    "torch.distributed": "torch.distributed.init_process_group('gloo')",
    "torch.package": "torch.package.PackageImporter('x')",
    "torch.onnx": "torch.onnx.export(x, x, 'x')",
    "torch.profiler": "torch.profiler.profile()",
    "torch.from_file": "y = torch.from_file('x', size=10)",
    "torch.frombuffer": "y = torch.frombuffer(x, dtype=torch.float32)",
    "torch.from_numpy": "y = torch.from_numpy(x)",
    "torch.library": "torch.library.Library('a', 'DEF')",
    "torch.nn.Module": "y = torch.nn.Module()",
    "torch.autograd": "y = torch.autograd.Function()",
    "torch.serialization": "torch.serialization.add_safe_globals([x])",
    "torch.set_default_device": "torch.set_default_device('meta')",
    "torch.set_printoptions": "torch.set_printoptions(precision=2)",
    "torch.cuda": "torch.cuda.synchronize()",
    "torch.overrides": "torch.overrides.get_overridable_functions()",
    "torch.sys": "torch.sys.modules",
    "torch.os": "torch.os.system('true')",
    "ctypes through torch": "torch.ctypes.CDLL('libc.so.6')",
    "numpy through torch": "torch.numpy",
    "builtins through torch": "torch.builtins.open('x')",
    "torch.empty shows old memory": "y = torch.empty(5)",
    "random numbers": "y = torch.rand(3)",
    "the seed of all": "torch.manual_seed(0)",
    "torch under another name": "t = torch\nt.load('x')",
    "torch in a list": "y = [torch][0].load('x')",
    "math in a dict": "y = {'m': math}['m']",
}
TENSOR_METHODS = {
    "numpy writes files": "x.numpy().tofile('x')",
    "data pointer": "y = x.data_ptr()",
    "shared memory": "x.share_memory_()",
    "storage": "y = x.storage()",
    "untyped storage": "x.untyped_storage()",
    "a file behind a storage": "x.untyped_storage().from_file('x', True, 10)",
    "set": "x.set_(x)",
    "resize": "x.resize_(1000)",
    "as strided": "y = x.as_strided((1000,), (1,))",
    "hook": "x.register_hook(reward_function)",
    "backward": "x.sum().backward()",
    "requires grad": "x.requires_grad_(True)",
    "requires grad as an argument": "y = torch.zeros(3, requires_grad=True)",
    "pinned memory": "y = torch.zeros(3, pin_memory=True)",
    "gradient function": "y = x.grad_fn",
    "apply": "x.apply_(eval)",
    "map": "x.map_(x, reward_function)",
    "data": "y = x.data",
    "module load": "x.module_load(x)",
    "random in place": "x.random_()",
    "copy in place": "x.copy_(x)",
    "new empty memory": "y = x.new_empty(5)",
    "out argument": "torch.add(x, x, out=states['eef_pos'])",
    "pickle": "y = x.dumps()",
    "dlpack": "y = x.__dlpack__()",
}
FORMATS = {
    "format reads attributes": "y = '{0.device}'.format(x)",
    "format map": "y = '{a}'.format_map(states)",
    "f-string reads attributes": "y = f'{x.device}'",
    "f-string calls": "y = f'{reward_function(x, x)}'",
    "f-string with a conversion": "y = f'{x!r}'",
    "f-string width": "n = 1\ny = f'{n:1000000000}'",
    "f-string nested width": "n = 9\ny = f'{n:{n}}'",
    "percent width": "y = '%1000000000d' % 1",
    "percent precision": "y = '%.1000000000f' % 1.0",
    "percent width by name": "y = '%(a)1000000000d' % {'a': 1}",
    "percent width from a star": "y = '%*d' % (1000000000, 1)",
    "string join": "y = 'a'.join(['b'])",
    "string translate": "y = 'a'.translate({})",
    "string encode": "y = 'a'.encode('idna')",
    "string multiplied": "y = 'a' * 999999",
    "escape sequence for a terminal": "y = '\\x1b]0;gone\\x07'",
    "half a character": "y = '\\ud800'",
}
SYNTAX = {
    "lambda": "f = lambda a=open: a",
    "while": "while True:\n    pass",
    "generator": "y = sum(i for i in range(9))",
    "set comprehension": "y = {i for i in range(9)}",
    "dict comprehension": "y = {i: i for i in range(9)}",
    "comprehension bomb": "y = [1 for a in range(9) for b in range(9)]",
    "loops within loops": "for a in range(9):\n    for b in range(9):\n        for c in range(9):\n            pass",
    "async comprehension": "y = [i async for i in x]",
    "await": "await x",
    "yield": "yield x",
    "yield from": "yield from x",
    "global": "global scene_info\nscene_info = 1",
    "nonlocal": "nonlocal x",
    "try": "try:\n    pass\nexcept BaseException:\n    pass",
    "except star": "try:\n    pass\nexcept* ValueError:\n    pass",
    "with": "with x:\n    pass",
    "raise": "raise x",
    "assert": "assert x",
    "del": "del states['eef_pos']",
    "match": "match x:\n    case _:\n        pass",
    "match on a class": "match x:\n    case Lift(envs=e):\n        pass",
    "walrus": "y = (z := 1)",
    "walrus in a comprehension": "y = [z := i for i in range(3)]",
    "star call": "torch.zeros(*[1, 2])",
    "double star call": "torch.zeros(**{'size': (1,)})",
    "star target": "a, *b = x",
    "import inside": "import os",
    "import from inside": "from os import system",
    "function in a function": "def f():\n    pass",
    "async function": "async def f():\n    pass",
    "class in a function": "class A:\n    pass",
    "type alias": "type A = open",
    "called subscript": "y = [len][0](x)",
    "called call": "y = reward_function(x, x)(1)",
    "called constant": "y = (1)()",
    "annotation that runs": "y: open('x') = 1",
    "annotation by attribute": "y: torch.os.PathLike = 1",
    "annotation in quotes": "y: 'open' = 1",
    "complex number": "y = 1j",
    "deep nesting": "y = " + "(" * 300 + "1" + ")" * 300,
    "deep operators": "y = " + "-" * 60 + "1",
    "deep lists": "y = " + "[" * 90 + "]" * 90,
    "deep attributes": "y = x" + ".T" * 60,
    "deep subscripts": "y = x" + "[0]" * 60,
    "a name of ten thousand letters": "y = " + "a" * 10_000,
}
NUMBERS = {
    "huge power": "y = 9 ** 9 ** 9",
    "tower of powers": "y = ((9 ** 8) ** 8) ** 8",
    "power of a name": "n = 9\ny = n ** n",
    "power by assignment": "n = 9\nn **= n",
    "shift": "y = 1 << 999999",
    "shift by assignment": "n = 1\nn <<= 999999",
    "huge number": "y = 10000000000000000000",
    "huge hexadecimal": "y = 0x" + "f" * 20_000,
    "long list": "y = [0] * 999999",
    "long tuple": "y = 999999 * (0,)",
    "long dict of lists": "y = {'a': [0] * 999999}",
}
REACH = {
    "the environment's inside": "self.envs.bundle",
    "the environment in another name": "e = self.envs\ny = e.physics",
    "another environment": "self.envs = states",
    "the environment's number": "self.envs.num_envs = 1",
    "base class's inside": "Task.compute_success(self, states)",
    "base class changed": "Task.compute_success = reward_function",
    "own class changed": "Lift.compute_success = reward_function",
    "torch function replaced": "torch.where = reward_function",
    "linalg function replaced": "torch.linalg.norm = reward_function",
    "math constant replaced": "math.pi = 3",
    "a tensor's attribute replaced": "x.T = x",
    "tensor method replaced": "Tensor.norm = reward_function",
    "tensor method replaced in a loop": "for Tensor.norm in [reward_function]:\n    pass",
    "tensor method replaced in a tuple": "a, Tensor.norm = 1, reward_function",
    "tensor method replaced under another name": "t = Tensor\nt.norm = reward_function",
    "new self": "self = states",
    "new torch": "torch = states",
    "new builtin name in a loop": "for self in x:\n    pass",
    "own name of a tensor's method": "self.untyped_storage = 1",
    "own name of a dict's method": "self.popitem = 1",
    "own name with an underscore": "self._hidden = 1",
    "own attribute with a dunder": "self.__array_interface__ = {}",
    "assets folder moved": "self.urdf_assets_root = '/etc'",
    "scene info replaced": "self.scene_info = states",
}
FROM_A_FUNCTION = {
    "tensor method replaced in a function": "Tensor.norm = reward_function",
    "torch function replaced in a function": "torch.where = reward_function",
    "math constant replaced in a function": "math.pi = 3",
    "tensor method replaced by adding": "Tensor.norm += 1",
    "the tensor's transpose replaced in a function": "r.T = r",
    "attribute of an argument": "actions.values = 1",
    "self outside of the class": "self = actions",
    "a super without a class": "super().compute_success(states)",
}
MODULE = {
    "print at module level": "print('hello')",
    "open at module level": "x = open('f')",
    "import os": "import os",
    "import sys and torch": "import torch, sys",
    "import a part of torch": "import torch.utils.cpp_extension",
    "import numpy": "import numpy as np",
    "import from os": "from os import system",
    "relative import": "from . import sandbox",
    "relative import of a parent": "from .. import errors",
    "star import": "from torch import *",
    "star import of typing": "from typing import *",
    "torch under another name": "import torch as t",
    "part of torch": "from torch import load",
    "typing's way to builtins": "from typing import sys",
    "the project's own modules": "from v2p_data.task import sandbox",
    "the future": "from __future__ import annotations",
    "ctypes": "import ctypes",
    "pickle": "import pickle",
    "decorator": "@staticmethod\ndef f():\n    pass",
    "decorator that runs": "@torch.hub.load('a', 'b')\ndef f():\n    pass",
    "decorator by subscript": "@[eval][0]\ndef f():\n    pass",
    "decorator that looks right": "@torch.jit.script('x')\ndef f():\n    pass",
    "default argument that runs": "def f(a=open('x')):\n    pass",
    "default argument in a keyword": "def f(*, a=open('x')):\n    pass",
    "annotation that runs": "def f(a: open('x')):\n    pass",
    "return annotation that runs": "def f() -> open('x'):\n    pass",
    "star arguments": "def f(*a):\n    pass",
    "double star arguments": "def f(**a):\n    pass",
    "type parameters": "def f[T: (open('x'))](a):\n    pass",
    "another class": "class Other(Task):\n    pass",
    "dunder getattr of the module": "def __getattr__(name):\n    pass",
    "hidden name": "_hidden = 1",
    "dunder name": "__builtins__ = {}",
    "comprehension": "x = [i for i in (1, 2)]",
    "loop": "for i in range(3):\n    pass",
    "condition": "if True:\n    x = 1",
    "walrus": "(x := 1)",
    "assignment to an attribute": "torch.where = 1",
    "assignment to an item": "a = {}\na['b'] = 1",
    "deletion": "del scene_info",
    "text multiplied in a constant": "a = 'x' * 999999",
    "sum of texts multiplied in a constant": "a = ('x' + 'y') * 999999",
    "list multiplied in a constant": "a = [1] * 999999",
    "power in a constant": "a = 9 ** 9 ** 9",
    "f-string in a constant": "a = f'{open}'",
    "Task under another name": "T = Task",
    "Task anew": "class Task:\n    pass",
    "Tensor anew": "def Tensor():\n    pass",
    "a coroutine": "async def f():\n    pass",
}
MEMBERS = {
    "code in the class body": "y = open('x')",
    "loop in the class body": "for i in range(3):\n    pass",
    "condition in the class body": "if True:\n    pass",
    "call after a docstring": "eval('1')",
    "nested class": "class A:\n    pass",
    "property": "@property\ndef shown(self):\n    return 1",
    "classmethod": "@classmethod\ndef made(self):\n    return 1",
    "dunder getattr": "def __getattr__(self, name):\n    pass",
    "dunder getattribute": "def __getattribute__(self, name):\n    pass",
    "dunder call": "def __call__(self):\n    pass",
    "dunder del": "def __del__(self):\n    pass",
    "dunder reduce": "def __reduce__(self):\n    return 1",
    "dunder init subclass": "def __init_subclass__(self):\n    pass",
    "dunder class getitem": "def __class_getitem__(self, k):\n    pass",
    "dunder set name": "def __set_name__(self, a, b):\n    pass",
    "torch's own protocol": "def __torch_function__(self, a, b):\n    pass",
    "slots": "__slots__ = ('a',)",
    "another name for self": "def f(this):\n    pass",
    "no self": "def f():\n    pass",
    "static success": "@staticmethod\ndef compute_observation_key(states):\n    return []",
    "a method of a tensor's name": "def norm(self):\n    pass",
    "a method of a dict's name": "def get(self, k):\n    pass",
    "two names at a time": "a, b = 1, 2",
    "annotation that runs in the class body": "a: open('x') = 1",
    "async method": "async def f(self):\n    pass",
}
WHOLE = {
    "metaclass": SKELETON.replace("(Task)", "(Task, metaclass=type)"),
    "two bases": SKELETON.replace("(Task)", "(Task, dict)"),
    "a tensor for a base": SKELETON.replace("(Task)", "(Tensor)"),
    "base that runs": SKELETON.replace("(Task)", "(open('x'))"),
    "star base": SKELETON.replace("(Task)", "(*[Task])"),
    "keyword of the class": SKELETON.replace("(Task)", "(Task, total=eval('1'))"),
    "type parameter of the class": SKELETON.replace("Lift(Task)", "Lift[T: (open('x'))](Task)"),
    "decorator of the class": SKELETON.replace("class Lift", "@eval\nclass Lift"),
    "no class": "import torch\nx = 1\n",
    "nothing": "",
    "null byte": program("y = 1\0"),
    "half a character in the source": program("y = '\ud800'"),
    "carriage return hides a line": program("y = 1 # fine\reval('1')"),
    "form feed hides a line": program("y = 1 # fine\feval('1')"),
    "line separator": program("y = 1 # fine\u2028eval('1')"),
    "backspace hides what stands before": program("eval('1') #\b\b\b\b"),
    "text turned around": program("y = 1 # \u202e )'1'(lave"),
    "encoding of another kind": "# -*- coding: utf-7 -*-\n" + program("y = +AGUAdgBhAGw-('1')"),
    "rot13 cookie": "# coding: rot13\n" + program("y = riny('1')"),
    "full-width eval": program("y = \uff45\uff56\uff41\uff4c('1')"),
    "full-width attribute": program("y = x.\uff4e\uff55\uff4d\uff50\uff59()"),
    "full-width dunder": program("y = x.__\uff43lass__"),
    "full-width allowed name": program("y = torch.\uff4eorm(x)"),
    "mathematical letters": program("y = \U0001d41e\U0001d42f\U0001d41a\U0001d425('1')"),
    "Cyrillic letter": program("y = \u0435val('1')"),
    "ligature": program("y = \ufb01lter(x)"),
    "foreign name of its own": program("gr\u00f6\u00dfe = 1"),
    "keyword in full-width letters": program("\uff49mport os"),
    "sixty thousand characters": program("y = 1\n" * 12_000),
    "twenty thousand nodes": program("y=1;" * 9_000),
    "parser's stack": program("y = " + "(" * 5_000 + ")" * 5_000),
    "ten thousand minus signs": program("y = " + "-" * 10_000 + "1"),
    "ten thousand additions": program("y = " + "1+" * 10_000 + "1"),
    "ten thousand attributes": program("y = x" + ".T" * 10_000),
    "a number of five thousand digits": program("y = " + "9" * 5_000),
    "code in a docstring that ends early": program('"""fine"""; eval("1")', "MEMBER"),
    "semicolons": program("y = 1; import os"),
    "line continuation": program("y = \\\neval('1')"),
    "a marked body that is not closed": program("y = '''"),
    "tabs and blanks": program("if 1:\n\ty = 1\n        y = 2"),
}

REFUSED: dict[str, str] = {
    f"{room}: {name}": program(text, place)
    for room, place, attempts in (
        ("dunder", "BODY", DUNDER_WALKS),
        ("builtin", "BODY", BUILTINS),
        ("torch", "BODY", TORCH),
        ("tensor", "BODY", TENSOR_METHODS),
        ("format", "BODY", FORMATS),
        ("syntax", "BODY", SYNTAX),
        ("number", "BODY", NUMBERS),
        ("reach", "BODY", REACH),
        ("function", "FUNCTION", FROM_A_FUNCTION),
        ("module", "TOP", MODULE),
        ("member", "MEMBER", MEMBERS),
    )
    for name, text in attempts.items()
} | {f"whole: {name}": text for name, text in WHOLE.items()}
"""What the reader must refuse, by what it tries."""


_TWICE = "def twice(n):\n    return 0 if n == 0 else twice(n - 1) + twice(n - 1)"
_BUILD = "y = {seed}\nfor i in range(200):\n    y = y + y"

CONTAINED: dict[str, tuple[str, str]] = {
    "memory: one tensor too large": (program("y = torch.zeros(1000000, 1000000)"), "memory"),
    "memory: a size calculated": (program("n = int(1e12)\ny = torch.zeros(n)"), "memory"),
    "memory: doubled by cat": (
        program("y = x\nfor i in range(60):\n    y = torch.cat([y, y])"),
        "",
    ),
    "memory: tile": (program("y = torch.tile(x, (100000, 100000))"), "memory"),
    "memory: outer product": (
        program("y = torch.arange(300000.0)\ny = torch.outer(y, y)"),
        "memory",
    ),
    "memory: a view spelled out": (
        program("y = torch.zeros(1).expand(1000000, 100000).tolist()"),
        "",
    ),
    "memory: a view made solid": (
        program("y = torch.zeros(1).expand(1000000, 1000000).contiguous()"),
        "memory",
    ),
    "memory: distances of all to all": (
        program("y = torch.zeros(200000, 3)\ny = torch.cdist(y, y)"),
        "memory",
    ),
    "memory: meshgrid": (
        program(
            "y = torch.arange(100000.0)\na, b = torch.meshgrid(y, y, indexing='ij')\ny = a + b"
        ),
        "memory",
    ),
    "memory: einsum": (
        program("y = torch.ones(5000)\ny = torch.einsum('a,b,c->abc', y, y, y)"),
        "memory",
    ),
    "memory: list doubled": (program(_BUILD.replace("{seed}", "[0]")), ""),
    "memory: list by assignment": (program("y = [0]\ny *= 999999\ny *= 999999"), "memory"),
    "memory: keys without end": (
        program(
            "def compute_observation_key(self, states):\n    y = ['base_observation']\n    for i "
            "in range(24):\n        y = y + y\n    return y",
            "MEMBER",
        ),
        "",
    ),
    "memory: components without end": (
        program(
            "y = {}\nfor i in range(1000):\n    y[str(i)] = actions[:, 0]\nreturn actions[:, 0], y",
            "REWARD",
        ),
        "components",
    ),
    "memory: kept on self": (
        program(
            "self.kept = [x]\nfor i in range(999):\n    self.kept = [self.kept, torch.zeros(100000, 1000)]"
        ),
        "memory",
    ),
    "memory: a tuple times a number": (program("y = (0, 0)\ny = y * int(1e12)"), "memory"),
    "memory: width put together": (
        program("y = '%9'\nfor i in range(9):\n    y = y + '9'\nz = (y + 'd') % 1"),
        "",
    ),
    "time: squares of a whole number": (
        program("y = 3\nfor i in range(99):\n    y = y * y"),
        "took more than",
    ),
    "time: loops called by loops": (
        program("y = [loop(1) for i in range(999)]").replace(
            "#TOP",
            "def loop(n):\n    y = [inner(i) for i in range(999)]\n    return y\ndef inner(n):\n  "
            "  y = [i for i in range(999)]\n    return n",
        ),
        "took more than",
    ),
    "time: calls that double": (
        program("y = twice(60)").replace("#TOP", _TWICE),
        "took more than",
    ),
    "time: slow beside the limit": (
        program(
            "y = torch.ones(1500, 1500)\nfor i in range(999):\n    y = y.matmul(y).clamp(0, 1)"
        ),
        "took more than",
    ),
    "time: the constructor never ends": (
        program("self.y = twice(60)", "INIT").replace("#TOP", _TWICE),
        "took more than",
    ),
    "depth: recursion without end": (
        program("return self.compute_success(states)"),
        "RecursionError",
    ),
    "depth: two functions that call each other": (
        program("y = ping(1)").replace(
            "#TOP", "def ping(n):\n    return pong(n)\ndef pong(n):\n    return ping(n)"
        ),
        "RecursionError",
    ),
    "depth: printing a list in lists": (
        program(
            "y = []\nfor i in range(999):\n    for j in range(999):\n        y = [y]\nz = str(y)"
        ),
        "",
    ),
    "depth: kinds in kinds": (
        program(
            "y = (int, float)\nfor i in range(999):\n    for j in range(50):\n        y = (y, "
            "y)\nz = isinstance(states, y)"
        ),
        "",
    ),
    "depth: lists that hold themselves": (
        program("y = []\ny.append(y)\nz = []\nz.append(z)\nif y == z:\n    y = 1"),
        "RecursionError",
    ),
    "range: a million steps": (
        program("for i in range(999999):\n    pass"),
        "range of 999999 steps",
    ),
    "range: backwards": (
        program("for i in range(999999, 0, -1):\n    pass"),
        "range of 999999 steps",
    ),
    "states: written into": (program("x[0, 0] = 1"), "changes states['box_pos'] in place"),
    "states: written into by a view": (
        program("y = x[:, 2]\ny += 1"),
        "changes states['box_pos'] in place",
    ),
    "states: written into by a method": (
        program("x.zero_()"),
        "changes states['box_pos'] in place",
    ),
    "states: written into by clamp": (
        program("torch.where(x > 9, x, x)\nx.view(-1).clamp_(0, 1)"),
        "changes states['box_pos'] in place",
    ),
    "states: another key replaced": (
        program("states['eef_pos'] = x + 1"),
        "changes states['eef_pos'] in place",
    ),
    "states: a key taken out": (
        program("states.pop('eef_pos')"),
        "changes states['eef_pos'] in place",
    ),
    "states: all replaced": (
        program("states.update({'table_height': x[:, 0]})"),
        "changes states['table_height'] in place",
    ),
    "states: the observation replaced": (
        program("states['base_observation'] = states['base_observation'] * 0"),
        "changes states['base_observation'] in place",
    ),
    "states: written into by the reward": (
        program("states['box_pos'][:, 2] += 1", "REWARD"),
        "changes states['box_pos'] in place",
    ),
    "states: written into by a helper": (
        program("states['box_pos'].fill_(0.0)", "FUNCTION"),
        "changes states['box_pos'] in place",
    ),
    "states: an action written into": (
        program("actions.fill_(0.0)", "REWARD"),
        "changes the actions in place",
    ),
    "states: an action written into by a view": (
        program("actions[:, 6] = 1.0", "FUNCTION"),
        "changes the actions in place",
    ),
    "states: a key that is no text": (
        program("states[1] = x\nreturn states"),
        "compute_success must be a tensor, not dict",
    ),
    "answer: a text": (program("return 'yes'"), "must be a tensor, not str"),
    "answer: a number": (program("return True"), "must be a tensor, not bool"),
    "answer: the task itself": (program("return self"), "must be a tensor, not Lift"),
    "answer: a class": (program("return Lift"), "must be a tensor, not type"),
    "answer: torch's stand-in for Tensor": (program("return Tensor"), "must be a tensor"),
    "answer: a function": (program("return reward_function"), "must be a tensor, not function"),
    "answer: nested tuples": (program("return (x, (x, (x,)))"), "must be a tensor, not tuple"),
    "answer: a tensor without numbers": (program("return x.to('meta')[:, 0] > 0"), ""),
    "answer: not finite": (
        program("r = torch.log(-1 - states['progress'])", "FUNCTION"),
        "not finite",
    ),
    "answer: names that are no text": (
        program("return actions[:, 0], {1: actions[:, 0]}", "REWARD"),
        "no name for a reward component",
    ),
    "answer: a reward and no parts": (
        program("return actions[:, 0]", "REWARD"),
        "must return the reward and a dict",
    ),
    "answer: memory as it was": (program("y = Tensor(5)"), "made of a list of numbers"),
    "answer: memory as it was, by another name": (
        program("y = torch.FloatTensor(5)"),
        "made of a list of numbers",
    ),
    "answer: a reset that gives states away": (
        program("def reset_objects_states(self, env_ids):\n    return self.scene_info", "MEMBER"),
        "must return a pose per object",
    ),
    "answer: a reset of texts": (
        program("def reset_objects_states(self, env_ids):\n    return {'box': 'here'}", "MEMBER"),
        "must be a tensor of shape",
    ),
    "answer: a reset to nowhere": (
        program(
            "def reset_objects_states(self, env_ids):\n    return {'box': torch.full((len(env_ids), 7), torch.nan)}",
            "MEMBER",
        ),
        "not finite",
    ),
    "answer: observations of another length": (
        program("def get_observation_space(self):\n    return 1000", "MEMBER"),
        "says 1000",
    ),
    "answer: a key of nothing": (
        program("def compute_observation_key(self, states):\n    return ['nothing']", "MEMBER"),
        "is not in states",
    ),
    "answer: differs from call to call": (
        program("self.calls = self.calls + 1\nx = x * self.calls").replace(
            "#INIT", "self.calls = 0"
        ),
        "two calls",
    ),
    "answer: depends on the order": (
        program("x = x * torch.arange(len(x)).reshape(-1, 1)"),
        "order",
    ),
    "environment: more of it than there is": (
        program("y = self.envs.sample_object_poses(torch.arange(9999))"),
        "in reset_objects_states only",
    ),
    "environment: a text for numbers": (
        program("y = self.envs.sample_object_poses('all')"),
        "in reset_objects_states only",
    ),
    "error: unknown state": (program("y = states['nothing']"), "line 15: KeyError"),
    "error: a division by zero": (program("y = 1 / 0"), "line 15: ZeroDivisionError"),
    "error: a device that is not there": (program("y = x.to('cuda:63')"), ""),
    "error: a kernel that does not fit": (
        program("y = x.gather(1, torch.full((4, 4), 99))"),
        "Error",
    ),
}
"""What passes the reader and must fail in the child, with words of the sentence ('' where there are several)."""
