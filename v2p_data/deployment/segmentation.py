"""One object's mask in every picture of a stream, from one clicked pixel: causal, without weights, a few milliseconds.

The first picture gives three colour models (object, robot, rest) and a picture of what is behind.
In each later one a pixel goes to the object where its colour is likelier under the object's model
than under the others', given where the object was and where the robot is drawn. A robot in front
hides the object; what is hidden is not lost.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from v2p_data.scene.frames.colour import histogram
from v2p_data.scene.frames.mask_ops import bounding_box, grow, shrink, tidy
from v2p_data.scene.frames.one_click import SPECK_PX, ClickConfig, clicked_mask

LIT_WEIGHT, SHADED_COST, DARKEST = 0.15, 9.0, 0.2
"""Of what is behind: weight of squared lightness, what being in a shadow costs, and the darkest a shadow gets."""
OTHER_LIGHT = {0.4: 0.08, 0.55: 0.08, 0.7: 0.08, 0.85: 0.08, 1.2: 0.08}
"""Weights of colour models in other light, by the factor on RGB values: hard shadows of a lamp leave 0.4."""
GREY = 128.0
"""Where 8-bit Lab has no colour."""
MOST_GROWTH = 1.5
REACH_PX = 12.0
"""How far an object may get in one step of 50 ms, at 256 px; 0.6 m/s are about 10."""
LEAST_VISIBLE = 0.12
"""Share of the expected area: with less the object counts as not seen in this picture."""
BACKGROUND_RATE = 0.15
"""Share of each new picture in the picture of what is behind."""


@dataclass(frozen=True, kw_only=True)
class Tracked:
    """One object in one picture."""

    mask: Bool[np.ndarray, "h w"]
    score: Float32[np.ndarray, "h w"]
    """How much likelier each pixel is the object's than not (logarithm)."""
    confidence: float
    """0 to 1: the visible share of what should be visible, or what a network says."""
    is_hidden: bool
    """The robot covers most of where the object should be."""


@runtime_checkable
class StreamTracker(Protocol):
    """Follows one object."""

    def start(
        self,
        picture: UInt8[np.ndarray, "h w 3"],
        click_px: tuple[float, float],
        robot: Bool[np.ndarray, "h w"],
    ) -> Bool[np.ndarray, "h w"]:
        """Return the mask of what was clicked (u right, v down).

        Raises:
            V2PError: no object is there.
        """
        ...

    def track(
        self, picture: UInt8[np.ndarray, "h w 3"], robot: Bool[np.ndarray, "h w"]
    ) -> Tracked:
        """Return the object in the next picture."""
        ...


class ColourTracker:
    """The tracker without weights."""

    def start(
        self,
        picture: UInt8[np.ndarray, "h w 3"],
        click_px: tuple[float, float],
        robot: Bool[np.ndarray, "h w"],
    ) -> Bool[np.ndarray, "h w"]:
        """Return the mask of what was clicked, and learn its colours."""
        mask = clicked_mask(picture, click_px, robot, ClickConfig())
        near, touched = grow(mask, 3), grow(robot, 3)
        core = shrink(mask, 1)
        mine = picture[core if core.sum() >= SPECK_PX else mask]
        self._object, self._as_clicked = _log(_in_any_light(mine)), _log(histogram(mine))
        self._rest = _log(_in_any_light(picture[~near & ~touched]))
        # Grey of any lightness until it is seen: an arm may begin outside the picture.
        inner = shrink(robot, 2) & ~near
        self._robot = _log(histogram(picture[inner] if inner.sum() >= 50 else _greys()))
        self._known = ~near & ~touched
        self._behind = cv2.GaussianBlur(_lab8(picture), (0, 0), 0.8).astype(np.float32)
        self._mask = mask
        self._area = float(mask.sum())
        self._motion = np.zeros(2)
        self._scale = picture.shape[0] / 256
        return mask

    def track(
        self, picture: UInt8[np.ndarray, "h w 3"], robot: Bool[np.ndarray, "h w"]
    ) -> Tracked:
        """Return the object in the next picture."""
        lab = cv2.GaussianBlur(_lab8(picture), (0, 0), 0.8)
        expected = _moved(self._mask, self._motion)
        # A dark hand looks like many things in a shadow: before the robot, only the clicked colours count.
        cells = _cells8(lab)
        own = np.where(robot, np.take(self._as_clicked, cells), np.take(self._object, cells))
        score = self._scores(lab, own, robot, expected)
        mask = self._chosen(score, own, expected)
        seen, should = float(mask.sum()), max(1.0, float(expected.sum()))
        hidden = float((expected & robot & ~mask).sum()) / should
        visible = seen / max(1.0, self._area * (1 - min(0.9, hidden)))
        found = seen >= SPECK_PX * self._scale**2 and visible >= LEAST_VISIBLE
        if found:
            self._follow(mask, expected, hidden, visible)
            self._learn(lab, mask, robot)
        else:
            self._mask, self._motion = expected if hidden > 0 else self._mask, 0.5 * self._motion
            mask = np.zeros_like(mask)
        return Tracked(
            mask=mask,
            score=score,
            confidence=min(1.0, visible) if found else 0.0,
            is_hidden=hidden > 0.6,
        )

    def _scores(
        self, lab: np.ndarray, own: np.ndarray, robot: np.ndarray, expected: np.ndarray
    ) -> np.ndarray:
        """Return log-likelihood ratios, with where the object was and the robot is as priors."""
        cells = _cells8(lab)
        rest = np.take(self._rest, cells)
        apart = self._unlike_behind(lab.astype(np.float32))
        rest = np.where(self._known, np.maximum(9.0 - 0.10 * apart, _FLOOR - 2.0), rest)
        arm = np.take(self._robot, cells) + np.where(robot, 0.0, -4.0).astype(np.float32)
        arm[grow(robot, 2) & ~robot] += 2.0
        away = cv2.distanceTransform((~expected).astype(np.uint8), cv2.DIST_L2, 3)
        reach = REACH_PX * self._scale
        return own + 1.0 - (away / reach) ** 2 - np.maximum(rest, arm)

    def _unlike_behind(self, lab: np.ndarray) -> np.ndarray:
        """Return squared distances from the picture of what is behind, which may lie in a shadow now."""
        difference = lab - self._behind
        tint = (difference[..., 1:] ** 2).sum(-1)
        lit = LIT_WEIGHT * difference[..., 0] ** 2 + tint
        # In a shadow hue stays and colour fades with the light.
        share = lab[..., 0] / np.maximum(self._behind[..., 0], 1.0)
        faded = (lab[..., 1:] - GREY) - share[..., None] * (self._behind[..., 1:] - GREY)
        # What was in a shadow at first is brighter without it.
        is_other_light = (share < 1 / DARKEST) & (share > DARKEST)
        shaded = np.where(is_other_light, SHADED_COST + (faded**2).sum(-1), np.inf)
        return np.minimum(lit, shaded)

    def _chosen(self, score: np.ndarray, own: np.ndarray, expected: np.ndarray) -> np.ndarray:
        """Return the part that fits best; nothing grows by half in a step, so what else has come is left out."""
        mask = self._best_part(score, expected)
        if mask.sum() > MOST_GROWTH * self._area:
            near = grow(expected, round(REACH_PX * self._scale / 2))
            mask = self._best_part(np.where((own > 0) & near, score, -1.0), expected)
        return mask

    def _best_part(self, score: np.ndarray, expected: np.ndarray) -> np.ndarray:
        """Return the part that fits best, with what a finger cuts off it."""
        count, parts, stats, _ = cv2.connectedComponentsWithStats(
            tidy(score > 0).astype(np.uint8), connectivity=4
        )
        if count < 2:
            return np.zeros_like(expected)
        weight = np.bincount(parts.ravel(), np.clip(score, 0, 4).ravel(), count)
        weight += 4 * np.bincount(parts[expected], minlength=count)
        weight[0] = -1
        best = int(weight.argmax())
        main = parts == best
        if count > 2:
            reached = np.unique(parts[grow(main | expected, round(3 * self._scale) + 1)])
            large = [k for k in reached if k and stats[k, cv2.CC_STAT_AREA] > 0.04 * self._area]
            main = np.isin(parts, [best, *large])
        return _without_pinholes(main)

    def _follow(
        self, mask: np.ndarray, expected: np.ndarray, hidden: float, visible: float
    ) -> None:
        if hidden < 0.1 and 0.6 < visible < 1.6:
            self._area += 0.1 * (float(mask.sum()) - self._area)
        step = _middle(mask) - _middle(self._mask)
        fast = REACH_PX * self._scale
        if hidden < 0.4:
            self._motion = 0.5 * self._motion + 0.5 * np.clip(step, -fast, fast)
        else:
            self._motion = 0.5 * self._motion
        # Under a robot the outline shrinks to what is seen; where it should be is what it was.
        self._mask = (
            mask | (expected & grow(mask, round(4 * self._scale))) if hidden > 0.1 else mask
        )

    def _learn(self, lab: np.ndarray, mask: np.ndarray, robot: np.ndarray) -> None:
        """Bring the picture of what is behind up to date where neither object nor robot is near."""
        near = grow(mask | self._mask | robot, 4)
        rate = np.where(self._known, BACKGROUND_RATE, 1.0)[..., None].astype(np.float32)
        self._behind += np.where(near[..., None], 0.0, rate) * (lab - self._behind)
        self._known |= ~near


_BINS = np.array([12, 24, 24])
"""As `scene.frames.colour.histogram` counts."""
_FLOOR = -4.0


def _in_any_light(pixels: UInt8[np.ndarray, "n 3"]) -> Float32[np.ndarray, "light a b"]:
    """Return the colours' histogram, with some weight on the same colours in shadows and in more light."""
    total = (1 - sum(OTHER_LIGHT.values())) * histogram(pixels)
    for factor, weight in OTHER_LIGHT.items():
        lit = np.clip(factor * pixels.astype(np.float32), 0, 255).astype(np.uint8)
        total = total + weight * histogram(lit)
    return total.astype(np.float32)


def _log(hist: np.ndarray) -> Float32[np.ndarray, "cell"]:
    """Return log-likelihoods over those of a colour drawn evenly, with a floor: no colour is impossible."""
    density = hist.ravel() * hist.size
    return np.log(np.maximum(density, np.exp(_FLOOR))).astype(np.float32)


def _lab8(picture: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2LAB)


def _cells8(lab: UInt8[np.ndarray, "h w 3"]) -> Int[np.ndarray, "h w"]:
    """Return the histogram's cell of each pixel."""
    table = [(np.arange(256) * bins // 256).astype(np.int32) for bins in _BINS]
    light, a, b = (np.take(t, lab[..., k]) for k, t in enumerate(table))
    return (light * _BINS[1] + a) * _BINS[2] + b


def _greys() -> UInt8[np.ndarray, "n 3"]:
    return np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)


def _moved(mask: np.ndarray, by: np.ndarray) -> np.ndarray:
    if not np.rint(by).any():
        return mask
    shift = np.array([[1, 0, round(float(by[0]))], [0, 1, round(float(by[1]))]], np.float32)
    return cv2.warpAffine(mask.astype(np.uint8), shift, mask.shape[::-1]) > 0


def _middle(mask: np.ndarray) -> np.ndarray:
    x, y, w, h = bounding_box(mask)
    return np.array([x + w / 2, y + h / 2])


def _without_pinholes(mask: np.ndarray) -> np.ndarray:
    """Return the mask with holes filled that are smaller than what a finger would leave."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats(
        (~mask).astype(np.uint8), connectivity=4
    )
    small = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] < 0.05 * mask.sum()]
    return mask | np.isin(parts, small) if small else mask
