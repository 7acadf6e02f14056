"""The command line: parse, call, print. Heavy packages are imported inside the commands, so that help is quick."""

from sphereorient.cli import begin, bench, cameras, inputs, map, show, tools, track, train
from sphereorient.cli.app import app, main
