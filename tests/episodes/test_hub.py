"""What goes wrong with a push is said in one sentence, and the token never."""

import contextlib
import copy
import json
import logging
import socket
from pathlib import Path

import pytest
from hub_server import CUT, LOST, TOKEN, Hub, Repo

from v2p_data.cli import run
from v2p_data.episodes.hub.hub import Pushed, push_dataset, push_envhub, push_policy
from v2p_data.episodes.hub.policy_card import name_policy, note_results, write_policy_card
from v2p_data.errors import V2PError

INFO = {
    "codebase_version": "v3.0",
    "fps": 20,
    "features": {},
    "total_episodes": 0,
    "total_frames": 0,
}


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    (tmp_path / "dataset/meta").mkdir(parents=True)
    (tmp_path / "dataset/meta/info.json").write_text(json.dumps(INFO))
    return tmp_path / "dataset"


@pytest.fixture
def online(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> Hub:
    monkeypatch.setenv("HF_ENDPOINT", hub.url)
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    # The server speaks the older way of sending large files; the library read its switch at import.
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_DISABLE_XET", True)
    return hub


def refusal(dataset: Path, repo_id: str = "user/toys") -> str:
    with pytest.raises(V2PError) as caught:
        push_dataset(dataset, repo_id, waits_s=())
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
    assert "may not push 'stranger/toys'" in said


@pytest.mark.parametrize(
    ("where", "status", "words"),
    [
        ("/commit/", 409, "in use"),
        ("/create", 500, "run the same command again"),
        ("/create", 429, "wait some minutes"),
        ("/commit/", 507, "storage is full"),
    ],
)
def test_other_answers_say_what_to_do(
    dataset: Path, online: Hub, where: str, status: int, words: str
):
    online.faults[where] = status

    said = refusal(dataset)

    assert f"answered {status}" in said
    assert words in said


@pytest.mark.parametrize("status", [CUT, 429, 500, 503])
@pytest.mark.parametrize("where", ["/create", "/commit/", "/tag/"])
def test_what_passes_is_waited_out(dataset: Path, online: Hub, where: str, status: int):
    online.passing_faults = [(where, status)] * 2

    pushed = push_dataset(dataset, "user/toys", waits_s=(0.0, 0.0, 0.0))

    repo = online.repos["datasets/user/toys"]
    assert online.passing_faults == []
    assert repo.tags == {"v3.0": pushed.commit}
    assert set(repo.files) == {"meta/info.json"}


def test_large_files_that_have_arrived_are_not_sent_again(dataset: Path, online: Hub):
    for name in ("a", "b", "c"):
        (dataset / f"{name}.mp4").write_bytes(name.encode() * 5000)
    online.passing_faults = [("/commit/", CUT), ("/commit/", 500)]

    push_dataset(dataset, "user/toys", waits_s=(0.0, 0.0))

    assert online.count("PUT /lfs/") == 3
    assert online.count("POST", "/commit/") == 3
    assert online.repos["datasets/user/toys"].files["b.mp4"] == b"b" * 5000


def test_an_upload_cut_in_the_middle_is_resumed_by_the_next_command(dataset: Path, online: Hub):
    (dataset / "a.mp4").write_bytes(b"a" * 5000)
    online.faults["/commit/"] = 507
    refusal(dataset)
    assert online.repos["datasets/user/toys"].tags == {}
    online.faults.clear()

    pushed = push_dataset(dataset, "user/toys")

    assert online.count("PUT /lfs/") == 1
    assert online.repos["datasets/user/toys"].tags == {"v3.0": pushed.commit}


@pytest.mark.parametrize("how", [CUT, LOST])
def test_whichever_request_breaks_off_the_version_that_loads_is_a_whole_one(
    tmp_path: Path, online: Hub, monkeypatch: pytest.MonkeyPatch, how: int
):
    """Before it was obeyed and after; once without further tries, and twice with them: then the push goes on."""
    monkeypatch.setattr("huggingface_hub.utils._http.time.sleep", lambda s: None)
    old, new = tmp_path / "old", tmp_path / "new"
    for root, name in ((old, "a"), (new, "b")):
        (root / "meta").mkdir(parents=True)
        (root / "meta/info.json").write_text(json.dumps({**INFO, "of": name}))
        (root / f"{name}.mp4").write_bytes(name.encode() * 5000)
        (root / "data").mkdir()
        (root / f"data/{name}.txt").write_text(name)

    def versions() -> list[dict[str, bytes] | None]:
        """Return the files under the tag `v3.0`, None without that tag, and the files on the branch."""
        repo = online.repos["datasets/user/toys"]
        return [repo.commits[repo.tags["v3.0"]] if "v3.0" in repo.tags else None, repo.files]

    push_dataset(old, "user/toys")
    before = copy.deepcopy((online.repos, online.blobs))
    old_files = dict(online.repos["datasets/user/toys"].files)

    def break_off(request: str, times: int) -> None:
        online.repos, online.blobs = copy.deepcopy(before)
        online.passing_faults = [(request, how)] * times

    online.requests.clear()
    push_dataset(new, "user/toys")
    asked = [r for r in dict.fromkeys(online.requests) if "agent-harnesses" not in r]
    new_files = dict(online.repos["datasets/user/toys"].files)
    assert len(asked) >= 8

    for request in asked:
        break_off(request, times=1)
        # The library itself tries some requests again.
        with contextlib.suppress(V2PError):
            push_dataset(new, "user/toys", waits_s=())
        assert all(v in (old_files, new_files, None) for v in versions()), request
        break_off(request, times=2)
        push_dataset(new, "user/toys", waits_s=(0.0, 0.0))
        assert online.passing_faults == [], request
        assert versions() == [new_files, new_files], request


def test_a_hub_without_xet_storage_gets_large_files_the_older_way(
    dataset: Path, online: Hub, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    pytest.importorskip("hf_xet")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_DISABLE_XET", False)
    (dataset / "a.mp4").write_bytes(b"a" * 5000)

    push_dataset(dataset, "user/toys", waits_s=())

    assert online.count("GET", "xet-write-token") == 1
    assert online.repos["datasets/user/toys"].files["a.mp4"] == b"a" * 5000
    assert "Xet storage answered 404" in caplog.text


def push_any(kind: str, folder: Path, *, private: bool) -> Pushed:
    """Push a small thing of each kind."""
    files = {
        "dataset": {"meta/info.json": json.dumps(INFO)},
        "policy": {"config.json": '{"type": "act"}', "model.safetensors": "weights"},
        "envhub": {"env.py": ""},
    }[kind]
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    push = {"dataset": push_dataset, "policy": push_policy, "envhub": push_envhub}[kind]
    return push(folder, "user/toys", private=private)


@pytest.mark.parametrize("gated", [False, "auto", "manual"])
@pytest.mark.parametrize("kind", ["dataset", "policy", "envhub"])
def test_nothing_private_goes_to_a_repository_that_others_see(
    tmp_path: Path, online: Hub, kind: str, gated: str | bool
):
    key = f"{'datasets' if kind == 'dataset' else 'models'}/user/toys"
    repo = online.repos[key] = Repo(gated=gated)
    repo.commit()

    with pytest.raises(V2PError, match=f"exists and is {'gated' if gated else 'public'}") as told:
        push_any(kind, tmp_path, private=True)

    assert "/user/toys/settings" in str(told.value)
    assert (repo.files, repo.tags, online.blobs, repo.private) == ({}, {}, {}, False)
    assert online.count("POST", "preupload") == 0


@pytest.mark.parametrize("kind", ["dataset", "policy", "envhub"])
def test_what_is_private_stays_so_and_is_told(tmp_path: Path, online: Hub, kind: str):
    assert push_any(kind, tmp_path, private=True).visibility == "private"

    assert push_any(kind, tmp_path, private=False).visibility == "private"
    assert all(repo.private for repo in online.repos.values())


def test_the_command_says_that_a_repository_is_not_public(
    capsys: pytest.CaptureFixture[str], dataset: Path, online: Hub
):
    repo = online.repos["datasets/user/toys"] = Repo(gated="auto")
    repo.commit()

    assert run(["push", str(dataset), "--repo-id", "user/toys"]) == 0

    assert "user/toys, which is gated and stays so\n" in capsys.readouterr().out


def test_patience_ends(dataset: Path, online: Hub):
    online.faults["/create"] = 503

    with pytest.raises(V2PError, match="answered 503"):
        push_dataset(dataset, "user/toys", waits_s=(0.0, 0.0))
    assert online.count("POST /api/repos/create") == 3


def test_a_new_version_leaves_no_file_of_the_old_one(dataset: Path, online: Hub):
    (dataset / "data/chunk-000").mkdir(parents=True)
    (dataset / "data/chunk-000/file-001.txt").write_text("old")
    push_dataset(dataset, "user/toys")
    online.repos["datasets/user/toys"].files["NOTES.md"] = b"written on the Hub"
    (dataset / "data/chunk-000/file-001.txt").rename(dataset / "data/chunk-000/file-000.txt")
    online.repos["datasets/user/toys"].commit()

    push_dataset(dataset, "user/toys", tag="v2.0")

    repo = online.repos["datasets/user/toys"]
    assert set(repo.files) == {"meta/info.json", "data/chunk-000/file-000.txt", "NOTES.md"}
    assert set(repo.tags) == {"v3.0", "v2.0"}


def test_a_name_that_is_taken_by_something_else_is_left_alone(dataset: Path, online: Hub):
    online.repos["datasets/user/toys"] = Repo(files={"thesis.pdf": b"mine"})
    online.repos["datasets/user/toys"].commit()

    said = refusal(dataset)

    assert "'user/toys' is taken" in said
    assert "thesis.pdf" in said
    assert set(online.repos["datasets/user/toys"].files) == {"thesis.pdf"}


def test_a_full_disk_is_named_and_the_old_card_stays(tmp_path: Path, online: Hub):
    (tmp_path / "config.json").write_text('{"type": "v2p_bc"}')
    (tmp_path / "model.safetensors").write_bytes(b"weights")
    # Where the card is written first, the kernel answers that no space is left.
    (tmp_path / "README.md.tmp").symlink_to("/dev/full")

    with pytest.raises(V2PError, match=r"README.md \(No space left on device\); make room"):
        push_policy(tmp_path, "user/policy")
    assert not (tmp_path / "README.md").exists()
    assert online.requests == []


@pytest.mark.parametrize("secret", ["hf_" + "aB3" * 12, TOKEN])
def test_a_file_that_holds_a_token_is_not_sent(
    dataset: Path, online: Hub, secret: str, capfd: pytest.CaptureFixture[str]
):
    (dataset / "meta/v2p_argv.json").write_text(f'["--key={secret}"]')

    said = refusal(dataset)

    assert "v2p_argv.json holds what looks like an access token" in said
    assert secret not in said + "".join(capfd.readouterr())
    assert online.requests == []


def test_the_token_is_in_no_file_and_no_output(
    dataset: Path,
    tmp_path: Path,
    online: Hub,
    caplog: pytest.LogCaptureFixture,
    capfd: pytest.CaptureFixture[str],
):
    caplog.set_level(logging.DEBUG)
    online.passing_faults = [("/create", 500), ("/commit/", CUT), ("/tag/", 429)]

    push_dataset(dataset, "user/toys", waits_s=(0.0, 0.0, 0.0))
    online.faults["/create"] = 500
    said = refusal(dataset)

    shown = said + caplog.text + "".join(capfd.readouterr())
    assert "try 2 of 4" in caplog.text
    assert TOKEN not in shown
    assert not [p for p in tmp_path.rglob("*") if p.is_file() and TOKEN.encode() in p.read_bytes()]


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


def test_a_policy_with_a_link_is_not_sent(tmp_path: Path, online: Hub):
    (tmp_path / "config.json").write_text('{"type": "act"}')
    (tmp_path / "model.safetensors").write_bytes(b"weights")
    (tmp_path / "notes.txt").symlink_to("/etc/passwd")

    with pytest.raises(V2PError, match=r"notes\.txt is a link"):
        push_policy(tmp_path, "user/policy", waits_s=())

    assert online.requests == []


def test_a_policys_card_names_its_type_and_dataset(
    tmp_path: Path, online: Hub, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "config.json").write_text('{"type": "v2p_bc"}')
    (tmp_path / "model.safetensors").write_bytes(b"weights")
    (tmp_path / "train_config.json").write_text('{"dataset": {"repo_id": "user/toys"}}')
    online.faults["/create"] = 500

    with pytest.raises(V2PError):
        push_policy(tmp_path, "user/policy", waits_s=())

    card = (tmp_path / "README.md").read_text()
    assert "datasets:\n- user/toys\n" in card
    assert "`v2p_bc`, trained on `user/toys`" in card
    assert "\n# user/policy\n" in card
    assert "v2p eval user/policy --tasks dataset/v2p/tasks" in card


def test_the_card_of_the_demos_policy_names_no_repository_but_its_own(tmp_path: Path):
    (tmp_path / "config.json").write_text('{"type": "v2p_bc"}')
    (tmp_path / "train_config.json").write_text('{"dataset": {"repo_id": "v2p/demo"}}')
    write_policy_card(tmp_path)

    name_policy(tmp_path, "user/policy")

    card = (tmp_path / "README.md").read_text()
    assert "v2p eval user/policy --tasks TASKS" in card
    assert "trained on `v2p/demo` (on no Hub)" in card
    assert card.count("v2p/demo") == 1


def test_an_evaluation_is_noted_in_a_policys_card_and_nothing_else_of_it_changes(tmp_path: Path):
    row = {"task": "lift", "seen": False, "rate": 0.5, "low": 0.25, "high": 0.75, "trials": 8}
    (tmp_path / "config.json").write_text(
        '{"type": "act", "input_features": {"x": {"shape": [3, 4]}}}'
    )
    write_policy_card(tmp_path)
    card = tmp_path / "README.md"
    card.write_text(card.read_text() + "\nA sentence of its owner.\n")

    note_results(tmp_path, [row])
    note_results(tmp_path, [row | {"at_end": {"rate": 0.25}}])

    text = card.read_text()
    assert "| lift | no | 50% (25% to 75%) | 25% | 8 |\n<!-- results: end -->" in text
    assert text.count("| lift |") == 1
    assert "| `x` | 3 x 4 |" in text
    assert text.endswith("A sentence of its owner.\n")
    card.write_text("A card by hand.")
    note_results(tmp_path, [row])
    assert card.read_text() == "A card by hand."
