"""The first experiment.yaml of new movies: what was measured is in it, what nobody measured is asked for."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sphereorient.files.draft import DraftKey
from sphereorient.files.whole_file import relative_path
from sphereorient.preflight.first_look import FirstLook

EXPOSURE = "s, how long the shutter is open; the ball's motion in this time is told from the blur of the optics"
RATE = "Hz, of the recording"


def experiment_keys(looks: Sequence[FirstLook], folder: Path, masks: Mapping[str, str] | None = None) -> list[DraftKey]:
    """Return the keys of an experiment.yaml in a folder, in their order; `masks`: files by camera."""
    sizes = ", ".join(f"{one.diameter_px:.0f} px in {one.name}" for one in looks if one.diameter_px)
    stamped = all(one.rate_hz for one in looks)
    one_camera, stays = len(looks) == 1, all(one.stays for one in looks)
    diameter = "mm" + ("; null where it is not known: lengths are then in radii" if one_camera and stays else "")
    cameras = [one.name for one in looks]

    def each(what: str) -> dict[str, Any]:
        return {camera: what.format(camera) for camera in cameras}

    counts = ", ".join(f"{one.name} {len(one.movie)}" for one in looks)
    keys = [DraftKey(name="name", value=folder.resolve().name, comment="free")]
    if stamped:
        rate = looks[0].rate_hz
        keys.append(DraftKey(name="times", value="movies", comment=f"time stamps of the files: usually {rate:.6g} Hz"))
    else:
        played = next((one.movie.played_hz for one in looks if one.movie.played_hz), None)
        told = f"{RATE}; players show it at {played:g}" if played else RATE
        keys.append(DraftKey(name="frame_rate", comment=told, example=600.0, asked=True))
    return [
        *keys,
        DraftKey(name="exposure", comment=EXPOSURE, example=0.0004),
        DraftKey(
            name="sphere.diameter", comment=f"{diameter} ({sizes or 'no ball was found'})", example=18.0, asked=True
        ),
        DraftKey(name="sphere.texture", value="texture.png", comment="`sphereorient map` learns it from the movies"),
        DraftKey(
            name="sphere.fixed",
            value=stays,
            comment=f"whether the ball only turns, in its place: {'' if stays else 'not '}so in these movies",
        ),
        DraftKey(
            name="cameras",
            value="cameras.yaml",
            comment="`sphereorient calibrate` writes it" if not one_camera else "written beside this file",
        ),
        DraftKey(
            name="movies",
            value={one.name: relative_path(one.movie.path, folder) for one in looks},
            comment=f"frames: {counts}",
        ),
        DraftKey(
            name="backgrounds",
            comment="the scene without the ball, of the movie's size: better for short movies",
            example=each("empty_{}.png"),
        ),
        DraftKey(
            name="masks",
            value=masks or ...,
            comment="black where something that does not move hides the ball: `sphereorient mark` draws them",
            example=each("mask_{}.png"),
        ),
        DraftKey(
            name="start",
            comment="frame of each movie that is the experiment's frame 0",
            example=dict.fromkeys(cameras, 0),
        ),
        DraftKey(
            name="frames", comment="first, last + 1; all without it", example=[0, min(len(one.movie) for one in looks)]
        ),
        DraftKey(name="flip", comment="mirrored movies: vertical, horizontal, both", example=each("vertical")),
        DraftKey(
            name="flow",
            comment="SI, for reports",
            example={
                "viscosity": 8.0e-6,
                "dissipation": 1.7,
                "u_rms": 0.61,
                "integral_length": 0.03,
                "integral_time": 0.3,
            },
        ),
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
