"""The review page as this machine serves it to itself: a person marks objects and sees the clip rebuilt."""

import json
import re
from typing import Any

from v2p_data.errors import V2PError
from v2p_data.local_page import LocalPage, Request
from v2p_data.report.reading import as_dict
from v2p_data.report.review import Review


class ReviewServer(LocalPage):
    """The page, served from the start of the `with` block to its end.

    Args:
        review: what is shown and changed.
        port: 0 takes a free one.

    Raises:
        V2PError: the port is taken.
    """

    longest_body = 200_000
    """A stroke of a thousand corners is 20 kB."""

    def __init__(self, review: Review, port: int = 0) -> None:
        super().__init__(port)
        self.review = review

    def show(self, path: str, request: Request) -> None:
        """Answer with the page, a picture or film of it, or a clip.

        Raises:
            LookupError: it asks for what there is not.
        """
        if path == "":
            request.answer("text/html; charset=utf-8", self.review.page())
        elif still := re.fullmatch(r"still/([^/.]+)/(\d{1,3})", path):
            request.answer("image/jpeg", self.review.still(still[1], int(still[2])))
        elif film := re.fullmatch(r"film/([^/.]+)/[^/]*", path):
            file = self.review.film(film[1])
            if file is None or not file.is_file():
                raise LookupError(path)
            request.answer_part("video/mp4", file.read_bytes())
        elif clip := re.fullmatch(r"clip/([^/.]+)", path):
            request.json(self.review.clip(clip[1]))
        else:
            raise LookupError(path)

    def changed(self, path: str, body: bytes) -> dict[str, Any]:
        """Return the answer to a change.

        Raises:
            LookupError: it changes what there is not.
        """
        asked = re.fullmatch(r"(mark|judge)/([^/.]+)", path)
        if asked is None:
            raise LookupError(path)
        try:
            change = as_dict(json.loads(body))
            if asked[1] == "judge":
                return self.review.judge(asked[2], str(change.get("judgement")))
            hint = change.get("hint")
            if hint is not None and not isinstance(hint, dict):
                return {"error": "a hint is an object, or null where nothing is marked"}
            return self.review.mark(asked[2], str(change.get("phrase", "")), hint)
        except V2PError as error:
            return {"error": str(error)}
        except (ValueError, RecursionError) as error:
            return {"error": f"that cannot be read: {error}"}
