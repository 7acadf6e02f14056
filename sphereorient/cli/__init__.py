"""The command line: parse, call, print. Heavy packages are imported inside the commands, so that help is quick."""

from sphereorient.cli import about, calibrate, check, movie, synth, track
from sphereorient.cli.app import app, main

__all__ = ["about", "app", "calibrate", "check", "main", "movie", "synth", "track"]
