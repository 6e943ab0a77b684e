"""The part of the Hugging Face Hub's HTTP interface that its client needs for small files."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

Files = dict[str, bytes]


class FakeHub:
    """Repositories of one commit per branch.

    Attributes:
      branches: `(repository, branch) -> files`.
      tokens: what requests were authorised with.
      private: repositories that were made so.
    """

    def __init__(self) -> None:
        self.branches: dict[tuple[str, str], Files] = {}
        self.tokens: set[str | None] = set()
        self.private: set[str] = set()

    def files(self, repo: str, revision: str) -> tuple[str, Files] | None:
        """The commit and the files of a branch or a commit."""
        for (name, branch), found in self.branches.items():
            digest = hashlib.sha1(f"{branch}{sorted(found.items())}".encode()).hexdigest()
            if name == repo and revision in (branch, digest):
                return digest, found
        return None


@contextmanager
def serving(hub: FakeHub) -> Iterator[str]:
    """Serves a hub on this machine; gives its address."""

    class Handler(_Handler):
        state = hub

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


class _Handler(BaseHTTPRequestHandler):
    state: FakeHub

    def log_message(self, *args: Any) -> None:
        pass

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        self.state.tokens.add(self.headers.get("authorization"))
        if found := re.fullmatch(r"/api/models/([^/]+/[^/]+)(?:/revision/(.+))?", path):
            return self._info(found[1], found[2] or "main")
        if found := re.fullmatch(r"/api/models/([^/]+/[^/]+)/tree/([^/]+)(?:/.*)?", path):
            return self._tree(found[1], found[2])
        if found := re.fullmatch(r"/([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path):
            return self._file(*found.groups())
        self._answer(404, {"error": path})

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers.get("content-length") or 0))
        self.state.tokens.add(self.headers.get("authorization"))
        path = self.path.partition("?")[0]
        if self.headers.get("authorization") != "Bearer hf_right":
            return self._answer(401, {"error": "Invalid username or password."})
        if path == "/api/validate-yaml":  # of the card's front matter
            return self._answer(200, {"errors": [], "warnings": []})
        if path == "/api/repos/create":
            return self._create(json.loads(body))
        if found := re.fullmatch(r"/api/models/([^/]+/[^/]+)/branch/(.+)", path):
            files = self.state.branches[found[1], "main"]
            self.state.branches.setdefault((found[1], found[2]), dict(files))
            return self._answer(200, {})
        if found := re.fullmatch(r"/api/models/[^/]+/[^/]+/preupload/.+", path):
            names = [file["path"] for file in json.loads(body)["files"]]
            how = {"uploadMode": "regular", "shouldIgnore": False, "oid": None}
            return self._answer(200, {"files": [{"path": name, **how} for name in names]})
        if found := re.fullmatch(r"/api/models/([^/]+/[^/]+)/commit/(.+)", path):
            return self._commit(found[1], found[2], body)
        self._answer(404, {"error": path})

    def _create(self, asked: dict[str, Any]) -> None:
        repo = f"{asked['organization']}/{asked['name']}"
        if asked.get("private") or asked.get("visibility") == "private":
            self.state.private.add(repo)
        self.state.branches.setdefault((repo, "main"), {})
        self._answer(200, {"url": f"http://{self.headers['host']}/{repo}", "name": repo})

    def _commit(self, repo: str, branch: str, body: bytes) -> None:
        files = self.state.branches[repo, branch]
        for line in map(json.loads, body.splitlines()):
            if line["key"] == "file":
                value = line["value"]
                files[value["path"]] = base64.b64decode(value["content"])
        commit, _ = self.state.files(repo, branch) or ("", {})
        url = f"http://{self.headers['host']}/{repo}/commit/{commit}"
        self._answer(200, {"commitUrl": url, "commitOid": commit, "success": True})

    def _info(self, repo: str, revision: str) -> None:
        found = self.state.files(repo, revision)
        if found is None:
            return self._answer(404, {"error": "not found"}, {"X-Error-Code": "RepoNotFound"})
        siblings = [{"rfilename": name, "size": len(data)} for name, data in found[1].items()]
        self._answer(200, {"id": repo, "sha": found[0], "siblings": siblings})

    def _tree(self, repo: str, revision: str) -> None:
        _, files = self.state.files(repo, revision) or ("", {})
        self._answer(
            200,
            [
                {"type": "file", "path": name, "size": len(data), "oid": _oid(data)}
                for name, data in files.items()
            ],
        )

    def _file(self, repo: str, revision: str, name: str) -> None:
        found = self.state.files(repo, revision)
        if found is None or name not in found[1]:
            return self._answer(404, {"error": name}, {"X-Error-Code": "EntryNotFound"})
        data = found[1][name]
        headers = {"ETag": f'"{_oid(data)}"', "X-Repo-Commit": found[0]}
        self._answer(200, data, headers)

    def _answer(self, code: int, value: Any, headers: dict[str, str] | None = None) -> None:
        data = value if isinstance(value, bytes) else json.dumps(value).encode()
        self.send_response(code)
        for name, text in {**(headers or {}), "Content-Length": str(len(data))}.items():
            self.send_header(name, text)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)


def _oid(data: bytes) -> str:
    return hashlib.sha1(data).hexdigest()
