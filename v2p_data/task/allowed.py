"""What task code may name: the allow-lists of `sandbox`. A name that is not here is refused."""


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


BUILTINS = _words(
    "abs bool dict enumerate float int isinstance len list max min range round sum tuple zip"
)
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
    argmin asin atan atan2 bitwise_and bitwise_not bitwise_or bmm broadcast_to ceil clamp clamp_max clamp_min clip
    cos cosh cross cummax cummin cumprod cumsum deg2rad diff dist div dot eq exp expm1 flatten flip floor
    floor_divide fmod frac gather ge greater greater_equal gt hypot index_select isclose isfinite isinf isnan le
    lerp less less_equal log log10 log1p log2 logaddexp logical_and logical_not logical_or logical_xor logsumexp
    lt matmul max maximum mean median min minimum movedim mul multiply nan_to_num narrow ne neg negative norm
    not_equal outer permute positive pow prod rad2deg reciprocal relu remainder reshape roll round rsqrt sigmoid
    sign sin sinc sinh softmax sort sqrt square squeeze std sub subtract sum swapaxes take_along_dim tan tanh
    tile topk transpose true_divide trunc unbind unflatten unsqueeze var where
""")
"""Functions without side effects that exist under `torch` and on tensors."""

TORCH = _MATHS | _words("""
    arange as_tensor broadcast_tensors cat chunk column_stack concat concatenate einsum eye full full_like hstack
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

ATTRIBUTES = _MATHS | _words("""
    T mT bool chunk clone contiguous cpu detach device dim double dtype expand expand_as float half int item long
    ndim new_full new_ones new_tensor new_zeros numel repeat reshape_as shape size split to tolist type_as view
    view_as
    append copy count extend get index insert items keys pop setdefault update values
    envs num_envs sample_object_poses scene_info task_description urdf_assets_root
""")
"""Attributes and methods of tensors, of lists and dicts, of the base class, and the environment's two."""
