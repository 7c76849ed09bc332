"""A review page that this machine serves to itself: a person marks objects, the clip is rebuilt, and the page shows the result."""

import json
import re
from collections.abc import Mapping
from http import HTTPStatus
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from v2p_data.errors import V2PError
from v2p_data.local_page import LocalPage, Request
from v2p_data.report.reading import as_dict
from v2p_data.report.review_page import rendered

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


class ReviewServer(LocalPage):
    """The page, served from the start of the `with` block to its end.

    Args:
        session: what is shown and changed.
        title: of the page.
        port: 0 takes a free one.

    Raises:
        V2PError: the port is taken.
    """

    longest_body = 200_000
    """A stroke of a thousand corners is 20 kB."""

    def __init__(self, session: Session, title: str, port: int = 0) -> None:
        super().__init__(port)
        self.session, self.title = session, title

    def show(self, path: str, request: Request) -> None:
        """Answer with the page, a picture or film of it, or what it asks for."""
        if path == "":
            request.answer("text/html; charset=utf-8", self.page())
        elif still := re.fullmatch(r"still/([a-z0-9_]+)/(\d{1,3})", path):
            request.answer("image/jpeg", self.session.still(still[1], int(still[2])))
        elif film := re.fullmatch(r"film/([a-z0-9_]+)/[a-z0-9_@:-]*", path):
            _show_film(self.session.film(film[1]), request)
        else:
            request.json(self.answer(path))

    def page(self) -> bytes:
        """Return the page."""
        return rendered("live.html", self.title, self.session.overview())

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


def _show_film(path: Path | None, request: Request) -> None:
    """Answer with a video, or with the part of it that a player asks for."""
    if path is None or not path.is_file():
        request.refuse(HTTPStatus.NOT_FOUND)
        return
    size = path.stat().st_size
    asked = re.fullmatch(r"bytes=([0-9]{1,15})-([0-9]{0,15})", request.headers.get("Range", ""))
    first = int(asked[1]) if asked else 0
    last = min(size - 1, int(asked[2])) if asked and asked[2] else size - 1
    if asked and first > last:
        request.refuse(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE)
        return
    request.head(
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
            request.wfile.write(chunk)
            left -= len(chunk)
