"""TinyViT, the image encoder of MobileSAM: a picture becomes 256 features at 64 x 64 places.

The modules are named as in the published checkpoint, so that its tensors load by name.

Sources: Wu et al. 2022 (TinyViT), arXiv:2207.10666; Zhang et al. 2023 (MobileSAM), arXiv:2306.14289.
"""

import torch
from jaxtyping import Float
from torch import nn
from torch.nn import functional as F  # noqa: N812  (the usual name)

SIDE_PX = 1024
"""Side of the square picture that the encoder takes."""
_WIDTHS = (64, 128, 160, 320)
_DEPTHS = (2, 2, 6, 2)
_HEADS = (2, 4, 5, 10)
_WINDOWS = (7, 7, 14, 7)
_GRIDS = (256, 128, 64, 64)
"""Places along a side at each stage; the last stage keeps its resolution."""
_FEATURES = 256


class TinyViT(nn.Module):
    """The encoder with 5 million parameters."""

    def __init__(self) -> None:
        super().__init__()
        half = _WIDTHS[0] // 2
        stem = nn.Sequential(_conv_bn(3, half, 3, 2), nn.GELU(), _conv_bn(half, _WIDTHS[0], 3, 2))
        self.patch_embed = nn.ModuleDict({"seq": stem})
        stages = [_Stage(k) for k in range(len(_WIDTHS))]
        self.layers = nn.ModuleList(stages)
        self.neck = nn.Sequential(
            nn.Conv2d(_WIDTHS[-1], _FEATURES, 1, bias=False),
            _PlaneNorm(_FEATURES),
            nn.Conv2d(_FEATURES, _FEATURES, 3, padding=1, bias=False),
            _PlaneNorm(_FEATURES),
        )

    def forward(self, x: Float[torch.Tensor, "n 3 h w"]) -> Float[torch.Tensor, "n 256 64 64"]:
        """Return the features of normalised pictures of `SIDE_PX`."""
        x = self.patch_embed["seq"](x)
        for stage in self.layers:
            x = stage(x)
        return self.neck(x)


class _Stage(nn.Module):
    """Blocks at one resolution, then a merge of places towards the next stage."""

    def __init__(self, k: int) -> None:
        super().__init__()
        width = _WIDTHS[k]
        blocks = [
            _Block(width, _HEADS[k], _WINDOWS[k]) if k else _InvertedBottleneck(width)
            for _ in range(_DEPTHS[k])
        ]
        self.blocks = nn.Sequential(*blocks)
        self.downsample = None
        if k + 1 < len(_WIDTHS):
            self.downsample = _Merge(width, _WIDTHS[k + 1], _GRIDS[k] // _GRIDS[k + 1])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = self.blocks(x)
        return x if self.downsample is None else self.downsample(x)


class _InvertedBottleneck(nn.Module):
    """A wider depthwise convolution beside a shortcut."""

    def __init__(self, width: int) -> None:
        super().__init__()
        inner = 4 * width
        self.conv1 = _conv_bn(width, inner, 1)
        self.conv2 = _conv_bn(inner, inner, 3, groups=inner)
        self.conv3 = _conv_bn(inner, width, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = F.gelu(self.conv2(F.gelu(self.conv1(x))))
        return F.gelu(x + self.conv3(y))


class _Merge(nn.Module):
    """Places are merged by `stride` and their features widened."""

    def __init__(self, width: int, out: int, stride: int) -> None:
        super().__init__()
        self.conv1 = _conv_bn(width, out, 1)
        self.conv2 = _conv_bn(out, out, 3, stride, groups=out)
        self.conv3 = _conv_bn(out, out, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.conv3(F.gelu(self.conv2(F.gelu(self.conv1(x)))))


class _Block(nn.Module):
    """Attention within windows, a depthwise convolution across them, and a perceptron."""

    def __init__(self, width: int, heads: int, window: int) -> None:
        super().__init__()
        self.window = window
        self.attn = _WindowAttention(width, heads, window)
        self.local_conv = _conv_bn(width, width, 3, groups=width)
        self.mlp = nn.ModuleDict(
            {
                "norm": nn.LayerNorm(width),
                "fc1": nn.Linear(width, 4 * width),
                "fc2": nn.Linear(4 * width, width),
            }
        )

    def forward(self, x: Float[torch.Tensor, "n c h w"]) -> Float[torch.Tensor, "n c h w"]:
        n, c, h, w = x.shape
        side = self.window
        rows, columns = -(-h // side), -(-w // side)
        y = F.pad(x.permute(0, 2, 3, 1), (0, 0, 0, columns * side - w, 0, rows * side - h))
        y = y.reshape(n, rows, side, columns, side, c).transpose(2, 3)
        y = self.attn(y.reshape(-1, side * side, c))
        y = y.reshape(n, rows, columns, side, side, c).transpose(2, 3)
        y = y.reshape(n, rows * side, columns * side, c)[:, :h, :w]
        x = self.local_conv(x + y.permute(0, 3, 1, 2))
        tokens = x.flatten(2).transpose(1, 2)
        mlp = self.mlp
        tokens = tokens + mlp["fc2"](F.gelu(mlp["fc1"](mlp["norm"](tokens))))
        return tokens.transpose(1, 2).reshape(n, c, h, w)


class _WindowAttention(nn.Module):
    """Attention among the places of a window, with one learned bias per head and distance of rows and columns."""

    def __init__(self, width: int, heads: int, window: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)
        self.attention_biases = nn.Parameter(torch.zeros(heads, window * window))
        row = torch.arange(window).repeat_interleave(window)
        column = torch.arange(window).repeat(window)
        apart = (row[:, None] - row).abs() * window + (column[:, None] - column).abs()
        self.register_buffer("apart", apart, persistent=False)
        self.apart: torch.Tensor

    def forward(self, x: Float[torch.Tensor, "n place c"]) -> Float[torch.Tensor, "n place c"]:
        n, places, c = x.shape
        # Each head has its query, key and value side by side.
        qkv = self.qkv(self.norm(x)).view(n, places, self.heads, 3, c // self.heads)
        q, k, v = qkv.permute(3, 0, 2, 1, 4)
        bias = self.attention_biases[:, self.apart]
        y = F.scaled_dot_product_attention(q, k, v, attn_mask=bias)
        return self.proj(y.transpose(1, 2).reshape(n, places, c))


class _PlaneNorm(nn.Module):
    """Layer norm over the channels of each place."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))
        self.bias = nn.Parameter(torch.zeros(width))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = F.layer_norm(x.permute(0, 2, 3, 1), self.weight.shape, self.weight, self.bias, 1e-6)
        return y.permute(0, 3, 1, 2)


class _ConvBN(nn.Sequential):
    """A convolution and its batch norm, named as in the checkpoint."""


def _conv_bn(n_in: int, n_out: int, side: int, stride: int = 1, groups: int = 1) -> nn.Sequential:
    both = _ConvBN()
    both.add_module(
        "c", nn.Conv2d(n_in, n_out, side, stride, side // 2, groups=groups, bias=False)
    )
    both.add_module("bn", nn.BatchNorm2d(n_out))
    return both
