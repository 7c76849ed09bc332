"""Every question to a model is an artefact: what was asked, what came back, what it cost.

And can be asked again offline.

A call is named by the hash of what was asked. A folder of calls holds `<key>.json` per answered call and the pictures
once each in `images/`. A budget for the whole folder is reckoned from its calls, whichever processes made them. Picture
data stands in the request as its hash.
"""

import base64
import hashlib
import json
import os
import tempfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from v2p_data.errors import V2PError
from v2p_data.json_files import read_json

IMAGES_FOLDER = "images"
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


def call_key(request: dict[str, Any], purpose: str) -> str:
    """Return the name of a call: the hash of what is asked and what for, pictures by their content."""
    text = json.dumps({"request": without_pictures(request), "purpose": purpose}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH]


def without_pictures(value: Any, found: dict[str, bytes] | None = None) -> Any:
    """Return a request with every JPEG data URL replaced by the file that the picture is stored in.

    Args:
        value: a request, or a part of one.
        found: takes the pictures, by the names of their files.
    """
    if isinstance(value, dict):
        return {k: without_pictures(v, found) for k, v in value.items()}
    if isinstance(value, list):
        return [without_pictures(v, found) for v in value]
    if isinstance(value, str) and value.startswith(DATA_URL):
        data = base64.b64decode(value.removeprefix(DATA_URL))
        name = f"{IMAGES_FOLDER}/{hashlib.sha256(data).hexdigest()}.jpg"
        if found is not None:
            found[name] = data
        return name
    return value


class CallStore:
    """A folder of calls, shared by the threads of a process and by processes.

    Args:
        folder: where calls are written; made with the first one.
        hide: a secret that may stand in no file, even if a server repeats it.
    """

    def __init__(self, folder: Path, *, hide: str = "") -> None:
        self.folder = folder
        self.hide = hide

    def find(self, key: str) -> Call | None:
        """Return the stored call of this key, in the folder or anywhere below it, None if there is none.

        Raises:
            V2PError: its file cannot be read.
        """
        path = self.folder / f"{key}.json"
        if not path.is_file():
            path = next(self.folder.rglob(path.name), None)
        return _read(path) if path else None

    def write(self, call: Call, request: dict[str, Any]) -> None:
        """Store a call that was answered, with its pictures.

        Args:
            call: the call.
            request: what was sent, with the pictures' data.
        """
        (self.folder / IMAGES_FOLDER).mkdir(parents=True, exist_ok=True)
        pictures: dict[str, bytes] = {}
        without_pictures(request, pictures)
        for name, data in pictures.items():
            _write_whole(self.folder / name, data)
        text = json.dumps(asdict(call) | {"usage": call.usage.as_dict()}, indent=1)
        _write_whole(self.folder / f"{call.key}.json", self.shown(text).encode())

    def spent(self) -> Usage:
        """Return what all calls of this folder took together."""
        stored = (p for p in self.folder.glob("*.json") if len(p.stem) == KEY_LENGTH)
        return sum((_read(path).usage for path in stored), Usage())

    def shown(self, text: str) -> str:
        """Return a text without the secret."""
        return text.replace(self.hide, "***") if self.hide else text


def _read(path: Path) -> Call:
    try:
        data = read_json(path)
        return Call(**data | {"usage": Usage(**data["usage"])})
    except (V2PError, ValueError, TypeError, KeyError) as error:
        raise V2PError(
            f"{path} holds no stored call ({type(error).__name__}); delete it, and it is asked again"
        ) from error


def _write_whole(path: Path, data: bytes) -> None:
    """Write a file so that it is either whole or absent, whoever else writes the same one."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".tmp")
    with os.fdopen(handle, "wb") as stream:
        stream.write(data)
    Path(name).replace(path)
