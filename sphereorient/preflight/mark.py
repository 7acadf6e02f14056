"""The server of the pages on which people mark what pictures show: masks, or fiducials of a plate.
It answers this machine alone, to who knows the random token of its address.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from pathlib import Path
from threading import Lock
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import SettingsError, SphereOrientError, refusal
from sphereorient.files.page_server import PageHandler, PageServer, new_token
from sphereorient.files.whole_file import TEXT_BYTES, read_text, write_text, writing
from sphereorient.files.yaml_file import FAULTS, parse_yaml, with_value, yaml_words

SHARED = {"mark.css": "text/css; charset=utf-8", "mark.js": "text/javascript; charset=utf-8"}  # beside the pages
MOST_BYTES = 1_000_000  # of a request
Json = dict[str, Any]


class Marking(ABC):
    """A YAML file in which a page writes what is marked; the handler of requests calls it from several threads."""

    page: ClassVar[str]  # name of its file
    error: ClassVar[type[SphereOrientError]]

    def __init__(self, path: Path) -> None:
        self.path = path
        self.token = new_token()
        self.lock = Lock()

    @abstractmethod
    def shown(self, steps: Sequence[str]) -> bytes | Json | None:
        """Return what lies at a path behind the token, a PNG file or values; None: nothing."""

    @abstractmethod
    def done(self, steps: Sequence[str], asked: Mapping[str, Any]) -> Json | None:
        """Do what is asked for at a path, and return what was done; None: nothing is done there."""

    def refused(self, name: str, expected: str, got: str, do: str) -> SphereOrientError:
        """Return an error of the file's kind, worded by `refusal`."""
        return self.error(refusal(name, expected=expected, got=got, do=do))

    def read(self) -> Any:
        """Return the values of the file as it is now."""
        try:
            return parse_yaml(self._text())
        except FAULTS as fault:
            raise self.refused(str(self.path), "YAML", yaml_words(fault), "correct the file there") from None

    def write(self, place: Sequence[str | int], value: Mapping[str, Any], by_hand: str) -> None:
        """Write a value in one line of the file, whose other lines stay, see `with_value`; `by_hand`: else to do."""
        text = with_value(self._text(), place, value)
        if text is None:
            expected = f"a key {place[-1]} in one line, or a place for it"
            raise self.refused(str(self.path), expected, "another form", by_hand)
        with writing(force=True):
            write_text(self.path, text)

    def _text(self) -> str:
        return read_text(self.path, TEXT_BYTES, "a YAML file", self.error, "correct the path")


def png(picture: NDArray[np.uint8]) -> bytes:
    """Return a picture as a PNG file, quickly."""
    return bytes(cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])


def serve(marking: Marking, port: int = 0) -> PageServer:
    """Return a server of the page; call `serve_forever`. Raise SettingsError for a port in use."""

    class Handler(PageHandler):
        token = marking.token

        def do_GET(self) -> None:
            match self._steps():
                case [""]:
                    self._file(marking.page, "text/html; charset=utf-8")
                case [name] if name in SHARED:
                    self._file(name, SHARED[name])
                case steps:
                    self._answer(lambda: None if steps is None else marking.shown(steps))

        def do_POST(self) -> None:
            length, steps = self.headers.get("Content-Length", ""), self._steps()
            if not length.isdigit() or int(length) > MOST_BYTES:
                self.close_connection = True
                self.send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
                return
            asked = self._asked(self.rfile.read(int(length)))
            self._answer(lambda: None if steps is None else marking.done(steps, asked))

        def _asked(self, content: bytes) -> Mapping[str, Any]:
            try:
                asked = json.loads(content)
            except (ValueError, RecursionError):
                asked = None
            return asked if isinstance(asked, dict) else {}

        def _file(self, name: str, kind: str) -> None:
            self._send(Path(__file__).with_name(name).read_bytes(), kind)

    return PageServer(Handler, port, "--port", SettingsError)
