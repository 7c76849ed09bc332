"""Camera heights become metres: every object's usual size votes for how high the camera stands.

One view does not show scale. Nouns are within about 15-20 % of their usual size; several objects together do better
than one, and a loose prior on the camera's height catches nouns that are not in the table.
"""

from dataclasses import dataclass

import numpy as np

from v2p_data.scene.nouns import Noun

_USUAL_HEIGHT_M = 0.55
_HEIGHT_SPREAD = 0.45
"""Cameras stand 0.25 to 1.2 m above tables, most of the time."""


@dataclass(frozen=True, kw_only=True)
class SizeVote:
    """One fitted object's say in the scale."""

    size: tuple[float, float, float]
    """In camera heights."""
    noun: Noun
    trust: float = 1.0
    """0 to 1: how good the fit is."""
    known_m: tuple[float, float, float] | None = None
    """The true size, where the user gave it."""


def camera_height_m(
    votes: list[SizeVote], measured: tuple[float, float] | None = None
) -> tuple[float, float]:
    """Return the camera's height [m] and the standard deviation of its logarithm.

    `measured` is such a pair from elsewhere, as from predicted depth.
    """
    means, weights = [float(np.log(_USUAL_HEIGHT_M))], [_HEIGHT_SPREAD**-2]
    if measured is not None:
        means.append(float(np.log(measured[0])))
        weights.append(measured[1] ** -2)
    for vote in votes:
        mean, spread = _implied(vote)
        means.append(mean)
        weights.append(vote.trust / spread**2)
    total = float(np.sum(weights))
    return float(np.exp(np.dot(means, weights) / total)), float(total**-0.5)


def disagreement(vote: SizeVote, height_m: float) -> float:
    """Return how many standard deviations of its noun an object is larger than usual, at this camera height."""
    mean, spread = _implied(vote)
    return (float(np.log(height_m)) - mean) / spread


def height_plausibility(height_m: float) -> float:
    """Return 1 for a height at which people film tables, less outside 0.25 to 1.2 m."""
    off = max(0.0, abs(float(np.log(height_m / _USUAL_HEIGHT_M))) - 0.8) / 0.4
    return float(np.exp(-0.5 * off**2))


def _implied(vote: SizeVote) -> tuple[float, float]:
    usual, seen = np.array(vote.known_m or vote.noun.size_m), np.array(vote.size)
    if vote.noun.form == "box":  # which side is up is not the noun's to say
        usual, seen = np.sort(usual), np.sort(seen)
    # Large extents are seen best: the thickness of a book says little about its scale.
    weight = usual / usual.sum()
    return float(weight @ np.log(usual / seen)), 0.03 if vote.known_m else vote.noun.spread
