"""Server of the pages for marking masks or fiducials; it answers local requests with the token of its address only."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from threading import Lock
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import SettingsError, SphereOrientError, refusal
from sphereorient.files.page_server import Answer, Json, PageServer, listen, new_token
from sphereorient.files.whole_file import TEXT_BYTES, read_text, write_text, writing
from sphereorient.files.yaml_file import read_yaml, with_value

HERE, SHARED = Path(__file__).parent, ("mark.css", "mark.js")  # beside the pages


class Marking(ABC):
    """A YAML file and the page that writes marks into it; called from several threads."""

    page: ClassVar[str]  # name of its file
    error: ClassVar[type[SphereOrientError]]

    def __init__(self, path: Path) -> None:
        self.path = path
        self.token = new_token()
        self.lock = Lock()

    def shown(self, steps: Sequence[str]) -> Answer:
        """Return the content at a path behind the token: here the files of the page; None: nothing."""
        match steps:
            case [""]:
                return HERE / self.page
            case [name] if name in SHARED:
                return HERE / name
        return None

    @abstractmethod
    def done(self, steps: Sequence[str], asked: Mapping[str, Any]) -> Json | None:
        """Execute the request at a path and return its result; None: no such request."""

    def refused(self, name: str, expected: str, got: str, do: str) -> SphereOrientError:
        """Return an error of the file's kind, worded by `refusal`."""
        return self.error(refusal(name, expected=expected, got=got, do=do))

    def read(self) -> Any:
        """Return the present values of the file."""
        return read_yaml(self.path, self.error)

    def write(self, place: Sequence[str | int], value: Any, by_hand: str) -> None:
        """Write a value in one line of the file, see `with_value`; `by_hand`: what the user does if that fails."""
        old = read_text(self.path, TEXT_BYTES, "a YAML file", self.error, "correct the path")
        text = with_value(old, place, value)
        if text is None:
            expected = f"a key {place[-1]} in one line, or room for it"
            raise self.refused(str(self.path), expected, "another form", by_hand)
        with writing(force=True):
            write_text(self.path, text)


def png(picture: NDArray[np.uint8]) -> bytes:
    """Return a picture as a PNG file, quickly."""
    return bytes(cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])


def serve(marking: Marking, port: int = 0) -> PageServer:
    """Return a server of the page; call `serve_forever`. Raise SettingsError for a port in use."""
    return PageServer(marking, listen(port, "--port", SettingsError), marking.token)
