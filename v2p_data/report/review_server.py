"""A review page that this machine serves to itself: a person marks objects, the clip is rebuilt, and the page shows the result.

It listens on 127.0.0.1 only, at an address with a random token. Other paths, other hosts' names and requests that another web
page sends get nothing.
"""

import base64
import contextlib
import hashlib
import json
import re
import secrets
import threading
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Protocol, runtime_checkable
from urllib.parse import unquote, urlsplit

import jinja2

from v2p_data.errors import V2PError
from v2p_data.report.reading import as_dict

LONGEST_BODY = 200_000
"""Bytes: a stroke of a thousand corners is 20 kB."""
_CHUNK = 1 << 16


@runtime_checkable
class Session(Protocol):
    """What the page shows and changes; all calls may come from several threads."""

    def overview(self) -> dict[str, Any]:
        """Return what the page shows of all clips."""
        ...

    def clip(self, item: str) -> dict[str, Any]:
        """Return what the page shows of one clip: it is looked at now.

        Raises:
            KeyError: there is no such clip.
        """
        ...

    def still(self, item: str, number: int) -> bytes:
        """Return a still as a JPEG.

        Raises:
            LookupError: there is no such still.
        """
        ...

    def film(self, item: str) -> Path | None:
        """Return the overlay video of the clip's scene."""
        ...

    def mark(self, item: str, phrase: str, hint: Mapping[str, Any] | None) -> dict[str, Any]:
        """Save what was marked for an object, or that nothing is, and rebuild the clip; return the clip.

        Raises:
            V2PError: it cannot be a mark; nothing was changed.
        """
        ...

    def judge(self, item: str, judgement: str | None) -> dict[str, Any]:
        """Save what a person says of the clip's result, and return the clip.

        Raises:
            V2PError: it cannot be said of this result.
        """
        ...


class ReviewServer:
    """The page, served from the start of the `with` block to its end.

    Args:
        session: what is shown and changed.
        title: of the page.
        port: 0 takes a free one.

    Raises:
        V2PError: the port is taken.
    """

    def __init__(self, session: Session, title: str, port: int = 0) -> None:
        self.session, self.title = session, title
        self._token = secrets.token_urlsafe(16)
        try:
            self._server = ThreadingHTTPServer(("127.0.0.1", port), _handler(self))
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

    def __enter__(self) -> "ReviewServer":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def inner_path(self, path: str, host: str) -> str | None:
        """Return a request's path behind the token; None where it is not for this page."""
        port = self._server.server_address[1]
        token, _, rest = urlsplit(path).path.removeprefix("/").partition("/")
        is_ours = secrets.compare_digest(token.encode(), self._token.encode())
        return unquote(rest) if is_ours and host in _names(port) else None

    def is_own_page(self, headers: Any) -> bool:
        """Return whether this page sent a request: what another page sends carries that page's origin."""
        port = self._server.server_address[1]
        own = {f"http://{name}" for name in _names(port)}
        return (
            headers.get("Origin") in own | {None}
            and headers.get("Sec-Fetch-Site", "none") in ("none", "same-origin")
            and headers.get("Content-Type", "").split(";")[0] == "application/json"
        )

    def page(self) -> bytes:
        """Return the page."""
        loader = jinja2.FileSystemLoader(Path(__file__).parent)
        environment = jinja2.Environment(
            loader=loader, autoescape=True, undefined=jinja2.StrictUndefined
        )
        source = (Path(__file__).parent / "live.html").read_text()
        script = re.search(r'<script id="app">(.*?)</script>', source, re.S)
        assert script is not None
        digest = base64.b64encode(hashlib.sha256(script[1].encode()).digest()).decode()
        words = {"title": self.title, "data": self.session.overview(), "script_hash": digest}
        return environment.get_template("live.html").render(words).encode("utf-8", "replace")

    def answer(self, path: str) -> dict[str, Any]:
        """Return the answer to a question of the page.

        Raises:
            LookupError: it asks for what there is not.
        """
        if path == "overview":
            return self.session.overview()
        if (found := re.fullmatch(r"clip/([a-z0-9_]+)", path)) is not None:
            return self.session.clip(found[1])
        raise LookupError(path)

    def changed(self, path: str, body: bytes) -> dict[str, Any]:
        """Return the answer to a change.

        Raises:
            LookupError: it changes what there is not.
        """
        found = re.fullmatch(r"(mark|judge)/([a-z0-9_]+)", path)
        if found is None:
            raise LookupError(path)
        try:
            said = as_dict(json.loads(body))
            if found[1] == "judge":
                judgement = said.get("judgement")
                if not isinstance(judgement, str | None):
                    return {"error": "a judgement is a word, or null where it is taken back"}
                return self.session.judge(found[2], judgement)
            hint = said.get("hint")
            if hint is not None and not isinstance(hint, dict):
                return {"error": "a hint is an object, or null where nothing is marked"}
            return self.session.mark(found[2], str(said.get("phrase", "")), hint)
        except V2PError as error:
            return {"error": str(error)}
        except (ValueError, RecursionError) as error:
            return {"error": f"that cannot be read: {error}"}


def _names(port: int) -> tuple[str, str]:
    return f"127.0.0.1:{port}", f"localhost:{port}"


def _handler(server: ReviewServer) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        timeout = 30
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            path = self._own_path()
            if path is None:
                return
            try:
                if path == "":
                    self._answer("text/html; charset=utf-8", server.page())
                elif still := re.fullmatch(r"still/([a-z0-9_]+)/(\d{1,3})", path):
                    self._answer("image/jpeg", server.session.still(still[1], int(still[2])))
                elif film := re.fullmatch(r"film/([a-z0-9_]+)/[a-z0-9_@:-]*", path):
                    self._film(server.session.film(film[1]))
                else:
                    self._json(server.answer(path))
            except LookupError:
                self._refuse(HTTPStatus.NOT_FOUND)

        def do_POST(self) -> None:
            path = self._own_path()
            if path is None:
                return
            length = self.headers.get("Content-Length", "")
            if not re.fullmatch(r"[0-9]{1,9}", length) or int(length) > LONGEST_BODY:
                self._refuse(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
            elif not server.is_own_page(self.headers):
                self._refuse(HTTPStatus.FORBIDDEN)
            else:
                try:
                    self._json(server.changed(path, self.rfile.read(int(length))))
                except LookupError:
                    self._refuse(HTTPStatus.NOT_FOUND)

        def _own_path(self) -> str | None:
            path = server.inner_path(self.path, self.headers.get("Host", ""))
            if path is None:
                self._refuse(HTTPStatus.NOT_FOUND)
            return path

        def _refuse(self, status: HTTPStatus) -> None:
            self.close_connection = True  # a body may be left unread
            self.send_error(status)

        def _json(self, data: dict[str, Any]) -> None:
            self._answer("application/json", json.dumps(data).encode())

        def _film(self, path: Path | None) -> None:
            """Answer with a video, or with the part of it that a player asks for."""
            if path is None or not path.is_file():
                self._refuse(HTTPStatus.NOT_FOUND)
                return
            size = path.stat().st_size
            asked = re.fullmatch(
                r"bytes=([0-9]{1,15})-([0-9]{0,15})", self.headers.get("Range", "")
            )
            first = int(asked[1]) if asked else 0
            last = min(size - 1, int(asked[2])) if asked and asked[2] else size - 1
            if asked and first > last:
                self._refuse(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE)
                return
            self._head(
                HTTPStatus.PARTIAL_CONTENT if asked else HTTPStatus.OK,
                "video/mp4",
                last + 1 - first,
                {"Accept-Ranges": "bytes"}
                | ({"Content-Range": f"bytes {first}-{last}/{size}"} if asked else {}),
            )
            with path.open("rb") as stream:
                stream.seek(first)
                left = last + 1 - first
                while left > 0 and (chunk := stream.read(min(_CHUNK, left))):
                    self.wfile.write(chunk)
                    left -= len(chunk)

        def _answer(self, kind: str, body: bytes) -> None:
            self._head(HTTPStatus.OK, kind, len(body), {})
            self.wfile.write(body)

        def _head(self, status: HTTPStatus, kind: str, size: int, more: dict[str, str]) -> None:
            self.send_response(status)
            about = {
                "Content-Type": kind,
                "Content-Length": str(size),
                "Cache-Control": "no-store",
            }
            guard = {"X-Frame-Options": "DENY", "X-Content-Type-Options": "nosniff"}
            for name, value in {
                **about,
                **guard,
                "Referrer-Policy": "no-referrer",
                **more,
            }.items():
                self.send_header(name, value)
            self.end_headers()

        def handle(self) -> None:
            with contextlib.suppress(ConnectionError, TimeoutError):  # the browser went on
                super().handle()

        def log_message(self, format: str, *args: Any) -> None: ...

    return Handler
