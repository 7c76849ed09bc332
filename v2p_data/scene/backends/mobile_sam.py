"""MobileSAM: points and boxes in one picture become outlines of what they are on.

The encoder is ours (`tiny_vit.py`), prompts and masks are transformers' SAM; `mobile_sam_setup.py` fetches the weights.

Source: Zhang et al. 2023, arXiv:2306.14289; Kirillov et al. 2023 (Segment Anything), arXiv:2304.02643.
"""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import nn

from v2p_data.errors import V2PError
from v2p_data.scene.backends.outlines import EncodedPicture, Outlines, Spots
from v2p_data.scene.backends.tiny_vit import SIDE_PX, TinyViT

_MEAN, _SD = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)
"""Mean and standard deviation of red, green and blue in the checkpoint's training pictures."""
_UNREADABLE = (
    OSError,
    ValueError,
    TypeError,
    AttributeError,
    KeyError,
    EOFError,
    RuntimeError,
    UnpicklingError,
    SafetensorError,
)
"""What files that are cut off or hold something else end with."""
_ON, _OFF = 1, 0
"""The decoder's labels of points."""


class MobileSam:
    """The model on the CPU.

    Args:
        weights: file that `mobile_sam_setup.py` wrote, or a published `mobile_sam.pt`.

    Raises:
        V2PError: transformers is missing, or the weights are not MobileSAM's.
    """

    def __init__(self, weights: Path) -> None:
        try:
            from transformers import SamConfig, SamModel
        except ImportError:
            raise V2PError(
                "MobileSAM needs transformers, which is not installed; install it with 'pip "
                "install lerobot_policy_v2p[learned]' "
                "or give --scene.outline.backend=none"
            ) from None
        config: Any = SamConfig()
        config.vision_config.num_hidden_layers = 0  # the encoder is ours
        decoder: Any = SamModel(config)
        decoder.vision_encoder = nn.Identity()
        encoder = TinyViT()
        try:
            tensors = _tensors_of(weights)
            if not all(tensor.isfinite().all() for tensor in tensors.values()):
                raise ValueError("not finite")
            own, theirs = _split(tensors)
            encoder.load_state_dict(own)
            decoder.load_state_dict(theirs)
        except _UNREADABLE as error:
            raise V2PError(
                f"{weights} does not hold MobileSAM's weights ({type(error).__name__}); if setup "
                "wrote it, delete it and run "
                "'v2p setup outlines', else name another file with --scene.outline.weights"
            ) from error
        self._encoder = encoder.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._decoder = decoder.eval()

    @torch.inference_mode()
    def encode(self, picture: UInt8[np.ndarray, "h w 3"]) -> EncodedPicture:
        """Return an RGB picture's features, scaled so that its longer side is 1024 px."""
        h, w = picture.shape[:2]
        scale = SIDE_PX / max(h, w)
        size = (round(w * scale), round(h * scale))
        large = cv2.resize(picture, size, interpolation=cv2.INTER_LINEAR).astype(np.float32)
        square = np.zeros((SIDE_PX, SIDE_PX, 3), np.float32)
        square[: size[1], : size[0]] = (large - _MEAN) / _SD
        x = torch.from_numpy(square).permute(2, 0, 1)[None]
        features = self._encoder(x.contiguous(memory_format=torch.channels_last))
        return EncodedPicture(features=features.contiguous())

    @torch.inference_mode()
    def outlines(
        self, picture: EncodedPicture, prompts: Sequence[Spots], size_px: tuple[int, int]
    ) -> Outlines:
        """Return three masks for each prompt.

        Args:
            picture: what `encode` returned.
            prompts: in pixels of a picture of `size_px`.
            size_px: height and width of the masks; the picture may have been larger.
        """
        h, w = size_px
        scale = SIDE_PX / max(h, w)
        logits = np.empty((len(prompts), 3, h, w), np.float32)
        ious = np.empty((len(prompts), 3), np.float32)
        # Points that fill up shorter prompts would change the answer: the decoder does
        # not leave them out of its attention.
        for alike in _alike(prompts):
            inputs = _inputs([prompts[k] for k in alike], scale)
            out = self._decoder(image_embeddings=picture.features, multimask_output=True, **inputs)
            ious[alike] = out.iou_scores[0].numpy()
            planes = out.pred_masks[0].numpy()
            side = planes.shape[-1]
            rows, columns = round(h * scale * side / SIDE_PX), round(w * scale * side / SIDE_PX)
            for k, three in zip(alike, planes[..., :rows, :columns], strict=True):
                for full, plane in zip(logits[k], three, strict=True):
                    cv2.resize(plane, (w, h), dst=full, interpolation=cv2.INTER_LINEAR)
        return Outlines(logits=logits, ious=ious)


@lru_cache(maxsize=1)
def mobile_sam(weights: Path) -> MobileSam:
    """Return the model, loaded once.

    Raises:
        V2PError: as `MobileSam`.
    """
    return MobileSam(weights)


def _alike(prompts: Sequence[Spots]) -> list[list[int]]:
    """Return the numbers of prompts that have as many points as each other, and all a box or none."""
    groups: dict[tuple[int, bool], list[int]] = {}
    for k, prompt in enumerate(prompts):
        key = len(prompt.on) + len(prompt.off), prompt.box_xyxy is not None
        groups.setdefault(key, []).append(k)
    return list(groups.values())


def _inputs(prompts: Sequence[Spots], scale: float) -> dict[str, torch.Tensor]:
    """Return what the decoder is given for prompts that are alike; `scale` is of its pixels per pixel."""
    inputs: dict[str, torch.Tensor] = {}
    # The decoder counts pixels from their middle.
    if prompts[0].on or prompts[0].off:
        points = np.array([[[*p.on, *p.off] for p in prompts]], np.float32)
        labels = [[[_ON] * len(p.on) + [_OFF] * len(p.off) for p in prompts]]
        inputs["input_points"] = torch.from_numpy(points * scale - 0.5)
        inputs["input_labels"] = torch.tensor(labels)
    if prompts[0].box_xyxy is not None:
        boxes = np.array([[p.box_xyxy for p in prompts]], np.float32)
        inputs["input_boxes"] = torch.from_numpy(boxes * scale - 0.5)
    return inputs


def _tensors_of(weights: Path) -> dict[str, torch.Tensor]:
    if weights.suffix == ".safetensors":
        return load_file(weights)
    return torch.load(weights, map_location="cpu", weights_only=True)


def _split(
    tensors: dict[str, torch.Tensor],
) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """Return the encoder's tensors, and the others under the names that transformers gives them."""
    own = {
        name.removeprefix("image_encoder."): tensor
        for name, tensor in tensors.items()
        if name.startswith("image_encoder.") and "head." not in name.replace("norm_", "")
    }
    theirs = {
        _renamed(name): tensor
        for name, tensor in tensors.items()
        if not name.startswith("image_encoder.")
    }
    place = theirs.pop("prompt_encoder.pe_layer.positional_encoding_gaussian_matrix")
    theirs["shared_image_embedding.positional_embedding"] = place
    theirs["prompt_encoder.shared_embedding.positional_embedding"] = place
    return own, theirs


_NAMES = (
    ("mask_downscaling.0", "mask_embed.conv1"),
    ("mask_downscaling.1", "mask_embed.layer_norm1"),
    ("mask_downscaling.3", "mask_embed.conv2"),
    ("mask_downscaling.4", "mask_embed.layer_norm2"),
    ("mask_downscaling.6", "mask_embed.conv3"),
    ("point_embeddings", "point_embed"),
    ("output_upscaling.0", "upscale_conv1"),
    ("output_upscaling.1", "upscale_layer_norm"),
    ("output_upscaling.3", "upscale_conv2"),
    ("norm_final_attn", "layer_norm_final_attn"),
    (".norm1.", ".layer_norm1."),
    (".norm2.", ".layer_norm2."),
    (".norm3.", ".layer_norm3."),
    (".norm4.", ".layer_norm4."),
)
_PERCEPTRON = (("layers.0.", "proj_in."), ("layers.1.", "layers.0."), ("layers.2.", "proj_out."))
"""Of the published names, those that transformers has otherwise."""


def _renamed(name: str) -> str:
    for theirs, here in _NAMES:
        name = name.replace(theirs, here)
    if "hypernetworks_mlps" in name or "iou_prediction_head" in name:
        for theirs, here in _PERCEPTRON:
            if theirs in name:
                return name.replace(theirs, here)
    return name
