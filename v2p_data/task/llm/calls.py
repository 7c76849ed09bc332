"""Every question to a model is an artefact: what was asked, what came back, what it cost; and can be asked again offline.

A call is named by the hash of what was asked. A folder of calls holds `<key>.json` per answered call, the pictures
once each in `images/`, and `ledger.jsonl`, one line per call, from which a budget for the whole folder is
reckoned, whichever processes spent it. Picture data stands in the request as its hash.
"""

import base64
import hashlib
import json
import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from v2p_data.errors import V2PError
from v2p_data.json_files import read_json

IMAGES_FOLDER = "images"
LEDGER_FILE = "ledger.jsonl"
KEY_LENGTH = 24
DATA_URL = "data:image/jpeg;base64,"


@dataclass(frozen=True, kw_only=True)
class Usage:
    """What one call or several took."""

    calls: int = 0
    prompt_tokens: int = 0
    completion_tokens: int = 0
    money: float = 0.0
    """In the currency of the configured prices."""
    seconds: float = 0.0
    """Waiting for answers, added up."""
    estimated: int = 0
    """Calls whose server did not count tokens; four letters were taken for one."""

    @property
    def tokens(self) -> int:
        return self.prompt_tokens + self.completion_tokens

    def __add__(self, other: "Usage") -> "Usage":
        mine, theirs = asdict(self), asdict(other)
        return Usage(**{k: mine[k] + theirs[k] for k in mine})

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return asdict(self) | {"money": round(self.money, 6), "seconds": round(self.seconds, 3)}


@dataclass(frozen=True, kw_only=True)
class Call:
    """One question and its answer, as stored."""

    key: str
    purpose: str
    """What the question was for; tells two equal questions apart."""
    request: dict[str, Any] = field(repr=False)
    """What was sent, pictures as hashes; never a key of the API."""
    answer: str
    finish_reason: str
    refusal: str = ""
    usage: Usage
    attempts: int = 1
    """Tries until the answer came."""
    model: str = ""
    """What the server said it is."""

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return asdict(self) | {"usage": self.usage.as_dict()}

    @staticmethod
    def from_dict(data: dict[str, Any]) -> "Call":
        """Read what `as_dict` gave."""
        usage = Usage(**data["usage"])
        return Call(**{k: v for k, v in data.items() if k != "usage"}, usage=usage)


def call_key(request: dict[str, Any], purpose: str) -> str:
    """Return the name of a call: the hash of what is asked and what for, pictures by their content."""
    text = json.dumps({"request": without_pictures(request), "purpose": purpose}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH]


def without_pictures(value: Any) -> Any:
    """Return a request with every JPEG data URL replaced by the file that the picture is stored in."""
    if isinstance(value, dict):
        return {k: without_pictures(v) for k, v in value.items()}
    if isinstance(value, list):
        return [without_pictures(v) for v in value]
    if isinstance(value, str) and value.startswith(DATA_URL):
        return _picture_name(value)
    return value


def _picture_name(url: str) -> str:
    data = base64.b64decode(url.removeprefix(DATA_URL))
    return f"{IMAGES_FOLDER}/{hashlib.sha256(data).hexdigest()}.jpg"


def _pictures(value: Any) -> Iterator[str]:
    if isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _pictures(part)
    elif isinstance(value, str) and value.startswith(DATA_URL):
        yield value


class CallStore:
    """A folder of calls, shared by the threads of a process and by processes.

    Args:
        folder: where calls are written; made with the first one.
        hide: a secret that may stand in no file, even if a server repeats it.
    """

    def __init__(self, folder: Path, *, hide: str = "") -> None:
        self.folder = folder
        self.hide = hide
        self._lock = threading.Lock()
        self._known: dict[str, Path] | None = None

    def find(self, key: str) -> Call | None:
        """Return the stored call of this key, in the folder or anywhere below it, None if there is none.

        Raises:
            V2PError: its file cannot be read.
        """
        path = self.folder / f"{key}.json"
        if not path.is_file():
            with self._lock:
                if self._known is None:  # a folder of runs may be large: looked through once
                    self._known = {
                        p.stem: p for p in self.folder.rglob("*.json") if len(p.stem) == KEY_LENGTH
                    }
            path = self._known.get(key)
        if path is None:
            return None
        try:
            return Call.from_dict(read_json(path))
        except (V2PError, ValueError, TypeError, KeyError) as error:
            raise V2PError(
                f"{path} holds no stored call ({type(error).__name__}); delete it, and it is asked again"
            ) from error

    def write(self, call: Call, request: dict[str, Any]) -> None:
        """Store a call that was answered, with its pictures, and enter it in the ledger.

        Args:
            call: the call.
            request: what was sent, with the pictures' data.
        """
        images = self.folder / IMAGES_FOLDER
        images.mkdir(parents=True, exist_ok=True)
        for url in _pictures(request):
            path = self.folder / _picture_name(url)
            if not path.exists():
                _write_whole(path, base64.b64decode(url.removeprefix(DATA_URL)))
        text = self._shown(json.dumps(call.as_dict(), indent=1))
        _write_whole(self.folder / f"{call.key}.json", text.encode())
        line = json.dumps({"key": call.key, "purpose": call.purpose, **call.usage.as_dict()})
        with self._lock, (self.folder / LEDGER_FILE).open("a") as stream:
            stream.write(
                self._shown(line) + "\n"
            )  # one short write: lines of processes do not mix

    def spent(self) -> Usage:
        """Return what all calls that were written to this folder took together."""
        path = self.folder / LEDGER_FILE
        total = Usage()
        if path.is_file():
            names = asdict(total)
            for line in path.read_text().splitlines():
                with suppress(ValueError):  # a process that was killed may leave half a line
                    entry = json.loads(line)
                    total += Usage(**{k: entry[k] for k in names})
        return total

    def _shown(self, text: str) -> str:
        return text.replace(self.hide, "***") if self.hide else text


def _write_whole(path: Path, data: bytes) -> None:
    """Write a file so that it is either whole or absent, whoever else writes the same one."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".tmp")
    with os.fdopen(handle, "wb") as stream:
        stream.write(data)
    Path(name).replace(path)
