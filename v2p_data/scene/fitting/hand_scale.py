"""A hand as a ruler: how large it looks where it touches an object on the table says how high the camera stands.

Hands differ by a few percent, household things by far more. How far away a hand is, one view does
not show, but it shows where a hand touches a thing at rest: as far as the thing's foot. There a
small network looks at the hand alone, in a window that is 28 cm wide if the camera stands as high
as guessed, and says how much too large or too small that window is. It was trained on rendered
hands only (`scripts/train_hand_ruler.py`); its weights lie beside this file.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import nn

from v2p_data.scene.data_types import RestingObject
from v2p_data.scene.frames.classes import HAND
from v2p_data.scene.frames.hand import HandEnd, gap_px, hand_end
from v2p_data.scene.frames.mask_ops import iou
from v2p_data.scene.frames.network import Encoder, trained
from v2p_data.scene.frames.segmentation import Segmentation
from v2p_data.scene.frames.working_clip import WorkingClip
from v2p_data.scene.scale.camera_height import table_width_m

HAND_SCALE_WEIGHTS = Path(__file__).with_name("ruler.safetensors")
GUESS_SPREAD = 0.25
"""Standard deviation of the logarithm by which windows are too large or small in training."""
REACH_M = 0.25
"""The end of a hand that touches a thing is no farther than this from the thing's foot."""
WINDOW_M, _WINDOW_PX = 0.28, 112
TOWARDS_ARM = 0.25
"""Share of the window by which it is moved towards the arm: it then shows more of the hand."""
_WIDTHS = (16, 32, 56, 96)
TOUCHING_M = 0.02
_IN_PLACE = 0.4
"""Least overlap with the outline of the resting object at which it counts as resting."""
_MOST_VIEWS = 12
_DOUBT = 0.15
"""Added to the spread that the network states: it learned from drawn hands, and real ones differ from those."""
_LEAST_PX_PER_M = 40.0


@dataclass(frozen=True, kw_only=True)
class HandView:
    """A hand that touches a thing at rest."""

    planes: Float32[np.ndarray, "4 112 112"]
    """Its colours, nothing of its surroundings, and its outline."""
    known: Float32[np.ndarray, "4"]
    """Camera's pitch [rad], how far the thing's foot lies under the picture's middle [picture
    widths], and where the foot is from the hand's end, (right, down) [windows]."""


class HandScaleNetwork(Encoder):
    """How much too large a window around a hand is."""

    def __init__(self) -> None:
        super().__init__(4, _WIDTHS)
        self.say = nn.Sequential(nn.Linear(2 * _WIDTHS[-1] + 4, 64), nn.ReLU(), nn.Linear(64, 2))

    def forward(
        self, planes: Float[torch.Tensor, "n 4 h w"], known: Float[torch.Tensor, "n 4"]
    ) -> Float[torch.Tensor, "n 2"]:
        """Return the logarithm of true over guessed pixels per metre, and the logarithm of its standard deviation."""
        tokens = self.levels(planes)[-1]
        with torch.autocast(tokens.device.type, enabled=False):
            tokens = tokens.float()
            return self.say(torch.cat([tokens.mean(1), tokens.amax(1), known], 1))


@lru_cache(maxsize=1)
def hand_scale_network() -> HandScaleNetwork:
    """Return the trained network, on the CPU.

    Raises:
        V2PError: its weights are missing or belong to another version.
    """
    return trained(HandScaleNetwork(), HAND_SCALE_WEIGHTS, "scripts/train_hand_ruler.py")


def view_hand(
    rgb: UInt8[np.ndarray, "h w 3"],
    hand: Float32[np.ndarray, "h w"],
    end: HandEnd,
    foot_px: Float[np.ndarray, "2"],
    px_per_m: float,
    pitch_rad: float,
    below: float,
) -> HandView:
    """Return a hand as the network sees it, in a window for so many pixels per metre; `below` as in `table_width_m`."""
    side_px = WINDOW_M * px_per_m
    tip = np.array(end.tip_px)
    centre = tip + np.array(end.way) * TOWARDS_ARM * side_px
    colours, outline = window(rgb, hand, centre, side_px)
    offset = (foot_px - tip) / side_px
    return HandView(
        planes=planes_of(colours, outline),
        known=np.array([pitch_rad, below, *offset], np.float32),
    )


def window(
    rgb: UInt8[np.ndarray, "h w 3"],
    hand: Float32[np.ndarray, "h w"],
    centre_px: Float[np.ndarray, "2"],
    side_px: float,
) -> tuple[UInt8[np.ndarray, "112 112 3"], Float32[np.ndarray, "112 112"]]:
    """Return a square of a picture and of the hand in it, resized to what the network takes."""
    step = side_px / _WINDOW_PX
    if step > 1.3:
        rgb, hand = (cv2.GaussianBlur(image, (0, 0), 0.4 * step) for image in (rgb, hand))
    M = np.column_stack([np.eye(2) * step, centre_px - side_px / 2])
    size, flags = (_WINDOW_PX, _WINDOW_PX), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return (
        cv2.warpAffine(rgb, M, size, flags=flags, borderMode=cv2.BORDER_REPLICATE),
        cv2.warpAffine(hand, M, size, flags=flags),
    )


def planes_of(
    rgb: UInt8[np.ndarray, "s s 3"], hand: Float32[np.ndarray, "s s"]
) -> Float32[np.ndarray, "4 s s"]:
    """Return the network's input: what is no hand is grey, so that nothing but the hand is measured."""
    near = cv2.dilate(hand, np.ones((7, 7), np.uint8)) > 0.5
    colours = (rgb.transpose(2, 0, 1) / np.float32(127.5) - 1) * near
    return np.concatenate([colours, hand[None]]).astype(np.float32)


def height_from_hand(
    working: WorkingClip, segmentation: Segmentation, resting: RestingObject, height_m: float
) -> tuple[float, float] | None:
    """Return the camera's height [m] by the hand that moves an object, and the standard deviation of its logarithm.

    Args:
        working: frames.
        segmentation: what the network sees in them.
        resting: the object that the hand touches.
        height_m: a guess of the camera's height.

    Returns:
        None where no hand is seen that touches the object at rest.
    """
    views = _views(working, segmentation, resting, height_m)
    if not views:
        return None
    off, stated = _said(views)
    return float(height_m * np.exp(-off)), float(np.hypot(stated, _DOUBT))


def _views(
    working: WorkingClip, segmentation: Segmentation, resting: RestingObject, height_m: float
) -> list[HandView]:
    h, w = working.shape
    masks, camera, pitch_rad = resting.masks, resting.camera, resting.pitch_rad
    feet = []
    for _, position in resting.rests:
        foot = camera.project((position * [1, 1, 0])[None])[0]
        below = (foot[1] - h / 2) / w
        px_per_m = w / table_width_m(pitch_rad, float(camera.K[0, 0]) / w, height_m, below)
        feet.append((foot, below, px_per_m))
    out = []
    for k, i in enumerate(segmentation.idx):
        overlaps = [iou(masks[i], mask) for mask, _ in resting.rests]
        best = int(np.argmax(overlaps))
        foot, below, px_per_m = feet[best]
        if overlaps[best] < _IN_PLACE or not px_per_m > _LEAST_PX_PER_M:
            continue
        share = segmentation.shares[k, HAND].astype(np.float32)
        hand = share > 0.5
        end = hand_end(hand)
        if end is None or gap_px(hand, masks[i]) > TOUCHING_M * px_per_m:
            continue
        if np.linalg.norm(foot - end.tip_px) > REACH_M * px_per_m:
            continue
        out.append(view_hand(working.rgb[i], share, end, foot, px_per_m, pitch_rad, below))
    few = np.linspace(0, len(out) - 1, min(len(out), _MOST_VIEWS)).round().astype(int)
    return [out[k] for k in few]


@torch.inference_mode()
def _said(views: list[HandView]) -> tuple[float, float]:
    """Return the logarithm of true over guessed pixels per metre, and its standard deviation.

    That is the mean of the frames' own: one hand held one way errs alike in all of them.
    """
    planes = torch.from_numpy(np.stack([view.planes for view in views]))
    known = torch.from_numpy(np.stack([view.known for view in views]))
    mirrored = known * torch.tensor([1.0, 1.0, -1.0, 1.0])
    net = hand_scale_network()
    said = torch.stack([net(planes, known), net(planes.flip(-1), mirrored)]).mean(0).numpy()
    weight = np.exp(-2 * said[:, 1])
    return float(weight @ said[:, 0] / weight.sum()), float(np.exp(said[:, 1]).mean())
