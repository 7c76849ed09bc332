"""Camera heights become metres: every object's usual size votes for how high the camera stands.

One view does not show scale. Nouns are within about 15-20 % of their usual size; several objects together do better
than one, the scene network says how much of the table the picture shows, and a loose prior on the camera's height
catches what neither knows.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from v2p_data.scene.scale.nouns import Noun

_USUAL_HEIGHT_M = 0.55
_HEIGHT_SPREAD = 0.45
"""Cameras stand 0.25 to 1.2 m above tables, most of the time."""
_FREEDOM, _ROUNDS = 4.0, 20
_FIT_SPREAD = 0.1
"""How far a fitted size is off the true one in the picture: a pixel or two of the outline, a shadow taken along."""


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


@dataclass(frozen=True, kw_only=True)
class SeenCamera:
    """What the scene network says about a level camera above a table."""

    pitch_rad: float
    """How far the camera looks below the horizon."""
    pitch_sd_rad: float
    """Its standard deviation, as the network states it."""
    focal_widths: float
    """Focal length over picture width."""
    table_width_m: float
    """How much of the table the picture shows from left to right at its middle: hands and things tell that directly,
    while a camera that is high with a long focal length sees what a low one with a short focal length does."""
    table_width_sd: float
    """Standard deviation of its logarithm."""


def table_width_m(
    pitch_rad: float, focal_widths: float, height_m: float, below: float = 0.0
) -> float:
    """Return how much of the table a level camera shows from left to right in one row of pixels.

    `below` is how far that row lies under the picture's middle, in picture widths. NaN at and above the horizon.
    """
    down = np.sin(pitch_rad) + below / focal_widths * np.cos(pitch_rad)
    return float(height_m / (focal_widths * down)) if down > 0.02 else float("nan")


def px_per_m(camera: SeenCamera, shape: tuple[int, int], row_px: float) -> float:
    """Return how many pixels wide a metre of the table is at a row of a picture of this shape."""
    h, w = shape
    middle, there = (
        table_width_m(camera.pitch_rad, camera.focal_widths, 1.0, below)
        for below in (0.0, (row_px - h / 2) / w)
    )
    ratio = there / middle
    return w / camera.table_width_m / (ratio if np.isfinite(ratio) else 1.0)


def camera_height_m(
    votes: list[SizeVote], measured: Sequence[tuple[float, float]] = ()
) -> tuple[float, float]:
    """Return the camera's height [m] and the standard deviation of its logarithm.

    `measured` are such pairs from elsewhere, as from predicted depth. What a noun says counts the
    less the farther it is from what all say together: a box may be of any size, and what was taken
    for a pen may be none.
    """
    rows = [(float(np.log(_USUAL_HEIGHT_M)), _HEIGHT_SPREAD, 1.0, False)]
    rows += [(float(np.log(height_m)), spread, 1.0, False) for height_m, spread in measured]
    rows += [(*_implied(vote), vote.trust, vote.known_m is None) for vote in votes]
    says, spread, trust, doubtful = (np.array(column) for column in zip(*rows, strict=True))
    middle, sd = robust_mean(says, spread, trust, doubtful)
    return float(np.exp(middle)), sd


def robust_mean(
    says: Float[np.ndarray, "n"],
    spread: Float[np.ndarray, "n"],
    trust: Float[np.ndarray, "n"],
    doubtful: Bool[np.ndarray, "n"],
) -> tuple[float, float]:
    """Return the mean of several guesses with deviations and trusts of 0 to 1, and its deviation.

    What is doubtful counts the less the farther it is from the mean: weights of Student's t with
        four degrees of freedom.

    Source: Lange, Little and Taylor 1989.
    """
    weight = trust / spread**2
    for _ in range(_ROUNDS):
        off = (says - says @ weight / weight.sum()) / spread
        weight = trust / spread**2 * np.where(doubtful, 1 / (1 + off**2 / _FREEDOM), 1.0)
    return float(says @ weight / weight.sum()), float(weight.sum() ** -0.5)


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
    spread = 0.03 if vote.known_m else float(np.hypot(vote.noun.spread, _FIT_SPREAD))
    return float(weight @ np.log(usual / seen)), spread
