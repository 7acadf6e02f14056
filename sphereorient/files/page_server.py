"""The server of pages in the browser: local to this machine, and only for addresses with the random token."""

import json
import secrets
import socket
import sys
from collections.abc import Callable, Mapping, Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import unquote

from sphereorient.errors import SphereOrientError, error_words, refusal

HOST = "127.0.0.1"
MOST_BYTES = 1_000_000  # of a request
KINDS = {".html": "text/html; charset=utf-8", ".css": "text/css; charset=utf-8"}
KINDS |= {".js": "text/javascript; charset=utf-8"}
Json = dict[str, Any]
Answer = Path | bytes | Json | None  # a file of the page, a picture as PNG, values, or nothing


class Page(Protocol):
    """Content behind the token, called from several threads. `steps` are the parts of the path."""

    def shown(self, steps: Sequence[str]) -> Answer:
        """Return the content at a path; None: nothing."""

    def done(self, steps: Sequence[str], asked: Mapping[str, Any]) -> Answer:
        """Perform a request at a path, and return its result; None: no such request."""


def new_token() -> str:
    """Return the secret part of an address."""
    return secrets.token_urlsafe(16)


def listen(port: int, option: str, error: type[SphereOrientError]) -> socket.socket:
    """Return a socket of this machine for a page; port 0: any free one. Raise `error`, with the `option`: in use."""
    try:
        return socket.create_server((HOST, port))
    except OSError as fault:
        do, got = f"choose another {option}", error_words(fault)
        raise error(refusal(f"{option} {port}", expected="a free port", got=got, do=do)) from None


class PageServer(ThreadingHTTPServer):
    """Serves a page on a socket of `listen`; call `serve_forever`."""

    def __init__(self, page: Page, door: socket.socket, token: str) -> None:
        handler = type("Handler", (_Handler,), {"page": page, "token": token})
        super().__init__(door.getsockname(), handler, bind_and_activate=False)
        self.socket.close()
        self.socket = door
        self.address = address(door, token)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a client that has disconnected."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


def address(door: socket.socket, token: str) -> str:
    """Return the address of the page on a socket."""
    return f"http://{HOST}:{door.getsockname()[1]}/{token}/"


class _Handler(BaseHTTPRequestHandler):
    """Answers requests to this machine whose path begins with the token."""

    protocol_version = "HTTP/1.1"
    page: Page
    token: str

    def do_GET(self) -> None:
        self._answer(self.page.shown)

    def do_POST(self) -> None:
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > MOST_BYTES:
            self.close_connection = True
            self.send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
            return
        content = self.rfile.read(int(length))
        try:
            asked = json.loads(content)
        except (ValueError, RecursionError):
            asked = None
        self._answer(lambda steps: self.page.done(steps, asked if isinstance(asked, dict) else {}))

    def _answer(self, make: Callable[[Sequence[str]], Answer]) -> None:
        """Send the result of `make` for the path behind the token, or its error; not found if it is None, or if the
        token or the host is wrong.
        """
        host = self.headers.get("Host", "").rpartition(":")[0]
        first, *steps = self.path.partition("?")[0].lstrip("/").split("/")
        known = secrets.compare_digest(first.encode(), self.token.encode()) and host in (HOST, "localhost")
        try:
            answer = make([unquote(step) for step in steps]) if known else None
        except SphereOrientError as error:
            self._send(json.dumps({"error": str(error)}).encode(), "application/json", HTTPStatus.BAD_REQUEST)
            return
        if answer is None:
            self.send_error(HTTPStatus.NOT_FOUND)
        elif isinstance(answer, Path):
            self._send(answer.read_bytes(), KINDS[answer.suffix])
        elif isinstance(answer, bytes):
            self._send(answer, "image/png")
        else:
            self._send(json.dumps(answer).encode(), "application/json")

    def _send(self, content: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, form: str, *values: object) -> None:
        """Print nothing: the page shows what happens."""
