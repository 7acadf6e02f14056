"""A page in the browser on which people draw what hides the ball; it saves masks beside the experiment.

The server answers this machine alone, to who knows the random token of its address.
"""

import base64
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from http import HTTPStatus
from http.server import ThreadingHTTPServer
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.errors import ExperimentError, MovieError, refusal
from sphereorient.experiment import load_experiment
from sphereorient.experiment.experiment import Experiment, open_movies
from sphereorient.experiment.stream import given_mask
from sphereorient.files.page_server import HOST, PageHandler, new_token
from sphereorient.files.picture import write_picture
from sphereorient.files.whole_file import read_text, write_text, writing
from sphereorient.files.yaml_file import FAULTS, parse_yaml
from sphereorient.movies import Movie, flipped_picture
from sphereorient.preflight.first_look import FirstLook, look_at_movie
from sphereorient.search import GreySearch, crop_disk
from sphereorient.sphere import load_texture, orthographic_view

PAGE = Path(__file__).with_name("mark.html")
MOST_BYTES, MOST_SHAPES = 1_000_000, 200
FAR_PX = 1e5
Json = dict[str, Any]


@dataclass
class Marking:
    """An experiment whose masks are drawn; the handler of requests calls it from several threads."""

    path: Path
    token: str = field(default_factory=new_token)
    lock: Lock = field(default_factory=Lock)

    def __post_init__(self) -> None:
        self.experiment: Experiment = load_experiment(self.path)
        self.movies: dict[str, Movie] = open_movies(self.experiment)
        self.masks = {name: given_mask(self.experiment, name, movie.frame_shape) for name, movie in self.movies.items()}

    @cached_property
    def looks(self) -> dict[str, FirstLook]:
        """What each movie shows without any mask drawn here."""
        return {name: look_at_movie(name, movie, self.masks[name]) for name, movie in self.movies.items()}

    def state(self) -> Json:
        """Return what the page begins with."""
        return {
            "experiment": str(self.path),
            "cameras": [
                {
                    "name": name,
                    "movie": Path(movie.path).name,
                    "frames": len(movie),
                    "height": movie.frame_shape[0],
                    "width": movie.frame_shape[1],
                }
                for name, movie in self.movies.items()
            ],
        }

    def frame(self, name: str, number: int) -> bytes:
        """Return a frame as PNG, 8 bit, its brightest level white; MovieError where it cannot be decoded."""
        movie = self._movie(name)
        if not 0 <= number < len(movie):
            raise MovieError(
                refusal(f"frame {number}", expected=f"0 .. {len(movie) - 1}", got=str(number), do="choose another")
            )
        with self.lock:
            picture = movie.sample([number])[0]
        white = max(1.0, float(np.percentile(picture, 99.9)))
        return _png(np.clip(picture * (255.0 / white), 0, 255).astype(np.uint8))

    def mask(self, name: str) -> bytes:
        """Return what is hidden now as PNG: red, half transparent, where the mask is black."""
        height, width = self._movie(name).frame_shape
        shown = self.masks[name]
        picture = np.zeros((height, width, 4), np.uint8)
        if shown is not None:
            picture[~shown] = (0, 0, 255, 110)
        return _png(picture)

    def outline(self, name: str) -> Json:
        """Return the ball as a first look finds it in this movie: where, how large, and whether it stays."""
        self._movie(name)
        with self.lock:
            look = self.looks[name]
        if look.outline is None:
            return {"found": False}
        u, v, radius = look.outline.u_px, look.outline.v_px, look.outline.radius_px
        return {"found": True, "u": u, "v": v, "radius": radius, "stays": look.stays, "frame": look.frame}

    def rendered(self, name: str) -> Json:
        """Return the ball of `outline` as the texture map says it looks: a picture, and how much of it is explained.

        Raises:
            ExperimentError: no map, no ball, or none that the map explains.
            TextureError: the map cannot be read.
        """
        ball = self.outline(name)
        if not ball["found"]:
            do = "draw what hides it, or choose another camera"
            raise ExperimentError(refusal(name, expected="a ball", got="none in this movie", do=do))
        with self.lock:
            look, search = self.looks[name], self._search
            u, v, radius = ball["u"], ball["v"], ball["radius"]
            disk = torch.from_numpy(crop_disk(look.picture, u, v, radius, search.size_px))
            found = search.propose(disk[None])
            if not len(found.score):
                do = "another ball, or the map of another one, looks like this"
                raise ExperimentError(refusal(name, expected="a ball that the map explains", got="none", do=do))
            size = max(2, round(2 * radius))
            view = orthographic_view(size)
            grey = view.render(self._texture, found.R_view_body[0].float()).clamp(0, 1).numpy()
        height, width = look.movie.frame_shape
        left, top = round(u - size / 2 + 0.5), round(v - size / 2 + 0.5)
        picture = np.zeros((height + 2 * size, width + 2 * size, 4), np.uint8)  # wider: the ball may leave the picture
        place = picture[top + size : top + 2 * size, left + size : left + 2 * size]
        place[..., :3] = (255 * grey[..., None]).astype(np.uint8)
        place[..., 3] = 255 * view.inside.numpy()
        inside = picture[size : size + height, size : size + width]
        content = base64.b64encode(_png(np.ascontiguousarray(inside))).decode()
        return ball | {"explained": 100 * float(found.score[0]), "picture": f"data:image/png;base64,{content}"}

    @cached_property
    def _texture(self) -> torch.Tensor:
        path = self.experiment.texture_path
        if path is None or not path.exists():
            do = f"learn it: `sphereorient map {self.path.name} --out texture.png`"
            raise ExperimentError(refusal("sphere.texture", expected="a texture map", got=f"{path or 'none'}", do=do))
        return load_texture(path)

    @cached_property
    def _search(self) -> GreySearch:
        return GreySearch(self._texture)

    def save(self, name: str, shapes: Sequence[Mapping[str, Any]], *, keep: bool) -> Json:
        """Write the mask of a camera and name it in experiment.yaml; return what was done.
        Shapes hide (`hide`) or are all that is shown (`show`): polygons (`points`) or circles (`u`, `v`, `radius`), px.
        `keep`: what the old mask hides stays hidden.

        Raises:
            ExperimentError: impossible shapes, or nothing would be shown.
            OutputError: a file cannot be written.
        """
        height, width = self._movie(name).frame_shape
        old = self.masks[name] if keep else None
        shown = drawn_mask((height, width), shapes, old)
        flip = self.experiment.flip.get(name, "none")
        file = self.path.parent / f"{name}_mask.png"
        with self.lock:
            write_picture(file, flipped_picture(np.where(shown, 255, 0).astype(np.uint8), flip))
            self._name_mask(name, file.name)
            self.masks[name] = shown
            vars(self).pop("looks", None)
        return {"file": str(file), "hidden": 100 * float(np.mean(~shown))}

    def _name_mask(self, name: str, file: str) -> None:
        text = read_text(self.path, 1 << 24, "a YAML file", ExperimentError, "correct the path")
        masks = dict((parse_yaml(text) or {}).get("masks") or {})
        if masks.get(name) == file:
            return
        new, wanted = with_key(text, "masks", masks | {name: file}), masks | {name: file}
        try:
            right = parse_yaml(new) == parse_yaml(text) | {"masks": wanted}
        except FAULTS:
            right = False
        if not right:
            do = f"write masks: {{{name}: {file}}} there"
            raise ExperimentError(
                refusal(str(self.path), expected="a key masks in one line", got="another form", do=do)
            )
        with writing(force=True):
            write_text(self.path, new)

    def _movie(self, name: str) -> Movie:
        if name not in self.movies:
            expected, do = ", ".join(self.movies), "choose one of these"
            raise ExperimentError(refusal("camera", expected=expected, got=repr(name)[:40], do=do))
        return self.movies[name]


def drawn_mask(
    size: tuple[int, int], shapes: Sequence[Mapping[str, Any]], old: NDArray[np.bool_] | None
) -> NDArray[np.bool_]:
    """Return what a mask (H, W) shows after shapes are drawn, see `Marking.save`; raise ExperimentError for others."""
    if not isinstance(shapes, list | tuple) or len(shapes) > MOST_SHAPES:
        raise _refused("shapes", f"at most {MOST_SHAPES} of them", "another thing")
    hidden = np.zeros(size, np.uint8)
    region = np.zeros(size, np.uint8)
    for shape in shapes:
        kind = shape.get("kind") if isinstance(shape, Mapping) else None
        if kind not in ("hide", "show"):
            raise _refused("kind", "hide or show", repr(kind)[:40])
        target = hidden if kind == "hide" else region
        if "points" in shape:
            points = _numbers(shape["points"], "points")
            if points.ndim != 2 or points.shape[1] != 2 or len(points) < 3:
                raise _refused("points", "three pairs u, v or more", str(points.shape))
            cv2.fillPoly(target, [np.rint(points).astype(np.int32)], 255)
        else:
            u, v, radius = _numbers([shape.get(key) for key in ("u", "v", "radius")], "circle")
            cv2.circle(target, (round(u), round(v)), max(round(radius), 1), 255, cv2.FILLED)
    shown = hidden == 0
    if any(shape["kind"] == "show" for shape in shapes):
        shown &= region > 0
    if old is not None:
        shown &= old
    if not shown.any():
        raise _refused("mask", "a part of the picture that is shown", "all of it hidden")
    return np.asarray(shown)


def with_key(text: str, key: str, value: Mapping[str, str]) -> str:
    """Return a YAML text with a top-level key in one line, in place of one that is there, commented out or not."""
    line = f"{key}: {{{', '.join(f'{name}: {file}' for name, file in value.items())}}}"
    for pattern in (rf"^{key}:.*$", rf"^# {key}:.*$"):
        if re.search(pattern, text, re.MULTILINE):
            return re.sub(pattern, line, text, count=1, flags=re.MULTILINE)
    return f"{text.rstrip()}\n{line}\n"


def _numbers(values: object, name: str) -> NDArray[np.float64]:
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        raise _refused(name, "numbers, px", repr(values)[:40]) from None
    if not (np.isfinite(array).all() and (np.abs(array) < FAR_PX).all()):
        raise _refused(name, f"numbers below {FAR_PX:g} px", repr(values)[:40])
    return array


def _refused(name: str, expected: str, got: str) -> ExperimentError:
    return ExperimentError(refusal(name, expected=expected, got=got, do="draw it again"))


def _png(picture: NDArray[np.uint8]) -> bytes:
    return bytes(cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])


def serve(marking: Marking, port: int = 0) -> ThreadingHTTPServer:
    """Return a server of the page on this machine; call `serve_forever`. Port 0: any free one."""

    class Handler(PageHandler):
        token = marking.token

        def do_GET(self) -> None:
            match self._steps():
                case [""]:
                    self._send(PAGE.read_bytes(), "text/html; charset=utf-8")
                case ["state"]:
                    self._json(marking.state)
                case ["frame", name, number] if number.isdigit():
                    self._picture(lambda: marking.frame(name, int(number[:9])))
                case ["mask", name]:
                    self._picture(lambda: marking.mask(name))
                case ["outline", name]:
                    self._json(lambda: marking.outline(name))
                case ["rendered", name]:
                    self._json(lambda: marking.rendered(name))
                case _:
                    self.send_error(HTTPStatus.NOT_FOUND)

        def do_POST(self) -> None:
            length = self.headers.get("Content-Length", "")
            if not length.isdigit() or int(length) > MOST_BYTES:
                self.close_connection = True
                self.send_error(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
                return
            content = self.rfile.read(int(length))
            match self._steps():
                case ["save", name]:
                    self._json(lambda: self._saved(name, content))
                case _:
                    self.send_error(HTTPStatus.NOT_FOUND)

        def _saved(self, name: str, content: bytes) -> Json:
            try:
                asked = json.loads(content)
                shapes, keep = asked["shapes"], bool(asked["keep"])
            except (ValueError, TypeError, KeyError):
                raise _refused("request", "shapes and keep, as JSON", "another thing") from None
            return marking.save(name, shapes, keep=keep)

    return ThreadingHTTPServer((HOST, port), Handler)
