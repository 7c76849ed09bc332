"""The page takes clicks from this machine, through its own address only."""

import json
import socket
import urllib.error
import urllib.request

import numpy as np
import pytest

from v2p_data.deployment.click_page import ClickPage
from v2p_data.errors import V2PError
from v2p_data.scene.frames.one_click import ClickConfig, clicked_mask


@pytest.fixture
def page():
    picture = np.full((96, 96, 3), (150, 140, 120), np.uint8)
    picture[20:40, 20:40] = (200, 30, 30)
    picture[60:80, 50:75] = (20, 40, 190)
    nothing = np.zeros((96, 96), bool)
    with ClickPage(
        picture,
        ["red <box>", "brick"],
        lambda click: clicked_mask(picture, click, nothing, ClickConfig()),
    ) as page:
        yield page


def fetched(address, body=None, host=None):
    headers = {"Content-Type": "application/json"} | ({"Host": host} if host else {})
    request = urllib.request.Request(address, data=body, headers=headers)
    with urllib.request.urlopen(request, timeout=10) as answer:
        return answer.read()


def post(page, **click):
    return json.loads(fetched(page.address, json.dumps(click).encode()))


def test_the_page_shows_the_picture_and_asks_for_each_object_in_order(page):
    text = fetched(page.address).decode()

    assert "data:image/png;base64,iVBOR" in text
    assert '["red \\u003cbox>", "brick"]' in text
    assert page.address.startswith("http://127.0.0.1:")


def test_clicks_are_checked_at_once_and_kept_in_order(page):
    wrong = post(page, u=5.0, v=90.0)
    garbled = post(page, u="left")
    endless = post(page, u=float("inf"), v=float("nan"))
    red = post(page, u=30.0, v=30.5)
    blue = post(page, u=60.0, v=70.0)
    late = post(page, u=60.0, v=70.0)

    assert "on the table or the background" in wrong["error"]
    assert "two numbers" in garbled["error"]
    assert "error" in endless
    assert (red["done"], blue["done"]) == (False, True)
    assert "error" in late
    assert page.wait(1.0) == ((30.0, 30.5), (60.0, 70.0))


def test_strangers_get_nothing(page):
    port = page.address.split(":")[2].split("/")[0]
    for address, body, host in (
        (f"http://127.0.0.1:{port}/", None, None),
        (f"http://127.0.0.1:{port}/wrong-token", b'{"u": 30, "v": 30}', None),
        (page.address, b'{"u": 30, "v": 30}', "evil.example:80"),
        (page.address, b" " * 5000, None),
    ):
        with pytest.raises(urllib.error.HTTPError) as error:
            fetched(address, body, host)
        assert error.value.code in (404, 413)
    assert page.clicks == []


def test_a_length_that_is_no_plain_number_is_refused(page):
    port, path = page.address.split(":")[2].split("/", 1)
    asked = f"POST /{path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nContent-Length: ²\r\n\r\n"

    with socket.create_connection(("127.0.0.1", int(port)), timeout=10) as connection:
        connection.sendall(asked.encode())
        assert b" 413 " in connection.recv(1000)


def test_nobody_clicks(page):
    with pytest.raises(V2PError, match="0 of 2 objects were clicked"):
        page.wait(0.05)
