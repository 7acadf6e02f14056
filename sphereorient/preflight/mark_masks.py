"""Masks drawn in the browser, and other keys tried there on a short clip."""

import base64
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.cameras import Camera, PinholeCamera, field_of_focal, load_cameras
from sphereorient.cameras.model import focal_of_field
from sphereorient.errors import CameraError, ExperimentError, MovieError, refusal
from sphereorient.experiment import load_experiment
from sphereorient.experiment.experiment import Experiment, open_movies, response_of
from sphereorient.experiment.recording import given_mask
from sphereorient.files.page_server import Answer, Json
from sphereorient.files.picture import eight_bits, write_picture
from sphereorient.files.whole_file import TEXT_BYTES, read_text, write_text, writing
from sphereorient.files.yaml_file import flow, parse_yaml, with_value
from sphereorient.movies import Movie, flipped_picture
from sphereorient.preflight.clip import Clip
from sphereorient.preflight.first_look import FirstLook, agreed, look_at_movie
from sphereorient.preflight.mark import Marking, png
from sphereorient.search import GreySearch, crop_disk
from sphereorient.sphere import load_texture, orthographic_view

Bools = NDArray[np.bool_]
MOST_SHAPES = 200  # of a mask
FAR_PX = 1e5


class MaskMarking(Marking):
    """An experiment with masks to draw, and circle, light and field of view to try."""

    page = "mark_masks.html"
    error = ExperimentError

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.experiment: Experiment = load_experiment(self.path)
        self.movies: dict[str, Movie] = open_movies(self.experiment)
        self.masks = {name: given_mask(self.experiment, name, movie.frame_shape) for name, movie in self.movies.items()}

    @cached_property
    def looks(self) -> dict[str, FirstLook]:
        """First looks at the movies, without the masks drawn here."""
        looks = agreed([look_at_movie(name, movie, self.masks[name]) for name, movie in self.movies.items()])
        return {look.name: look for look in looks}

    @cached_property
    def clip(self) -> Clip:
        """The first frames, to be tracked again."""
        return Clip(self.experiment)

    def shown(self, steps: Sequence[str]) -> Answer:
        """Return the state, a frame, a mask, an outline or a rendered ball."""
        match steps:
            case ["state"]:
                return self.state()
            case ["frame", name, number] if number.isdecimal():
                return self.frame(name, int(number[:9]))
            case ["mask", name]:
                return self.mask(name)
            case ["outline", name]:
                return self.outline(name)
            case ["rendered", name]:
                return self.rendered(name)
        return super().shown(steps)

    def done(self, steps: Sequence[str], asked: Mapping[str, Any]) -> Json | None:
        """Save a camera's mask of `shapes` and `keep`; or track a clip with these and other keys; or save those."""
        match steps:
            case ["save" | "track" | "adopt" as what, name]:
                if not {"shapes", "keep"} <= set(asked):
                    raise _refused("request", "shapes and keep, as JSON", "another thing")
                if what == "save":
                    return self.save(name, asked["shapes"], keep=bool(asked["keep"]))
                return self.track(name, asked) if what == "track" else self.adopt(name, asked)
        return None

    def state(self) -> Json:
        """Return the initial state of the page."""
        return {
            "experiment": str(self.path),
            "cameras": [
                {"name": name, "movie": Path(movie.path).name, "frames": len(movie)}
                | dict(zip(("height", "width"), movie.frame_shape, strict=True))
                | {"circle": self.experiment.circles.get(name), "vfov_deg": _vfov_deg(self.experiment.cameras[name])}
                for name, movie in self.movies.items()
            ],
            "tries": self.experiment.alone and self.experiment.fixed,
        }

    def track(self, name: str, asked: Mapping[str, Any]) -> Json:
        """Track the clip with `shapes` and `keep` of a mask, and `circle`, `light`, `vfov_deg` if given."""
        with self.lock, tempfile.TemporaryDirectory() as folder:
            return self.clip.tracked(self._changed(name, asked, Path(folder)))

    def _changed(self, name: str, asked: Mapping[str, Any], folder: Path) -> Experiment:
        shown = drawn_mask(self._movie(name).frame_shape, asked["shapes"], self.masks[name] if asked["keep"] else None)
        write_picture(folder / "mask.png", self._as_filmed(name, shown))
        tried = replace(self.experiment, mask_paths=self.experiment.mask_paths | {name: folder / "mask.png"})
        if asked.get("circle") is not None:
            tried = replace(tried, circles=tried.circles | {name: _circle(asked["circle"])})
        if asked.get("light") is not None:
            tried = replace(tried, response=tried.response | {name: response_of("light", asked["light"])})
        if asked.get("vfov_deg") is not None:
            write_text(folder / "cameras.yaml", self._cameras(name, asked["vfov_deg"]))
            known = load_cameras(folder / "cameras.yaml")
            tried = replace(tried, cameras={one: known[one] for one in tried.cameras})
        return tried

    def adopt(self, name: str, asked: Mapping[str, Any]) -> Json:
        """Write the values of `track` into mask, experiment.yaml and cameras.yaml; other lines stay."""
        with self.lock, tempfile.TemporaryDirectory() as folder:
            tried = self._changed(name, asked, Path(folder))  # checks all of it first
        keys: Json = {}
        if asked.get("circle") is not None:
            new = [round(part, 2) for part in tried.circles[name]]
            keys["circles"] = dict(self.read().get("circles") or {}) | {name: new}
        if asked.get("light") is not None:
            old = self.read().get("response")
            each = old if isinstance(old, dict) and old.keys() != {"gamma"} else dict.fromkeys(self.movies, old)
            keys["response"] = {one: part for one, part in (each | {name: asked["light"]}).items() if part is not None}
        files = []
        with self.lock:
            for key, value in keys.items():
                self.write([key], value, f"write {key}: {flow(value)} there")
            if asked.get("vfov_deg") is not None:
                with writing(force=True):
                    write_text(tried.cameras_path, self._cameras(name, asked["vfov_deg"]))
                files.append(str(tried.cameras_path))
        if asked["shapes"]:  # last: least likely to fail
            files.append(self.save(name, asked["shapes"], keep=bool(asked["keep"]))["file"])
        self.experiment = load_experiment(self.path)
        return {"files": [*files, str(self.path)]}

    def _as_filmed(self, name: str, shown: Bools) -> NDArray[np.uint8]:
        """Return a mask as a picture, flipped as the movie's file is."""
        return flipped_picture(np.where(shown, 255, 0).astype(np.uint8), self.experiment.flip.get(name, "none"))

    def _cameras(self, name: str, vfov_deg: object) -> str:
        """Return the text of cameras.yaml with another field of view of a camera."""
        (angle,) = _numbers([vfov_deg], "vfov_deg").tolist()
        path = self.experiment.cameras_path
        text = read_text(path, TEXT_BYTES, "cameras", CameraError, "correct the path")
        entry = parse_yaml(text)["cameras"][name]
        height = self.experiment.cameras[name].image_size[1]
        in_px = "vfov_deg" not in entry and "f_px" in entry
        key, value = ("f_px", focal_of_field(height, angle)) if in_px else ("vfov_deg", angle)
        new = with_value(text, ["cameras", name, key], value)
        if new is None or "fx" in entry:
            do = f"write vfov_deg: {angle:g} of {name} there by hand"
            raise CameraError(refusal(str(path), expected="a key vfov_deg in a line", got="another form", do=do))
        return new

    def frame(self, name: str, number: int) -> bytes:
        """Return a frame as PNG, 8 bit, the brightest level white. Raises MovieError if it cannot be decoded."""
        movie = self._movie(name)
        if number >= len(movie):
            expected = f"0 .. {len(movie) - 1}"
            raise MovieError(refusal(f"frame {number}", expected=expected, got=str(number), do="choose another"))
        with self.lock:
            return png(eight_bits(movie.sample([number])[0]))

    def mask(self, name: str) -> bytes:
        """Return the present mask as PNG: red, half transparent, where it hides."""
        picture = np.zeros((*self._movie(name).frame_shape, 4), np.uint8)
        if (shown := self.masks[name]) is not None:
            picture[~shown] = (0, 0, 255, 110)
        return png(picture)

    def outline(self, name: str) -> Json:
        """Return outline, size and rest of the ball by a first look at this movie."""
        self._movie(name)
        with self.lock:
            look = self.looks[name]
        if look.outline is None:
            return {"found": False, "words": look.words()}
        circle = dict(zip(("u", "v", "radius"), look.outline.circle, strict=True))
        return circle | {"found": True, "stays": look.stays, "frame": look.frame, "words": look.words()}

    def rendered(self, name: str) -> Json:
        """Render the ball of `outline` from the texture map; return the picture and the share that it explains. Raises
        ExperimentError (no map, no ball, or the map does not fit), TextureError (the map cannot be read).
        """
        ball = self.outline(name)
        if not ball["found"]:
            raise self.refused(name, "a ball", "none in this movie", "mask what hides it, or choose another camera")
        with self.lock:
            look, search = self.looks[name], self._search
            u, v, radius = ball["u"], ball["v"], ball["radius"]
            disk = torch.from_numpy(crop_disk(look.picture, u, v, radius, search.size_px))
            found = search.propose(disk[None])
            if not len(found.score):
                do = "check sphere.texture: the map may be of another ball"
                raise self.refused(name, "a ball that the map explains", "none", do)
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
        content = base64.b64encode(png(np.ascontiguousarray(inside))).decode()
        return ball | {"explained": 100 * float(found.score[0]), "picture": f"data:image/png;base64,{content}"}

    @cached_property
    def _texture(self) -> torch.Tensor:
        path = self.experiment.texture_path
        if path is None or not path.exists():
            do = f"learn it: `sphereorient map {self.path.name} --out texture.png`"
            raise self.refused("sphere.texture", "a texture map", f"{path or 'none'}", do)
        return load_texture(path)

    @cached_property
    def _search(self) -> GreySearch:
        return GreySearch(self._texture)

    def save(self, name: str, shapes: Sequence[Mapping[str, Any]], *, keep: bool) -> Json:
        """Write the mask of a camera and name it in experiment.yaml. Shapes hide their inside (`hide`) or outside
        (`show`): polygons (`points`) or circles (`u`, `v`, `radius`), px; `keep`: add to the old mask. Raises
        ExperimentError (impossible shapes, or all is hidden), OutputError (a file cannot be written).
        """
        shown = drawn_mask(self._movie(name).frame_shape, shapes, self.masks[name] if keep else None)
        file = self.path.parent / f"{name}_mask.png"
        with self.lock:
            write_picture(file, self._as_filmed(name, shown))
            masks = dict((self.read() or {}).get("masks") or {})
            if masks.get(name) != file.name:
                self.write(["masks"], masks | {name: file.name}, f"write masks: {{{name}: {file.name}}} there")
            self.masks[name] = shown
            vars(self).pop("looks", None)
        return {"file": str(file), "hidden": 100 * float(np.mean(~shown))}

    def _movie(self, name: str) -> Movie:
        if name not in self.movies:
            raise self.refused("camera", ", ".join(self.movies), repr(name)[:40], "choose one of these")
        return self.movies[name]


def _vfov_deg(camera: Camera) -> float | None:
    return field_of_focal(camera.image_size[1], float(camera.f_px)) if isinstance(camera, PinholeCamera) else None


def drawn_mask(size: tuple[int, int], shapes: Sequence[Mapping[str, Any]], old: Bools | None) -> Bools:
    """Return a mask (H, W), True: shown, with shapes drawn, see `MaskMarking.save`. Raises ExperimentError."""
    if not isinstance(shapes, list | tuple) or len(shapes) > MOST_SHAPES:
        raise _refused("shapes", f"at most {MOST_SHAPES} of them", "another thing")
    hidden, region = np.zeros((2, *size), np.uint8)
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
    shown = np.asarray(shown if old is None else shown & old)
    if not shown.any():
        raise _refused("mask", "a part of the picture that is shown", "all of it hidden")
    return shown


def _numbers(values: object, name: str) -> NDArray[np.float64]:
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        raise _refused(name, "numbers, px", repr(values)[:40]) from None
    if not (np.isfinite(array).all() and (np.abs(array) < FAR_PX).all()):
        raise _refused(name, f"numbers below {FAR_PX:g} px", repr(values)[:40])
    return array


def _circle(values: object) -> tuple[float, float, float]:
    circle = _numbers(values, "circle")
    if circle.shape != (3,) or not circle[2] > 0:
        raise _refused("circle", "u, v and a radius, px", repr(values)[:40])
    u, v, radius = circle.tolist()
    return u, v, radius


def _refused(name: str, expected: str, got: str) -> ExperimentError:
    return ExperimentError(refusal(name, expected=expected, got=got, do="draw it again"))
