"""A page on this machine that shows the robot's picture and takes a click for each object, in order."""

import base64
import json
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from v2p_data.errors import V2PError
from v2p_data.local_page import LocalPage, Request

PAGE = Path(__file__).with_name("click.html")
MARK = np.array([255, 0, 255])


class ClickPage(LocalPage):
    """The page, served from the start of the `with` block to its end.

    Args:
        picture: what is clicked on.
        objects: what to ask for.
        mask_at: returns the mask of the object at a pixel (u right, v down); the page shows it.
    """

    longest_body = 1000

    def __init__(
        self,
        picture: UInt8[np.ndarray, "h w 3"],
        objects: Sequence[str],
        mask_at: Callable[[tuple[float, float]], Bool[np.ndarray, "h w"]],
    ) -> None:
        self.picture, self.objects, self.mask_at = picture.copy(), tuple(objects), mask_at
        self.clicks: list[tuple[float, float]] = []
        self._done = threading.Event()
        self._lock = threading.Lock()
        super().__init__()

    def wait(self, timeout_s: float) -> tuple[tuple[float, float], ...]:
        """Return the clicks once all were made.

        Raises:
            V2PError: they were not made in time.
        """
        if not self._done.wait(timeout_s):
            raise V2PError(
                f"{len(self.clicks)} of {len(self.objects)} objects were clicked within "
                f"{timeout_s:g} s; start again, or give"
                " the pixels with --click X,Y"
            )
        return tuple(self.clicks)

    def show(self, path: str, request: Request) -> None:
        """Answer with the page."""
        if path:
            raise LookupError(path)
        names = json.dumps(self.objects).replace("<", "\\u003c")
        text = PAGE.read_text("utf-8").replace("__OBJECTS__", names)
        page = text.replace("__PICTURE__", self._png())
        request.answer("text/html; charset=utf-8", page.encode())

    def changed(self, path: str, body: bytes) -> dict[str, Any]:
        """Return the answer to a click."""
        if path:
            raise LookupError(path)
        with self._lock:
            if self._done.is_set():
                return {"error": "all objects are known already"}
            try:
                said = json.loads(body)
                pixel = float(said["u"]), float(said["v"])
                mask = self.mask_at(pixel)
            except V2PError as error:
                return {"error": str(error)}
            except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
                return {"error": "a click has two numbers, u and v"}
            rim = mask & ~(cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
            self.picture[rim] = MARK
            self.clicks.append(pixel)
            if len(self.clicks) == len(self.objects):
                self._done.set()
            return {"picture": self._png(), "done": self._done.is_set()}

    def _png(self) -> str:
        _, png = cv2.imencode(".png", self.picture[..., ::-1])
        return base64.b64encode(png.tobytes()).decode()
