"""What task code may name: the allow-lists of `sandbox`. A name that is not here is refused."""


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
TYPING = _words("Any Dict List Optional Tuple Union Sequence")
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
"""Harmless on tensors of the task's own; `watched` sees to it that they are not used on others."""

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
