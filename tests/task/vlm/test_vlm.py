import hashlib
import json

import cv2
import numpy as np
import pytest

from v2p_data.errors import V2PError
from v2p_data.task.llm.client import BudgetError, FaultyAnswerError, VlmClient
from v2p_data.task.llm.config import VlmConfig
from v2p_data.task.llm.pictures import scene_pictures

HELLO = [{"role": "user", "content": "hello"}]


def plain(text):
    return text


def wants_hi(text):
    if "hi" not in text:
        raise FaultyAnswerError("There is no hi in it.")
    return "hi"


def stored_call(client):
    (path,) = client.store.folder.glob("*.json")
    return json.loads(path.read_text())


def test_an_answer_is_counted_in_tokens_and_money_and_stored_whole(chat, client, say):
    chat.otherwise = say("hi there")

    asking = client()
    text, talk = asking.ask(HELLO, "greeting", plain)

    assert text == "hi there"
    assert talk[-1] == {"role": "assistant", "content": "hi there"}
    assert (asking.spent.prompt_tokens, asking.spent.completion_tokens) == (1000, 500)
    assert asking.spent.money == pytest.approx((1000 * 2 + 500 * 8) / 1e6)
    stored = stored_call(asking)
    assert stored["request"] == chat.requests[0]
    assert stored["answer"] == "hi there"
    assert stored["model"] == "small-1"
    assert stored["usage"]["seconds"] > 0
    assert chat.paths[0] == "/v1/chat/completions"


def test_tokens_are_estimated_where_the_server_counts_none(chat, client, say):
    chat.otherwise = say("hi", tokens=None)

    asking = client()
    asking.ask(HELLO, "greeting", plain)

    assert asking.spent.estimated == 1
    assert 10 < asking.spent.prompt_tokens < 60
    assert asking.spent.money > 0


@pytest.mark.parametrize(
    "fault",
    [
        {"status": 429, "headers": {"Retry-After": "0.01"}},
        {"status": 503},
        {"hang_up": True},
        {"raw": b'{"choices"', "length": 500},
        {"sleep": 0.4},
    ],
    ids=str,
)
def test_a_fault_that_may_pass_is_waited_out(fault, chat, client, say):
    chat.script = [fault, say("hi")]

    asking = client(timeout_s=0.2 if "sleep" in fault else 20.0)
    text, _ = asking.ask(HELLO, "greeting", plain)

    assert text == "hi"
    assert stored_call(asking)["attempts"] == 2
    assert len(chat.requests) == 2


def test_a_server_that_stays_down_ends_in_one_sentence(chat, client):
    chat.otherwise = {"status": 500, "json": {"error": {"message": "out of memory"}}}

    with pytest.raises(V2PError, match=r"refuses the request .* 500: out of memory"):
        client().ask(HELLO, "greeting", plain)

    assert len(chat.requests) == 3


@pytest.mark.parametrize(
    "fault",
    [
        {"raw": b"<html>busy</html>"},
        {"json": {"choices": []}},
        {"json": {"choices": [{"message": None}]}},
    ],
    ids=str,
)
def test_what_is_no_chat_completion_is_named(fault, chat, client):
    chat.otherwise = fault

    with pytest.raises(V2PError, match="is no chat completion"):
        client().ask(HELLO, "greeting", plain)

    assert len(chat.requests) == 1


@pytest.mark.parametrize("status", [400, 401, 404])
def test_what_will_not_get_better_is_not_tried_again(status, chat, client, secret):
    chat.otherwise = {"status": status, "json": {"error": {"message": f"no, {secret}"}}}

    with pytest.raises(V2PError, match=rf"refuses .* {status}: no, \*\*\*$"):
        client().ask(HELLO, "greeting", plain)

    assert len(chat.requests) == 1


@pytest.mark.parametrize(
    ("bad", "told"),
    [
        ({"text": "so long hi", "finish": "length"}, "cut off after 500 tokens"),
        ({"text": ""}, "empty"),
        ({"text": None}, "empty"),
        ({"text": "<think>hi</think>"}, "empty"),
        ({"text": None, "refusal": "I cannot help"}, "refused"),
        ({"text": "hi", "finish": "content_filter"}, "refused"),
        ({"text": "good day"}, "no hi in it"),
    ],
    ids=str,
)
def test_an_answer_of_no_use_is_asked_for_again_with_its_fault(bad, told, chat, client, say):
    chat.script = [say(**bad), say("hi")]

    wanted, talk = client().ask(HELLO, "greeting", wants_hi)

    assert wanted == "hi"
    assert told in chat.requests[1]["messages"][-1]["content"]
    assert [m["role"] for m in talk] == ["user", "assistant", "user", "assistant"]


def test_asking_again_has_an_end(chat, client, say):
    chat.otherwise = say("good day")

    with pytest.raises(FaultyAnswerError, match="no hi in it"):
        client(max_reasks=1).ask(HELLO, "greeting", wants_hi)

    assert len(chat.requests) == 2


@pytest.mark.parametrize(
    ("limit", "words"),
    [
        ({"max_money": 0.011}, r"0.012 of the 0.011 that --task.vlm.max-money"),
        ({"max_total_tokens": 3000}, r"3000 of the 3000 that --task.vlm.max-total-tokens"),
        ({"max_total_s": 1e-9}, "max-total-s"),
    ],
)
def test_a_budget_stops_every_client_of_a_folder(limit, words, chat, client, say):
    chat.otherwise = say("hi")  # 0.006 and 1500 tokens each
    client().ask(HELLO, "first", plain)
    client().ask(HELLO, "second", plain)

    with pytest.raises(BudgetError, match=words):
        client(**limit).ask(HELLO, "third", plain)

    assert len(chat.requests) == 2
    assert client(**limit).ask(HELLO, "first", plain)[0] == "hi"  # what is stored costs nothing


def test_a_missing_key_is_named_before_anything_is_sent(chat, client, monkeypatch):
    monkeypatch.delenv("V2P_TEST_KEY")

    with pytest.raises(V2PError, match=r"V2P_TEST_KEY .* is not set"):
        client()

    assert chat.requests == []


def test_a_server_without_keys_needs_none(chat, client, say):
    chat.otherwise = say("hi")

    assert client(key_env="").ask(HELLO, "greeting", plain)[0] == "hi"


def test_the_key_is_sent_and_lies_nowhere_on_disk(chat, client, say, secret, tmp_path, caplog):
    caplog.set_level("DEBUG")
    chat.script = [{"status": 500, "json": {"error": {"message": f"{secret}!"}}}]
    chat.otherwise = say(f"your key is {secret}")

    client().ask(HELLO, "greeting", plain)

    assert chat.headers[0]["authorization"] == f"Bearer {secret}"
    files = [p for p in tmp_path.rglob("*") if p.is_file()]
    assert len(files) == 1
    assert not [p for p in files if secret.encode() in p.read_bytes()]
    assert secret not in caplog.text


def test_stored_answers_are_given_without_a_server(serve, settings, say, tmp_path):
    server = serve()
    server.script = [say("hi"), say("and again")]
    VlmClient(settings(server), tmp_path / "run" / "calls", 0).ask(HELLO, "one", plain)
    VlmClient(settings(server), tmp_path / "run" / "calls", 0).ask(HELLO, "two", plain)
    server.close()

    replaying = VlmClient(
        settings(server, mode="replay", calls=tmp_path / "run", key_env="NOT_SET"), tmp_path, 0
    )

    assert replaying.ask(HELLO, "two", plain)[0] == "and again"
    assert replaying.ask(HELLO, "one", plain)[0] == "hi"
    assert replaying.spent.calls == 0
    with pytest.raises(
        V2PError, match=r"replay: .*run holds no answer to 'three' \(call [0-9a-f]+\)"
    ):
        replaying.ask(HELLO, "three", plain)


def test_an_answer_that_is_stored_is_not_paid_for_twice_but_another_seed_asks_anew(
    chat, settings, say, tmp_path
):
    chat.script = [say("hi"), say("ho")]

    first, again, other = (
        VlmClient(settings(chat), tmp_path, seed).ask(HELLO, "one", plain)[0] for seed in (0, 0, 1)
    )

    assert (first, again, other) == ("hi", "hi", "ho")
    assert len(chat.requests) == 2


def test_a_broken_stored_call_is_named(chat, client, say):
    chat.otherwise = say("hi")
    asking = client()
    asking.ask(HELLO, "greeting", plain)
    (path,) = asking.store.folder.glob("*.json")
    path.write_text("{")

    with pytest.raises(V2PError, match=f"{path.name} holds no stored call"):
        client().ask(HELLO, "greeting", plain)


@pytest.fixture
def filmed(scene_of, tmp_path):
    """A scene folder with two stills and a film of 12 frames that get brighter."""
    folder = tmp_path / "scene"
    folder.mkdir()
    film = cv2.VideoWriter(
        str(folder / "overlay.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (320, 240)
    )
    frames = [np.full((240, 320, 3), 20 * i, np.uint8) for i in range(12)]
    for frame in frames:
        film.write(frame)
    film.release()
    cv2.imwrite(str(folder / "overlay_first.png"), frames[0])
    cv2.imwrite(str(folder / "overlay_last.png"), np.full((300, 1200, 3), 200, np.uint8))
    scene = scene_of("lift_up")
    scene.save(folder)
    return type(scene).load(folder)


def test_a_scene_is_shown_by_what_lies_in_its_folder(filmed, chat, client, say):
    chat.otherwise = say("hi")
    pictures = scene_pictures(filmed, 400, 4)
    content = [{"type": "image_url", "image_url": {"url": p.url}} for p in pictures]

    asking = client()
    asking.ask([{"role": "user", "content": content}], "look", plain)

    assert [p.shows.split(",")[0] for p in pictures] == [
        "the first frame",
        "the last frame with the manipulated object",
        "4 moments of the video",
    ]
    stored = sorted(
        (asking.store.folder / "images").iterdir(), key=lambda p: cv2.imread(str(p)).mean()
    )
    images = [cv2.imread(str(p)) for p in stored]
    assert [i.shape[:2] for i in images] == [
        (240, 320),
        (300, 600),
        (100, 400),
    ]  # dark, film, bright
    # Three tiles of 200 x 150 a row: frames 0, 4, 7, and 11 below.
    tiles = [images[1][75, 100], images[1][75, 300], images[1][75, 500], images[1][225, 100]]
    assert [t.mean() for t in tiles] == pytest.approx([0, 80, 140, 220], abs=8)
    assert [p.name for p in stored] == [
        f"{hashlib.sha256(p.read_bytes()).hexdigest()}.jpg" for p in stored
    ]
    request = stored_call(asking)["request"]
    assert {p["image_url"]["url"] for p in request["messages"][0]["content"]} == {
        f"images/{p.name}" for p in stored
    }
    assert "base64" not in json.dumps(request)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"base_url": "localhost:8000"}, "must be an address"),
        ({"base_url": "https://me:secret@host/v1"}, "no user name, password"),
        ({"base_url": "https://host/v1?api-key=secret"}, "no user name, password"),
        ({"key_env": "sk-abc123"}, "must be the NAME"),
        ({"mode": "replay"}, "needs calls"),
        ({"parallel": 0}, "parallel must be at least 1"),
    ],
)
def test_settings_that_cannot_work_are_refused_without_repeating_a_key(wrong, words):
    with pytest.raises(ValueError, match=words) as refusal:
        VlmConfig(**wrong)

    assert "abc123" not in str(refusal.value)
    assert "secret" not in str(refusal.value)
