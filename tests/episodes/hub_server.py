"""A server on the loopback that speaks as much of the Hub's protocol as pushing and loading need.

Repositories live in memory: files, commits as snapshots of all files, tags. A token of another value gets
401, a namespace other than `user` gets 403.
"""

import base64
import hashlib
import json
import re
import socket
import threading
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

TOKEN = "hf_right_token"
NAMESPACE = "user"
CUT, LOST = 0, 1
LFS_SUFFIXES = (".mp4", ".parquet", ".safetensors")


@dataclass
class Repo:
    """One repository."""

    files: dict[str, bytes] = field(default_factory=dict)
    lfs: set[str] = field(default_factory=set)
    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)
    head: str = ""
    tags: dict[str, str] = field(default_factory=dict)
    private: bool = False
    gated: str | bool = False
    """`auto` or `manual` where people ask for access."""

    def commit(self) -> str:
        listing = sorted(
            (path, hashlib.sha1(data).hexdigest()) for path, data in self.files.items()
        )
        self.head = hashlib.sha1(json.dumps([listing, len(self.commits)]).encode()).hexdigest()
        self.commits[self.head] = dict(self.files)
        return self.head

    def resolve(self, revision: str) -> str | None:
        if revision == "main":
            return self.head
        return self.tags.get(revision, revision if revision in self.commits else None)


@dataclass
class Hub:
    """What the server knows, for tests to look at."""

    url: str = ""
    repos: dict[str, Repo] = field(default_factory=dict)
    blobs: dict[str, bytes] = field(default_factory=dict)
    requests: list[str] = field(default_factory=list)
    faults: dict[str, int] = field(default_factory=dict)
    """Requests whose address holds the key get this answer."""
    passing_faults: list[tuple[str, int]] = field(default_factory=list)
    """The same, each for one request only, whose method may stand before the address.

    `CUT` is no answer but half a request read and the line cut; with `LOST` the request is obeyed
    before the line is cut.
    """

    def count(self, start: str, part: str = "") -> int:
        """Return how many requests there were of this kind."""
        return sum(r.startswith(start) and part in r for r in self.requests)


@contextmanager
def running_hub() -> Generator[Hub]:
    """Serve on a free port of 127.0.0.1 until the block ends."""
    hub = Hub()

    class Handler(_Handler):
        state = hub

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    hub.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        server.shutdown()
        server.server_close()
        thread.join(5)


class _Handler(BaseHTTPRequestHandler):
    state: Hub
    is_lost = False
    """The answer to this request."""
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # else every answer waits 40 ms for an acknowledgement

    def log_message(self, format: str, *args: object) -> None:
        pass

    def do_GET(self) -> None:
        self._answer_to("GET")

    def do_HEAD(self) -> None:
        self._answer_to("HEAD")

    def do_POST(self) -> None:
        self._answer_to("POST")

    def do_PUT(self) -> None:
        self._answer_to("PUT")

    def do_DELETE(self) -> None:
        self._answer_to("DELETE")

    def _answer_to(self, method: str) -> None:
        hub = self.state
        path = unquote(urlsplit(self.path).path)
        hub.requests.append(f"{method} {path}")
        size = int(self.headers.get("Content-Length") or 0)
        fault = next((f for f in hub.passing_faults if f[0] in f"{method} {path}"), None)
        self.is_lost = fault is not None and fault[1] == LOST
        if fault is not None:
            hub.passing_faults.remove(fault)
            if fault[1] == CUT:
                self.rfile.read(size // 2)
                self.close_connection = True
                self.connection.shutdown(socket.SHUT_RDWR)
                return None
        body = self.rfile.read(size)
        if fault is not None and not self.is_lost:
            return self._json(fault[1], {"error": "told to answer so"}, {"Retry-After": "0"})
        for part, status in hub.faults.items():
            if part in path:
                return self._json(status, {"error": "told to answer so"})
        if path.startswith("/lfs/"):
            hub.blobs[path.removeprefix("/lfs/")] = body
            return self._json(200, {})
        if self.headers.get("Authorization") != f"Bearer {TOKEN}":
            return self._json(401, {"error": "Invalid username or password."})
        if path == "/api/validate-yaml":
            return self._json(200, {"errors": [], "warnings": []})
        if path == "/api/repos/create":
            return self._create(json.loads(body))
        lfs = re.fullmatch(r"/(datasets/)?([^/]+/[^/]+)\.git/info/lfs/objects/batch", path)
        if lfs:
            return self._lfs_batch(json.loads(body))
        resolve = re.fullmatch(r"/(datasets/)?([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path)
        if resolve:
            return self._file(self._key(resolve[1], resolve[2]), resolve[3], resolve[4])
        api = re.fullmatch(r"/api/(datasets|models)/([^/]+/[^/]+)(?:/([^/]+))?(?:/(.+))?", path)
        if not api:
            return self._json(404, {"error": f"no such address: {method} {path}"})
        repo = hub.repos.get(f"{api[1]}/{api[2]}")
        if repo is None:
            return self._json(
                404, {"error": "Repository not found"}, {"X-Error-Code": "RepoNotFound"}
            )
        return self._repo_call(method, api[2], repo, api[3] or "", api[4] or "main", body)

    def _key(self, prefix: str | None, repo_id: str) -> str:
        return f"{'datasets' if prefix else 'models'}/{repo_id}"

    def _create(self, asked: dict) -> None:
        owner = asked.get("organization") or NAMESPACE
        name = asked["name"].split("/")[-1]
        kind = "datasets" if asked.get("type") == "dataset" else "models"
        key = f"{kind}/{owner}/{name}"
        url = f"{self.state.url}/{'datasets/' if kind == 'datasets' else ''}{owner}/{name}"
        if owner != NAMESPACE:
            return self._json(403, {"error": f"You don't have the rights to create under {owner}"})
        if key in self.state.repos:
            return self._json(409, {"error": "You already created this repo", "url": url})
        self.state.repos[key] = Repo(private=asked.get("visibility") == "private")
        self.state.repos[key].commit()
        return self._json(200, {"url": url, "name": f"{owner}/{name}", "id": f"{owner}/{name}"})

    def _lfs_batch(self, asked: dict) -> None:
        objects = []
        for thing in asked["objects"]:
            actions = {}
            if thing["oid"] not in self.state.blobs:
                actions = {"upload": {"href": f"{self.state.url}/lfs/{thing['oid']}"}}
            objects.append({**thing, "actions": actions} if actions else thing)
        self._json(200, {"transfer": "basic", "objects": objects})

    def _repo_call(
        self, method: str, repo_id: str, repo: Repo, verb: str, rest: str, body: bytes
    ) -> None:
        if method == "POST" and verb == "preupload":
            files = [
                {
                    "path": f["path"],
                    "uploadMode": "lfs" if f["path"].endswith(LFS_SUFFIXES) else "regular",
                    "shouldIgnore": False,
                }
                for f in json.loads(body)["files"]
            ]
            return self._json(200, {"files": files})
        if method == "POST" and verb == "commit":
            return self._commit(repo_id, repo, body)
        if verb == "tag":
            if method == "DELETE":
                if repo.tags.pop(rest, None) is None:
                    return self._json(
                        404, {"error": "no tag"}, {"X-Error-Code": "RevisionNotFound"}
                    )
                return self._json(200, {})
            repo.tags[json.loads(body)["tag"]] = repo.resolve(rest) or repo.head
            return self._json(200, {})
        if verb == "refs":
            tags = [
                {"name": k, "ref": f"refs/tags/{k}", "targetCommit": v}
                for k, v in repo.tags.items()
            ]
            branches = [{"name": "main", "ref": "refs/heads/main", "targetCommit": repo.head}]
            return self._json(200, {"branches": branches, "converts": [], "tags": tags})
        commit = repo.resolve(rest.split("/")[0])
        if commit is None:
            return self._json(404, {"error": "no revision"}, {"X-Error-Code": "RevisionNotFound"})
        if verb in ("", "revision"):
            siblings = [{"rfilename": path} for path in repo.commits[commit]]
            return self._json(
                200,
                {
                    "id": repo_id,
                    "sha": commit,
                    "siblings": siblings,
                    "tags": [],
                    "downloads": 0,
                    "likes": 0,
                    "private": repo.private,
                    "gated": repo.gated,
                },
            )
        if verb == "tree":
            return self._json(
                200, [self._tree_entry(repo, p, d) for p, d in repo.commits[commit].items()]
            )
        return self._json(404, {"error": f"no such call: {verb}"})

    def _tree_entry(self, repo: Repo, path: str, data: bytes) -> dict:
        entry = {
            "type": "file",
            "path": path,
            "size": len(data),
            "oid": hashlib.sha1(data).hexdigest(),
        }
        if path in repo.lfs:
            sha = hashlib.sha256(data).hexdigest()
            entry["lfs"] = {"oid": sha, "size": len(data), "pointerSize": 130}
        return entry

    def _commit(self, repo_id: str, repo: Repo, body: bytes) -> None:
        for line in body.decode().splitlines():
            entry = json.loads(line)
            value = entry["value"]
            if entry["key"] == "file":
                repo.files[value["path"]] = base64.b64decode(value["content"])
            elif entry["key"] == "lfsFile":
                if value["oid"] not in self.state.blobs:
                    return self._json(400, {"error": f"{value['path']} was not uploaded"})
                repo.files[value["path"]] = self.state.blobs[value["oid"]]
                repo.lfs.add(value["path"])
            elif entry["key"] == "deletedFile":
                repo.files.pop(value["path"], None)
        commit = repo.commit()
        return self._json(
            200,
            {
                "success": True,
                "commitOid": commit,
                "commitUrl": f"{self.state.url}/{repo_id}/commit/{commit}",
            },
        )

    def _file(self, key: str, revision: str, path: str) -> None:
        repo = self.state.repos.get(key)
        commit = repo.resolve(revision) if repo else None
        if repo is None or commit is None:
            return self._json(404, {"error": "no revision"}, {"X-Error-Code": "RevisionNotFound"})
        data = repo.commits[commit].get(path)
        if data is None:
            return self._json(404, {"error": "no file"}, {"X-Error-Code": "EntryNotFound"})
        return self._send(
            200,
            data,
            {
                "ETag": f'"{hashlib.sha256(data).hexdigest()}"',
                "X-Repo-Commit": commit,
                "Content-Type": "application/octet-stream",
                "Accept-Ranges": "bytes",
            },
        )

    def _json(self, status: int, data: object, headers: dict[str, str] | None = None) -> None:
        more = (
            {"X-Error-Message": data["error"]}
            if isinstance(data, dict) and "error" in data
            else {}
        )
        self._send(
            status,
            json.dumps(data).encode(),
            {"Content-Type": "application/json", **more, **(headers or {})},
        )

    def _send(self, status: int, data: bytes, headers: dict[str, str]) -> None:
        if self.is_lost:
            self.close_connection = True
            self.connection.shutdown(socket.SHUT_RDWR)
            return
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)
