"""The command line: parse, call, print. Heavy packages are imported inside the commands, so that help is quick."""

from sphereorient.cli import (
    about,
    bench,
    calibrate,
    check,
    compare_maps,
    export,
    map,
    movie,
    overlay,
    report,
    spin,
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
    "export",
    "main",
    "map",
    "movie",
    "overlay",
    "report",
    "spin",
    "synth",
    "texture",
    "track",
    "train",
    "view",
]
