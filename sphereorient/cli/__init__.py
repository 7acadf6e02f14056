"""The command line: parse, call, print. Heavy packages are imported inside the commands, so that help is quick."""

from sphereorient.cli import about, calibrate, synth, track
from sphereorient.cli.app import app, main

__all__ = ["about", "app", "calibrate", "main", "synth", "track"]
