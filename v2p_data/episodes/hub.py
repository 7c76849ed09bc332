"""Push a dataset or a policy to the Hugging Face Hub.

The calls are those of LeRobot's `push_to_hub` but for its dataset card: ours is uploaded instead, in the same
commit, and so nothing asks huggingface.co to check it when `HF_ENDPOINT` names another server. The token is
read from the environment only; it is never stored, logged or shown.
"""

import json
import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from v2p_data.episodes.card import CARD_FILE, LICENSE, write_card
from v2p_data.episodes.features import METADATA_FILE
from v2p_data.episodes.writer import check_repo_id
from v2p_data.errors import V2PError

logger = logging.getLogger(__name__)

TOKEN_VARIABLES = ("HF_TOKEN", "HUGGING_FACE_HUB_TOKEN")
DEFAULT_ENDPOINT = "https://huggingface.co"
NOT_UPLOADED = [
    "images/*",
    "tmp*",
    "*.tmp",
    "*.partial",
    ".cache/*",
    "record.json",
    "traceback.txt",
]
POLICY_FILES = ("config.json", "model.safetensors")

RepoType = Literal["dataset", "model"]


@dataclass(frozen=True, kw_only=True)
class Pushed:
    """Where it is now."""

    repo_id: str
    url: str
    commit: str


def push_dataset(root: Path, repo_id: str, *, private: bool = False) -> Pushed:
    """Upload the LeRobot dataset at `root` and tag it with LeRobot's format version.

    Raises:
        V2PError: no dataset, no token, or the Hub refuses; says what to do.
    """
    check_repo_id(repo_id)
    info_path = root / "meta/info.json"
    if not info_path.is_file():
        raise V2PError(f"{root} holds no LeRobot dataset (no meta/info.json); nothing was pushed")
    version = str(json.loads(info_path.read_text()).get("codebase_version", ""))
    if (root / METADATA_FILE).is_file():
        write_card(root, repo_id)
    return _push(root, repo_id, "dataset", private=private, tag=version)


def push_policy(folder: Path, repo_id: str, *, private: bool = False) -> Pushed:
    """Upload a LeRobot policy (a checkpoint's `pretrained_model` folder).

    Raises:
        V2PError: no policy, no token, or the Hub refuses; says what to do.
    """
    check_repo_id(repo_id)
    missing = [name for name in POLICY_FILES if not (folder / name).is_file()]
    if missing:
        raise V2PError(
            f"{folder} holds no LeRobot policy ({', '.join(missing)} missing); give the folder "
            "'pretrained_model' of a checkpoint"
        )
    if not (folder / CARD_FILE).is_file():
        (folder / CARD_FILE).write_text(_policy_card(folder, repo_id))
    return _push(folder, repo_id, "model", private=private, tag=None)


def _push(
    folder: Path, repo_id: str, repo_type: RepoType, *, private: bool, tag: str | None
) -> Pushed:
    token = _token()
    # Not left to the library's default, which it read from the environment when it was imported.
    endpoint = os.environ.get("HF_ENDPOINT", "").rstrip("/") or DEFAULT_ENDPOINT

    from huggingface_hub import HfApi
    from huggingface_hub.errors import RevisionNotFoundError

    api = HfApi(endpoint=endpoint, token=token)

    def upload() -> Pushed:
        api.create_repo(repo_id, repo_type=repo_type, private=private, exist_ok=True)
        commit = api.upload_folder(
            repo_id=repo_id,
            repo_type=repo_type,
            folder_path=folder,
            ignore_patterns=NOT_UPLOADED,
            commit_message=f"Upload {repo_type} with v2p",
        )
        if tag:
            try:
                api.delete_tag(repo_id, tag=tag, repo_type=repo_type)
            except RevisionNotFoundError:
                logger.debug("%s had no tag %s yet", repo_id, tag)
            api.create_tag(repo_id, tag=tag, repo_type=repo_type, exist_ok=True)
        kind = "datasets/" if repo_type == "dataset" else ""
        return Pushed(repo_id=repo_id, url=f"{endpoint}/{kind}{repo_id}", commit=commit.oid)

    return _explained(upload, repo_id, endpoint, token)


def _token() -> str:
    for name in TOKEN_VARIABLES:
        token = os.environ.get(name, "").strip()
        if token:
            return token
    raise V2PError(
        "pushing needs a token of the Hugging Face Hub with write access: set it as the environment variable "
        "HF_TOKEN (make one at https://huggingface.co/settings/tokens)"
    )


def _explained(upload: Callable[[], Pushed], repo_id: str, endpoint: str, token: str) -> Pushed:
    """Return what `upload` returns, or raise in one sentence what the Hub or the network had against it."""
    import httpx
    from huggingface_hub.errors import HfHubHTTPError, OfflineModeIsEnabled

    again = "run the same command again; what has arrived is not sent twice"
    try:
        return upload()
    except HfHubHTTPError as error:
        status = error.response.status_code if error.response is not None else 0
        said = _first_line(error.server_message or str(error), token)
        reasons = {
            401: "the token in HF_TOKEN is not valid there; make a new one with write access",
            403: f"the token in HF_TOKEN may not write to '{repo_id}'; check the user name before the "
            "slash and that the token has write access",
            404: f"'{repo_id}' is not there, or this token may not see it",
            409: f"'{repo_id}' is in use for something else or is being changed; choose another "
            "--repo-id or try again in a minute",
            413: "a file is larger than the Hub takes",
            429: f"it asks to slow down; wait some minutes and {again}",
        }
        reason = reasons.get(status, f"the fault is on its side; {again}")
        raise V2PError(f"{endpoint} answered {status} ({said}): {reason}") from None
    except OfflineModeIsEnabled:
        raise V2PError(
            f"cannot push '{repo_id}': HF_HUB_OFFLINE is set; unset it and run the command again"
        ) from None
    except httpx.TransportError as error:
        raise V2PError(
            f"cannot reach {endpoint} ({type(error).__name__}: {_first_line(str(error), token)}); check the "
            f"connection and HF_ENDPOINT, then {again}"
        ) from None


def _first_line(text: str, token: str) -> str:
    lines = [line.strip() for line in text.replace(token, "***").splitlines() if line.strip()]
    return lines[0][:200] if lines else "no message"


def _policy_card(folder: Path, repo_id: str) -> str:
    config: dict[str, Any] = json.loads((folder / "config.json").read_text())
    kind = str(config.get("type", "unknown"))
    dataset = ""
    train_config = folder / "train_config.json"
    if train_config.is_file():
        dataset = str(json.loads(train_config.read_text()).get("dataset", {}).get("repo_id", ""))
    trained_on = f"datasets:\n- {dataset}\n" if dataset else ""
    words = f"Policy of type `{kind}`" + (f", trained on `{dataset}`." if dataset else ".")
    return (
        f"---\nlibrary_name: lerobot\npipeline_tag: robotics\nlicense: {LICENSE}\n{trained_on}"
        f"tags:\n- lerobot\n- robotics\n- {kind}\n- video2policy\n---\n\n# {repo_id}\n\n{words}\n\n"
        "It acts on segmentation masks and the robot's state. Evaluate it with\n\n"
        f"```\nv2p eval {repo_id}\n```\n"
    )
