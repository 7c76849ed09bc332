"""What a model that outlines objects is asked, and what it answers."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32


@dataclass(frozen=True, kw_only=True)
class Spots:
    """One prompt: points on and off an object, and a box around it; at least one of on and box."""

    on: tuple[tuple[float, float], ...] = ()
    """Points on the object, u right and v down [px]."""
    off: tuple[tuple[float, float], ...] = ()
    """Points beside it."""
    box_xyxy: tuple[float, float, float, float] | None = None
    """Left, top, right, bottom [px]."""


@dataclass(frozen=True, kw_only=True)
class Outlines:
    """Three masks per prompt: a part, a thing, and a thing with what belongs to it, in no fixed order."""

    logits: Float32[np.ndarray, "prompt 3 h w"]
    """Above 0: inside."""
    ious: Float32[np.ndarray, "prompt 3"]
    """Overlap with a true outline, as the model estimates it."""

    @property
    def masks(self) -> Bool[np.ndarray, "prompt 3 h w"]:
        return self.logits > 0


@dataclass(frozen=True, kw_only=True)
class EncodedPicture:
    """A picture that prompts can be put to."""

    features: Float[torch.Tensor, "1 256 64 64"]
