"""Compare stated with true errors: the part that varies from frame to frame, and the part that lasts over a movie.

    scripts/stated_errors.py SHARED_FOLDER [--only sets movies both stills] [--movies 40] [--stills 300] [--jobs 2]
                             [--out out/stated]

sets: the path-traced movies of SHARED_FOLDER, each camera alone and both together. The mean error of a movie is what
lasts; the rest varies. Each is divided by its stated covariance: 1 is right, above 1 the stated errors are too small.
movies: synthetic movies of one camera with lamps, gloss, wear and blur drawn by the seed; both: of two cameras.
stills: 1, 2, 4 and 8 frames of a synthetic ball, one camera. Results are kept in --out: an interrupted run
continues. Half an hour on two cores.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sphereorient.bench.run import CACHE, run_all
from sphereorient.cli.app import progress_bar
from sphereorient.errors import Flag, SphereOrientError
from sphereorient.experiment import load_experiment
from sphereorient.files.whole_file import write_text
from sphereorient.run import MemoryStore, Request, run
from sphereorient.synth import SynthSettings, write_synthetic_experiment
from sphereorient.trajectory import Trajectory

DOCS = Path(__file__).resolve().parents[1] / "docs"
SETS = ("experiment", "tank", "gloss")
FRAMES = 48  # of a synthetic movie
STILLS = (1, 2, 4, 8)  # frames
INSIDE = 7.815  # chi-square of three axes that 95 % of errors stay below
IN_DOUBT = Flag.DOUBTFUL_FIT | Flag.CONTRADICTION
Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Stated:
    """Errors of a track over its stated errors; squares are means over the three axes."""

    name: str
    frames: int  # valid, not in doubt
    p50_deg: float
    varying: float  # mean square of the orientation's error less its mean, whitened
    lasting: float  # mean square of the mean error, whitened
    inside: int  # frames with the truth in the stated 95 %
    place_varying: float  # as `varying`, of the position
    place_lasting: float
    refused: str = ""


def main() -> None:
    """Read the options, run, write, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shared", type=Path)
    parser.add_argument("--only", nargs="+", default=["sets", "movies", "both", "stills"])
    parser.add_argument("--movies", type=int, default=40)
    parser.add_argument("--stills", type=int, default=300)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=DOCS.parent / "out" / "stated")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    cameras = (["cam1"], ["cam2"], ["cam1", "cam2"])
    parts: dict[str, list[tuple[str, Callable[[], list[Stated]]]]] = {
        "sets": [
            (f"{name}-{'+'.join(some)}", partial(of_set, options.shared / name, some))
            for some in cameras
            for name in SETS
        ],
        "movies": [(f"movie-{seed}", partial(of_movie, seed, 1)) for seed in range(options.movies)],
        "both": [(f"both-{seed}", partial(of_movie, seed, 2)) for seed in range(options.movies)],
        "stills": [(f"stills-{seed}", partial(of_stills, seed)) for seed in range(options.stills)],
    }
    for part in options.only:
        print(TABLES[part](measured(parts[part], options.out, options.jobs)), flush=True)


def measured(tasks: Sequence[tuple[str, Callable[[], list[Stated]]]], out: Path, jobs: int) -> list[Stated]:
    """Measure what is not kept yet; return all."""
    places = [out / f"{name}.json" for name, _ in tasks]
    missing = [partial(keep, place, task) for place, (_, task) in zip(places, tasks, strict=True) if not place.exists()]
    with progress_bar(unit="") as advance:
        run_all(missing, out / CACHE, jobs, lambda left: advance("movies", len(tasks) - left, len(tasks)))
    return [Stated(**one) for place in places for one in json.loads(place.read_text())]


def keep(place: Path, task: Callable[[], list[Stated]]) -> None:
    """Measure, and write what was measured."""
    write_text(place, json.dumps([asdict(one) for one in task()]))


def of_set(folder: Path, cameras: Sequence[str]) -> list[Stated]:
    """Measure a set with some of its cameras."""
    return [of_track(f"{folder.name}, {' + '.join(cameras)}", folder / "experiment.yaml", cameras, None)]


def of_movie(seed: int, cameras: int) -> list[Stated]:
    """Render and measure a synthetic movie; one camera: by turns lit from above and from its own side."""
    with tempfile.TemporaryDirectory() as name:
        path, every = filmed(Path(name), seed, 2, FRAMES), ["cam1", "cam2"]
        return [of_track(f"{seed}", path, every if cameras == 2 else [every[seed % 2]], None)]


def of_stills(seed: int) -> list[Stated]:
    """Render and measure stills of one ball: the first frames of a movie."""
    with tempfile.TemporaryDirectory() as name:
        path = filmed(Path(name), 1000 + seed, 1, max(STILLS))
        return [of_track(f"{count}", path, ["cam1"], (0, count)) for count in STILLS]


def filmed(folder: Path, seed: int, cameras: int, frames: int) -> Path:
    """Render a movie whose paint, lamps, gloss, wear, size and blur the seed draws."""
    draw = np.random.default_rng([66, seed])
    settings = SynthSettings(
        frames=frames,
        seed=seed,
        cameras=cameras,
        image_size=(480, 480),
        volume_mm=30.0,
        texture=draw.choice(["blobs", "patches", "dots"]),
        ambient=draw.uniform(0.1, 0.7),
        diameter_px=draw.uniform(50.0, 110.0),
        blur_px=draw.uniform(0.4, 1.2),
    )
    values = {"highlights": draw.uniform(0.0, 60.0), "paint_wear": draw.choice([0.0, draw.uniform(0.0, 0.04)])}
    return write_synthetic_experiment(folder, settings, values=values)


def of_track(name: str, path: Path, cameras: Sequence[str], frames: tuple[int, int] | None) -> Stated:
    """Track a movie with one ball, and compare it with its truth."""
    store = MemoryStore()
    experiment = replace(load_experiment(path), frames=frames)
    try:
        track = run(Request(experiment=experiment, cameras=tuple(cameras)), store)
    except SphereOrientError as error:
        nothing = dict.fromkeys(("p50_deg", "varying", "lasting", "place_varying", "place_lasting"), float("nan"))
        return Stated(name=name, frames=0, inside=0, refused=str(error), **nothing)
    assert isinstance(track, Trajectory)
    assert store.known is not None
    (known,) = store.known.values()
    lasting = (known.lasting.alone[0] if len(cameras) == 1 else known.lasting.covariance).numpy()
    with h5py.File(path.parent / "truth.h5") as file:
        R, X = (file[key][slice(*(frames or (None,)))] for key in ("orientation", "position"))
    some = track.valid & (track.flags & IN_DOUBT == 0) & (track.believed.sum(1) == len(cameras))
    turn = Rotation.from_matrix((track.orientation @ R.transpose(0, 2, 1))[some]).as_rotvec()
    place = (track.position - X)[some]
    spread = track.orientation_cov[some]
    parts = (turn, spread, lasting[:3, :3]), (place, track.position_cov[some], lasting[3:, 3:])
    (varying, lasts), (place_varying, place_lasts) = (of_parts(*part) for part in parts)
    return Stated(
        name=name,
        frames=int(some.sum()),
        p50_deg=float(np.degrees(np.median(np.linalg.norm(turn, axis=1)))) if some.any() else float("nan"),
        varying=varying,
        lasting=lasts,
        inside=int((squares(turn, spread) < INSIDE / 3).sum()),
        place_varying=place_varying,
        place_lasting=place_lasts,
    )


def of_parts(error: Floats, covariance: Floats, lasting: Floats) -> tuple[float, float]:
    """Return the mean squares, whitened, of errors (N, 3) less their mean, and of the mean."""
    if not len(error):
        return float("nan"), float("nan")
    mean, count, varying = error.mean(0), len(error), covariance - lasting
    left = squares(error - mean, varying).mean() * count / max(count - 1, 1) if count > 1 else np.nan
    return float(left), float(squares(mean[None], (lasting + varying.mean(0) / count)[None])[0])


def squares(error: Floats, covariance: Floats) -> Floats:
    """Return the mean over the axes of errors (N, 3) squared, whitened by covariances (N, 3, 3)."""
    white: Floats = (error * np.linalg.solve(covariance, error[..., None])[..., 0]).mean(-1)
    return white


def root(values: Iterable[float]) -> str:
    """Return the root of mean squares as text."""
    return f"{np.sqrt(np.nanmean(list(values))):.2f}"


def of_sets(found: Sequence[Stated]) -> str:
    """Return a table with a row for each movie."""
    head = "| movie | valid | p50, degrees | varies, over sigma | lasts, over sigma | in the stated 95 % | "
    head += "position: varies | lasts |\n|" + "---|" * 8
    rows = [
        f"| {one.name} | {one.frames} | {one.p50_deg:.4f} | {root([one.varying])} | {root([one.lasting])} | "
        f"{100 * one.inside / max(one.frames, 1):.0f} % | {root([one.place_varying])} | {root([one.place_lasting])} |"
        for one in found
    ]
    return "\n".join(["", head, *rows])


def of_movies(found: Sequence[Stated], cameras: int) -> str:
    """Return a table of all movies together."""
    good = [one for one in found if not one.refused and one.frames]
    parts = [[getattr(one, name) for one in good] for name in ("varying", "lasting", "place_varying", "place_lasting")]
    inside = 100 * float(np.mean(3 * np.array(parts[1]) < INSIDE))
    head = f"| synthetic movies, {cameras} camera{'s' * (cameras > 1)} | p50, degrees | varies, over sigma | lasts | "
    head += "position: varies | lasts | lasting error in the stated 95 % |\n|" + "---|" * 7
    row = f"| {len(good)} of {len(found)} | {np.median([one.p50_deg for one in good]):.4f} | "
    row += " | ".join(root(part) for part in parts) + f" | {inside:.0f} % |"
    return "\n".join(["", head, row, *(f"refused: {one.name}: {one.refused}" for one in found if one.refused)])


def of_counts(found: Sequence[Stated]) -> str:
    """Return a table of the stills with their truth in the stated region."""
    lines = ["", "| frames | stills measured | in the stated 95 % | p50, degrees | over sigma |\n|---|---|---|---|---|"]
    for count in STILLS:
        some = [one for one in found if one.name == str(count)]
        good = [one for one in some if one.frames]
        inside = sum(one.inside for one in good) / max(sum(one.frames for one in good), 1)
        over = root(one.lasting for one in good)
        p50 = np.median([one.p50_deg for one in good]) if good else np.nan
        lines.append(f"| {count} | {len(good)} of {len(some)} | {100 * inside:.1f} % | {p50:.4f} | {over} |")
    return "\n".join(lines)


TABLES: dict[str, Callable[[Sequence[Stated]], str]] = {
    "sets": of_sets,
    "movies": partial(of_movies, cameras=1),
    "both": partial(of_movies, cameras=2),
    "stills": of_counts,
}


if __name__ == "__main__":
    main()
