"""Fetching from a local server, an honest one and those that lie; nothing leaves this machine."""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from pnpdepth_cli.cli.main import run

hub = pytest.importorskip("huggingface_hub", reason="needs the extra [hf]")

COMMIT = "0123456789abcdef0123456789abcdef01234567"
FILES = {
    "config.json": b'{"model_type": "glpn"}',
    "model.safetensors": bytes(range(256)) * 40,
    "model.bin": b"a pickle",
    "net.py": b"code",
    "../escaped.safetensors": b"outside",
    "model/../../escaped.safetensors": b"outside",
}


class Server(ThreadingHTTPServer):
    """A repository ORG/NAME, and what it sends in place of its files."""

    sent: dict[str, bytes]
    cut: bool
    redirect: str | None
    requested: list[str]

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.sent, self.cut, self.redirect, self.requested = dict(FILES), False, None, []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


def entry(name: str, data: bytes) -> dict[str, Any]:
    """What a repository states of a file: weights are in LFS, text is in Git."""
    blob = hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()
    stated = {"rfilename": name, "size": len(data), "blobId": blob}
    if name.endswith(".safetensors"):
        digest = hashlib.sha256(data).hexdigest()
        stated["lfs"] = {"sha256": digest, "size": len(data), "pointerSize": 130}
    return stated


class Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        self.server.requested.append(self.path)
        if self.path.startswith("/api/models/"):
            siblings = [entry(name, data) for name, data in FILES.items()]
            info = {"id": "org/name", "sha": COMMIT, "siblings": siblings, "tags": []}
            self.answer(200, json.dumps(info).encode(), {"Content-Type": "application/json"})
            return
        name = self.path.partition(f"/resolve/{COMMIT}/")[2]
        if self.server.redirect is not None and "moved" not in self.path:
            self.answer(302, b"", {"Location": self.server.redirect})
            return
        data = self.server.sent[name.removeprefix("moved/")]
        digest = hashlib.sha256(FILES[name.removeprefix("moved/")]).hexdigest()
        self.answer(200, data, {"ETag": f'"{digest}"', "X-Repo-Commit": COMMIT})

    do_HEAD = do_GET

    def answer(self, status: int, data: bytes, headers: dict[str, str]) -> None:
        cut = self.server.cut and self.command == "GET" and status == 200 and "ETag" in headers
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(data[: len(data) // 2] if cut else data)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Server]:
    from huggingface_hub import constants

    with Server() as server:
        template = constants.HUGGINGFACE_CO_URL_TEMPLATE
        path = template.removeprefix(constants.ENDPOINT)
        monkeypatch.setattr(constants, "ENDPOINT", server.url)
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", server.url + path)
        monkeypatch.setattr("time.sleep", lambda _: None)
        monkeypatch.chdir(tmp_path)
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield server
        server.shutdown()


def failed(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line of a fetch that must fail and leave nothing."""
    assert run(["models", "fetch", "org/name", "-o", "net"]) == 4
    lines = [each for each in capsys.readouterr().err.splitlines() if "pnpdepth: " in each]
    assert list(Path().iterdir()) == []
    (line,) = lines
    return line


def test_settings_and_weights_are_fetched_and_nothing_else(
    server: Server, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["models", "fetch", "org/name", "-o", "net", "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert sorted(p.name for p in Path().rglob("*")) == [
        *("config.json", "fetched.json", "model.safetensors", "net")
    ]
    assert record == json.loads(Path("net/fetched.json").read_text())
    assert record["revision"] == COMMIT
    for name, digest in record["sha256"].items():
        assert Path("net", name).read_bytes() == FILES[name]
        assert digest == hashlib.sha256(FILES[name]).hexdigest()
    assert run(["models", "fetch", "org/name", "-o", "net"]) == 2


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
@pytest.mark.parametrize("part", [slice(None, None, -1), slice(None, -1)])
def test_a_file_with_another_content_or_length_is_refused(
    server: Server, capsys: pytest.CaptureFixture[str], name: str, part: slice
) -> None:
    server.sent[name] = FILES[name][part]
    line = failed(capsys)
    assert f"org/name: {name} arrived with another content" in line or "cannot be fetched" in line


RESOLVED = f"/org/name/resolve/{COMMIT}"


@pytest.mark.parametrize(
    ("redirect", "message"),
    [
        (None, "cannot be fetched"),  # the connection ends early
        (f"{{url}}{RESOLVED}/config.json", "cannot be fetched"),  # in a circle
        ("file:///etc/hostname", "cannot be fetched"),
        (f"{{url}}{RESOLVED}/moved/net.py", ""),  # whose content is another
    ],
)
def test_a_connection_that_ends_early_or_leads_elsewhere_is_refused(
    server: Server, capsys: pytest.CaptureFixture[str], redirect: str | None, message: str
) -> None:
    server.cut = redirect is None
    server.redirect = redirect and redirect.format(url=server.url)
    assert message in failed(capsys)
    assert len(server.requested) < 100


def test_a_repository_without_weights_and_settings_is_refused(
    server: Server, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("config.json", "model.safetensors"):
        monkeypatch.delitem(FILES, name)
    assert "has no config.json" in failed(capsys)
