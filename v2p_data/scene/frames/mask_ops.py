"""Masks: a blob or a user's box becomes the object's outline (GrabCut), and small helpers on masks."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from v2p_data.scene.frames.colour import lab_of

_ITERATIONS = 4
DRAWN_OFF_PX = 2
"""At working size, 320 px wide: people draw boxes so tightly that what they mean may go on so far beside them."""
_HANDLE_WIDTH = 0.45
"""A handle is narrower than this share of its vessel's outline."""
_LEAST_HANDLE = 0.02
"""Of an outline: what sticks out less is a corner."""


def refine(
    image: UInt8[np.ndarray, "h w 3"],
    blob: Bool[np.ndarray, "h w"],
    never: Bool[np.ndarray, "h w"] | None = None,
) -> Bool[np.ndarray, "h w"]:
    """Return the object's outline around a blob; the blob itself where GrabCut runs away.

    `never` marks pixels that belong to something else (the hand, the other object).
    """
    area = int(blob.sum())
    reach = max(4, int(0.35 * np.sqrt(area)))
    labels = np.full(blob.shape, cv2.GC_BGD, np.uint8)
    labels[grow(blob, reach)] = cv2.GC_PR_BGD
    labels[blob] = cv2.GC_PR_FGD
    labels[shrink(blob, max(1, int(0.08 * np.sqrt(area))))] = cv2.GC_FGD
    if never is not None:
        labels[never & ~shrink(blob, 2)] = cv2.GC_BGD
        labels[never & (labels == cv2.GC_FGD)] = cv2.GC_PR_BGD
    mask = _grab_cut(image, labels)
    if mask is None or not 0.55 * area <= mask.sum() <= 2.2 * area:
        return blob
    return mask


def from_box(
    image: UInt8[np.ndarray, "h w 3"],
    box: tuple[float, float, float, float],
    thing: Float[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """Return the mask of the object in the box (x0, y0, x1, y1 in pixels of this image).

    Several methods run and the best-looking one is kept: GrabCut from a centred ellipse, what differs from the colours
    of the ring around the box, and GrabCut from `thing` (how likely each pixel is some object).
    None is kept that fills less than half of the box: people draw boxes tightly.
    """
    h, w = image.shape[:2]
    x0, y0 = max(0, round(box[0])), max(0, round(box[1]))
    x1, y1 = min(w, max(round(box[2]), x0 + 3)), min(h, max(round(box[3]), y0 + 3))
    inside = np.zeros((h, w), bool)
    inside[y0:y1, x0:x1] = True
    candidates = [_ellipse_cut(image, inside, (x0, y0, x1, y1)), _unlike_ring(image, inside)]
    if ((thing > 0.5) & inside).sum() > 0.2 * inside.sum():
        core = largest(tidy((thing > 0.5) & inside))
        candidates += [core, refine(image, core, never=~grow(inside, 2))]
    masks = [
        mask
        for mask in candidates
        if mask is not None and mask.sum() > 12 and spans(mask, (x0, y0, x1, y1)) > 0.5
    ]
    if not masks:
        return ellipse_in((x0, y0, x1, y1), (h, w))
    return max(masks, key=lambda mask: _plausibility(image, mask, (x0, y0, x1, y1)))


def inside_box(
    box_xyxy: tuple[float, float, float, float], shape: tuple[int, int]
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of a picture of this shape inside of a box [px]."""
    x0, y0, x1, y1 = (max(0, round(v)) for v in box_xyxy)
    inside = np.zeros(shape, bool)
    inside[y0:y1, x0:x1] = True
    return inside


def ellipse_in(
    box: tuple[int, int, int, int], shape: tuple[int, int], share: float = 1.0
) -> Bool[np.ndarray, "h w"]:
    """Return the ellipse in a box's middle that spans this share of its sides, in a picture of this shape."""
    x0, y0, x1, y1 = box
    centre = ((x0 + x1) // 2, (y0 + y1) // 2)
    axes = (max(1, int(share * (x1 - x0) / 2)), max(1, int(share * (y1 - y0) / 2)))
    return cv2.ellipse(np.zeros(shape, np.uint8), centre, axes, 0, 0, 360, 1, -1) > 0


def spans(mask: Bool[np.ndarray, "h w"], box: tuple[int, int, int, int]) -> float:
    """Return how much of a box the mask's own bounding box covers, and it of that (intersection over union)."""
    x, y, w, h = bounding_box(mask)
    x0, y0, x1, y1 = box
    common = max(0, min(x + w, x1) - max(x, x0)) * max(0, min(y + h, y1) - max(y, y0))
    return common / (w * h + (x1 - x0) * (y1 - y0) - common)


def handle_of(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return what sticks out of a vessel's outline: a disc that fits into the vessel does not fit into its handle."""
    if not mask.any():
        return mask
    inner = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    radius = _HANDLE_WIDTH * float(inner.max())
    core = (inner <= radius).astype(np.uint8)
    body = mask & (cv2.distanceTransform(core, cv2.DIST_L2, 5) <= radius)
    count, parts, stats, _ = cv2.connectedComponentsWithStats((mask & ~body).astype(np.uint8))
    large = [k for k in range(1, count) if stats[k, cv2.CC_STAT_AREA] > _LEAST_HANDLE * mask.sum()]
    return np.isin(parts, large)


def attainable_iou(mask: Bool[np.ndarray, "h w"]) -> float:
    """Return the overlap that the best of shapes can be expected to have: half of the outline's pixels may be wrong."""
    inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8))
    edge = float(mask.sum()) - float(inner.sum())
    return 1 - 0.5 * edge / max(1.0, float(mask.sum()))


def from_points(
    image: UInt8[np.ndarray, "h w 3"], points: list[tuple[float, float]], alike_lab: float = 9.0
) -> Bool[np.ndarray, "h w"]:
    """Return the region around points (x, y) [px] that has their colours, up to a distance in Lab."""
    lab = lab_of(cv2.GaussianBlur(image, (0, 0), 1.0))
    h, w = lab.shape[:2]
    seed = np.zeros((h, w), np.uint8)
    for x, y in points:
        cv2.circle(seed, (round(x), round(y)), 4, 1, -1)
    colours = lab[seed > 0][::3]
    nearest = np.min(np.linalg.norm(lab[:, :, None] - colours[None, None, :24], axis=-1), axis=-1)
    alike = tidy(nearest < alike_lab) | (seed > 0)
    _, parts = cv2.connectedComponents(alike.astype(np.uint8))
    wanted = {int(parts[min(h - 1, round(y)), min(w - 1, round(x))]) for x, y in points} - {0}
    return refine(image, np.isin(parts, list(wanted)))


def tidy(mask: Bool[np.ndarray, "h w"], close_px: int = 3) -> Bool[np.ndarray, "h w"]:
    """Return the mask without specks and pinholes."""
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3)))
    return cv2.morphologyEx(opened, cv2.MORPH_CLOSE, np.ones((close_px, close_px))) > 0


def grow(mask: Bool[np.ndarray, "h w"], px: int) -> Bool[np.ndarray, "h w"]:
    """Return the mask dilated by `px` pixels."""
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * px + 1, 2 * px + 1))) > 0


def shrink(mask: Bool[np.ndarray, "h w"], px: int) -> Bool[np.ndarray, "h w"]:
    """Return the mask eroded by `px` pixels; outside the picture counts as mask."""
    kernel = np.ones((2 * px + 1, 2 * px + 1))
    return cv2.erode(mask.astype(np.uint8), kernel, borderValue=1) > 0


def largest(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the largest connected part, its holes filled."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if count < 2:
        return mask
    part = (parts == 1 + stats[1:, 4].argmax()).astype(np.uint8)
    outlines, _ = cv2.findContours(part, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(part, outlines, -1, 1, -1) > 0


def main_parts(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the mask without parts below a sixth of the largest: a hand may cut an object in two."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if count < 2:
        return mask
    kept = 1 + np.flatnonzero(stats[1:, 4] > stats[1:, 4].max() / 6)
    whole = np.isin(parts, kept).astype(np.uint8)
    outlines, _ = cv2.findContours(whole, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = cv2.drawContours(whole.copy(), outlines, -1, 1, -1) > 0
    # A hole that is large is no pinhole but a hand in front.
    return filled if (filled & (whole == 0)).sum() < 0.1 * whole.sum() else whole > 0


def convex_hull(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the filled convex hull of all the mask's pixels."""
    y, x = np.nonzero(mask)
    filled = np.zeros(mask.shape, np.uint8)
    if len(x):
        cv2.fillConvexPoly(filled, cv2.convexHull(np.stack([x, y], 1).astype(np.int32)), 1)
    return filled > 0


def bounding_box(mask: Bool[np.ndarray, "h w"]) -> tuple[int, int, int, int]:
    """Return x, y, width, height of the mask's bounding box."""
    x, y, w, h = cv2.boundingRect(mask.astype(np.uint8))
    return int(x), int(y), int(w), int(h)


def iou(a: Bool[np.ndarray, "h w"], b: Bool[np.ndarray, "h w"]) -> float:
    """Return two masks' intersection over their union; 0 where both are empty."""
    return float((a & b).sum() / max(1, (a | b).sum()))


def is_cut(mask: Bool[np.ndarray, "h w"]) -> bool:
    """Return whether the picture's edge may cut the mask."""
    x, y, w, h = bounding_box(mask)
    return x <= 1 or y <= 1 or x + w >= mask.shape[1] - 1 or y + h >= mask.shape[0] - 1


def edge_contrast(lab: np.ndarray, mask: Bool[np.ndarray, "h w"]) -> float:
    """Return the median Lab step between just inside and just outside the mask's outline."""
    x, y, w, h = bounding_box(mask)
    rows, cols = slice(max(0, y - 8), y + h + 8), slice(max(0, x - 8), x + w + 8)
    lab, mask = lab[rows, cols], mask[rows, cols]
    inside, outside = mask & ~shrink(mask, 2), grow(mask, 3) & ~grow(mask, 1)
    if not inside.any() or not outside.any():
        return 0.0
    local_in = _local_mean(lab, inside)
    local_out = _local_mean(lab, outside)
    rim = mask & ~shrink(mask, 1)
    return float(np.median(np.linalg.norm(local_in - local_out, axis=-1)[rim]))


def solidity(mask: Bool[np.ndarray, "h w"]) -> float:
    """Return area over area of the convex hull, 0 to 1."""
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not outlines:
        return 0.0
    hull = cv2.convexHull(np.concatenate(outlines))
    return min(1.0, float(mask.sum()) / max(1.0, cv2.contourArea(hull)))


def _local_mean(lab: np.ndarray, where: np.ndarray) -> np.ndarray:
    weight = cv2.boxFilter(where.astype(np.float32), -1, (11, 11))
    total = cv2.boxFilter(lab * where[..., None].astype(np.float32), -1, (11, 11))
    return total / np.maximum(weight, 1e-6)[..., None]


def from_core(
    image: UInt8[np.ndarray, "h w 3"],
    core: Bool[np.ndarray, "h w"],
    likely: Bool[np.ndarray, "h w"],
    possible: Bool[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"] | None:
    """Return what GrabCut makes of three nested regions: all of the first is object, nothing outside of the last.

    None where it finds nothing.
    """
    labels = np.full(core.shape, cv2.GC_BGD, np.uint8)
    labels[possible] = cv2.GC_PR_BGD
    labels[likely] = cv2.GC_PR_FGD
    labels[core] = cv2.GC_FGD
    return _grab_cut(image, labels)


def _grab_cut(image: np.ndarray, labels: np.ndarray) -> np.ndarray | None:
    sure = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if sure.sum() < 12 or (~sure).sum() < 12:
        return None
    cv2.setRNGSeed(2)
    x, y, w, h = bounding_box(labels != cv2.GC_BGD)
    pad = 12
    rows, cols = slice(max(0, y - pad), y + h + pad), slice(max(0, x - pad), x + w + pad)
    local = np.ascontiguousarray(labels[rows, cols])
    crop = np.ascontiguousarray(image[rows, cols][..., ::-1])
    if np.all(np.isin(local, (cv2.GC_FGD, cv2.GC_PR_FGD))):
        return None
    cv2.grabCut(
        crop,
        local,
        (0, 0, 1, 1),
        np.zeros((1, 65)),
        np.zeros((1, 65)),
        _ITERATIONS,
        cv2.GC_INIT_WITH_MASK,
    )  # type: ignore[call-overload]
    mask = np.zeros(labels.shape, bool)
    mask[rows, cols] = np.isin(local, (cv2.GC_FGD, cv2.GC_PR_FGD))
    mask = tidy(mask)
    return main_parts(mask) if mask.any() else None


def _ellipse_cut(
    image: np.ndarray, inside: np.ndarray, box: tuple[int, int, int, int]
) -> np.ndarray | None:
    core = ellipse_in(box, inside.shape, share=0.5)
    labels = np.full(inside.shape, cv2.GC_BGD, np.uint8)
    labels[inside] = cv2.GC_PR_FGD
    labels[core] = cv2.GC_FGD
    return _grab_cut(image, labels)


def _unlike_ring(image: np.ndarray, inside: np.ndarray) -> np.ndarray | None:
    _, _, w, h = bounding_box(inside)
    reach = int(0.35 * max(w, h)) + 8
    ring = grow(inside, reach) & ~inside
    lab = cv2.GaussianBlur(lab_of(image), (0, 0), 0.8) * np.array([0.5, 1.3, 1.3], np.float32)
    samples = np.ascontiguousarray(lab[ring])
    clusters = min(12, len(samples) // 20)
    if clusters < 2:
        return None
    cv2.setRNGSeed(2)
    _, _, centres = cv2.kmeans(
        samples, clusters, np.empty(0), (3, 20, 1), 2, cv2.KMEANS_PP_CENTERS
    )
    far = np.min(np.linalg.norm(lab[:, :, None] - centres[None, None], axis=-1), axis=-1)
    values = np.clip(far[inside] * 8, 0, 255).astype(np.uint8).reshape(1, -1)
    threshold = np.clip(cv2.threshold(values, 0, 255, cv2.THRESH_OTSU)[0] / 8 * 0.75, 3, 14)
    blob = tidy((far > threshold) & inside, 5)
    return refine(image, largest(blob), never=~grow(inside, 2)) if blob.any() else None


def _plausibility(image: np.ndarray, mask: np.ndarray, box: tuple[int, int, int, int]) -> float:
    x0, y0, x1, y1 = box
    everything = 0.5 if mask.sum() > 0.93 * (x1 - x0) * (y1 - y0) else 0.0
    contrast = min(40.0, edge_contrast(lab_of(image), mask))
    return spans(mask, box) + 0.5 * solidity(mask) + 0.008 * contrast - everything
