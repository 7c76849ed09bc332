"""A page on this machine that shows the robot's picture and takes a click for each object, in order.

It listens on 127.0.0.1 only, at an address with a random token; other paths and other hosts' names get nothing.
"""

import base64
import json
import re
import secrets
import threading
from collections.abc import Callable, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from v2p_data.errors import V2PError

PAGE = Path(__file__).with_name("click.html")
LONGEST_BODY = 1000
MARK = np.array([255, 0, 255])


class ClickPage:
    """The page, served from the start of the `with` block to its end.

    Args:
        picture: what is clicked on.
        objects: what to ask for.
        mask_at: returns the mask of the object at a pixel (u right, v down); the page shows it.
    """

    def __init__(
        self,
        picture: UInt8[np.ndarray, "h w 3"],
        objects: Sequence[str],
        mask_at: Callable[[tuple[float, float]], Bool[np.ndarray, "h w"]],
    ) -> None:
        self.picture, self.objects, self.mask_at = picture.copy(), tuple(objects), mask_at
        self.clicks: list[tuple[float, float]] = []
        self._token = secrets.token_urlsafe(16)
        self._done = threading.Event()
        self._lock = threading.Lock()
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), _handler(self))
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)

    @property
    def address(self) -> str:
        """Where to find it."""
        return f"http://127.0.0.1:{self._server.server_address[1]}/{self._token}"

    def __enter__(self) -> "ClickPage":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def wait(self, timeout_s: float) -> tuple[tuple[float, float], ...]:
        """Return the clicks once all were made.

        Raises:
            V2PError: they were not made in time.
        """
        if not self._done.wait(timeout_s):
            raise V2PError(
                f"{len(self.clicks)} of {len(self.objects)} objects were clicked within {timeout_s:g} s; start again, or give"
                " the pixels with --click X,Y"
            )
        return tuple(self.clicks)

    def path_is_right(self, path: str, host: str) -> bool:
        """Return whether a request is for this page: a page elsewhere that guesses the port must not get through."""
        port = self._server.server_address[1]
        return secrets.compare_digest(path.encode(), f"/{self._token}".encode()) and host in (
            f"127.0.0.1:{port}",
            f"localhost:{port}",
        )

    def page(self) -> bytes:
        """Return the page."""
        names = json.dumps(self.objects).replace("<", "\\u003c")
        text = PAGE.read_text("utf-8").replace("__OBJECTS__", names)
        return text.replace("__PICTURE__", self._png()).encode()

    def clicked(self, body: bytes) -> dict[str, Any]:
        """Return the answer to a click."""
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


def _handler(page: ClickPage) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        timeout = 10

        def do_GET(self) -> None:
            if self._is_ours():
                self._answer("text/html; charset=utf-8", page.page())

        def do_POST(self) -> None:
            if not self._is_ours():
                return
            length = self.headers.get("Content-Length", "")
            if not re.fullmatch(r"[0-9]{1,9}", length) or int(length) > LONGEST_BODY:
                self.send_error(413)
                return
            said = page.clicked(self.rfile.read(int(length)))
            self._answer("application/json", json.dumps(said).encode())

        def _is_ours(self) -> bool:
            if page.path_is_right(self.path, self.headers.get("Host", "")):
                return True
            self.send_error(404)
            return False

        def _answer(self, kind: str, body: bytes) -> None:
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            self.send_header("X-Frame-Options", "DENY")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None: ...

    return Handler
