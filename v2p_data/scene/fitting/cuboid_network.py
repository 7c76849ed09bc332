"""How a box is turned and how its sides compare, by what it looks like: outlines hardly tell a cube's yaw.

A small network looks at one box as a camera would see it that stands at the same place and looks
straight at it, and says which way its sides run along the table, which of them is longer, and how
high it is. It was trained on rendered boxes only (`scripts/train_box_network.py`); its weights lie
beside this file.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from torch import nn

from v2p_data.geometry.camera import Camera, between_centres
from v2p_data.scene.frames.network import Encoder, trained

BOX_WEIGHTS = Path(__file__).with_name("boxes.safetensors")
INPUT_PX = 80
WINDOW_SHARE = 1.45
"""Side of what the network sees, in longer sides of the outline's bounding box."""
_WIDTHS = (16, 32, 56, 96)
_MOST_KAPPA = 10.0
"""Drawn boxes have clearer edges than real ones: surer than this it is not believed to be."""
_LEAST_SD = 0.12
"""The same for the ratio of the sides and for the height."""
_UPRIGHT = 0.99
LOG_SD = (-3.5, 1.0)
"""Range of what is stated."""
TAIL = 4.0
"""Degrees of freedom of the ratios' t distributions."""


@dataclass(frozen=True, kw_only=True)
class Aim:
    """A camera that looks straight at an outline, level, from where the picture's camera stands."""

    H: Float[np.ndarray, "3 3"]
    """From pixels of the picture to pixels of its own, in OpenCV's count."""
    azimuth_rad: float
    """Azimuth of its line of sight, from +x towards +y."""
    below_rad: float
    """Angle of its line of sight under the horizon."""
    extent: float
    """Longer side of the outline, in focal lengths."""


@dataclass(frozen=True, kw_only=True)
class CuboidGuess:
    """What the network says of a box that stands or lies level."""

    azimuth_rad: float
    """That its yaws count from."""
    fourfold: tuple[float, float]
    """Concentration (von Mises) times cosine and sine of four times the yaw: sides at right angles look alike."""
    twofold: tuple[float, float]
    """Logarithm of one side over the other, times cosine and sine of twice the yaw of the former."""
    twofold_sd: float
    height: float
    """Logarithm of the height over the sides' geometric mean."""
    height_sd: float

    def cost(
        self,
        size: Float[np.ndarray, "3"] | tuple[float, float, float],
        T_world_obj: Float[np.ndarray, "4 4"],
    ) -> float:
        """Return how much less likely a box is than the likeliest, in nats; nothing for one that is tilted."""
        z = T_world_obj[2]
        up = max(range(3), key=lambda k: abs(z[k]))
        if abs(z[up]) < _UPRIGHT:
            return 0.0
        a, b = (up + 1) % 3, (up + 2) % 3
        yaw = math.atan2(T_world_obj[1, a], T_world_obj[0, a]) - self.azimuth_rad
        x, y = self.fourfold
        lost = math.hypot(x, y) - x * math.cos(4 * yaw) - y * math.sin(4 * yaw)
        ratio = math.log(max(size[a], 1e-9) / max(size[b], 1e-9))
        u, v = self.twofold
        off = (u - ratio * math.cos(2 * yaw)) ** 2 + (v - ratio * math.sin(2 * yaw)) ** 2
        lost += (TAIL + 2) / 2 * math.log1p(off / (TAIL * self.twofold_sd**2))
        high = math.log(max(size[up], 1e-9) / math.sqrt(max(size[a] * size[b], 1e-18)))
        off = (self.height - high) ** 2 / (TAIL * self.height_sd**2)
        return lost + (TAIL + 1) / 2 * math.log1p(off)


class CuboidNetwork(Encoder):
    """How a box is turned, and how its sides compare."""

    def __init__(self) -> None:
        super().__init__(6, _WIDTHS)
        self.say = nn.Sequential(nn.Linear(2 * _WIDTHS[-1] + 2, 96), nn.ReLU(), nn.Linear(96, 7))

    def forward(
        self, planes: Float[torch.Tensor, "n 6 h w"], known: Float[torch.Tensor, "n 2"]
    ) -> Float[torch.Tensor, "n 7"]:
        """Return `fourfold`, `twofold`, `height` and the logarithms of deviations, as in `CuboidGuess`.

        `known` is how far the line of sight points below the horizon [rad], and the logarithm of the outline's extent.
        """
        tokens = self.levels(planes)[-1]
        with torch.autocast(tokens.device.type, enabled=False):
            tokens = tokens.float()
            return self.say(torch.cat([tokens.mean(1), tokens.amax(1), known], 1))


@lru_cache(maxsize=1)
def box_network() -> CuboidNetwork:
    """Return the trained network, on the CPU.

    Raises:
        V2PError: its weights are missing or belong to another version.
    """
    return trained(CuboidNetwork(), BOX_WEIGHTS, "scripts/train_box_network.py")


def aim_at(
    mask: Bool[np.ndarray, "h w"], camera: Camera, side_px: int, window_share: float
) -> Aim:
    """Return the camera that looks straight at an outline, and sees a window `side_px` wide around it."""
    y, x = np.nonzero(mask)
    middle = np.array([[(x.min() + x.max() + 1) / 2, (y.min() + y.max() + 1) / 2]])
    forward = camera.rays_world(middle)[0]
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= max(float(np.linalg.norm(right)), 1e-9)
    R_world_aim = np.stack([right, np.cross(forward, right), forward], 1)
    turn = R_world_aim.T @ camera.T_world_cam[:3, :3] @ np.linalg.inv(camera.K)
    seen = turn @ np.stack([x + 0.5, y + 0.5, np.ones(len(x))])
    seen = seen[:2] / seen[2]
    low, high = seen.min(1), seen.max(1)
    extent = max(float((high - low).max()), 1e-6)
    focal = side_px / (window_share * extent)
    u, v = side_px / 2 - focal * (low + high) / 2
    K = np.array([[focal, 0, u], [0, focal, v], [0, 0, 1.0]])
    return Aim(
        H=between_centres(K @ turn),
        azimuth_rad=float(np.arctan2(forward[1], forward[0])),
        below_rad=float(np.arcsin(np.clip(-forward[2], -1, 1))),
        extent=extent,
    )


def planes_of(
    rgb: UInt8[np.ndarray, "s s 3"], mask: Float32[np.ndarray, "s s"]
) -> Float32[np.ndarray, "6 s s"]:
    """Return the network's input: colours, outline, and where each pixel is."""
    line = np.linspace(-1, 1, len(rgb), dtype=np.float32)
    colours = rgb.transpose(2, 0, 1) / np.float32(127.5) - 1
    return np.stack([*colours, mask, *np.meshgrid(line, line)]).astype(np.float32)


@torch.inference_mode()
def cuboid_guess(
    image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], camera: Camera
) -> CuboidGuess:
    """Return what the network says of a box that is seen level; `mask` is its outline."""
    aim = aim_at(mask, camera, INPUT_PX, WINDOW_SHARE)
    size, flags = (INPUT_PX, INPUT_PX), cv2.INTER_LINEAR
    rgb = cv2.warpPerspective(image, aim.H, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    outline = cv2.warpPerspective(mask.astype(np.float32), aim.H, size, flags=flags)
    planes = torch.from_numpy(planes_of(rgb, outline))[None]
    both = torch.cat([planes, planes.flip(-1)])
    both[1, 4] = planes[0, 4]
    known = torch.tensor([[aim.below_rad, math.log(aim.extent)]]).expand(2, 2)
    said = box_network()(both.contiguous(memory_format=torch.channels_last), known)
    said[1, [1, 3]] *= -1  # mirrored, yaws turn the other way
    x, y, u, v, twofold, height, height_sd = said.mean(0).tolist()
    less = min(1.0, _MOST_KAPPA / max(math.hypot(x, y), 1e-9))
    return CuboidGuess(
        azimuth_rad=aim.azimuth_rad,
        fourfold=(less * x, less * y),
        twofold=(u, v),
        twofold_sd=max(_LEAST_SD, math.exp(np.clip(twofold, *LOG_SD))),
        height=height,
        height_sd=max(_LEAST_SD, math.exp(np.clip(height_sd, *LOG_SD))),
    )
