"""Procedural pictures: what is printed on things, and what tables, walls and cloths look like."""

import colorsys
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from drawn_clips.shapes import PATCH_ROWS

Rgb = tuple[float, float, float]
Print = Literal["plain", "label", "stripes", "checker", "speckle", "gradient", "photo", "wood"]
PRINTS: tuple[Print, ...] = (
    "plain",
    "label",
    "stripes",
    "checker",
    "speckle",
    "gradient",
    "photo",
    "wood",
)

_HSV: dict[str, tuple[float, float, float, float, float, float]] = {
    "red": (-0.02, 0.02, 0.65, 0.95, 0.40, 0.85),
    "orange": (0.05, 0.085, 0.70, 0.95, 0.65, 0.95),
    "yellow": (0.12, 0.16, 0.55, 0.95, 0.70, 0.95),
    "green": (0.25, 0.42, 0.40, 0.90, 0.25, 0.70),
    "blue": (0.55, 0.66, 0.45, 0.95, 0.30, 0.85),
    "purple": (0.74, 0.82, 0.35, 0.80, 0.30, 0.70),
    "pink": (0.90, 0.97, 0.30, 0.60, 0.75, 0.95),
    "brown": (0.04, 0.08, 0.45, 0.75, 0.20, 0.45),
    "white": (0.0, 1.0, 0.0, 0.08, 0.82, 0.97),
    "black": (0.0, 1.0, 0.0, 0.25, 0.03, 0.14),
    "grey": (0.0, 1.0, 0.0, 0.10, 0.35, 0.65),
}
"""Colour word -> hue, saturation and value from and to; hue in turns."""


def colour_called(word: str, rng: np.random.Generator) -> Rgb:
    """Return a colour that people would call by this word."""
    h0, h1, s0, s1, v0, v1 = _HSV[word]
    h, s, v = rng.uniform((h0, s0, v0), (h1, s1, v1))
    return colorsys.hsv_to_rgb(float(h) % 1.0, float(s), float(v))


def any_colour(rng: np.random.Generator) -> Rgb:
    """Return any colour."""
    h, s, v = rng.uniform((0, 0, 0.1), (1, 0.95, 0.97))
    return colorsys.hsv_to_rgb(float(h), float(s), float(v))


def smooth_noise(
    shape: tuple[int, int], cells: tuple[float | int, float | int], rng: np.random.Generator
) -> Float[np.ndarray, "h w"]:
    """Return noise in about [-1, 1] with the given number of bumps down and across."""
    rows, columns = max(2, round(cells[0]) + 1), max(2, round(cells[1]) + 1)
    grid = rng.uniform(-1, 1, (min(rows, shape[0]), min(columns, shape[1]))).astype(np.float32)
    return cv2.resize(grid, shape[::-1], interpolation=cv2.INTER_CUBIC).astype(float)


def pixels_of(values: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return values of 0 to 1 as bytes."""
    return (values.clip(0, 1) * 255).round().astype(np.uint8)


def printed(
    kind: Print, base: Rgb, accent: Rgb, second: Rgb, detail: Rgb, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the texture of a thing: print, second area and detail in their patches."""
    h, w = 320, 320
    image = np.zeros((h, w, 3))
    rows = [round(low * h) for low, _ in PATCH_ROWS] + [h]
    image[: rows[1]] = _print(kind, (rows[1], w), base, accent, rng)
    image[rows[1] : rows[2]] = second
    image[rows[2] :] = detail
    wear = 0.05 * smooth_noise((h, w), (6, 6), rng) + 0.03 * smooth_noise((h, w), (90, 90), rng)
    return pixels_of(image * (1 + wear[..., None]))


def _print(
    kind: Print, shape: tuple[int, int], base: Rgb, accent: Rgb, rng: np.random.Generator
) -> Float[np.ndarray, "h w 3"]:
    h, w = shape
    y, x = np.mgrid[0:h, 0:w] / float(h)
    one, two = np.array(base), np.array(accent)
    if kind == "wood":
        return grain(shape, base, float(rng.uniform(0.05, 0.2)), rng)
    if kind == "gradient":
        mix = (y + 0.3 * smooth_noise(shape, (2, 3), rng)).clip(0, 1)[..., None]
        return one * (1 - mix) + two * mix
    if kind == "photo":
        octaves = [smooth_noise(shape, (n, n), rng) / k for n, k in ((3, 1), (8, 2), (20, 4))]
        mix = np.sum(octaves, axis=0)
        third = np.array(any_colour(rng))
        low, high = (mix > 0.25)[..., None], (mix < -0.35)[..., None]
        return np.where(low, two, np.where(high, third, one)) * (1 + 0.2 * mix[..., None])
    mark = np.zeros(shape, bool)
    if kind == "stripes":
        slope, count = rng.choice([0.0, 0.25, 3.0]), rng.uniform(2, 7)
        mark = ((y + slope * x) * count % 1) < rng.uniform(0.2, 0.55)
    elif kind == "checker":
        n = int(rng.integers(3, 9))
        mark = ((y * n).astype(int) + (x * n).astype(int)) % 2 == 0
    elif kind == "speckle":
        n = rng.uniform(10, 30)
        mark = smooth_noise(shape, (n, n), rng) > rng.uniform(0.25, 0.6)
    image = np.where(mark[..., None], two, one)
    if kind == "label":
        canvas = image.copy()
        top, tall = rng.uniform(0.15, 0.4), rng.uniform(0.25, 0.5)
        for panel in (0, 1):
            x0 = panel * w // 2
            _label(canvas[:, x0 : x0 + w // 2], (float(top), float(tall)), one, two, rng)
        return canvas
    return image


def _label(
    canvas: Float[np.ndarray, "h w 3"],
    band: tuple[float, float],
    base: Float[np.ndarray, "3"],
    accent: Float[np.ndarray, "3"],
    rng: np.random.Generator,
) -> None:
    """Draw a band, a blob like a logo and lines like words."""
    h, w = canvas.shape[:2]
    top, bottom = int(band[0] * h), int(min(0.95, sum(band)) * h)
    edge = int(rng.choice([0, 0.08 * w]))
    canvas[top:bottom, edge : w - edge] = accent
    ink = base if rng.random() < 0.6 else np.array(any_colour(rng))
    scratch = np.ascontiguousarray(canvas.astype(np.float32))
    cv2.ellipse(
        scratch,
        (int(w * rng.uniform(0.3, 0.7)), int(h * rng.uniform(0.2, 0.8))),
        (int(w * rng.uniform(0.1, 0.3)), int(h * rng.uniform(0.06, 0.16))),
        float(rng.uniform(0, 90)),
        0,
        360,
        [float(c) for c in any_colour(rng)],
        -1,
        cv2.LINE_AA,
    )
    word = "".join(rng.choice(list("ABCDEFGHIKLMNOPRSTUVWZ"), int(rng.integers(3, 7))))
    scale = 0.85 * w / (20.0 * len(word))
    at = (int(0.08 * w), int((top + bottom) / 2))
    cv2.putText(
        scratch, word, at, cv2.FONT_HERSHEY_DUPLEX, scale, [float(c) for c in ink], 2, cv2.LINE_AA
    )
    for row in range(int(rng.integers(1, 5))):
        yy = int((top + bottom) / 2 + (row + 1) * 0.045 * h)
        if yy < bottom:
            end = int(w * rng.uniform(0.5, 0.9))
            cv2.line(
                scratch, (int(0.1 * w), yy), (end, yy), [float(c) for c in ink], 1, cv2.LINE_AA
            )
    canvas[:] = scratch


def grain(
    shape: tuple[int, int], base: Rgb, contrast: float, rng: np.random.Generator, planks: int = 1
) -> Float[np.ndarray, "h w 3"]:
    """Return wood with its grain along the rows."""
    h, _w = shape
    y = np.linspace(0, 1, h)[:, None]
    bend = smooth_noise(shape, (3, 3), rng)
    rings = np.sin(2 * np.pi * (6 * y + 1.5 * bend))
    fine = smooth_noise(shape, (h / 2, 8), rng)
    image = 1 + contrast * (0.5 * rings + 0.5 * fine + 0.4 * smooth_noise(shape, (12, 2), rng))
    if planks > 1:
        tone = rng.uniform(1 - contrast, 1 + contrast, planks)
        row = (y[:, 0] * planks).clip(0, planks - 1e-6)
        image = image * tone[row.astype(int)][:, None]
        image[(row % 1) < 0.03] *= 0.7
    return image[..., None] * np.array(base)


def surface(
    kind: str, base: Rgb, accent: Rgb, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """Return a table's or wall's picture: wood, planks, cloth, marble, plain, gingham, dots, or stripes."""
    shape = (768, 768) if kind in {"wood", "planks"} else (512, 512)
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]] / float(shape[0])
    one, two = np.array(base), np.array(accent)
    fine = smooth_noise(shape, (shape[0] / 2, shape[1] / 2), rng)[..., None]
    broad = smooth_noise(shape, (4, 4), rng)[..., None]
    if kind in {"wood", "planks"}:
        planks = int(rng.integers(4, 12)) if kind == "planks" else 1
        return pixels_of(grain(shape, base, float(rng.uniform(0.04, 0.2)), rng, planks))
    if kind == "marble":
        veins = np.abs(smooth_noise(shape, (5, 5), rng) + 0.5 * smooth_noise(shape, (14, 14), rng))
        mix = np.exp(-veins / rng.uniform(0.03, 0.12))[..., None] * rng.uniform(0.2, 0.7)
        return pixels_of((one * (1 - mix) + two * mix) * (1 + 0.04 * broad))
    if kind == "gingham":
        n = int(rng.integers(8, 28))
        mix = (((x * n) % 1 < 0.5) * 0.5 + ((y * n) % 1 < 0.5) * 0.5)[..., None]
        return pixels_of((one * (1 - mix) + two * mix) * (1 + 0.06 * fine))
    if kind == "dots":
        n = int(rng.integers(8, 30))
        mix = (((x * n % 1 - 0.5) ** 2 + (y * n % 1 - 0.5) ** 2) < 0.07)[..., None]
        return pixels_of(np.where(mix, two, one) * (1 + 0.06 * fine))
    if kind == "stripes":
        n = int(rng.integers(5, 30))
        return pixels_of(
            np.where(((x * n) % 1 < rng.uniform(0.1, 0.5))[..., None], two, one)
            * (1 + 0.06 * fine)
        )
    if kind == "flowers":
        image = np.tile(one, (*shape, 1)).astype(np.float32)
        for _ in range(140):
            centre = [int(c) for c in rng.uniform(0, 512, 2)]
            colour = [float(c) for c in any_colour(rng)]
            axes = [int(a) for a in rng.integers(4, 26, 2)]
            cv2.ellipse(
                image, centre, axes, float(rng.uniform(0, 180)), 0, 360, colour, -1, cv2.LINE_AA
            )
        return pixels_of(image * (1 + 0.05 * fine))
    amount = rng.uniform(0.02, 0.12) if kind == "cloth" else rng.uniform(0.005, 0.03)
    return pixels_of(one * (1 + amount * fine + 0.04 * broad))
