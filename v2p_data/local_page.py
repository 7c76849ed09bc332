"""A page that this machine serves to itself: on 127.0.0.1 only, at an address with a random token.

Other paths, other hosts' names and requests that another web page sends get nothing.
"""

import contextlib
import json
import re
import secrets
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, ClassVar
from urllib.parse import unquote, urlsplit

from v2p_data.errors import V2PError


class Request(BaseHTTPRequestHandler):
    """A request to a `LocalPage`, and the ways to answer it."""

    page: "LocalPage"
    timeout = 30
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        """Let the page answer what is asked of it."""
        path = self._own_path()
        if path is None:
            return
        try:
            self.page.show(path, self)
        except LookupError:
            self.refuse(HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        """Let the page change what it itself asks for."""
        path = self._own_path()
        if path is None:
            return
        length = self.headers.get("Content-Length", "")
        if not re.fullmatch(r"[0-9]{1,9}", length) or int(length) > self.page.longest_body:
            self.refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
        elif not self.page.is_own_page(self.headers):
            self.refuse(HTTPStatus.FORBIDDEN)
        else:
            try:
                self.json(self.page.changed(path, self.rfile.read(int(length))))
            except LookupError:
                self.refuse(HTTPStatus.NOT_FOUND)

    def refuse(self, status: HTTPStatus) -> None:
        """Answer with an error."""
        self.close_connection = True  # a body may be left unread
        self.send_error(status)

    def json(self, data: dict[str, Any]) -> None:
        """Answer with JSON."""
        self.answer("application/json", json.dumps(data).encode())

    def answer(self, kind: str, body: bytes) -> None:
        """Answer with a whole body of a media type."""
        self.head(HTTPStatus.OK, kind, len(body), {})
        self.wfile.write(body)

    def answer_part(self, kind: str, body: bytes) -> None:
        """Answer with a body of a media type, or with the part of it that a player asks for."""
        asked = re.fullmatch(r"bytes=([0-9]{1,15})-([0-9]{0,15})", self.headers.get("Range", ""))
        if asked is None:
            self.head(HTTPStatus.OK, kind, len(body), {"Accept-Ranges": "bytes"})
            self.wfile.write(body)
            return
        first, last = int(asked[1]), min(int(asked[2] or len(body)), len(body) - 1)
        if first > last:
            self.refuse(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE)
            return
        place = {"Content-Range": f"bytes {first}-{last}/{len(body)}"}
        self.head(HTTPStatus.PARTIAL_CONTENT, kind, last + 1 - first, place)
        self.wfile.write(body[first : last + 1])

    def head(self, status: HTTPStatus, kind: str, size: int, more: dict[str, str]) -> None:
        """Send the head of an answer whose body of `size` bytes follows."""
        self.send_response(status)
        for name, value in {
            "Content-Type": kind,
            "Content-Length": str(size),
            "Cache-Control": "no-store",
            "X-Frame-Options": "DENY",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            **more,
        }.items():
            self.send_header(name, value)
        self.end_headers()

    def handle(self) -> None:
        """Serve a connection until the browser goes on."""
        with contextlib.suppress(ConnectionError, TimeoutError):
            super().handle()

    def log_message(self, format: str, *args: Any) -> None: ...

    def _own_path(self) -> str | None:
        path = self.page.inner_path(self.path, self.headers.get("Host", ""))
        if path is None:
            self.refuse(HTTPStatus.NOT_FOUND)
        return path


class LocalPage:
    """The page, served from the start of the `with` block to its end.

    Args:
        port: 0 takes a free one.

    Raises:
        V2PError: the port is taken.
    """

    longest_body: ClassVar[int]
    """Bytes of a request that changes something."""

    def __init__(self, port: int = 0) -> None:
        self._token = secrets.token_urlsafe(16)
        handler = type("Handler", (Request,), {"page": self})
        try:
            self._server = ThreadingHTTPServer(("127.0.0.1", port), handler)
        except (OSError, OverflowError) as error:
            raise V2PError(
                f"port {port} of this machine cannot be used ({error}); choose another --port, or leave it out"
            ) from error
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)

    @property
    def address(self) -> str:
        """Where to find it."""
        return f"http://127.0.0.1:{self._server.server_address[1]}/{self._token}/"

    def __enter__(self) -> Any:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def show(self, path: str, request: Request) -> None:
        """Answer a request for a path below the token; the path of the page itself is "".

        Raises:
            LookupError: there is nothing.
        """
        raise NotImplementedError

    def changed(self, path: str, body: bytes) -> dict[str, Any]:
        """Return the answer to a change.

        Raises:
            LookupError: it changes what there is not.
        """
        raise NotImplementedError

    def inner_path(self, path: str, host: str) -> str | None:
        """Return a request's path behind the token; None where it is not for this page."""
        token, _, rest = urlsplit(path).path.removeprefix("/").partition("/")
        is_ours = secrets.compare_digest(token.encode(), self._token.encode())
        return unquote(rest) if is_ours and host in self._names() else None

    def is_own_page(self, headers: Any) -> bool:
        """Return whether this page sent a request: what another page sends carries that page's origin."""
        own = {f"http://{name}" for name in self._names()}
        return (
            headers.get("Origin") in own | {None}
            and headers.get("Sec-Fetch-Site", "none") in ("none", "same-origin")
            and headers.get("Content-Type", "").split(";")[0] == "application/json"
        )

    def _names(self) -> tuple[str, str]:
        port = self._server.server_address[1]
        return f"127.0.0.1:{port}", f"localhost:{port}"
