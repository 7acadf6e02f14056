"""A server of `sphereorient mark`, used without and with a browser."""

import json
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sphereorient.files.page_server import HOST
from sphereorient.preflight.mark import Marking, serve


@contextmanager
def served(marking: Marking) -> Iterator[str]:
    """The address of the server of a marking, without its token."""
    server = serve(marking)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://{HOST}:{server.server_address[1]}"
    server.shutdown()
    server.server_close()
    thread.join()


def ask(url: str, content: object = None, **headers: str) -> tuple[int, bytes]:
    data = None if content is None else json.dumps(content).encode()
    try:
        with urllib.request.urlopen(urllib.request.Request(url, data, headers), timeout=60) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


@contextmanager
def opened(browser: Any, address: str) -> Iterator[Any]:
    """A page of the browser; errors of its console fail the test."""
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    wrong: list[str] = []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
    page.goto(address)
    page.wait_for_function("picture !== null")
    yield page
    page.close()
    assert wrong == []


def place(page: Any, u: float, v: float) -> tuple[float, float]:
    """Position of a picture's pixel on the page."""
    code = """([u, v]) => { const box = canvas.getBoundingClientRect(), [x, y] = toPage(u, v);
        const scale = canvas.width / box.width; return [box.left + x / scale, box.top + y / scale]; }"""
    x, y = page.evaluate(code, [u, v])
    return x, y
