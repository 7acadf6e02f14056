"""Measure the orientation of the Moon in photographs, and compare it with an ephemeris.

    scripts/moon.py PICTURE ... --time 2020-03-09T23:32:46Z --place -11.0092,-37.0914 --map moon.png [--mirrored]
    scripts/moon.py FOLDER                    # of experiments NAME*/experiment.yaml and truth.csv; as docs/moon.md

The orientation of the Moon is published to a millidegree, so a photograph tests a track against a truth that no
program rendered. `--time` (UTC) and `--place` (latitude, longitude, degrees north and east) are those of the pictures,
to a minute and a few km: they give the point of the Moon from which the camera is in the zenith. The roll about the
line of sight is free, as the camera was not levelled. `--map`: an equirectangular map of the whole Moon, longitude 0 in
its middle, east to the right, mean-Earth frame (source: docs/moon.md). `--vfov` is not needed: the size
of the Moon is known as well. Needs astronomy-engine: pip install 'sphereorient[moon]'. Prints a table in Markdown.
"""

from __future__ import annotations

import argparse
import csv
import math
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sphereorient.errors import SphereOrientError
from sphereorient.preflight.first_look import look_at
from sphereorient.trajectory import Trajectory

MOON_MM = 3474.8  # diameter of the Moon; here a mm stands for a km
HEAD = (
    "| picture | phase, degrees | latitude, longitude | error, degrees | stated | over sigma | |\n" + 7 * "|---" + "|"
)


@dataclass(frozen=True, kw_only=True)
class Ephemeris:
    """The Moon as seen from a place: angles in degrees, lunar mean-Earth frame of the IAU."""

    latitude: float  # of the point that has the place in its zenith
    longitude: float
    semidiameter: float
    phase: float  # between Sun and place, seen from the Moon

    @property
    def zenith_body(self) -> np.ndarray:
        """Unit vector (3,), body frame, from the Moon to the place."""
        north, east = math.radians(self.latitude), math.radians(self.longitude)
        return np.array([math.cos(north) * math.cos(east), math.cos(north) * math.sin(east), math.sin(north)])


def ephemeris(time_utc: str, latitude: float, longitude: float) -> Ephemeris:
    """Return the Moon at a time, ISO 8601 UTC, from a place, degrees.
    Source: IAU 2009 axis of the Moon and prime meridian (mean Earth), which astronomy-engine gives.
    """
    try:
        import astronomy
    except ImportError:
        raise SystemExit("moon: astronomy-engine is missing: pip install 'sphereorient[moon]'") from None
    time = astronomy.Time.Parse(time_utc)
    seen = astronomy.Equator(
        astronomy.Body.Moon,
        time,
        astronomy.Observer(latitude, longitude, 0.0),
        ofdate=False,  # J2000, as the axis
        aberration=False,
    )
    away = np.array([seen.vec.x, seen.vec.y, seen.vec.z])  # from the place, au
    axis = astronomy.RotationAxis(astronomy.Body.Moon, time)
    pole = np.array([axis.north.x, axis.north.y, axis.north.z])
    node = np.cross([0.0, 0.0, 1.0], pole)  # ascending, from which the meridian counts
    node /= np.linalg.norm(node)
    spin = math.radians(axis.spin)
    prime = math.cos(spin) * node + math.sin(spin) * np.cross(pole, node)
    body = np.stack([prime, np.cross(pole, prime), pole])
    distance_km = float(np.linalg.norm(away)) * astronomy.KM_PER_AU
    m = body @ -away / np.linalg.norm(away)
    sun = astronomy.GeoVector(astronomy.Body.Sun, time, aberration=False)
    moon = astronomy.GeoVector(astronomy.Body.Moon, time, aberration=False)
    lit = np.array([sun.x - moon.x, sun.y - moon.y, sun.z - moon.z])
    cosine = float(lit @ -away / np.linalg.norm(lit) / np.linalg.norm(away))
    return Ephemeris(
        latitude=math.degrees(math.asin(m[2])),
        longitude=math.degrees(math.atan2(m[1], m[0])),
        semidiameter=math.degrees(math.asin(MOON_MM / 2 / distance_km)),
        phase=math.degrees(math.acos(cosine)),
    )


def program(*arguments: object) -> None:
    """Run the program as a user does; SystemExit with its message."""
    command = [sys.executable, "-m", "sphereorient.cli", *map(str, arguments)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    if run.returncode:
        raise SystemExit(run.stderr.strip().splitlines()[-1])


def experiment_of(picture: Path, map_file: Path, at: Ephemeris, folder: Path, mirrored: bool) -> Path:
    """Write the experiment of a photograph into a folder: the field of view follows from the size of the Moon."""
    (look,) = look_at([picture])
    if look.diameter_px is None:
        raise SystemExit(f"{picture}: no ball was found")
    radius_px, height = look.diameter_px / 2, look.movie.frame_shape[0]
    vfov_deg = 2 * math.degrees(math.atan(math.tan(math.radians(at.semidiameter)) * height / 2 / radius_px))
    out = folder / "experiment.yaml"
    flip = ["--set", "flip={cam1: horizontal}"] if mirrored else []
    known = ["--vfov", vfov_deg, "--sphere-map", map_file, "--set", f"sphere.diameter={MOON_MM}"]
    program("init", picture.resolve(), "--out", out, *known, *flip, "-q", "--force")
    return out


def row(name: str, experiment: Path, at: Ephemeris, folder: Path, settings: list[str]) -> str:
    """Track an experiment; return its row of the table."""
    track = folder / f"{name}.h5"
    changes = [word for text in settings for word in ("--set", text)]
    try:
        program("track", experiment, "--out", track, "-q", "--force", *changes)
    except SystemExit as error:
        why = str(error).partition(";")[0].removeprefix("sphereorient: ")
        return f"| {name} | {at.phase:.0f} | | | | | refused: {why} |"
    found = Trajectory.load(track)
    R, C = found.orientation[0], found.orientation_cov[0]
    place = found.position[0]
    sight = -place / np.linalg.norm(place)  # to the camera, at the lab's origin
    if not np.isfinite(R).all():
        return f"| {name} | {at.phase:.0f} | | | | | no orientation |"
    m = R.T @ sight
    off = np.cross(R @ at.zenith_body, sight)  # small rotation about axes across the sight: the roll is free
    across = np.linalg.svd(sight[None])[2][1:]
    covariance = across @ C @ across.T
    sigma = math.sqrt(off @ across.T @ np.linalg.solve(covariance, across @ off))
    error = math.degrees(math.atan2(float(np.linalg.norm(off)), float(m @ at.zenith_body)))
    stated = math.degrees(math.sqrt(np.trace(covariance) / 2))
    where = f"{math.degrees(math.asin(m[2])):+.2f}, {math.degrees(math.atan2(m[1], m[0])):+.2f}"
    return f"| {name} | {at.phase:.0f} | {where} | {error:.3f} | {stated:.3f} | {sigma:.1f} | |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pictures", type=Path, nargs="+", metavar="PICTURE")
    parser.add_argument("--time", help="UTC, as 2020-03-09T23:32:46Z")
    parser.add_argument("--place", help="latitude,longitude in degrees, north and east, as --place=-11.01,-37.09")
    parser.add_argument("--map", type=Path, help="texture map of the Moon")
    parser.add_argument("--mirrored", action="store_true", help="the telescope has an odd number of mirrors")
    parser.add_argument("--set", action="append", default=[], help="a setting of `sphereorient track`")
    given = parser.parse_args()
    print(HEAD)
    with tempfile.TemporaryDirectory() as kept:
        folder = Path(kept)
        if len(given.pictures) == 1 and (table := given.pictures[0] / "truth.csv").is_file():
            for one in csv.DictReader(table.open()):
                at = ephemeris(one["utc"], float(one["site_lat_deg"]), float(one["site_lon_deg"]))
                for path in sorted(given.pictures[0].glob(f"{one['picture']}_raw/experiment.yaml")):
                    print(row(one["picture"], path, at, folder, given.set), flush=True)
            return
        if not (given.time and given.place and given.map):
            parser.error("pictures need --time, --place and --map")
        at = ephemeris(given.time, *map(float, given.place.split(",")))
        for picture in given.pictures:
            path = experiment_of(picture, given.map, at, folder, given.mirrored)
            print(row(picture.stem, path, at, folder, given.set), flush=True)


if __name__ == "__main__":
    try:
        main()
    except SphereOrientError as error:
        raise SystemExit(f"moon: {error}") from None
