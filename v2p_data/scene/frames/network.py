"""A small network of our own tells hand, moved thing, other things and table in one frame.

Three pictures go in: the frame, the still of the clip's beginning, and the still of its end. Class
probabilities and a guess of the camera come out. It was trained on rendered clips only
(`scripts/train_scene_network.py`); hands and the change they cause look much the same there. Weights
lie beside this file.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from safetensors.torch import load_file
from torch import nn
from torch.nn import functional as F  # noqa: N812  (the usual name)

from v2p_data.errors import V2PError
from v2p_data.scene.frames.classes import CLASSES, LONG_SIDE_PX
from v2p_data.scene.scale.camera_height import SeenCamera

WEIGHTS = Path(__file__).with_name("network.safetensors")
CAMERA_WEIGHTS = Path(__file__).with_name("camera.safetensors")
"""Of the network that is asked for the camera: it learned that longer than how real things look,
and sees those less well."""
_STEP = 16
_WIDTHS = (24, 48, 80, 128)
_CAMERA_EVERY = 3
"""Of the frames: one clip has one camera."""
_QUESTIONS = 4
"""Learned queries that gather from all places what tells of the camera: how large the hand is and where, say."""


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What the network says about some frames of a clip, at the frames' own size."""

    shares: Float32[np.ndarray, "n 5 h w"]
    """Probability of each class, summing to one."""
    camera: SeenCamera


def net_size(height_px: int, width_px: int) -> tuple[int, int]:
    """Return (height, width) at which the network looks at pictures of this size: longer side 256, multiples of 16."""
    step_px = max(height_px, width_px) * _STEP / LONG_SIDE_PX
    return max(1, round(height_px / step_px)) * _STEP, max(1, round(width_px / step_px)) * _STEP


class Encoder(nn.Module):
    """Four levels of a picture, each half as large as the one before.

    The coarsest compares all places with each other.
    """

    def __init__(self, n_in: int, widths: tuple[int, int, int, int]) -> None:
        super().__init__()
        a, b, c, d = widths
        self.stem = nn.Sequential(nn.Conv2d(n_in, a, 4, 2, 1), nn.BatchNorm2d(a), nn.ReLU())
        self.enc1 = _pair(a, a)
        self.enc2 = _pair(a, b)
        self.enc3 = _pair(b, c)
        self.enc4 = _pair(c, d)
        self.compare = nn.TransformerEncoderLayer(
            d, 4, 2 * d, dropout=0.0, batch_first=True, norm_first=True
        )

    def levels(self, x: Float[torch.Tensor, "n c h w"]) -> tuple[torch.Tensor, ...]:
        """Return the three finer levels as planes, and the coarsest as tokens (n, places, channels)."""
        x1 = self.enc1(self.stem(x))
        x2 = self.enc2(F.max_pool2d(x1, 2))
        x3 = self.enc3(F.max_pool2d(x2, 2))
        x4 = self.enc4(F.max_pool2d(x3, 2))
        return x1, x2, x3, self.compare(x4.flatten(2).transpose(1, 2))


class CameraNetwork(Encoder):
    """What a picture shows of its camera."""

    def __init__(self) -> None:
        super().__init__(15, _WIDTHS)
        d = _WIDTHS[-1]
        self.ask = nn.Parameter(0.02 * torch.randn(1, _QUESTIONS, d))
        self.answer = nn.MultiheadAttention(d, 4, batch_first=True)
        self.camera = nn.Sequential(nn.Linear(_QUESTIONS * d + 1, 64), nn.ReLU(), nn.Linear(64, 6))

    def camera_of(self, x: Float[torch.Tensor, "n 15 h w"]) -> Float[torch.Tensor, "n 6"]:
        """Return (pitch [rad], log focal over width, log width of the table [m], log sd of each)."""
        tokens = self.levels(x)[-1]
        return self._camera(tokens, x.shape[3] / x.shape[2])

    def _camera(self, tokens: torch.Tensor, aspect: float) -> torch.Tensor:
        n, device = len(tokens), tokens.device
        with torch.autocast(device.type, enabled=False):  # half precision is too coarse for angles
            tokens = tokens.float()
            gathered = self.answer(self.ask.expand(n, -1, -1), tokens, tokens)[0].flatten(1)
            shape = torch.full((n, 1), float(np.log(aspect)), device=device)
            return self.camera(torch.cat([gathered, shape], 1))


class SceneNetwork(CameraNetwork):
    """U-Net on the camera's encoder: the class of every pixel."""

    def __init__(self) -> None:
        super().__init__()
        a, b, c, d = _WIDTHS
        self.dec3 = _pair(c + d, c)
        self.dec2 = _pair(b + c, b)
        self.dec1 = _pair(a + b, a)
        self.head = nn.Sequential(nn.Conv2d(a, len(CLASSES) * 4, 3, padding=1), nn.PixelShuffle(2))

    def forward(
        self, x: Float[torch.Tensor, "n 15 h w"]
    ) -> tuple[Float[torch.Tensor, "n 5 h w"], Float[torch.Tensor, "n 6"]]:
        """Return class logits, and the camera as `camera_of` does: learning the one helps the other."""
        x1, x2, x3, tokens = self.levels(x)
        return self._classes(x1, x2, x3, tokens), self._camera(tokens, x.shape[3] / x.shape[2])

    def classes_of(self, x: Float[torch.Tensor, "n 15 h w"]) -> Float[torch.Tensor, "n 5 h w"]:
        """Return class logits."""
        return self._classes(*self.levels(x))

    def _classes(
        self, x1: torch.Tensor, x2: torch.Tensor, x3: torch.Tensor, tokens: torch.Tensor
    ) -> torch.Tensor:
        n, d, h, w = *tokens.shape[::2], *(side // 2 for side in x3.shape[2:])
        x4 = tokens.transpose(1, 2).reshape(n, d, h, w)
        up = self.dec3(torch.cat([x3, _twice(x4)], 1))
        up = self.dec2(torch.cat([x2, _twice(up)], 1))
        up = self.dec1(torch.cat([x1, _twice(up)], 1))
        return self.head(up)


def inputs_of(
    frame: UInt8[torch.Tensor, "n 3 h w"],
    early: UInt8[torch.Tensor, "n 3 h w"],
    late: UInt8[torch.Tensor, "n 3 h w"],
) -> Float[torch.Tensor, "n 15 h w"]:
    """Return the network's input: the three pictures, how much each pair differs, and the place."""
    now, before, after = (x.float() / 127.5 - 1 for x in (frame, early, late))
    pairs = ((now, before), (now, after), (before, after))
    changes = [(p - q).abs().amax(1, keepdim=True) for p, q in pairs]
    n, _, h, w = frame.shape
    longest = max(h, w)
    y = (torch.arange(h, device=frame.device) - h / 2) / longest * 2
    x = (torch.arange(w, device=frame.device) - w / 2) / longest * 2
    place = [y[None, None, :, None].expand(n, 1, h, w), x[None, None, None, :].expand(n, 1, h, w)]
    flat = (before - after).mean(1, keepdim=True)
    return torch.cat([now, before, after, *changes, flat, *place], 1)


@lru_cache(maxsize=1)
def network() -> SceneNetwork:
    """Return the trained network that says what each pixel is, on the CPU.

    Raises:
        V2PError: its weights are missing or belong to another version.
    """
    return trained(SceneNetwork(), WEIGHTS)


@lru_cache(maxsize=1)
def camera_network() -> CameraNetwork:
    """Return the trained network that is asked for the camera, on the CPU.

    Raises:
        V2PError: its weights are missing or belong to another version.
    """
    return trained(CameraNetwork(), CAMERA_WEIGHTS)


def trained[N: nn.Module](
    net: N, weights: Path, script: str = "scripts/train_scene_network.py"
) -> N:
    """Return a network with the weights that the script wrote, ready to be asked, on the CPU.

    Raises:
        V2PError: the weights are missing or belong to another version.
    """
    if not weights.is_file():
        raise V2PError(
            f"the weights {weights.name} are not beside network.py; reinstall the package, or train them with {script}"
        )
    try:
        net.load_state_dict({k: v.float() for k, v in load_file(weights).items()})
    except (RuntimeError, ValueError, OSError) as error:
        raise V2PError(
            f"{weights.name} does not fit this version's network; train it anew with {script} ({type(error).__name__})"
        ) from error
    net.eval()
    return net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # five times as fast on a CPU


@torch.inference_mode()
def classify(
    frames: UInt8[np.ndarray, "n h w 3"],
    early: UInt8[np.ndarray, "n h w 3"],
    late: UInt8[np.ndarray, "n h w 3"],
    batch: int = 8,
) -> Seen:
    """Return what the network sees in frames of one clip, given the stills of beginning and end that go with each."""
    h, w = frames.shape[1:3]
    size = net_size(h, w)
    net, eye = network(), camera_network()
    shares = np.empty((len(frames), len(CLASSES), h, w), np.float32)
    cameras = []
    for start in range(0, len(frames), batch):
        part = slice(start, start + batch)
        three = [
            torch.from_numpy(np.stack([resized(image, size) for image in images[part]])).permute(
                0, 3, 1, 2
            )
            for images in (frames, early, late)
        ]
        x = inputs_of(*three).contiguous(memory_format=torch.channels_last)
        for full, small in zip(shares[part], net.classes_of(x).softmax(1).numpy(), strict=True):
            for plane, own in zip(full, small, strict=True):
                cv2.resize(own, (w, h), dst=plane, interpolation=cv2.INTER_LINEAR)
        # A mirrored picture shows the same camera; what is guessed otherwise there is chance.
        flipped = inputs_of(*(y[::_CAMERA_EVERY].flip(-1) for y in three))
        for some in (x[::_CAMERA_EVERY], flipped):
            cameras.append(eye.camera_of(some.contiguous(memory_format=torch.channels_last)))
    camera = torch.cat(cameras).numpy().mean(0)
    return Seen(
        shares=shares,
        camera=SeenCamera(
            pitch_rad=float(camera[0]),
            pitch_sd_rad=float(np.exp(camera[3])),
            focal_widths=float(np.exp(camera[1])),
            table_width_m=float(np.exp(camera[2])),
            table_width_sd=float(np.exp(camera[5])),
        ),
    )


def resized(
    image: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]
) -> UInt8[np.ndarray, "a b 3"]:
    """Return a picture at (height, width), averaged where it shrinks."""
    how = cv2.INTER_AREA if size[1] < image.shape[1] else cv2.INTER_LINEAR
    return np.ascontiguousarray(cv2.resize(image, (size[1], size[0]), interpolation=how))


def _pair(n_in: int, n_out: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(n_in, n_out, 3, padding=1, bias=False),
        nn.BatchNorm2d(n_out),
        nn.ReLU(),
        nn.Conv2d(n_out, n_out, 3, padding=1, bias=False),
        nn.BatchNorm2d(n_out),
        nn.ReLU(),
    )


def _twice(x: torch.Tensor) -> torch.Tensor:
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
