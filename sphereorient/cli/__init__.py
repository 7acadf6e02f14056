"""The command line: parse, call, print. Heavy packages are imported inside the commands, so that help is quick."""

from sphereorient.cli import (
    about,
    bench,
    calibrate,
    check,
    compare_maps,
    convert_cameras,
    export,
    map,
    movie,
    overlay,
    report,
    score,
    synth,
    texture,
    track,
    train,
    view,
)
from sphereorient.cli.app import app, main

__all__ = [
    "about",
    "app",
    "bench",
    "calibrate",
    "check",
    "compare_maps",
    "convert_cameras",
    "export",
    "main",
    "map",
    "movie",
    "overlay",
    "report",
    "score",
    "synth",
    "texture",
    "track",
    "train",
    "view",
]
