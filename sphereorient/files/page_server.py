"""What the pages of `mark` and `live` share: a server that answers this machine alone, to who knows its address."""

import json
import secrets
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote

from sphereorient.errors import SphereOrientError, error_words, refusal

HOST = "127.0.0.1"


def new_token() -> str:
    """Return the part of an address that nobody can guess."""
    return secrets.token_urlsafe(16)


class PageHandler(BaseHTTPRequestHandler):
    """Answers requests whose path begins with the token and that name this machine."""

    protocol_version = "HTTP/1.1"
    token: str  # of the class that a server is given

    def _steps(self) -> list[str] | None:
        """Return the parts of the path behind the token; None for who does not know it, or another host's page."""
        host = self.headers.get("Host", "").rpartition(":")[0]
        first, *steps = self.path.partition("?")[0].lstrip("/").split("/")
        known = secrets.compare_digest(first.encode(), self.token.encode())
        return [unquote(step) for step in steps] if known and host in (HOST, "localhost") else None

    def _answer(self, make: Callable[[], Any]) -> None:
        """Send what `make` returns, a PNG file or values, or its error; nothing is there where it is None."""
        try:
            answer = make()
        except SphereOrientError as error:
            self._send(json.dumps({"error": str(error)}).encode(), "application/json", HTTPStatus.BAD_REQUEST)
            return
        if answer is None:
            self.send_error(HTTPStatus.NOT_FOUND)
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
        """Print nothing: the page tells what happens."""


class PageServer(ThreadingHTTPServer):
    """Serves a page on this machine; port 0: any free one. Raise `error`, with the `option`, for a port in use."""

    def __init__(self, handler: type[PageHandler], port: int, option: str, error: type[SphereOrientError]) -> None:
        try:
            super().__init__((HOST, port), handler)
        except OSError as fault:
            do, got = f"choose another {option}", error_words(fault)
            raise error(refusal(f"{option} {port}", expected="a free port", got=got, do=do)) from None
        self.address = f"http://{HOST}:{self.server_address[1]}/{handler.token}/"
