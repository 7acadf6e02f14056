"""A first look at unknown movies, and their experiment.yaml, with open keys for what was not measured."""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient.cameras import PinholeCamera
from sphereorient.cameras.model import focal_of_field, middle_of_picture
from sphereorient.errors import ExperimentError, MovieError
from sphereorient.experiment.recording import CameraStream
from sphereorient.files.picture import vertical_field_deg
from sphereorient.files.threads import Progress, counted, side_by_side, silent
from sphereorient.files.whole_file import relative_path
from sphereorient.files.yaml_file import DraftKey
from sphereorient.locate import LocateSettings
from sphereorient.locate.outline import Outline
from sphereorient.locate.scene import CameraScene, fixed_ball, given_outline, still_ball, swaying_ball, wander_px
from sphereorient.movies import Movie, movie_files, open_movie
from sphereorient.movies.stamps import rate_of
from sphereorient.preflight.sample import sample_movie

WIDE_DEG = 30.0  # field of view in the example
STAYS, NEAR = 0.15, 1.0  # of the radius: a ball is fixed if its outlines scatter, or lie apart, by less
FIRM = 0.05  # likewise, if all pictures together show no outline
PARTS, LEAST = 5, 4  # of the pictures, for the outline of a fixed ball; least pictures of a part
SURE_PX, SURE_SHARE = 1.0, 0.03  # px, share of the radius: outlines of parts that differ by more than both are doubtful
AGREES = 0.05  # of the radius: a given circle that differs by less
SEEN, ALWAYS = 0.4, 0.99  # least share of the frames with a ball that moves; that sinks slowly
PICTURES, SLOW_PICTURES = 40, 100  # spread over the movie, for a ball that is fixed, or sways
EXPOSURE = "s, how long the shutter is open; separates motion blur from the blur of the optics"
DEVICE = {"trigger": "Line1", "exposure_ms": 0.4, "rate_hz": 600.0, "pixel_format": "Mono8", "offset": [0, 0]}
FLOW = {"viscosity": 8.0e-6, "dissipation": 1.7, "u_rms": 0.61, "integral_length": 0.03, "integral_time": 0.3}


@dataclass(frozen=True, kw_only=True, eq=False)
class FirstLook:
    """Findings of a first look at a movie; made by `look_at`."""

    name: str  # of its camera
    movie: Movie
    rate_hz: float | None  # by exact time stamps; None: the file has none
    diameter_px: float | None  # None: no ball was found
    stays: bool | None  # whether the ball is fixed; None: not known
    sways: bool = False  # whether it moves a little in its place
    found: int  # of `looked`, with a ball: frames, or parts of the movie if the outline is of all pictures together
    looked: int
    apart_px: float = math.nan  # largest difference of these outlines in u, v or radius
    together: bool = False  # whether the outline is that of all pictures together, as `track` finds it
    given: tuple[float, float, float] | None = None  # a given circle: u, v, radius, px
    frame: int  # one with the ball, if found
    picture: NDArray[Any]  # (H, W), of this frame
    outline: Outline | None  # of the ball in it
    vfov_deg: float | None = None  # field of view, by the tags of a photograph

    @property
    def photograph(self) -> bool:
        """Whether the movie is one picture."""
        return len(self.movie) == 1

    @property
    def differs(self) -> bool:
        """Whether the outline is not the circle that was given."""
        if self.given is None or self.outline is None:
            return False
        return float(np.abs(np.subtract(self.given, self.outline.circle)).max()) > AGREES * self.outline.radius_px

    @property
    def doubtful(self) -> bool:
        """Whether the outline of a fixed ball is uncertain, and no given circle agrees."""
        if not self.stays or self.sways or self.photograph or self.outline is None:
            return False
        alone = not self.together or self.found < self.looked - 1
        apart = self.apart_px > max(SURE_PX, SURE_SHARE * self.outline.radius_px)
        return self.differs or ((alone or apart) and self.given is None)

    def words(self) -> str:
        """Describe the ball."""
        if self.diameter_px is None or self.outline is None:
            return "no ball was found: check the light, and whether anything else moves"
        seen = f"found in {self.found} of {self.looked} {'parts of the movie' if self.together else 'frames'}"
        seen += f", {self.apart_px:.1f} px apart" if math.isfinite(self.apart_px) else ""
        seen = "as given, as the movie shows none clearly" if self.given == self.outline.circle else seen
        stays = "sways in its place" if self.sways else f"fixed, outline {seen}"
        where = "one picture" if self.photograph else stays if self.stays else f"moves, {seen}"
        words = f"ball of {self.diameter_px:.{int(bool(self.stays))}f} px, {where}"
        if self.given is not None and self.given != self.outline.circle:
            u, v, radius = self.given
            words += f"; the given circle, {2 * radius:.1f} px about ({u:.1f}, {v:.1f}), "
            words += "differs: the found outline is used" if self.differs else "agrees"
        return f"{words}; DOUBTFUL: see the picture, draw it with `sphereorient mark`" if self.doubtful else words


def with_circle(look: FirstLook, circle: tuple[float, float, float] | None) -> FirstLook:
    """Return a look at a fixed ball with a given circle (u, v, radius, px), used if the pictures show none."""
    if circle is None or look.together:
        return replace(look, stays=True, given=circle)
    return replace(look, stays=True, given=circle, outline=given_outline(circle), diameter_px=2 * circle[2])


def look_at(
    paths: Sequence[Path | str], progress: Progress = silent, shown: NDArray[np.bool_] | None = None
) -> list[FirstLook]:
    """Look at the movies of one ball; `shown` (H, W): False where a single movie's ball is hidden. Raise MovieError."""
    movies = [open_movie(path) for path in paths]
    each = side_by_side(lambda k: look_at_movie(f"cam{k + 1}", movies[k], shown), range(len(movies)))
    return agreed(list(counted("look", each, len(movies), progress)))


def agreed(looks: Sequence[FirstLook]) -> list[FirstLook]:
    """Return consistent looks at one ball: if it moves in one movie, it moves in all (a short movie may hide it)."""
    moves = not all(one.stays for one in looks)
    return [replace(one, stays=None, sways=False, together=False) if moves and one.sways else one for one in looks]


def look_at_movie(name: str, movie: Movie, shown: NDArray[np.bool_] | None = None) -> FirstLook:
    """Look at the movie of a camera; `shown` (H, W) is False where something hides the ball."""
    settings, stream = LocateSettings(), _stream(name, movie, shown)
    find = still_ball if stream.photograph else fixed_ball
    sample = sample_movie(stream, None, settings)
    outlines = [outline for _, outline in sample.balls]
    with_ball = [k for k, (outline, _) in enumerate(sample.found) if outline is not None]
    readable = [k for k, picture in enumerate(sample.picture) if picture is not None]
    k, looked = with_ball[len(with_ball) // 2] if with_ball else readable[0], len(readable)
    picture, outline = sample.picture[k], sample.found[k][0]
    assert picture is not None
    seen, near, sways, stays, firm = len(outlines) >= SEEN * looked, True, False, None, False
    found, apart_px, together = len(outlines), math.nan, False
    if seen:
        places = np.array([(one.u_px, one.v_px) for one in outlines])
        radius_px = float(np.median([one.radius_px for one in outlines]))
        away = np.hypot(*(places - np.median(places, axis=0)).T) / radius_px
        stays, near, firm = bool(np.median(away) < STAYS), bool(away.max() < NEAR), bool(np.median(away) < FIRM)
    if stays or not seen:
        try:
            outline, background = find(pictures := stream.spread(PICTURES), settings, shown=shown)
            seen, stays, radius_px = True, True, outline.radius_px
            scene = CameraScene(background=background, diameter_px=2 * radius_px)
            sways = not stream.photograph and wander_px(pictures, scene, settings) > 0
            found, looked, apart_px = _again(pictures, outline, settings, shown)
            together = True
        except (ExperimentError, MovieError):
            stays = None
    if not (stays or stream.photograph) and near and (not seen or len(outlines) > ALWAYS * looked):
        with suppress(ExperimentError, MovieError):
            # A ball that sinks slowly hardly moves in a few frames.
            outline, _ = swaying_ball(stream.spread(SLOW_PICTURES), settings, shown=shown)
            seen, stays, sways, together, radius_px = True, True, True, True, outline.radius_px
    if stays is None and firm:
        circles = np.array([one.circle for one in outlines])
        (u, v, radius_px), stays = np.median(circles, axis=0).tolist(), True
        apart_px = 1.4826 * float(np.median(np.abs(circles - (u, v, radius_px)), axis=0).max())
        outline = replace(outlines[0], u_px=u, v_px=v, radius_px=radius_px)
    rate_hz = None if movie.times_s is None or len(movie) < 2 else rate_of(movie.times_s)
    return FirstLook(
        name=name,
        movie=movie,
        rate_hz=rate_hz,
        diameter_px=2 * radius_px if seen else None,
        stays=stays,
        sways=sways,
        found=found,
        looked=looked,
        apart_px=apart_px,
        together=together,
        frame=int(sample.row[k]),
        picture=picture,
        outline=outline if seen else None,
        vfov_deg=vertical_field_deg(movie_files(movie.path)[0]) if stream.photograph else None,
    )


def _again(
    pictures: NDArray[Any], outline: Outline, settings: LocateSettings, shown: NDArray[np.bool_] | None
) -> tuple[int, int, float]:
    """Return parts of pictures (n, H, W) with a fixed ball, number of parts, and largest difference of outlines, px."""
    parts, circles = max(1, min(PARTS, len(pictures) // LEAST)), []
    for k in range(parts):
        with suppress(ExperimentError):
            circles.append(fixed_ball(pictures[k::parts], settings, shown=shown)[0].circle)
    return len(circles), parts, float(np.abs(np.subtract(circles, outline.circle)).max()) if circles else math.nan


def _stream(name: str, movie: Movie, shown: NDArray[np.bool_] | None) -> CameraStream:
    """Return a movie with a dummy camera: the search in pictures alone needs none."""
    height, width = movie.frame_shape
    pose: dict[str, Any] = {"R_cam_lab": torch.eye(3, dtype=torch.float64), "T_cam_lab_mm": (0.0,) * 3}
    lens: dict[str, Any] = {"f_px": 2.0 * height, "centre_px": middle_of_picture((width, height))}
    camera = PinholeCamera(image_size=(width, height), **lens, **pose)
    return CameraStream(name=name, camera=camera, movie=movie, rows=np.arange(len(movie)), shown=shown)


def experiment_keys(looks: Sequence[FirstLook], folder: Path, masks: Mapping[str, str] | None = None) -> list[DraftKey]:
    """Return the keys of an experiment.yaml in a folder, in their order; `masks`: files by camera."""
    cameras, one_camera = [one.name for one in looks], len(looks) == 1
    counts = ", ".join(f"{one.name} {len(one.movie)}" for one in looks)
    movies = {one.name: relative_path(one.movie.path, folder) for one in looks}
    made = "written beside this file" if one_camera else "`sphereorient calibrate` writes it"

    def each(value: Any) -> dict[str, Any]:
        return {name: value.format(name) if isinstance(value, str) else value for name in cameras}

    circles = {one.name: [round(part, 1) for part in one.outline.circle] for one in looks if one.stays and one.outline}
    lost = any(one.stays and not one.together for one in looks)  # without a circle `track` does not find it
    taken = lost and all(one.given for one in looks)
    found = "DOUBTFUL, draw it: `sphereorient mark`" if any(one.doubtful for one in looks) else "found without this key"

    def key(name: str, comment: str, value: Any = ..., example: Any = None) -> DraftKey:
        return DraftKey(name=name, value=value, comment=comment, example=example)

    empty = "the scene without the ball, in the movie's size: better for short movies"
    hidden = "black where a static object hides the ball: `sphereorient mark` draws them"
    return [
        key("name", "free", folder.resolve().name),
        *_rate_keys(looks),
        key("exposure", EXPOSURE, example=0.0004),
        *_sphere_keys(looks),
        key("cameras", made, "cameras.yaml"),
        key("movies", f"frames: {counts}", movies),
        key("backgrounds", empty, example=each("empty_{}.png")),
        key("masks", hidden, masks or ..., each("mask_{}.png")),
        DraftKey(
            name="circles",
            value=circles if taken else ...,
            comment=f"outline of a fixed ball, u, v, radius, px: {found}",
            example=circles or each([320.0, 240.0, 90.0]),
            asked=lost,
        ),
        key("start", "frame of each movie that is the experiment's frame 0", example=each(0)),
        key("frames", "first, last + 1; default: all", example=[0, min(len(one.movie) for one in looks)]),
        key("flip", "mirrored movies: vertical, horizontal, both, transpose", example=each("vertical")),
        key("response", "of the cameras: linear, srgb, {gamma: 2.2}, or a table; default: learnt", example="srgb"),
        key("flow", "SI, for reports", example=FLOW),
        key("camera", "settings of each device for `live`; trigger: none runs freely", example=each(DEVICE)),
    ]


def _rate_keys(looks: Sequence[FirstLook]) -> list[DraftKey]:
    if all(one.photograph for one in looks):
        return [DraftKey(name="frame_rate", value=1.0, comment="Hz; any value, for one picture")]
    rate = looks[0].rate_hz
    if rate is not None and all(one.rate_hz for one in looks):
        times = DraftKey(name="times", value="movies", comment=f"time stamps of the files: usually {rate:.6g} Hz")
        units = f"of these stamps, not stated in the files: s, or, judged by their size, {looks[0].movie.likely_units}"
        asked = DraftKey(name="time_unit", comment=units, example="ms", asked=True)
        return [times, asked] if looks[0].movie.likely_units else [times]
    played = next((f"; players show it at {one.movie.played_hz:g}" for one in looks if one.movie.played_hz), "")
    return [DraftKey(name="frame_rate", comment=f"Hz, of the recording{played}", example=600.0, asked=True)]


def _sphere_keys(looks: Sequence[FirstLook]) -> list[DraftKey]:
    stays: bool | str = all(one.stays for one in looks)
    sizes = ", ".join(f"{one.diameter_px:.0f} px in {one.name}" for one in looks if one.diameter_px)
    photograph = len(looks) == 1 and looks[0].photograph
    unknown = "; null if unknown: lengths are then in radii" if len(looks) == 1 and stays else ""
    size = f"mm{unknown} ({sizes or 'no ball was found'})"
    fixed = f"whether the ball only rotates, in its place: {'yes' if stays else 'no'} in these movies"
    if stays and any(one.sways for one in looks):
        stays, fixed = "sways", "true, false, or sways: it rotates in its place, but sways or sinks in these movies"
    if looks[0].photograph:
        stays, fixed = False, "whether the ball only rotates, in its place: irrelevant for one picture"
    return [
        DraftKey(name="sphere.diameter", value=None if photograph else ..., comment=size, example=18.0, asked=True),
        DraftKey(name="sphere.texture", value="texture.png", comment="`sphereorient track` learns it from the movies"),
        DraftKey(name="sphere.fixed", value=stays, comment=fixed),
    ]


def field_key(look: FirstLook, vfov_deg: float | None) -> DraftKey:
    """Return the field of view of a single camera as an open key; the comment gives the effect of a wrong value."""
    known, height = vfov_deg or look.vfov_deg, look.movie.frame_shape[0]
    focal_px = focal_of_field(height, WIDE_DEG)
    limb_deg = math.degrees(math.atan((look.diameter_px or height / 2) / 2 / focal_px))
    wrong = f"{WIDE_DEG:g} instead of 1 moves paint at this ball's limb by {limb_deg:.0f} degrees"
    comment = f"field of view, degrees, top to bottom of the picture: 2 atan(height of the sensor / 2 f); {wrong}"
    name = f"cameras.{look.name}.vfov_deg"
    return DraftKey(name=name, value=known or ..., comment=comment, example=WIDE_DEG, asked=True)


def camera_keys(
    look: FirstLook, field: DraftKey, R: Sequence[Sequence[float]] | None = None, model: str = "pinhole"
) -> list[DraftKey]:
    """Return the keys of cameras.yaml for one camera, with the field of view of `field_key`; R: R_cam_lab, if known."""
    height, width = look.movie.frame_shape
    where = "the lab is the animal's frame: x ahead, y right, z down" if R else "the lab is the camera's frame"
    if field.value is not ...:
        field = replace(field, comment="degrees, " + ("by EXIF" if field.value == look.vfov_deg else "as given"))
    values = {"model": model, "image_size": [width, height], field.name.rpartition(".")[2]: field.value}
    values |= {} if R is None else {"R": [list(row) for row in R], "T": [0.0, 0.0, 0.0]}
    comments = {"model": where, "image_size": "W, H px", "R": "rows: the camera's axes in the lab"}
    known = [
        DraftKey(name=f"cameras.{look.name}.{name}", value=value, comment=comments.get(name, ""))
        for name, value in values.items()
    ]
    return [field if key.name == field.name else key for key in known]
