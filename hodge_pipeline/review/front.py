"""The HTTP server of a review, on 127.0.0.1: a page, its data and, behind it, the 3-D viewer.

Whoever can send a request can decide. So every request must carry the secret token in its path, and name this server as
its host, and as its origin where it states one: that stops other users, other pages and DNS rebinding.
"""

from __future__ import annotations

import hmac
import json
import secrets
import socket
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from hodge_pipeline.errors import HodgeError, WorkspaceError
from hodge_pipeline.review.decisions import LockedError, StaleError
from hodge_pipeline.store.artifacts import json_text

HOST = "127.0.0.1"
HEAD_S = 30.0
"""Seconds that a request may take to arrive."""
MOST_BYTES = 1 << 18
"""Bytes of a request's body at most: a decision about 5000 edges is 40 kB."""
BEAT_S = 10.0
"""Seconds between two lines of the stream of events at most: a write shows that a page has gone."""
CHUNK = 1 << 16
"""Bytes passed on at once."""
PAGE_POLICY = (
    "default-src 'self'; img-src 'self' data: blob:; frame-src 'self'; frame-ancestors 'none'; base-uri 'none'; "
    "form-action 'none'"
)
VIEWER_POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self' ws://{host} data: blob:; "
    "frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
)
"""Content security policies: of our page, and of viser's, which needs inline scripts and its socket."""
REFUSED = {HodgeError: HTTPStatus.BAD_REQUEST, LockedError: HTTPStatus.LOCKED, StaleError: HTTPStatus.CONFLICT}


@dataclass(frozen=True)
class Answer:
    """What a route gives: bytes of a content type; with a `name` they are a file to download."""

    body: bytes
    content_type: str = "application/json"
    name: str = ""

    @classmethod
    def json(cls, value: Any) -> Answer:
        """A value as JSON."""
        return cls(json_text(value).encode())


Route = Callable[[dict[str, Any]], Answer]


@dataclass(frozen=True)
class Site:
    """What the server serves.

    - `routes` by method and name.
    - `wait(version, seconds)`: the next version and its state; the same version again once the seconds are over.
    - `viewer`: the Unix socket of the 3-D viewer, None without one.
    """

    routes: Mapping[tuple[str, str], Route]
    wait: Callable[[int, float], tuple[int, dict[str, Any]]]
    viewer: Path | None = None


class Front:
    """Serves a site in threads of its own; `port` 0 takes a free one. Raises `WorkspaceError` for a taken port."""

    def __init__(self, site: Site, port: int = 0) -> None:
        self.token = secrets.token_urlsafe(24)
        try:
            self._server = _Server((HOST, port), _Handler)
        except OSError as error:
            raise WorkspaceError(
                f"--port {port}: {HOST}:{port} cannot be listened on ({error.strerror}): give another --port, or none"
            ) from error
        self.port = int(self._server.server_address[1])
        self._server.site, self._server.token = site, self.token
        self._server.hosts = (f"{HOST}:{self.port}", f"localhost:{self.port}")
        self._thread = threading.Thread(target=self._server.serve_forever, name="front", daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """The URL of the page, which holds the token."""
        return f"http://{HOST}:{self.port}/{self.token}/"

    def close(self) -> None:
        """Stop serving."""
        self._server.closing.set()
        self._server.shutdown()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True
    site: Site
    token: str
    hosts: tuple[str, ...]

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.closing = threading.Event()


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    protocol_version = "HTTP/1.1"
    timeout = HEAD_S

    def version_string(self) -> str:
        return "hodge"

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: the path holds the token."""

    def do_GET(self) -> None:
        self._serve("GET")

    def do_POST(self) -> None:
        self._serve("POST")

    def _serve(self, method: str) -> None:
        name = self._admitted()
        if name is None:
            self.close_connection = True
            self._send(HTTPStatus.FORBIDDEN, Answer(b"forbidden\n", "text/plain"))
        elif method == "GET" and (name == "scene" or name.startswith("scene/")):
            self._proxy(name.removeprefix("scene") or "/")
        elif method == "GET" and name == "events":
            self._events()
        else:
            self._route(method, name)

    def _admitted(self) -> str | None:
        """The name in the path, without the token; None where token, host or origin is wrong."""
        hosts, origin = self.server.hosts, self.headers.get("Origin")
        token, _, name = urlsplit(self.path).path.removeprefix("/").partition("/")
        is_ours = self.headers.get_all("Host") is not None and all(h in hosts for h in self.headers.get_all("Host", []))
        is_here = origin is None or origin in [f"http://{host}" for host in hosts]
        is_known = hmac.compare_digest(token.encode(), self.server.token.encode())
        return name if is_ours and is_here and is_known else None

    def _route(self, method: str, name: str) -> None:
        route = self.server.site.routes.get((method, name))
        if route is None:
            self.close_connection = True
            self._send(HTTPStatus.NOT_FOUND, Answer.json({"error": f"{name}: there is no such page"}))
            return
        try:
            self._send(HTTPStatus.OK, route(self._parameters(method)))
        except HodgeError as error:
            status = REFUSED.get(type(error), HTTPStatus.BAD_REQUEST)
            self._send(status, Answer.json({"error": str(error)}))

    def _parameters(self, method: str) -> dict[str, Any]:
        if method == "GET":
            return dict(parse_qsl(urlsplit(self.path).query))
        size = self.headers.get("Content-Length", "")
        if not size.isdecimal() or int(size) > MOST_BYTES:
            self.close_connection = True
            raise WorkspaceError(f"a request of {size or 'unknown'} bytes: at most {MOST_BYTES} are read")
        try:
            found = json.loads(self.rfile.read(int(size)))
        except ValueError as error:
            raise WorkspaceError("the request is no JSON") from error
        if not isinstance(found, dict):
            raise WorkspaceError("the request is no mapping")
        return found

    def _send(self, status: HTTPStatus, answer: Answer) -> None:
        with suppress(ConnectionError):
            self.send_response(status)
            self.send_header("Content-Type", answer.content_type)
            self.send_header("Content-Length", str(len(answer.body)))
            if answer.name:
                self.send_header("Content-Disposition", f'attachment; filename="{answer.name}"')
            self._end_headers(PAGE_POLICY)
            self.wfile.write(answer.body)

    def _end_headers(self, policy: str) -> None:
        """Send what every answer is guarded by, and end the head."""
        for name, value in (
            ("Content-Security-Policy", policy),
            ("Referrer-Policy", "no-referrer"),
            ("X-Content-Type-Options", "nosniff"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Cache-Control", "no-store"),
        ):
            self.send_header(name, value)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()

    def _events(self) -> None:
        """Server-sent events: the state, again after each change, until the page has gone."""
        self.close_connection = True
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", "text/event-stream")
        self._end_headers(PAGE_POLICY)
        version = -1
        with suppress(OSError):
            while not self.server.closing.is_set():
                found, state = self.server.site.wait(version, BEAT_S)
                text = ": still here\n\n" if found == version else f"data: {json.dumps(state)}\n\n"
                version = found
                self.wfile.write(text.encode())
                self.wfile.flush()

    def _proxy(self, path: str) -> None:
        """Pass an admitted request on to the viewer, and its answer back; a WebSocket in both directions."""
        self.close_connection = True
        if self.server.site.viewer is None:
            self._send(HTTPStatus.NOT_FOUND, Answer(b"no viewer\n", "text/plain"))
            return
        upgrade = self.headers.get("Upgrade", "").lower() == "websocket"
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as viewer, suppress(OSError):
            viewer.connect(str(self.server.site.viewer))
            viewer.sendall(self._head(path, upgrade))
            if upgrade:
                self.connection.settimeout(None)
                _both_ways(self.connection, viewer)
            else:
                self._pass_on(viewer)

    def _head(self, path: str, upgrade: bool) -> bytes:
        """The request's head for the viewer, without what concerns this connection alone."""
        dropped = ("connection", "keep-alive", "proxy-connection", "transfer-encoding", "content-length")
        kept = [(name, value) for name, value in self.headers.items() if name.lower() not in dropped]
        kept.append(("Connection", "Upgrade" if upgrade else "close"))
        lines = [f"GET {path} HTTP/1.1", *(f"{name}: {value}" for name, value in kept), "", ""]
        return "\r\n".join(lines).encode("latin-1")

    def _pass_on(self, viewer: socket.socket) -> None:
        """The viewer's answer, under our own headers."""
        answer = b"".join(iter(lambda: viewer.recv(CHUNK), b""))
        head, _, body = answer.partition(b"\r\n\r\n")
        status, *lines = head.decode("latin-1").split("\r\n")
        self.send_response(int(status.split()[1]))
        for line in lines:
            name, _, value = line.partition(":")
            if name.lower() in ("content-type", "content-encoding"):
                self.send_header(name, value.strip())
        self.send_header("Content-Length", str(len(body)))
        self._end_headers(VIEWER_POLICY.format(host=self.headers["Host"]))
        self.wfile.write(body)


def _both_ways(first: socket.socket, second: socket.socket) -> None:
    """Copy bytes between two sockets until either ends."""
    back = threading.Thread(target=_copy, args=(second, first), daemon=True)
    back.start()
    _copy(first, second)
    back.join()


def _copy(source: socket.socket, target: socket.socket) -> None:
    """Copy bytes until the source ends, then shut both down: that wakes whoever still reads one of them."""
    with suppress(OSError):
        while data := source.recv(CHUNK):
            target.sendall(data)
    for end in (source, target):
        with suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)
