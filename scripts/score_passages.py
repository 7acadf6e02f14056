"""Score the precise method on the films of the paper's experiment, where the ball enters and leaves.

    scripts/score_passages.py [--out DIR] [--movies N]

Makes what is missing of DIR (films and tracks, see reproduce_paper.py), then prints Markdown: of each class of frames
how many are valid, marked (flags 16, 32, 512), right and silently wrong, errors and errors over the stated ones; and
each movie's figures. `both`: the whole disk is in both pictures; `one`: in one; `part`: half of it or more in one;
`rim`: less; `absent`: none. Right: within 1 degree, 0.5 mm (`both`) or 3 mm, 5 stated sigmas. Silently wrong: valid,
not marked, off by over 1 degree or 5 sigmas, or no ball in any picture.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import kept
import numpy as np
import torch
from numpy.typing import NDArray
from reproduce_paper import FULL, made_by, make_movies

from sphereorient.bench.score import AXES, score_track
from sphereorient.cameras import load_cameras, sphere_disk_px
from sphereorient.experiment import load_experiment
from sphereorient.trajectory import Flag, Trajectory

CLASSES = ("both", "one", "part", "rim", "absent")
MARKED = Flag.AMBIGUOUS | Flag.DOUBTFUL_FIT | Flag.CONTRADICTION
WRONG_DEG, WRONG_SIGMAS = 1.0, 5.0
WRONG_MM = dict.fromkeys(CLASSES, 3.0) | {"both": 0.5}
ACROSS = 81  # places over the disk by which the share in a picture is counted


@dataclass(frozen=True, eq=False)
class Scored:
    """The N frames of a movie: what is seen, and what the track says."""

    kind: NDArray[np.str_]
    valid: NDArray[np.bool_]
    marked: NDArray[np.bool_]
    deg: NDArray[np.float64]
    mm: NDArray[np.float64]
    turn_sigmas: NDArray[np.float64]  # of an axis: rms over the three
    place_sigmas: NDArray[np.float64]

    @property
    def off(self) -> NDArray[np.bool_]:
        """Whether the pose is off by more than its error, or there is none to measure."""
        beyond = (self.turn_sigmas > WRONG_SIGMAS) | (self.place_sigmas > WRONG_SIGMAS)
        return (self.deg > WRONG_DEG) | beyond | ~np.isfinite(self.deg) | (self.kind == "absent")

    @property
    def silent(self) -> NDArray[np.bool_]:
        """Whether a frame is silently wrong."""
        return self.valid & ~self.marked & self.off

    @property
    def right(self) -> NDArray[np.bool_]:
        """Whether a frame is valid, right and not marked."""
        near = self.mm < np.array([WRONG_MM[kind] for kind in self.kind])
        return self.valid & ~self.marked & ~self.off & near


def seen_in(folder: Path, position_mm: torch.Tensor) -> NDArray[np.str_]:
    """Return the class of each frame, by the true positions (N, 3)."""
    experiment = load_experiment(folder / "experiment.yaml")
    side = np.linspace(-1, 1, ACROSS)
    x, y = np.meshgrid(side, side)
    places = torch.from_numpy(np.stack([x, y], -1)[x**2 + y**2 <= 1])
    shares = []
    for camera in load_cameras(folder / "cameras.yaml").values():
        middle, radius = sphere_disk_px(camera, position_mm, experiment.radius_mm)
        at = middle[:, None] + places * radius[:, None, None]
        inside = ((at >= -0.5) & (at <= at.new_tensor(camera.image_size) - 0.5)).all(-1)
        shares.append(inside.double().mean(1).nan_to_num().numpy())
    share = np.stack(shares)
    whole = (share == 1).sum(0)
    kinds = [whole == len(share), whole > 0, share.max(0) >= 0.5, share.max(0) > 0]
    return np.select(kinds, CLASSES[:-1], CLASSES[-1])


def scored(folder: Path, path: Path) -> Scored:
    """Compare a track with the truth of a movie."""
    track, truth = Trajectory.load(path), folder / "truth.h5"
    score = score_track(track, truth)
    with h5py.File(truth) as file:
        kind = seen_in(folder, torch.from_numpy(file["position"][()]))
    return Scored(
        kind=kind,
        valid=score.valid,
        marked=(track.flags & MARKED) != 0,
        deg=score.orientation_deg,
        mm=score.position_mm,
        turn_sigmas=score.orientation_sigmas / np.sqrt(AXES),
        place_sigmas=score.position_sigmas / np.sqrt(AXES),
    )


def joined(movies: list[Scored]) -> Scored:
    """Put the frames of movies one after another."""
    return replace(movies[0], **{name: np.concatenate([vars(one)[name] for one in movies]) for name in vars(movies[0])})


def row(name: str, movie: Scored, kind: str) -> str:
    """Return the line of one class of frames."""
    own = movie.kind == kind
    told = own & movie.valid & np.isfinite(movie.deg)
    each = (own, own & movie.valid, own & movie.valid & movie.marked, own & movie.right, own & movie.silent)
    cells = [str(one.sum()) for one in each]
    for values in (movie.deg, movie.mm):
        cells.append(" / ".join(f"{np.quantile(values[told], q):.3f}" for q in (0.5, 0.95, 1)) if told.any() else "")
    sigmas = [np.sqrt(np.mean(one[told] ** 2)) for one in (movie.turn_sigmas, movie.place_sigmas) if told.any()]
    return " | ".join(["", name, *cells, " / ".join(f"{one:.2f}" for one in sigmas), ""]).strip()


def main() -> None:
    """Read the options, make what is missing, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/paper"))
    parser.add_argument("--movies", type=int, default=FULL.movies)
    options = parser.parse_args()
    plan = replace(FULL, movies=options.movies)
    make_movies(options.out, plan, ("precise",))
    numbers = range(1, plan.movies + 1)
    records = {number: kept.known(made_by(options.out, number, "precise")) for number in numbers}
    refused = [one["failed"] for one in records.values() if one.get("failed")]
    movies = {
        number: scored(*(made_by(options.out, number, stage) for stage in ("film", "precise")))
        for number in numbers
        if not records[number].get("failed")
    }
    head = "frames | valid | marked | right, unmarked | silently wrong | degrees p50 / p95 / max | mm | over sigma"
    print(f"| class | {head} |\n{'|---' * 9}|")
    print("\n".join(row(kind, joined(list(movies.values())), kind) for kind in CLASSES))
    head = "movie | where whole: right, % | part: right, % | silently wrong | valid without a ball | CPU s"
    print(f"\n| {head} |\n{'|---' * 6}|")
    for number, movie in movies.items():
        whole, part, absent = np.isin(movie.kind, CLASSES[:2]), movie.kind == "part", movie.kind == "absent"
        shares = [f"{100 * movie.right[own].mean():.1f}" if own.any() else "" for own in (whole, part)]
        counts = f"{movie.silent.sum()} | {(movie.valid & absent).sum()} | {records[number]['cpu_s']}"
        print(f"| {number:03d} | {shares[0]} | {shares[1]} | {counts} |")
    cpu_s = [float(one["cpu_s"]) for one in records.values()]
    print(f"\nrefused: {len(refused)} {refused}; CPU {sum(cpu_s) / 60:.0f} min, longest {max(cpu_s):.0f} s")


if __name__ == "__main__":
    main()
