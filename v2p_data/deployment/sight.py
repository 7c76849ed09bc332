"""Pictures and joint angles become the label image that policies were trained on.

0 background, 1 robot, 2 the manipulated object, 3.. the others in the order of the clicks. The
robot's mask is drawn from its joints, the objects' are tracked; nothing else of the scene is
known.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from v2p_data.deployment.robot import Reading, fingers_m
from v2p_data.deployment.segmentation import ColourTracker, StreamTracker, Tracked
from v2p_data.deployment.silhouette import Silhouette
from v2p_data.deployment.view import view_for
from v2p_data.errors import V2PError
from v2p_data.geometry.camera import Camera
from v2p_data.sim.render.masks import BACKGROUND, FIRST_OBJECT, PALETTE, ROBOT

MAX_OBJECTS = len(PALETTE) - FIRST_OBJECT
LOST_AFTER = 20
"""`Seen.missed` from which on an object is lost."""
HIDDEN_WEIGHT, UNSEEN_WEIGHT = 1, 4
"""What a picture without the object adds to it: five pictures, or a second behind the arm, are too many."""
SAME_SHARE = 0.5
"""Two clicks whose masks overlap by more of the smaller one are on the same object."""


@dataclass(frozen=True, kw_only=True)
class Seen:
    """One picture, understood."""

    labels: UInt8[np.ndarray, "h w"]
    """As the camera of training would see the scene: what a policy gets."""
    confidences: tuple[float, ...]
    """Per object, 0 to 1; 0 where it is not seen."""
    missed: tuple[int, ...]
    """Per object: the weight of the pictures on end in which it was not seen; `LOST_AFTER` is too much."""
    in_picture: UInt8[np.ndarray, "h w"]
    """Labels of the robot's own picture."""


class Sight:
    """Sees one robot's scene from the clicks on.

    Args:
        camera: of the pictures, calibrated. It may stand elsewhere than the camera of training.
        clicks_px: a pixel (u right, v down) on each object, the manipulated one first.
        new_tracker: makes what follows one object.
        training_view: labels are carried over to the camera of training.

    Raises:
        V2PError: no click, or more than there are greys; the camera sees too little of the table.
    """

    def __init__(
        self,
        camera: Camera,
        clicks_px: Sequence[tuple[float, float]],
        new_tracker: Callable[[], StreamTracker] = ColourTracker,
        *,
        training_view: bool = True,
    ) -> None:
        if not 1 <= len(clicks_px) <= MAX_OBJECTS:
            raise V2PError(
                f"{len(clicks_px)} objects are clicked; give 1 to {MAX_OBJECTS} clicks, the object that is moved first"
            )
        self.camera = camera
        self.clicks_px = tuple(clicks_px)
        self._new_tracker = new_tracker
        self._silhouette = Silhouette(camera)
        self._view = view_for(camera) if training_view else None
        self._trackers: list[StreamTracker] = []
        self._missed: list[int] = []

    def start(self, reading: Reading) -> Seen:
        """Look for what was clicked in this reading's picture.

        Raises:
            V2PError: a click is on no object, or two are on the same.
        """
        picture, robot = self._picture(reading), self._robot(reading)
        self._trackers = [self._new_tracker() for _ in self.clicks_px]
        self._missed = [0] * len(self._trackers)
        masks = [
            tracker.start(picture, click, robot)
            for tracker, click in zip(self._trackers, self.clicks_px, strict=True)
        ]
        labels = np.where(robot, ROBOT, BACKGROUND).astype(np.uint8)
        for k, mask in enumerate(masks):
            for other in range(k):
                common = (mask & masks[other]).sum()
                if common > SAME_SHARE * min(mask.sum(), masks[other].sum()):
                    u, v = self.clicks_px[k]
                    raise V2PError(
                        f"the click at ({u:g}, {v:g}) is on the same thing as click {other + 1}; "
                        "click on each object once"
                    )
            labels[mask] = FIRST_OBJECT + k
        count = len(masks)
        return self._seen(labels, reading, confidences=(1.0,) * count, missed=(0,) * count)

    def see(self, reading: Reading) -> Seen:
        """Return the labels of the next reading."""
        picture, robot = self._picture(reading), self._robot(reading)
        tracked = [tracker.track(picture, robot) for tracker in self._trackers]
        labels = np.where(robot, ROBOT, BACKGROUND).astype(np.uint8)
        best = np.full(robot.shape, -np.inf, np.float32)
        for k, found in enumerate(tracked):
            mine = found.mask & (found.score > best)
            labels[mine] = FIRST_OBJECT + k
            best[mine] = found.score[mine]
            self._missed[k] = 0 if found.confidence > 0 else self._missed[k] + _weight(found)
        return self._seen(
            labels,
            reading,
            confidences=tuple(found.confidence for found in tracked),
            missed=tuple(self._missed),
        )

    def _seen(
        self,
        labels: np.ndarray,
        reading: Reading,
        *,
        confidences: tuple[float, ...],
        missed: tuple[int, ...],
    ) -> Seen:
        assert reading.joints_rad is not None
        for_policy = labels
        if self._view is not None:
            fingers = fingers_m(reading.opening)
            for_policy = self._view.labels(labels, reading.joints_rad, fingers)
        return Seen(labels=for_policy, confidences=confidences, missed=missed, in_picture=labels)

    def _picture(self, reading: Reading) -> np.ndarray:
        if reading.picture is None or reading.joints_rad is None:
            raise V2PError("the robot gives no picture, so nothing can be tracked in it")
        wanted = (self.camera.height_px, self.camera.width_px)
        if reading.picture.shape[:2] != wanted:
            raise V2PError(
                f"the robot's picture has {reading.picture.shape[:2]} pixels and its calibration is for {wanted}"
            )
        return reading.picture

    def _robot(self, reading: Reading) -> np.ndarray:
        assert reading.joints_rad is not None
        return self._silhouette.draw(reading.joints_rad, fingers_m(reading.opening))


def _weight(found: Tracked) -> int:
    return HIDDEN_WEIGHT if found.is_hidden else UNSEEN_WEIGHT


def clicks_from(words: Sequence[str]) -> tuple[tuple[float, float], ...]:
    """Return the pixels that `120,80` and the like name.

    Raises:
        V2PError: something else is written there.
    """
    found: list[tuple[float, float]] = []
    for word in words:
        match = re.fullmatch(r"(\d+(?:\.\d+)?),(\d+(?:\.\d+)?)", word.strip())
        if match is None:
            raise V2PError(
                f"a click is X,Y in pixels of the picture, such as 120,80; got '{word}'"
            )
        found.append((float(match[1]), float(match[2])))
    return tuple(found)
