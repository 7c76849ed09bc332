"""Colours as people name them, and colour statistics of regions.

Lab is OpenCV's float Lab: L in 0..100, a and b in about -100..100. Images are RGB.
"""

import re

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from scipy.ndimage import gaussian_filter

from v2p_data.scene.scale.nouns import noun_for

_BINS = np.array([12, 24, 24])
_HUES_DEG = {
    "red": (26.0, 22.0),
    "orange": (66.0, 24.0),
    "yellow": (92.0, 26.0),
    "green": (150.0, 42.0),
    "blue": (268.0, 48.0),
    "purple": (318.0, 28.0),
    "pink": (358.0, 36.0),
}
"""Hue angle in Lab and half width at which the membership is one half."""
_SATURATION = {
    "red": 0.85,
    "orange": 0.55,
    "yellow": 0.42,
    "green": 0.16,
    "blue": 0.2,
    "purple": 0.2,
    "pink": 0.25,
}
"""Chroma over lightness from which on a pixel counts as coloured. It does not change with the light; wood and light
skin lie below 0.5, hence the higher bars for warm colours. Dark skin is told from red by its hue (50 degrees)."""
_SYNONYMS = {
    "gray": "grey",
    "violet": "purple",
    "lilac": "purple",
    "golden": "yellow",
    "beige": "brown",
    "tan": "brown",
    "cardboard": "brown",
    "wooden": "brown",
    "crimson": "red",
    "scarlet": "red",
    "turquoise": "green",
    "teal": "green",
    "cyan": "blue",
    "navy": "blue",
    "silver": "grey",
    "steel": "grey",
    "metal": "grey",
    "magenta": "pink",
}
_PLAIN = ("brown", "black", "white", "grey")
_DARKEST_SHADOW = 0.22
"""Of the lightness without the shadow."""


def colour_words(phrase: str) -> tuple[str, ...]:
    """Return the colours that an object phrase names, or that its noun usually has."""
    return named_colours(phrase) or noun_for(phrase).colours


def named_colours(phrase: str) -> tuple[str, ...]:
    """Return the colours that an object phrase itself names."""
    words = re.findall(r"[a-z]+", phrase.lower())
    named = [_SYNONYMS.get(word, word) for word in words]
    return tuple(dict.fromkeys(word for word in named if word in _HUES_DEG or word in _PLAIN))


def lab_of(image: UInt8[np.ndarray, "*time h w 3"]) -> Float32[np.ndarray, "*time h w 3"]:
    """Return Lab of an RGB image or of a stack of them."""
    stack = image.reshape(-1, *image.shape[-3:])
    lab = np.empty(stack.shape, np.float32)
    for frame, out in zip(stack, lab, strict=True):  # one at a time: a clip takes much memory
        cv2.cvtColor(frame.astype(np.float32) / 255, cv2.COLOR_RGB2LAB, dst=out)
    return lab.reshape(image.shape)


def lab_distance(
    one: Float[np.ndarray, "*one 3"], other: Float[np.ndarray, "*other 3"]
) -> Float[np.ndarray, "*pixels"]:
    """Return how far apart the colours of two images are: `np.linalg.norm`, bit for bit, in a fifth of its time."""
    squares = np.square(one - other)
    return np.sqrt(squares[..., 0] + squares[..., 1] + squares[..., 2])


def balance(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return the image with half of its colour cast and darkness taken out (shades of grey, p = 6).

    Half: a brown table is brown, not a cast, and full correction turned it grey.
    """
    x = image.astype(np.float32) / 255
    norm = np.maximum((x**6).mean((0, 1)) ** (1 / 6), 1e-3)
    gain = np.clip((norm.mean() / norm) ** 0.5, 0.7, 1.5) * np.clip(0.75 / norm.mean(), 1.0, 1.6)
    return np.clip(x * gain * 255, 0, 255).astype(np.uint8)


def colour_match(
    image: UInt8[np.ndarray, "h w 3"], words: tuple[str, ...]
) -> Float32[np.ndarray, "h w"]:
    """Return per pixel, 0 to 1, how well it fits the best of the colour words (balance first)."""
    lab = lab_of(cv2.GaussianBlur(image, (0, 0), 0.8))
    light, chroma = lab[..., 0], np.hypot(lab[..., 1], lab[..., 2])
    hue_deg = np.degrees(np.arctan2(lab[..., 2], lab[..., 1])) % 360
    best = np.zeros(light.shape, np.float32)
    for word in words:
        if word in _HUES_DEG:
            centre, width = _HUES_DEG[word]
            off = np.abs((hue_deg - centre + 180) % 360 - 180)
            strong = _rise(
                chroma, 21.0 if word in ("red", "orange", "yellow") else 9.0, 2.0
            ) * _rise(chroma / (light + 5), _SATURATION[word], 0.05)
            fit = _rise(-off, -width, width / 6) * strong
        elif word == "brown":
            off = np.abs((hue_deg - 70 + 180) % 360 - 180)
            fit = _rise(-off, -25.0, 4.0) * _rise(chroma, 10.0, 2.0) * _rise(-light, -66.0, 4.0)
        elif word == "black":
            fit = _rise(-light, -30.0, 4.0) * _rise(-chroma, -18.0, 4.0)
        elif word == "white":
            fit = _rise(light, 72.0, 4.0) * _rise(-chroma, -14.0, 3.0)
        else:
            fit = _rise(light, 28.0, 4.0) * _rise(-light, -80.0, 4.0) * _rise(-chroma, -12.0, 3.0)
        best = np.maximum(best, fit.astype(np.float32))
    return best


def histogram(pixels: UInt8[np.ndarray, "n 3"]) -> Float[np.ndarray, "l a b"]:
    """Return a smoothed Lab histogram that sums to one (zeros for no pixels)."""
    counts = np.zeros(_BINS)
    if len(pixels):
        cells = _cells(pixels[None])[0]
        np.add.at(counts, tuple(cells.T), 1)
        counts = gaussian_filter(counts, 0.8)
        counts /= counts.sum()
    return counts


def likelihood(
    hist: Float[np.ndarray, "l a b"], image: UInt8[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "h w"]:
    """Return the histogram's value at each pixel's colour."""
    cells = _cells(image)
    return hist[cells[..., 0], cells[..., 1], cells[..., 2]]


def similarity(a: Float[np.ndarray, "l a b"], b: Float[np.ndarray, "l a b"]) -> float:
    """Return the Bhattacharyya coefficient of two histograms, 0 to 1."""
    return float(np.sqrt(a * b).sum())


def shadow(
    lab: Float32[np.ndarray, "h w 3"], bare: Float32[np.ndarray, "h w 3"]
) -> Bool[np.ndarray, "h w"]:
    """Return where `lab` is `bare` with less light: darker in proportion, of the same hue."""
    lab, bare = cv2.GaussianBlur(lab, (0, 0), 1.0), cv2.GaussianBlur(bare, (0, 0), 1.0)
    ratio = lab[..., 0] / np.maximum(bare[..., 0], 1)
    tint = np.linalg.norm(lab[..., 1:] - bare[..., 1:] * ratio[..., None], axis=-1)
    return (ratio > _DARKEST_SHADOW) & (ratio < 0.96) & (tint < 6)


def _cells(image: UInt8[np.ndarray, "h w 3"]) -> np.ndarray:
    lab = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2LAB).astype(np.int32)
    return lab * _BINS // 256


def _rise(x: np.ndarray, middle: np.ndarray | float, width: float) -> np.ndarray:
    """Return a smooth step from 0 to 1 around `middle`."""
    return 1 / (1 + np.exp(-np.clip((x - middle) / width, -30, 30)))
