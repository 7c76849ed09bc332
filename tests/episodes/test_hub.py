"""What goes wrong with a push is said in one sentence, and the token never."""

import json
import logging
import socket
from pathlib import Path

import pytest
from hub_server import TOKEN, Hub

from v2p_data.episodes.hub import push_dataset, push_policy
from v2p_data.errors import V2PError


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    (tmp_path / "dataset/meta").mkdir(parents=True)
    (tmp_path / "dataset/meta/info.json").write_text(json.dumps({"codebase_version": "v3.0"}))
    return tmp_path / "dataset"


@pytest.fixture
def online(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> Hub:
    monkeypatch.setenv("HF_ENDPOINT", hub.url)
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    return hub


def refusal(dataset: Path, repo_id: str = "user/toys") -> str:
    with pytest.raises(V2PError) as caught:
        push_dataset(dataset, repo_id)
    return str(caught.value)


def test_a_dataset_arrives_with_its_version_tag(dataset: Path, online: Hub):
    pushed = push_dataset(dataset, "user/toys")

    repo = online.repos["datasets/user/toys"]
    assert set(repo.files) == {"meta/info.json"}
    assert repo.tags == {"v3.0": pushed.commit}
    assert pushed.url == f"{online.url}/datasets/user/toys"


def test_records_and_temporary_files_stay_at_home(dataset: Path, online: Hub):
    for name in ("record.json", "tmpabc/x.mp4", "images/mask/0.png", "traceback.txt", "data.tmp"):
        (dataset / name).parent.mkdir(parents=True, exist_ok=True)
        (dataset / name).write_text("x")

    push_dataset(dataset, "user/toys")

    assert set(online.repos["datasets/user/toys"].files) == {"meta/info.json"}


def test_without_a_token_nothing_is_asked(
    dataset: Path, online: Hub, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.delenv("HF_TOKEN")
    monkeypatch.delenv("HUGGING_FACE_HUB_TOKEN", raising=False)

    assert "HF_TOKEN" in refusal(dataset)
    assert online.requests == []


def test_a_wrong_token_is_named_but_not_shown(
    dataset: Path, online: Hub, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    caplog.set_level(logging.DEBUG)
    monkeypatch.setenv("HF_TOKEN", "hf_wrong_secret")

    said = refusal(dataset)

    assert "answered 401" in said
    assert "HF_TOKEN" in said
    assert "hf_wrong_secret" not in said + caplog.text


def test_another_users_name_is_refused(dataset: Path, online: Hub):
    said = refusal(dataset, "stranger/toys")

    assert "answered 403" in said
    assert "may not write to 'stranger/toys'" in said


@pytest.mark.parametrize(
    ("where", "status", "words"),
    [
        ("/commit/", 409, "in use"),
        ("/create", 500, "run the same command again"),
        ("/create", 429, "wait some minutes"),
    ],
)
def test_other_answers_say_what_to_do(
    dataset: Path, online: Hub, where: str, status: int, words: str
):
    online.faults[where] = status

    said = refusal(dataset)

    assert f"answered {status}" in said
    assert words in said


def test_an_unreachable_hub_is_named(dataset: Path, monkeypatch: pytest.MonkeyPatch):
    with socket.socket() as taken:  # bound but not listening: refuses connections
        taken.bind(("127.0.0.1", 0))
        monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{taken.getsockname()[1]}")
        monkeypatch.setenv("HF_TOKEN", TOKEN)

        assert "cannot reach http://127.0.0.1" in refusal(dataset)


@pytest.mark.parametrize("repo_id", ["toys", "user/to ys", "user/", "a/b/c", "user/../x"])
def test_what_is_no_repository_id_is_refused(dataset: Path, online: Hub, repo_id: str):
    assert "USER/NAME" in refusal(dataset, repo_id)
    assert online.requests == []


def test_a_folder_without_a_policy_is_refused(tmp_path: Path, online: Hub):
    (tmp_path / "config.json").write_text("{}")

    with pytest.raises(V2PError, match=r"model.safetensors missing"):
        push_policy(tmp_path, "user/policy")


def test_a_policys_card_names_its_type_and_dataset(
    tmp_path: Path, online: Hub, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "config.json").write_text('{"type": "v2p_bc"}')
    (tmp_path / "model.safetensors").write_bytes(b"weights")
    (tmp_path / "train_config.json").write_text('{"dataset": {"repo_id": "user/toys"}}')
    online.faults["/create"] = 500

    with pytest.raises(V2PError):
        push_policy(tmp_path, "user/policy")

    card = (tmp_path / "README.md").read_text()
    assert "datasets:\n- user/toys\n" in card
    assert "`v2p_bc`, trained on `user/toys`" in card
