"""Push a dataset, a policy or an environment to the Hugging Face Hub.

The calls are those of LeRobot's `push_to_hub` but for its dataset card: ours is uploaded instead, in the same
commit, and so nothing asks huggingface.co to check it when `HF_ENDPOINT` names another server. The token is
read from the environment only; it is never stored, logged or shown, and files that hold one are not sent.

What exists keeps its visibility: `private` is for a new repository, and one that is public is refused then, before a
file is sent.

A lost connection, a 429 and a fault of the server are waited out, longer each time; large files that have
arrived are not sent again (the Hub knows them by their digest). The tag that LeRobot loads moves after the last
file has arrived, so nobody loads half a version.
"""

import logging
import os
import re
import shutil
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import httpx
from huggingface_hub import HfApi, constants, snapshot_download
from huggingface_hub.errors import (
    HfHubHTTPError,
    LocalEntryNotFoundError,
    OfflineModeIsEnabled,
    RevisionNotFoundError,
)

from v2p_data.episodes.dataset.about import CARRIED_TASKS
from v2p_data.episodes.dataset.card import CARD_FILE, write_card
from v2p_data.episodes.dataset.features import METADATA_FILE
from v2p_data.episodes.dataset.intake import demand_bounded
from v2p_data.episodes.dataset.repo_id import check_repo_id
from v2p_data.episodes.hub.policy_card import name_policy, write_policy_card
from v2p_data.errors import V2PError
from v2p_data.json_files import json_or_none
from v2p_data.pipeline.artifact import write_json_atomically
from v2p_data.pipeline.shareable import without_places
from v2p_data.scene.files import demand_plain_files

logger = logging.getLogger(__name__)

TOKEN_VARIABLES = ("HF_TOKEN", "HUGGING_FACE_HUB_TOKEN")
DEFAULT_ENDPOINT = "https://huggingface.co"
NOT_UPLOADED = [
    "images/*",
    "tmp*",
    "*.tmp",
    "*.partial",
    ".cache/*",
    "*__pycache__*",
    "record.json",
    "traceback.txt",
]
POLICY_FILES = ("config.json", "model.safetensors")
ENV_FILE = "env.py"
DATASET_PARTS = ("data/*", "videos/*", "meta/*", "v2p/*", "media/*")
"""What a new version replaces: LeRobot reads every file under `data/`, an older version's too."""
ENV_PARTS = ("tasks/*", "mjcf/*", "v2p_data/*")
WAITS_S = (2.0, 5.0, 15.0, 45.0)
"""Before each further try; the Hub's limits are counted per five minutes."""
LONGEST_WAIT_S = 300.0
WORTH_ANOTHER_TRY = (408, 429, 500, 502, 503, 504)
NO_XET = re.compile(r"HTTP status client error \((\d+).*/xet-")
"""What the library says of a Hub that has no such storage, or none for this repository: in words only."""
SECRET = re.compile(
    rb"\bhf_[A-Za-z0-9]{30,}\b|\bsk-[A-Za-z0-9_-]{30,}\b|\bgh[pousr]_[A-Za-z0-9]{36,}\b"
)
TEXT_SUFFIXES = (".json", ".jsonl", ".md", ".txt", ".py", ".yaml", ".yml", ".xml", ".toml", "")
LARGEST_TEXT = 20_000_000

RepoType = Literal["dataset", "model"]


@dataclass(frozen=True, kw_only=True)
class Pushed:
    """Where it is now."""

    repo_id: str
    url: str
    commit: str
    visibility: str = "public"
    """As the Hub says after the push: public, gated or private."""


@dataclass(frozen=True, kw_only=True)
class _Upload:
    folder: Path
    repo_type: RepoType = "model"
    marker: str
    """A repository that holds files but not this one is about something else."""
    replaces: tuple[str, ...] = ()
    tags: tuple[str, ...] = ()


def push_dataset(
    root: Path,
    repo_id: str,
    *,
    private: bool = False,
    tag: str | None = None,
    waits_s: Sequence[float] = WAITS_S,
) -> Pushed:
    """Upload the LeRobot dataset at `root` and tag it with LeRobot's format version.

    Args:
        root: folder of the dataset.
        repo_id: `user/name`.
        private: make a new repository private.
        tag: a further tag, say `v1.0`.
        waits_s: seconds before each further try.

    Raises:
        V2PError: no dataset, no token, or the Hub refuses; says what to do.
    """
    check_repo_id(repo_id)
    info_path = root / "meta/info.json"
    if not info_path.is_file():
        raise V2PError(f"{root} holds no LeRobot dataset (no meta/info.json); nothing was pushed")
    info = json_or_none(info_path)
    if not isinstance(info, dict):
        raise V2PError(f"{info_path} is damaged: it is no JSON object; nothing was pushed")
    version = str(info.get("codebase_version", ""))
    demand_bounded(root)
    if (root / METADATA_FILE).is_file():
        _remove_places(root)
        write_card(root, repo_id)
    upload = _Upload(
        folder=root,
        repo_type="dataset",
        marker="meta/info.json",
        replaces=DATASET_PARTS,
        tags=tuple(t for t in (version, tag) if t),
    )
    return _push(upload, repo_id, private=private, waits_s=waits_s)


def push_policy(
    folder: Path,
    repo_id: str,
    *,
    private: bool = False,
    tag: str | None = None,
    waits_s: Sequence[float] = WAITS_S,
) -> Pushed:
    """Upload a LeRobot policy (a checkpoint's `pretrained_model` folder).

    Raises:
        V2PError: no policy, links in it, no token, or the Hub refuses; says what to do.
    """
    check_repo_id(repo_id)
    demand_plain_files(folder, shutil.ignore_patterns("*.tmp"))  # which is not sent
    missing = [name for name in POLICY_FILES if not (folder / name).is_file()]
    if missing:
        raise V2PError(
            f"{folder} holds no LeRobot policy ({', '.join(missing)} missing); give the folder "
            "'pretrained_model' of a checkpoint"
        )
    if not (folder / CARD_FILE).is_file():
        write_policy_card(folder)
    name_policy(folder, repo_id)
    upload = _Upload(folder=folder, marker="config.json", tags=(tag,) if tag else ())
    return _push(upload, repo_id, private=private, waits_s=waits_s)


def fetch_policy(repo_id: str, *, waits_s: Sequence[float] = WAITS_S) -> Path:
    """Return the folder of a policy on the Hub, fetched once and kept in the library's own cache.

    Raises:
        V2PError: there is no such policy, or the Hub cannot be reached.
    """
    folder = fetch_model(repo_id, ignore=("*.ckpt", "*.bin"), waits_s=waits_s)
    missing = [name for name in POLICY_FILES if not (folder / name).is_file()]
    if missing:
        raise V2PError(f"'{repo_id}' is no LeRobot policy: it holds no {' and no '.join(missing)}")
    return folder


def fetch_model(
    repo_id: str, *, ignore: Sequence[str], waits_s: Sequence[float] = WAITS_S
) -> Path:
    """Return the folder of any model on the Hub, fetched once and kept in the library's own cache.

    Args:
        repo_id: its name.
        ignore: patterns of files that are not fetched.
        waits_s: pauses before further tries.

    Raises:
        V2PError: there is no such model, or the Hub cannot be reached.
    """
    check_repo_id(repo_id)
    endpoint = _endpoint()
    token = next((t for name in TOKEN_VARIABLES if (t := os.environ.get(name, "").strip())), "")

    def fetch() -> Path:
        try:
            found = snapshot_download(
                repo_id, endpoint=endpoint, token=token or False, ignore_patterns=list(ignore)
            )
        except (
            LocalEntryNotFoundError
        ) as error:  # nothing is stored here, for the reason that it hides
            raise error.__cause__ or error from None
        return Path(found)

    return _explained(lambda: _patiently(fetch, waits_s), f"fetch '{repo_id}'", endpoint, token)


def push_envhub(
    folder: Path,
    repo_id: str,
    *,
    private: bool = False,
    tag: str | None = None,
    waits_s: Sequence[float] = WAITS_S,
) -> Pushed:
    """Upload a folder that `envhub.write_envhub` wrote; LeRobot looks for environments among the models.

    Raises:
        V2PError: no environment, no token, or the Hub refuses; says what to do.
    """
    check_repo_id(repo_id)
    if not (folder / ENV_FILE).is_file():
        raise V2PError(f"{folder} holds no {ENV_FILE}: it is no EnvHub repository")
    upload = _Upload(
        folder=folder, marker=ENV_FILE, replaces=ENV_PARTS, tags=(tag,) if tag else ()
    )
    return _push(upload, repo_id, private=private, waits_s=waits_s)


def _push(upload: _Upload, repo_id: str, *, private: bool, waits_s: Sequence[float]) -> Pushed:
    token = _token()
    _check_no_secret(upload.folder, token)
    endpoint = _endpoint()

    api = HfApi(endpoint=endpoint, token=token)
    repo_type = upload.repo_type
    url = f"{endpoint}/{'datasets/' if repo_type == 'dataset' else ''}{repo_id}"

    def send_files() -> Any:
        return api.upload_folder(
            repo_id=repo_id,
            repo_type=repo_type,
            folder_path=upload.folder,
            ignore_patterns=NOT_UPLOADED,
            delete_patterns=list(upload.replaces) or None,
            commit_message=f"Upload {repo_type} with v2p",
        )

    def send() -> Pushed:
        api.create_repo(repo_id, repo_type=repo_type, private=private, exist_ok=True)
        info = api.repo_info(repo_id, repo_type=repo_type)
        visibility = "private" if info.private else "gated" if info.gated else "public"
        if private and not info.private:
            raise V2PError(
                f"'{repo_id}' exists and is {visibility}, so what is pushed there can be seen; "
                "nothing was sent. Make it "
                f"private at {url}/settings, or choose another --repo-id"
            )
        there = set(api.list_repo_files(repo_id, repo_type=repo_type)) - {
            ".gitattributes",
            CARD_FILE,
        }
        if there and upload.marker not in there:
            raise V2PError(
                f"the name '{repo_id}' is taken: that repository holds something else ({sorted(there)[0]}, no "
                f"{upload.marker}); choose another --repo-id"
            )
        try:
            commit = send_files()
        except ConnectionError as error:
            if (found := NO_XET.search(str(error))) is None:
                raise
            logger.warning(
                "the Hub's Xet storage answered %s; files are sent the older way, as HF_HUB_DISABLE_XET=1 asks for",
                found[1],
            )
            with _without_xet():
                commit = send_files()
        for tag in upload.tags:
            try:
                api.delete_tag(repo_id, tag=tag, repo_type=repo_type)
            except RevisionNotFoundError:
                logger.debug("%s had no tag %s yet", repo_id, tag)
            api.create_tag(repo_id, tag=tag, repo_type=repo_type, exist_ok=True)
        return Pushed(repo_id=repo_id, url=url, commit=commit.oid, visibility=visibility)

    return _explained(lambda: _patiently(send, waits_s), f"push '{repo_id}'", endpoint, token)


@contextmanager
def _without_xet() -> Generator[None]:
    """Have the library send files by LFS: it reads its variable at import, and the switch at each upload."""
    before, constants.HF_HUB_DISABLE_XET = constants.HF_HUB_DISABLE_XET, True
    try:
        yield
    finally:
        constants.HF_HUB_DISABLE_XET = before


def _endpoint() -> str:
    """Return the Hub's address; the library's default is what the environment held when it was imported."""
    return os.environ.get("HF_ENDPOINT", "").rstrip("/") or DEFAULT_ENDPOINT


def _patiently[T](send: Callable[[], T], waits_s: Sequence[float]) -> T:
    """Return what `send` returns, trying again after what may pass."""
    for number, wait_s in enumerate(waits_s, start=2):
        try:
            return send()
        except HfHubHTTPError as error:
            response = error.response
            if response is None or response.status_code not in WORTH_ANOTHER_TRY:
                raise
            asked = response.headers.get("Retry-After", "")
            wait = max(wait_s, float(asked)) if asked.isdigit() else wait_s
            what = f"the Hub answered {response.status_code}"
        except (httpx.TransportError, ConnectionError, TimeoutError) as error:
            wait, what = wait_s, f"the connection broke ({type(error).__name__})"
        wait = min(wait, LONGEST_WAIT_S)
        logger.warning("%s; try %d of %d in %g s", what, number, len(waits_s) + 1, wait)
        time.sleep(wait)
    return send()


def _token() -> str:
    for name in TOKEN_VARIABLES:
        token = os.environ.get(name, "").strip()
        if token:
            return token
    raise V2PError(
        "pushing needs a token of the Hugging Face Hub with write access: set it as the environment variable "
        "HF_TOKEN (make one at https://huggingface.co/settings/tokens)"
    )


def _check_no_secret(folder: Path, token: str) -> None:
    """Raise where a text file holds what looks like a token: what was typed on a command line is recorded."""
    for path in sorted(folder.rglob("*")):
        if path.suffix not in TEXT_SUFFIXES or not path.is_file():
            continue
        if path.stat().st_size > LARGEST_TEXT:
            continue
        text = path.read_bytes()
        if SECRET.search(text) or token.encode() in text:
            raise V2PError(
                f"{path} holds what looks like an access token; nothing was pushed. Remove it from the file, and "
                "revoke the token if others could read it"
            )


def _explained[T](transfer: Callable[[], T], doing: str, endpoint: str, token: str) -> T:
    """Return what `transfer` returns, or raise in one sentence what the Hub or the network had against it."""
    again = "run the same command again; what has arrived is not sent twice"
    try:
        return transfer()
    except HfHubHTTPError as error:
        status = error.response.status_code if error.response is not None else 0
        words = _first_line(error.server_message or str(error), token)
        reasons = {
            401: "the token in HF_TOKEN is not valid there; make a new one with write access",
            403: f"the token in HF_TOKEN may not {doing}; check the user name before the slash and what the token "
            "gives access to",
            404: f"cannot {doing}: it is not there, or this token may not see it",
            507: "its storage is full; delete something there or make room in the plan",
            409: f"cannot {doing}: it is in use for something else or is being changed; choose another "
            "--repo-id or try again in a minute",
            413: "a file is larger than the Hub takes",
            429: f"it asks to slow down; wait some minutes and {again}",
        }
        reason = reasons.get(status, f"the fault is on its side; {again}")
        raise V2PError(f"{endpoint} answered {status} ({words}): {reason}") from None
    except OfflineModeIsEnabled:
        raise V2PError(
            f"cannot {doing}: HF_HUB_OFFLINE is set; unset it and run the command again"
        ) from None
    except (httpx.TransportError, ConnectionError, TimeoutError) as error:
        raise V2PError(
            f"cannot reach {endpoint} ({type(error).__name__}: {_first_line(str(error), token)}); check the "
            f"connection and HF_ENDPOINT, then {again}"
        ) from None
    except OSError as error:
        raise V2PError(
            f"cannot {doing}: something here cannot be read or written ({error.strerror or type(error).__name__}): "
            f"{error.filename or 'no file named'}; {again}"
        ) from None


def _first_line(text: str, token: str) -> str:
    text = text.replace(token, "***") if token else text
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[0][:200] if lines else "no message"


def _remove_places(root: Path) -> None:
    """Take places of this machine out of what earlier versions wrote; today's names none."""
    for path in (root / METADATA_FILE, *root.glob(f"{CARRIED_TASKS}/*/task.json")):
        data = json_or_none(path, max_bytes=None)
        if data is not None and (shareable := without_places(data)) != data:
            write_json_atomically(path, shareable)
