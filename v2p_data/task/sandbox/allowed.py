"""What task code may name and write, and how much of it: the allow-lists of `reader` and `sandbox`.

What is not here is refused.
"""

import ast

MAX_SOURCE_CHARS = 40_000
MAX_NODES = 10_000
MAX_DEPTH = 40
MAX_LOOP_DEPTH = 2
MAX_STRING_CHARS = 4_000
MAX_NUMBER = 1e6
MAX_EXPONENT = 8


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


BUILTINS = _words(
    "abs all any bool dict enumerate float int isinstance len list max min range reversed round sorted str sum "
    "tuple zip"
)
INSTEAD = {
    "print": "leave it out",
    "hasattr": "set the attribute in __init__",
    "getattr": "set the attribute in __init__ and write self.name",
    "setattr": "write self.name = value",
    "type": "use isinstance",
    "set": "use a list",
    "map": "use a list comprehension",
    "filter": "use a list comprehension",
    "pow": "use torch.pow",
    "slice": "write [a:b]",
    "open": "all that is known is in states",
}
"""What to write for some builtins that are asked for without harm in mind."""
MODULES = _words("torch math")
TYPING = _words("Any Dict List Optional Tuple Union Sequence")
TYPES = TYPING | _words("Tensor torch str int float bool dict list tuple")
IMPORTS = {
    "torch": _words("Tensor"),
    "typing": TYPING,
    "factory.tasks.task": _words("Task"),
}
"""What may be imported from where."""
TASK_METHODS = _words(
    "__init__ reset_objects_states compute_observation_key get_observation_space compute_success compute_reward"
)
MATH = _words("""
    acos asin atan atan2 cos cosh degrees e exp fabs floor hypot inf isfinite log log10 log2 nan pi radians sin
    sinh sqrt tan tanh tau
""")

_MATHS = _words("""
    abs absolute acos add addcdiv addcmul all allclose amax amin aminmax any arccos arcsin arctan arctan2 argmax
    argmin argsort asin atan atan2 bitwise_and bitwise_not bitwise_or bmm broadcast_to ceil clamp clamp_max clamp_min clip
    cos cosh count_nonzero cross cummax cummin cumprod cumsum deg2rad det diag diagonal diff dist div dot eq exp expm1 flatten flip floor
    floor_divide fmod frac gather ge greater greater_equal gt heaviside hypot index_select isclose isfinite isinf isnan le
    lerp less less_equal log log10 log1p log2 logaddexp logical_and logical_not logical_or logical_xor logsumexp
    lt masked_fill masked_select matmul max maximum mean median min minimum movedim mul multiply nan_to_num narrow ne neg negative norm
    nonzero not_equal outer permute positive pow prod rad2deg reciprocal relu remainder reshape roll round rsqrt scatter sgn sigmoid
    sign sin sinc sinh softmax sort sqrt square squeeze std sub subtract sum swapaxes take_along_dim tan tanh
    tile topk trace transpose true_divide trunc unbind unflatten unsqueeze var where
""")
"""Functions without side effects that exist under `torch` and on tensors."""

TORCH = _MATHS | _words("""
    arange as_tensor cdist clone broadcast_tensors cat chunk column_stack concat concatenate einsum eye full full_like hstack
    is_tensor linspace meshgrid ones ones_like split stack tensor vstack zeros zeros_like
    Tensor FloatTensor bool device double dtype float float16 float32 float64 half int int32 int64 long uint8
    e inf nan pi
""")
TORCH_NAMESPACES = {
    "linalg": _words("cross matrix_norm norm vecdot vector_norm"),
    "nn.functional": _words("""
        cosine_similarity elu gelu hardtanh huber_loss l1_loss leaky_relu logsigmoid mse_loss normalize
        pairwise_distance relu sigmoid silu smooth_l1_loss softmax softplus tanh
    """),
}
SCRIPT_DECORATOR = "torch.jit.script"
"""Accepted and dropped: the function runs as plain Python."""
STATIC_DECORATOR = "staticmethod"

IN_PLACE = _words("add_ clamp_ clip_ div_ fill_ masked_fill_ mul_ sub_ zero_")
"""Harmless on tensors of the task's own; `guarded` sees to it that they are not used on others."""

ATTRIBUTES = (
    _MATHS
    | IN_PLACE
    | _words("""
    T mT bool chunk clone contiguous cpu detach device dim double dtype expand expand_as float half int item long
    ndim new_full new_ones new_tensor new_zeros numel repeat reshape_as shape size split to tolist type_as view
    view_as
    indices is_floating_point startswith endswith
    append copy count extend get index insert items keys pop setdefault update values
    envs num_envs sample_object_poses scene_info task_description urdf_assets_root
""")
)
"""Attributes and methods of tensors, of lists and dicts, of the base class, and the environment's two."""

AT_MODULE_LEVEL = (
    ast.Import,
    ast.ImportFrom,
    ast.ClassDef,
    ast.FunctionDef,
    ast.Assign,
    ast.AnnAssign,
    ast.Expr,
)
IN_FUNCTIONS = (
    ast.Return,
    ast.Assign,
    ast.AugAssign,
    ast.AnnAssign,
    ast.For,
    ast.If,
    ast.Expr,
    ast.Pass,
    ast.Break,
    ast.Continue,
    ast.arguments,
    ast.arg,
    ast.BoolOp,
    ast.BinOp,
    ast.UnaryOp,
    ast.IfExp,
    ast.Compare,
    ast.Call,
    ast.Constant,
    ast.Attribute,
    ast.Subscript,
    ast.Name,
    ast.List,
    ast.Tuple,
    ast.Dict,
    ast.Slice,
    ast.ListComp,
    ast.comprehension,
    ast.JoinedStr,
    ast.FormattedValue,
    ast.keyword,
    ast.expr_context,
    ast.operator,
    ast.boolop,
    ast.unaryop,
    ast.cmpop,
)
"""Statements, their parts, expressions, their parts."""
INSTEAD_OF_SYNTAX = {
    "While": "while loops are not allowed; use tensor operations, or for with range",
    "Lambda": "lambda is not allowed; write a function at module level",
    "GeneratorExp": "generators are not allowed; use a list or a tensor operation",
    "Try": "try is not allowed; an error should be seen",
    "With": "with is not allowed; no gradients are kept anyway",
    "Global": "global is not allowed; keep state in tensors",
    "Nonlocal": "nonlocal is not allowed",
    "NamedExpr": "':=' is not allowed; assign on a line of its own",
    "Starred": "'*' is not allowed here; name the values",
    "Assert": "assert is not allowed",
    "Raise": "raise is not allowed",
    "Delete": "del is not allowed",
    "Yield": "yield is not allowed",
    "Match": "match is not allowed; use if",
}
"""What to write for some kinds of statements and expressions, or why they are refused."""
