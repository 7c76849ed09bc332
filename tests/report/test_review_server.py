"""The served page takes requests from itself only, and says in a sentence what cannot be done."""

import json
import socket
import urllib.error
import urllib.request

import pytest

from v2p_data.errors import V2PError
from v2p_data.report.review import Review
from v2p_data.report.review_server import ReviewServer


class Clips(Review):
    """A review that remembers what it was told; the real one is tested with a real clip."""

    def __init__(self, film=None) -> None:
        self.changes, self._film = [], film

    def page(self):
        return b"<!doctype html>"

    def clip(self, item):
        return {"lift": {"item": "lift"}}[item]

    def still(self, item, number):
        return [b"\xff\xd8still"][number]

    def film(self, item):
        return self._film

    def mark(self, item, phrase, hint):
        self.changes.append((item, phrase, hint))
        if phrase != "cup":
            raise V2PError(f"'{phrase}' is none of the objects")
        return self.clip(item)

    def judge(self, item, judgement):
        self.changes.append((item, judgement))
        return self.clip(item)


@pytest.fixture
def clips(tmp_path):
    film = tmp_path / "overlay.mp4"
    film.write_bytes(bytes(range(200)))
    return Clips(film)


@pytest.fixture
def server(clips):
    with ReviewServer(clips) as server:
        yield server


def fetched(address, body=None, **headers):
    """Return the answer's status, headers and bytes."""
    kind = {"Content-Type": "application/json"} if body is not None else {}
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(address, data=data, headers={**kind, **headers})
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return answer.status, answer.headers, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.headers, error.read()


def test_changes_reach_the_review_and_refusals_come_back_as_sentences(server, clips):
    marked = fetched(server.address + "mark/lift", {"phrase": "cup", "hint": {"click": [3, 4]}})
    wrong = fetched(server.address + "mark/lift", {"phrase": "pot", "hint": None})
    judged = fetched(server.address + "judge/lift", {"judgement": "right"})

    assert server.address.startswith("http://127.0.0.1:")
    assert json.loads(marked[2]) == {"item": "lift"}
    assert json.loads(wrong[2])["error"] == "'pot' is none of the objects"
    assert judged[0] == 200
    marks = [("lift", "cup", {"click": [3, 4]}), ("lift", "pot", None)]
    assert clips.changes == [*marks, ("lift", "right")]


def test_what_there_is_not_is_not_found(server):
    for path in ("clip/other", "still/lift/7", "mark", "../../etc/passwd", "film/../x"):
        assert fetched(server.address + path)[0] == 404
    assert fetched(server.address + "mark/other", {"phrase": "cup"})[0] == 404


@pytest.mark.parametrize(
    ("path", "headers", "status"),
    [
        ("", {"Host": "evil.example"}, 404),
        ("mark/lift", {"Origin": "http://evil.example"}, 403),
        ("mark/lift", {"Origin": "null"}, 403),
        ("mark/lift", {"Sec-Fetch-Site": "cross-site"}, 403),
        ("mark/lift", {"Content-Type": "text/plain"}, 403),
        ("mark/lift", {"Host": "evil.example"}, 404),
    ],
)
def test_another_page_gets_nothing_and_changes_nothing(server, clips, path, headers, status):
    body = {"phrase": "cup", "hint": None} if path else None

    assert fetched(server.address + path, body, **headers)[0] == status
    assert clips.changes == []


def test_nothing_is_there_without_the_token(server, clips):
    port = server.address.split(":")[2].split("/")[0]

    for path in ("", "clip/lift", "wrong/clip/lift"):
        assert fetched(f"http://127.0.0.1:{port}/{path}")[0] == 404
    assert fetched(f"http://127.0.0.1:{port}/wrong/mark/lift", {"phrase": "cup"})[0] == 404
    assert clips.changes == []


@pytest.mark.parametrize("hint", [[], [1], "box", 3, True])
def test_a_hint_of_another_type_is_refused(server, clips, hint):
    said = json.loads(fetched(server.address + "mark/lift", {"phrase": "cup", "hint": hint})[2])

    assert said["error"].startswith("a hint is an object")
    assert clips.changes == []


@pytest.mark.parametrize("length", ["²", "٣", "-1", "1e3", "9" * 5000, ""])
def test_a_length_that_is_no_plain_number_is_refused(server, clips, length):
    port, path = server.address.split(":")[2].split("/", 1)
    asked = f"POST /{path}mark/lift HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nContent-Length: {length}\r\n\r\n"

    with socket.create_connection(("127.0.0.1", int(port)), timeout=10) as connection:
        connection.sendall(asked.encode())
        answer = connection.recv(1000)

    assert answer.startswith(b"HTTP/1.1 413")
    assert clips.changes == []


def test_a_body_that_is_too_long_or_no_object_is_refused(server, clips):
    assert fetched(server.address + "mark/lift", {"phrase": "x" * 300_000})[0] == 413
    said = json.loads(fetched(server.address + "mark/lift", [1, 2])[2])

    assert "none of the objects" in said["error"]
    assert clips.changes == [("lift", "", None)]


def test_a_player_gets_the_part_of_the_film_that_it_asks_for(server):
    whole = fetched(server.address + "film/lift/key")
    part = fetched(server.address + "film/lift/key", Range="bytes=10-19")
    rest = fetched(server.address + "film/lift/key", Range="bytes=190-")
    beyond = fetched(server.address + "film/lift/key", Range="bytes=500-")
    beyond_all = fetched(server.address + "film/lift/", Range="bytes=" + "9" * 5000 + "-")

    assert (whole[0], len(whole[2])) == (200, 200)
    assert (part[0], part[2]) == (206, bytes(range(10, 20)))
    assert part[1]["Content-Range"] == "bytes 10-19/200"
    assert rest[2] == bytes(range(190, 200))
    assert beyond[0] == 416
    assert (beyond_all[0], len(beyond_all[2])) == (200, 200)


def test_a_port_that_is_taken_is_named(server, clips):
    port = int(server.address.split(":")[2].split("/")[0])

    with pytest.raises(V2PError, match=f"port {port} of this machine cannot be used"):
        ReviewServer(clips, port)
