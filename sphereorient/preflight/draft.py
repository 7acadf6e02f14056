"""The first experiment.yaml of new movies: what was measured is in it, what nobody measured is asked for."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sphereorient.files.draft import DraftKey
from sphereorient.files.whole_file import relative_path
from sphereorient.preflight.first_look import FirstLook

EXPOSURE = "s, how long the shutter is open; the ball's motion in this time is told from the blur of the optics"
FLOW = {"viscosity": 8.0e-6, "dissipation": 1.7, "u_rms": 0.61, "integral_length": 0.03, "integral_time": 0.3}


def experiment_keys(looks: Sequence[FirstLook], folder: Path, masks: Mapping[str, str] | None = None) -> list[DraftKey]:
    """Return the keys of an experiment.yaml in a folder, in their order; `masks`: files by camera."""
    cameras, one_camera = [one.name for one in looks], len(looks) == 1
    counts = ", ".join(f"{one.name} {len(one.movie)}" for one in looks)
    movies = {one.name: relative_path(one.movie.path, folder) for one in looks}
    made = "written beside this file" if one_camera else "`sphereorient calibrate` writes it"

    def each(value: Any) -> dict[str, Any]:
        return {name: value.format(name) if isinstance(value, str) else value for name in cameras}

    def key(name: str, comment: str, value: Any = ..., example: Any = None) -> DraftKey:
        return DraftKey(name=name, value=value, comment=comment, example=example)

    empty = "the scene without the ball, of the movie's size: better for short movies"
    hidden = "black where something that does not move hides the ball: `sphereorient mark` draws them"
    return [
        key("name", "free", folder.resolve().name),
        _rate_key(looks),
        key("exposure", EXPOSURE, example=0.0004),
        *_sphere_keys(looks),
        key("cameras", made, "cameras.yaml"),
        key("movies", f"frames: {counts}", movies),
        key("backgrounds", empty, example=each("empty_{}.png")),
        key("masks", hidden, masks or ..., each("mask_{}.png")),
        key("start", "frame of each movie that is the experiment's frame 0", example=each(0)),
        key("frames", "first, last + 1; all without it", example=[0, min(len(one.movie) for one in looks)]),
        key("flip", "mirrored movies: vertical, horizontal, both", example=each("vertical")),
        key("flow", "SI, for reports", example=FLOW),
    ]


def _rate_key(looks: Sequence[FirstLook]) -> DraftKey:
    rate = looks[0].rate_hz
    if rate is not None and all(one.rate_hz for one in looks):
        return DraftKey(name="times", value="movies", comment=f"time stamps of the files: usually {rate:.6g} Hz")
    played = next((f"; players show it at {one.movie.played_hz:g}" for one in looks if one.movie.played_hz), "")
    return DraftKey(name="frame_rate", comment=f"Hz, of the recording{played}", example=600.0, asked=True)


def _sphere_keys(looks: Sequence[FirstLook]) -> list[DraftKey]:
    stays = all(one.stays for one in looks)
    sizes = ", ".join(f"{one.diameter_px:.0f} px in {one.name}" for one in looks if one.diameter_px)
    unknown = "; null where it is not known: lengths are then in radii" if len(looks) == 1 and stays else ""
    size = f"mm{unknown} ({sizes or 'no ball was found'})"
    fixed = f"whether the ball only turns, in its place: {'' if stays else 'not '}so in these movies"
    return [
        DraftKey(name="sphere.diameter", comment=size, example=18.0, asked=True),
        DraftKey(name="sphere.texture", value="texture.png", comment="`sphereorient map` learns it from the movies"),
        DraftKey(name="sphere.fixed", value=stays, comment=fixed),
    ]


def camera_keys(
    look: FirstLook, vfov_deg: float, R: Sequence[Sequence[float]] | None = None, *, known: bool
) -> list[DraftKey]:
    """Return the keys of cameras.yaml for one camera of which at most the field of view is known.
    R: R_cam_lab, where the lab is not the camera's own frame.
    """
    height, width = look.movie.frame_shape
    entry: dict[str, Any] = {"model": "pinhole", "image_size": [width, height], "vfov_deg": vfov_deg}
    if R is not None:
        entry |= {"R": [list(row) for row in R], "T": [0.0, 0.0, 0.0]}
    told = "known" if known else "assumed: it hardly matters for a ball in its place"
    where = "the lab is the animal's frame: x ahead, y right, z down" if R else "the lab is the camera's frame"
    comment = f"field of view {told}; {where}"
    return [DraftKey(name=f"cameras.{look.name}", value=entry, comment=comment)]
