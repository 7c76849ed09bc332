"""From features to actions: what the last layer's numbers mean, and which loss they learn by.

`regression` predicts each entry of the action. `bins` predicts for each entry a distribution over levels in [-1, 1]
and takes the mean about the likeliest. Where experts do one of two opposite things in states that look alike,
regression answers with their mean, which is neither; a distribution chooses one.
"""

from typing import Protocol, runtime_checkable

import torch
import torch.nn.functional as F  # noqa: N812 - the name everybody knows
from jaxtyping import Float
from torch import Tensor

from policies.bc.configuration_v2p_bc import V2PBCConfig


@runtime_checkable
class Head(Protocol):
    """What a last layer's outputs mean."""

    @property
    def width(self) -> int:
        """Outputs per entry of the action."""
        ...

    def loss(
        self, outputs: Float[Tensor, "*batch out"], target: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """Return the loss of each entry."""
        ...

    def decode(self, outputs: Float[Tensor, "*batch out"]) -> Float[Tensor, "*batch"]:
        """Return each entry's value."""
        ...


class RegressionHead:
    """One number an entry, by the Huber loss.

    Huber and not squares: experts trained by reinforcement saturate now and then, and single wild actions should
    not rule.
    """

    width = 1

    def loss(
        self, outputs: Float[Tensor, "*batch out"], target: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        return F.smooth_l1_loss(outputs[..., 0], target, reduction="none")

    def decode(self, outputs: Float[Tensor, "*batch out"]) -> Float[Tensor, "*batch"]:
        return outputs[..., 0]


class BinnedHead:
    """A distribution over `num_bins` levels from -1 to 1 an entry, by cross-entropy.

    A target between two levels is shared between them in proportion to nearness. Targets beyond the range count as
    its end.

    Args:
        num_bins: levels, two or more; an odd number has one at zero.
    """

    def __init__(self, num_bins: int) -> None:
        self.width = num_bins

    def loss(
        self, outputs: Float[Tensor, "*batch out"], target: Float[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        place = (target.clamp(-1, 1) + 1) / 2 * (self.width - 1)
        below = place.floor().long().clamp(max=self.width - 2)
        share = (place - below).to(outputs.dtype)
        log_p = outputs.float().log_softmax(-1)
        low = log_p.gather(-1, below[..., None])[..., 0]
        high = log_p.gather(-1, below[..., None] + 1)[..., 0]
        return -(low * (1 - share) + high * share)

    def decode(self, outputs: Float[Tensor, "*batch out"]) -> Float[Tensor, "*batch"]:
        """Return the mean of the likeliest pair of neighbouring levels and the level on either side of it."""
        p = outputs.float().softmax(-1)
        likeliest = (p[..., :-1] + p[..., 1:]).argmax(-1, keepdim=True)
        bins = torch.arange(self.width, device=outputs.device)
        near = p * ((bins >= likeliest - 1) & (bins <= likeliest + 2))
        levels = torch.linspace(-1, 1, self.width, device=outputs.device)
        return (near * levels).sum(-1) / near.sum(-1)


def head_of(cfg: V2PBCConfig) -> Head:
    """Return the head that the settings name."""
    return BinnedHead(cfg.num_bins) if cfg.head == "bins" else RegressionHead()
