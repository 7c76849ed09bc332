"""Two pictures of one plane: the homography between them, fitted to all edges at once.

Wood, cloth and paper have few corners, but edges nearly everywhere. The strongest in each small cell counts, no edge
much more than another, so that a thing with a bold pattern does not outweigh the table; what differs too much, such
as a hand, counts nothing. What a hand usually does with a camera decides where the pictures say little.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

CELL_PX = 5
"""One pixel, that with the strongest edge, is fitted in each cell of this size."""
_WEAKEST_EDGE = 0.8
"""Grey levels per pixel."""
FEWEST_PIXELS = 150
LEVELS = (4, 2, 1)
"""Pictures are fitted at a fourth of the working size first."""
_OVER_PX = 1.5
_ROUNDS = 8
_FINE_PX = 8.0
"""What is coarser than about twice this is light, not texture."""
_EVEN_EDGE = 3.0
"""Grey levels per pixel: steeper edges count no more, or the pattern of one moving thing outweighs
a whole table of wood."""
_USUAL = np.array([0.06, 0.03, 0.06, 0.03, 0.3, 0.3, 0.05, 0.05])
"""How far a hand moves a picture, half a width being 1: scale, aspect, turn, shear, shift right
and down, perspective (standard deviations)."""
_ALIKE = 9.0
"""So many neighbouring pixels tell one thing only."""
_NOISE = (3.0, 14.0)
"""Grey levels: the least and the most that a pixel may differ and count as the same, as a standard deviation."""
_MIXED = np.array(
    [
        [0.5, 0, 0, 0, 0.5, 0, 0, 0], [0.5, 0, 0, 0, -0.5, 0, 0, 0],
        [0, -0.5, 0, 0.5, 0, 0, 0, 0], [0, 0.5, 0, 0.5, 0, 0, 0, 0],
        [0, 0, 1, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 1, 0, 0],
        [0, 0, 0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 0, 0, 1],
    ]
)  # fmt: skip
"""From a homography's eight numbers to those of `_USUAL`."""
_BENT = np.array([False, True, False, True, False, False, True, True])
"""Those that a small picture is fitted without."""

Grey = UInt8[np.ndarray, "h w"]
Homography = Float[np.ndarray, "3 3"]


@dataclass(frozen=True, kw_only=True, eq=False)
class EdgePixels:
    """The pixels that are fitted at one size, and how each changes with the numbers of a homography."""

    spots: Float[np.ndarray, "n 2"]
    values: Float32[np.ndarray, "n"]
    jacobian: Float[np.ndarray, "n 8"]
    steep: Float[np.ndarray, "n"]
    """Grey levels per pixel."""
    over: Float[np.ndarray, "n 2"]
    """From each pixel over its edge to the brighter side [px]."""
    rise: Float32[np.ndarray, "n"]
    """By how much that side is brighter than the other."""
    trust: Float[np.ndarray, "n"]
    """How much each counts, 0 to 1."""
    unit: Homography
    """From pixels to numbers about one, in which the eight are alike."""

    def trusting(self, trust: Float32[np.ndarray, "h w"], level: int) -> "EdgePixels":
        """Return the pixels with each counting by its place, given at working size."""
        x, y = np.clip(self.spots * level, 0, np.array(trust.shape[::-1]) - 1).astype(int).T
        return replace(self, trust=np.clip((trust[y, x] - 0.3) / 0.4, 0.02, 1).astype(np.float64))

    @staticmethod
    def of(image: Grey, level: int) -> "EdgePixels":
        """Return the pixels of a frame made smaller by `level`."""
        fine = fine_of(image, level)
        h, w = fine.shape
        gx, gy = (cv2.Sobel(fine, cv2.CV_32F, *d, ksize=3) / 8 for d in ((1, 0), (0, 1)))
        y, x = _strongest(np.hypot(gx, gy))
        unit = np.array([[2 / w, 0, -1], [0, 2 / w, -h / w], [0, 0, 1]])
        spots = np.stack([x, y], 1) + 0.5
        u, v = (spots @ unit[:2, :2].T + unit[:2, 2]).T
        a, b = gx[y, x] * w / 2, gy[y, x] * w / 2
        along = a * u + b * v
        jacobian = np.stack([a * u, a * v, a, b * u, b * v, b, -along * u, -along * v], 1)
        steep = np.hypot(gx, gy)[y, x].astype(np.float64)
        over = _OVER_PX * np.stack([gx[y, x], gy[y, x]], 1) / steep[:, None]
        rise = _values(fine, spots + over) - _values(fine, spots - over)
        return EdgePixels(
            spots=spots,
            values=fine[y, x],
            jacobian=jacobian.astype(np.float64),
            steep=steep,
            over=over,
            rise=rise,
            trust=np.ones(len(steep)),
            unit=unit,
        )


def fine_of(image: Grey, level: int) -> Float32[np.ndarray, "b a"]:
    """Return a picture at one size without its light: only what is finer than about 16 px."""
    h, w = image.shape
    small = cv2.resize(image, (w // level, h // level), interpolation=cv2.INTER_AREA)
    soft = cv2.GaussianBlur(small.astype(np.float32), (0, 0), 0.8)
    return soft - cv2.GaussianBlur(soft, (0, 0), _FINE_PX)


def _strongest(edge: Float32[np.ndarray, "h w"]) -> Int[np.ndarray, "2 n"]:
    """Return rows and columns of the strongest edge in every cell that has one, the picture's rim left out."""
    h, w = (n // CELL_PX * CELL_PX for n in edge.shape)
    cells = edge[:h, :w].reshape(h // CELL_PX, CELL_PX, w // CELL_PX, CELL_PX)
    cells = cells.transpose(0, 2, 1, 3).reshape(h // CELL_PX, w // CELL_PX, -1)
    at = cells.argmax(-1)
    rows, columns = np.indices(at.shape)
    y, x = rows * CELL_PX + at // CELL_PX, columns * CELL_PX + at % CELL_PX
    good = (cells.max(-1) > _WEAKEST_EDGE) & (y > 1) & (x > 1)
    good &= (y < edge.shape[0] - 2) & (x < edge.shape[1] - 2)
    return np.stack([y[good], x[good]])


def fitted(
    levels: Sequence[EdgePixels], fine: Sequence[np.ndarray], H: Homography
) -> Homography | None:
    """Return the homography that fits best, found from `H` on; None where it runs away."""
    width = fine[-1].shape[1]
    for pixels, picture in zip(levels, fine, strict=True):
        size = picture.shape[1] / width
        to_level = np.diag([size, size, 1.0])
        H = to_level @ H @ np.linalg.inv(to_level)
        coarse = len(levels) > 1 and pixels is levels[0]
        for _ in range(_ROUNDS):
            step = _step(pixels, picture, H, plain=coarse)
            if step is None:  # nothing to see at this size
                break
            H = H @ np.linalg.inv(step)
            H = H / H[2, 2]
            if np.abs(through(step, pixels.spots) - pixels.spots).max() < 0.03:
                break
        H = np.linalg.inv(to_level) @ H @ to_level
        if not np.isfinite(H).all() or not 0.3 < np.linalg.det(H[:2, :2]) < 3:
            return None
    return H


def _step(
    pixels: EdgePixels, picture: Float32[np.ndarray, "h w"], H: Homography, *, plain: bool
) -> Homography | None:
    """Return the next step of the fit, in the keyframe's pixels; `plain`: shift, turn and scale only."""
    off, inside = _differences(pixels, picture, H)
    if inside.sum() < FEWEST_PIXELS / 3:
        return None
    noise = np.clip(1.48 * np.median(np.abs(off[inside])), *_NOISE)
    weight = np.clip(1 - (off / (3 * noise)) ** 2, 0, None) ** 2 * inside
    weight *= np.minimum(1, (_EVEN_EDGE / pixels.steep) ** 2) / (_ALIKE * noise**2)
    weight *= pixels.trust
    J = pixels.jacobian
    # what is known of hands: the step also leads back to where nothing speaks against it
    far = pixels.unit @ H @ np.linalg.inv(pixels.unit)
    so_far = (far / far[2, 2] - np.eye(3)).ravel()[:8]
    tight = _MIXED.T @ np.diag(_USUAL**-2 * np.where(plain & _BENT, 1e6, 1.0)) @ _MIXED
    d = np.linalg.solve(J.T @ (J * weight[:, None]) + tight, J.T @ (weight * off) + tight @ so_far)
    by = np.eye(3) + np.append(d, 0).reshape(3, 3)
    return np.linalg.inv(pixels.unit) @ by @ pixels.unit


def alike(
    pixels: EdgePixels, picture: Float32[np.ndarray, "h w"], H: Homography
) -> tuple[Bool[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Return which pixels look the same through a homography, brightness and edge, and which of all are in view."""
    off, inside = _differences(pixels, picture, H)
    bright = _values(picture, through(H, pixels.spots + pixels.over))
    dark = _values(picture, through(H, pixels.spots - pixels.over))
    edge = np.abs(bright - dark - pixels.rise) < _NOISE[0] + 0.5 * np.abs(pixels.rise)
    # a pixel that is off by half a pixel differs by half its steepness
    return inside & edge & (np.abs(off) < 1.5 * _NOISE[0] + 0.5 * pixels.steep), inside


def explained(
    pixels: EdgePixels, picture: Float32[np.ndarray, "h w"], H: Homography
) -> tuple[float, float]:
    """Return the share of the pixels in view that look alike, and how much of the picture these cover, 0 to 1 each."""
    same, inside = alike(pixels, picture, H)
    if inside.sum() < 0.3 * len(inside) or same.sum() < FEWEST_PIXELS / 3:
        return 0.0, 0.0
    # flat pixels look alike everywhere
    counts = np.clip(pixels.steep / _NOISE[0] - 0.5, 0, 1.5) * pixels.trust
    low, high = np.percentile(pixels.spots[same], [5, 95], axis=0)
    share = float(counts[same].sum() / max(counts[inside].sum(), 1e-9))
    return share, float(((high - low) / picture.shape[::-1]).min())


def _differences(
    pixels: EdgePixels, picture: Float32[np.ndarray, "h w"], H: Homography
) -> tuple[Float[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Return by how much each pixel is brighter in the picture, and which are in view."""
    h, w = picture.shape
    there = through(H, pixels.spots)
    inside = np.asarray(((there >= 1.5) & (there <= (w - 1.5, h - 1.5))).all(1))
    return (_values(picture, there) - pixels.values).astype(np.float64), inside


def _values(
    picture: Float32[np.ndarray, "h w"], spots: Float[np.ndarray, "n 2"]
) -> Float32[np.ndarray, "n"]:
    """Return a picture's values at points, pixel centres at one half."""
    if not len(spots):
        return np.zeros(0, np.float32)
    x, y = (spots - 0.5).T.astype(np.float32)
    return cv2.remap(picture, x[None], y[None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[
        0
    ]


def through(H: Homography, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Return points taken through a homography."""
    if not len(points):
        return points.astype(np.float64)
    return cv2.perspectiveTransform(points[None].astype(np.float64), H)[0]
