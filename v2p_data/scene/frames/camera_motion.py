"""How a camera moved: for every frame the homography that takes the first frame's pixels there.

Two measures go together. Corners are followed from the first frame into each other one: they bridge quick motion. From
there all pixels with an edge, spread evenly over the picture, are fitted at once: wood, cloth and paper have few
corners. Both compare with the first frame itself, so nothing drifts; where a hand hides too much of it, the latest
keyframe stands in.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from v2p_data.geometry.camera import between_centres
from v2p_data.scene.frames.edge_fit import (
    CELL_PX,
    FEWEST_PIXELS,
    LEVELS,
    EdgePixels,
    Grey,
    Homography,
    alike,
    explained,
    fine_of,
    fitted,
    through,
)

STANDS_PX = 1.0
"""A camera whose picture moves less than this at working size stands still."""
_CORNERS = 400
_CORNER_QUALITY = 0.003
_CORNERS_APART_PX = 6
_FEWEST = 16
"""Corners in agreement; with fewer they say nothing."""
_AGREES_PX = 1.2
_THERE_AND_BACK_PX = 1.0
_AS_GOOD = 0.85
"""A motion without perspective is taken where so many of the corners agree with it that agree with a homography."""
_SPREAD = 0.3
"""Of the picture's width and height: what agrees must cover so much, or it may all be one moving thing."""
_EXPLAINED = 0.45
"""Share of the pixels in view that must look as in the first frame."""
_STEADY = 0.5
"""Corners are followed where more than this share of the frames looks alike."""
_WELL_EXPLAINED = 0.8
"""With less, the frame is also looked for where the first one was."""
_KEY_EXPLAINED = 0.6
"""A frame that is explained so well may be a keyframe."""
_CLEARLY_BETTER = 1.3
"""So many times more pixels must be explained by a camera that moves than by one that stands, in
the mean over the frames that move."""
_LEAST_LINKED = 0.6
"""Share of the frames that must be linked to the first one itself."""
_MOST_LOST = 0.15
"""Share of the frames that may have no link at all: blurred ones, whose motion is interpolated."""
_MOST_IN_A_ROW = 4
"""Frames without a link, one after the other."""


@dataclass(frozen=True, kw_only=True)
class CameraMotion:
    """What is known of a camera that moved."""

    to_frames: Float[np.ndarray, "time 3 3"] = field(repr=False)
    """By frame: takes the first frame's pixels there [px of the frames given; pixel centres at one half]."""
    linked: Bool[np.ndarray, "time"] = field(repr=False)
    """Frames whose motion was measured against the first frame itself."""
    explained: Float[np.ndarray, "time"] = field(repr=False)
    """Share of the pixels in view that look as in the first frame, 0 to 1."""

    def travel(self, width: int, height: int) -> float:
        """Return how far the picture's middle got from its place, of the picture's width."""
        middle = np.array([[[width / 2, height / 2]]])
        there = np.stack([cv2.perspectiveTransform(middle, H)[0, 0] for H in self.to_frames])
        return float(np.linalg.norm(there - middle[0], axis=1).max()) / width

    def zoom(self, width: int, height: int) -> float:
        """Return by how much lengths in the picture's middle grew or shrank at most, of 1."""
        side = 0.25 * width
        spots = np.array([[[0, 0], [1, 0], [1, 1], [0, 1]]]) * side
        spots += np.array([width, height]) / 2 - side / 2
        areas = [
            cv2.contourArea(cv2.perspectiveTransform(spots, H).astype(np.float32))
            for H in self.to_frames
        ]
        return float(np.abs(np.sqrt(np.array(areas)) / side - 1).max())


def camera_motion(grey: Sequence[Grey]) -> CameraMotion | None:
    """Return how the camera moved; None where that is not clear, or where it stood.

    Args:
        grey: frames of one size, about 320 px wide.
    """
    first = _Key.of(grey[0], np.eye(3))
    if first is None:
        return None
    fine = [[fine_of(image, level) for level in LEVELS] for image in grey[1:]]
    links = _followed_through(first, grey[1:], fine)
    # what moved by itself is known now; without it the rest says more
    trusted = first.trusting(_trust(first, fine, links))
    return _judged(trusted, _followed_through(trusted, grey[1:], fine))


def _followed_through(
    first: "_Key", grey: Sequence[Grey], fine: Sequence[list[np.ndarray]]
) -> "list[_Link | None]":
    """Return the motion to every frame after the first one, each found from the one before."""
    key, last = first, np.eye(3)
    links: list[_Link | None] = []
    for image, levels in zip(grey, fine, strict=True):
        link = _best_link(first, image, levels, last)
        if link is None or link.explained < _WELL_EXPLAINED:
            again = _best_link(first, image, levels, np.eye(3))
            if again is not None and (link is None or again.explained > link.explained):
                link = again
        if link is None and key is not first:
            through = _best_link(key, image, levels, last)
            link = None if through is None else _best_link(first, image, levels, through.H)
            link = link or through
        if link is not None:
            last = link.H
            if link.explained > _KEY_EXPLAINED:
                key = _Key.of(image, link.H) or key
        links.append(link)
    return links


def _trust(
    first: "_Key", fine: Sequence[list[np.ndarray]], links: "list[_Link | None]"
) -> Float32[np.ndarray, "h w"]:
    """Return for each place of the first frame in how many of the others it looked alike, 0 to 1."""
    pixels, size = first.levels[-1], first.image.shape
    seen, stayed = np.full(len(pixels.spots), 0.5), np.full(len(pixels.spots), 0.5)
    for link, levels in zip(links, fine, strict=True):
        if link is not None:
            same, inside = alike(pixels, levels[-1], link.H)
            seen += inside
            stayed += same
    x, y = pixels.spots.astype(int).T
    total, weight = np.zeros(size, np.float32), np.zeros(size, np.float32)
    total[y, x], weight[y, x] = stayed / seen, 1.0
    total, weight = (cv2.GaussianBlur(one, (0, 0), 2.0 * CELL_PX) for one in (total, weight))
    return total / np.maximum(weight, 1e-6)


def _judged(first: "_Key", links: list["_Link | None"]) -> CameraMotion | None:
    linked = np.array([True, *(link is not None and link.key is first for link in links)])
    lost = np.array([False, *(link is None for link in links)])
    gap = max(
        (len(run) for run in "".join("x" if one else " " for one in lost).split()), default=0
    )
    moving = [link for link in links if link is not None and link.moved_px > STANDS_PX]
    if (
        not moving
        or lost.mean() > _MOST_LOST
        or gap > _MOST_IN_A_ROW
        or linked.mean() < _LEAST_LINKED
        or np.mean([link.explained for link in moving])
        < _CLEARLY_BETTER * np.mean([link.explained_by_standing for link in moving])
    ):
        return None
    found = np.stack([np.eye(3), *(np.eye(3) if link is None else link.H for link in links)])
    explained = [1.0, *(0.0 if link is None else link.explained for link in links)]
    return CameraMotion(
        to_frames=_between_neighbours(found, lost), linked=linked, explained=np.array(explained)
    )


@dataclass(frozen=True, eq=False)
class _Key:
    """A frame from which others are found."""

    image: Grey
    H: Homography
    """From the first frame's pixels to this one's."""
    corners: Float32[np.ndarray, "n 2"]
    levels: tuple["EdgePixels", ...]

    def trusting(self, trust: Float32[np.ndarray, "h w"]) -> "_Key":
        """Return the frame with each pixel counting as much as its place is trusted."""
        x, y = np.clip(self.corners.astype(int), 0, np.array(trust.shape[::-1]) - 1).T
        steady = trust[y, x] > _STEADY
        levels = tuple(
            pixels.trusting(trust, level)
            for pixels, level in zip(self.levels, LEVELS, strict=True)
        )
        return replace(self, corners=self.corners[steady], levels=levels)

    @staticmethod
    def of(image: Grey, H: Homography) -> "_Key | None":
        levels = tuple(EdgePixels.of(image, level) for level in LEVELS)
        if len(levels[-1].spots) < FEWEST_PIXELS:
            return None
        found = cv2.goodFeaturesToTrack(image, _CORNERS, _CORNER_QUALITY, _CORNERS_APART_PX)
        corners = np.zeros((0, 2), np.float32) if found is None else found[:, 0] + 0.5
        return _Key(image, H, corners, levels)


@dataclass(frozen=True, eq=False)
class _Link:
    H: Homography
    """From the first frame's pixels to this one's."""
    key: _Key
    explained: float
    explained_by_standing: float
    moved_px: float


def _best_link(
    key: _Key, image: Grey, fine: list[np.ndarray], expected: Homography
) -> _Link | None:
    """Return the motion to this frame by a keyframe; None where too little looks alike.

    Args:
        key: where from.
        image: where to.
        fine: the same frame as it is fitted, by level.
        expected: the motion from the first frame as far as it is known before.
    """
    to_key = np.linalg.inv(key.H)
    start = expected @ to_key
    by_corners = _by_corners(key, image, start)
    fits = [fitted(key.levels, fine, start)]
    if by_corners is not None:
        fits.append(fitted(key.levels[-1:], fine[-1:], by_corners))
    pixels = key.levels[-1]
    judged = [(explained(pixels, fine[-1], H), H) for H in fits if H is not None]
    if not judged:
        return None
    (same, spread), H = max(judged, key=lambda one: one[0][0])
    if same < _EXPLAINED or spread < _SPREAD:
        return None
    moved = np.linalg.norm(through(H @ key.H, pixels.spots) - pixels.spots, axis=1)
    standing = explained(pixels, fine[-1], to_key)[0]
    return _Link(H @ key.H, key, same, standing, float(np.median(moved)))


def _by_corners(key: _Key, image: Grey, expected: Homography) -> Homography | None:
    """Return the motion from the keyframe to this frame on which most corners agree."""
    h, w = image.shape
    if len(key.corners) < _FEWEST:
        return None
    shown = cv2.warpPerspective(
        key.image, between_centres(expected), (w, h), borderMode=cv2.BORDER_REPLICATE
    )
    start = through(expected, key.corners).astype(np.float32)
    inside = (start > 4).all(1) & (start < (w - 4, h - 4)).all(1)
    here, start = key.corners[inside], start[inside]
    if len(here) < _FEWEST:
        return None
    there, sure = _followed(shown, image, (start - 0.5)[:, None])
    here, there = here[sure], there[sure, 0] + 0.5
    if len(here) < _FEWEST:
        return None
    H, agree = cv2.findHomography(here, there, cv2.USAC_MAGSAC, _AGREES_PX)
    plain, agree_plain = cv2.estimateAffinePartial2D(
        here, there, method=cv2.RANSAC, ransacReprojThreshold=_AGREES_PX
    )
    if plain is not None and (H is None or agree_plain.sum() >= _AS_GOOD * agree.sum()):
        H, agree = np.vstack([plain, [0, 0, 1]]), agree_plain
    return H if H is not None and agree.sum() >= _FEWEST else None


def _followed(
    shown: Grey, image: Grey, start: Float32[np.ndarray, "n 1 2"]
) -> tuple[Float32[np.ndarray, "n 1 2"], Bool[np.ndarray, "n"]]:
    """Return where points of one picture are in the other, and which of them are found again on the way back."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(shown, image, start, np.empty(0))
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(image, shown, there, np.empty(0))
    sure = (found[:, 0] > 0) & (found_back[:, 0] > 0)
    return there, sure & (np.linalg.norm((back - start)[:, 0], axis=-1) < _THERE_AND_BACK_PX)


def _between_neighbours(
    moves: Float[np.ndarray, "time 3 3"], lost: Bool[np.ndarray, "time"]
) -> Float[np.ndarray, "time 3 3"]:
    """Return the motions with those of lost frames taken from the frames before and after."""
    moves = moves / moves[:, 2:, 2:]
    times, known = np.arange(len(moves)), ~lost
    filled = [np.interp(times, times[known], one[known]) for one in moves.reshape(-1, 9).T]
    return np.stack(filled, axis=1).reshape(-1, 3, 3)
