"""A real server on this machine that speaks the chat-completions protocol and says what a test wants it to say."""

import json
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from v2p_data.task.llm.client import VlmClient
from v2p_data.task.llm.config import VlmConfig

SECRET = "sk-test-0123456789abcdef"


class ChatServer:
    """Answers requests from `script`, one entry each, and then from `otherwise`.

    An entry is a reply or takes the request.
    """

    def __init__(self):
        self.script = []
        self.otherwise = None
        self.requests = []
        self.headers = []
        self.paths = []
        self.lock = threading.Lock()
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self):
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                with outer.lock:
                    outer.requests.append(body)
                    outer.headers.append({k.lower(): v for k, v in self.headers.items()})
                    outer.paths.append(self.path)
                    entry = outer.script.pop(0) if outer.script else outer.otherwise
                reply = entry(body) if callable(entry) else entry
                time.sleep(reply.get("sleep", 0))
                if reply.get("hang_up"):
                    self.close_connection = True
                    return
                data = reply.get("raw", json.dumps(reply.get("json", {})).encode())
                self.send_response(reply.get("status", 200))
                for name, value in reply.get("headers", {}).items():
                    self.send_header(name, value)
                self.send_header("Content-Type", "application/json")
                self.send_header("Content-Length", str(reply.get("length", len(data))))
                self.end_headers()
                self.wfile.write(data)
                if "length" in reply:
                    self.close_connection = True

            def log_message(self, *words):
                pass

        self.httpd = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.httpd.handle_error = lambda *who: None  # a client that hangs up is part of the tests
        self.url = f"http://127.0.0.1:{self.httpd.server_address[1]}/v1"
        self.thread = threading.Thread(target=self.httpd.serve_forever, args=(0.01,), daemon=True)
        self.thread.start()

    def close(self):
        self.httpd.shutdown()
        self.httpd.server_close()


def said(text, *, finish="stop", tokens=(1000, 500), refusal=None):
    """Return a reply with one choice."""
    message = {"role": "assistant", "content": text, "refusal": refusal}
    data = {
        "id": "1",
        "object": "chat.completion",
        "created": 1,
        "model": "small-1",
        "choices": [{"index": 0, "message": message, "finish_reason": finish}],
    }
    if tokens:
        data["usage"] = {
            "prompt_tokens": tokens[0],
            "completion_tokens": tokens[1],
            "total_tokens": sum(tokens),
        }
    return {"json": data}


@pytest.fixture(scope="module")
def say():
    return said


@pytest.fixture(scope="module")
def serve():
    """Return a function that starts a server; all of them end with the module."""
    started = []

    def start():
        started.append(ChatServer())
        return started[-1]

    yield start
    for server in started:
        server.close()


@pytest.fixture
def chat(serve):
    return serve()


@pytest.fixture(autouse=True, scope="module")
def environment():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("V2P_TEST_KEY", SECRET)
        patch.setenv("NO_PROXY", "127.0.0.1")
        yield


@pytest.fixture
def secret():
    return SECRET


def settings_for(server, **changes) -> VlmConfig:
    return VlmConfig(
        **{
            "base_url": server.url,
            "model": "small",
            "key_env": "V2P_TEST_KEY",
            "max_retries": 2,
            "timeout_s": 20.0,
            "price_in_per_million": 2.0,
            "price_out_per_million": 8.0,
        }
        | changes
    )


@pytest.fixture(scope="module")
def settings() -> Callable[..., VlmConfig]:
    return settings_for


@pytest.fixture
def client(chat, tmp_path) -> Callable[..., VlmClient]:
    """Return a function that makes a client of the test's server."""
    return lambda **changes: VlmClient(settings_for(chat, **changes), tmp_path / "calls", 0)
