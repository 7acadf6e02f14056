"""Measure the cost of each fault of a movie: frames before and after, their reasons, and lost good frames.

    scripts/faults.py [--frames 96] [--turn 3] [--only NAME ...] [--json]

Each fault is planted in a synthetic movie, which is tracked twice. First with the appearance of the clean run: each
camera's orientations in blocks without a fault are then the same to the last bit, and positions to a millionth of a mm
(the smoothed path sets their instant within the exposure). Then with everything learnt from the spoilt movie: poses
differ by tenths of a sigma (last columns).
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
import yaml
from numpy.typing import NDArray

from sphereorient import so3
from sphereorient.methods.method import Learnt, load_learnt
from sphereorient.methods.settings import load_settings
from sphereorient.movies import open_movie, write_ffv1
from sphereorient.run import MemoryStore, Request, run
from sphereorient.synth import SynthSettings, write_synthetic_experiment
from sphereorient.trajectory import Trajectory

BLOCK = 16  # frames; short, so that a short movie has blocks without the fault
RATE = 600.0
CAMERAS = ("cam1", "cam2")
Pictures = dict[str, NDArray[np.uint8]]
SAME_MM = 1e-6  # of positions: the smoothed path sets their instant within the exposure
# Orientations depend on the path of all positions, stated errors on the cameras' disagreement in the whole movie.
SEEN = ("score", "centre_px", "orientation", "orientation_cov")


@dataclass
class Spoilt:
    """Movies with a fault, and which frames have it."""

    pictures: Pictures
    bad: list[int]
    keys: dict[str, Any] = field(default_factory=dict)  # of experiment.yaml
    files: Callable[[Path, Pictures], dict[str, str]] | None = None  # writes the movies itself


@dataclass(frozen=True)
class Scene:
    """The clean movies and their truth."""

    folder: Path
    pictures: Pictures
    empty: float
    centre_px: dict[str, NDArray[np.float64]]
    R_lab_body: NDArray[np.float64]

    @property
    def some(self) -> NDArray[np.int64]:
        """Six frames within the third block."""
        return np.arange(2 * BLOCK + 5, 2 * BLOCK + 11)

    def changed(self, cameras: Iterable[str], rows: NDArray[np.int64], how: Callable[..., Any]) -> Spoilt:
        pictures = {name: movie.copy() for name, movie in self.pictures.items()}
        for name in cameras:
            pictures[name][rows] = how(pictures[name][rows], name)
        return Spoilt(pictures, rows.tolist())


def noise(scene: Scene, shape: tuple[int, ...], level: float, seed: int) -> NDArray[np.float64]:
    return np.clip(np.rint(np.random.default_rng(seed).normal(level, 1.9, shape)), 0, 255)


def black(scene: Scene, cameras: tuple[str, ...]) -> Spoilt:
    return scene.changed(cameras, scene.some, lambda p, _: 0)


def white(scene: Scene) -> Spoilt:
    return scene.changed(("cam1",), scene.some, lambda p, _: 255)


def lamp_off(scene: Scene) -> Spoilt:
    return scene.changed(("cam2",), scene.some, lambda p, _: noise(scene, p.shape, 3, 1))


def repeated(scene: Scene, cameras: tuple[str, ...]) -> Spoilt:
    rows = scene.some
    return scene.changed(cameras, rows, lambda p, name: scene.pictures[name][rows[0] - 1])


def no_ball(scene: Scene, cameras: tuple[str, ...]) -> Spoilt:
    return scene.changed(cameras, scene.some, lambda p, name: noise(scene, p.shape, scene.empty, len(name)))


def half_out(scene: Scene) -> Spoilt:
    """The right half of the disk is outside of the view."""
    rows = scene.some
    spoilt = scene.changed((), rows, lambda p, _: p)
    for k in rows.tolist():
        edge = int(scene.centre_px["cam1"][k, 0])
        rest = spoilt.pictures["cam1"][k][:, edge:]
        spoilt.pictures["cam1"][k][:, edge:] = noise(scene, rest.shape, scene.empty, k)
    return spoilt


def swapped(scene: Scene, cameras: tuple[str, ...]) -> Spoilt:
    return scene.changed(cameras, scene.some[2:4], lambda p, _: p[::-1])


def drift(scene: Scene) -> Spoilt:
    """From here on cam2 is a frame late."""
    rows = np.arange(scene.some[0], len(scene.R_lab_body))
    return scene.changed(("cam2",), rows, lambda p, name: scene.pictures[name][rows - 1])


def dropped(scene: Scene) -> Spoilt:
    """30 % of each camera's frames are black."""
    draw = np.random.default_rng(30)
    pictures = {name: movie.copy() for name, movie in scene.pictures.items()}
    bad: set[int] = set()
    for movie in pictures.values():
        rows = draw.choice(len(movie), int(0.3 * len(movie)), replace=False)
        movie[rows] = 0
        bad |= set(rows.tolist())
    return Spoilt(pictures, sorted(bad))


def dropped_stamped(scene: Scene) -> Spoilt:
    """Each camera lost 30 % of its pictures; the others have time stamps."""
    draw = np.random.default_rng(31)
    total = len(scene.R_lab_body)
    kept = {name: np.sort(draw.choice(total, total - int(0.3 * total), replace=False)) for name in CAMERAS}

    def write(folder: Path, pictures: Pictures) -> dict[str, str]:
        for name, movie in pictures.items():
            with h5py.File(folder / f"{name}.h5", "w") as file:
                file["frames"], file["time"] = movie[kept[name]], kept[name] / RATE
        return {name: f"{name}.h5" for name in pictures}

    there = np.union1d(*kept.values())  # instants without a picture are no frames
    bad = [k for k, frame in enumerate(there.tolist()) if not all(frame in rows for rows in kept.values())]
    spoilt = Spoilt(dict(scene.pictures), bad, {"frame_rate": None, "times": "movies"}, write)
    spoilt.keys["there"] = there
    return spoilt


def truncated(scene: Scene) -> Spoilt:
    """The file of cam2 ends in the middle of a frame."""
    last = len(scene.R_lab_body) - BLOCK - 5

    def write(folder: Path, pictures: Pictures) -> dict[str, str]:
        files = as_npy(folder, pictures)
        path = folder / files["cam2"]
        frame = pictures["cam2"][0].nbytes
        path.write_bytes(path.read_bytes()[: -(len(pictures["cam2"]) - last) * frame + frame // 2])
        return files

    return Spoilt(dict(scene.pictures), list(range(last, len(scene.R_lab_body))), files=write)


def damaged(scene: Scene) -> Spoilt:
    """Some packets of cam1's FFV1 movie have wrong bytes."""
    rows = scene.some[::2]

    def write(folder: Path, pictures: Pictures) -> dict[str, str]:
        files = {}
        for name, movie in pictures.items():
            files[name] = f"{name}.mkv"
            write_ffv1(folder / files[name], iter(movie), RATE)
        spoil_packets(folder / files["cam1"], rows.tolist())
        return files

    return Spoilt(dict(scene.pictures), rows.tolist(), files=write)


def spoil_packets(path: Path, frames: list[int]) -> None:
    """Change some bytes in the middle of frames of a movie."""
    import av

    with av.open(str(path)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    data = bytearray(path.read_bytes())
    for frame in frames:
        at = data.index(packets[frame][:200]) + len(packets[frame]) // 2
        data[at : at + 40] = bytes(byte ^ 0x5A for byte in data[at : at + 40])
    path.write_bytes(data)


FAULTS: dict[str, Callable[[Scene], Spoilt]] = {
    "truncated movie, cam2": truncated,
    "corrupt frames, cam1": damaged,
    "black, cam1": lambda scene: black(scene, ("cam1",)),
    "black, both": lambda scene: black(scene, CAMERAS),
    "lamp off, cam2": lamp_off,
    "white, cam1": white,
    "repeated, cam1": lambda scene: repeated(scene, ("cam1",)),
    "repeated, both": lambda scene: repeated(scene, CAMERAS),
    "one camera without the ball": lambda scene: no_ball(scene, ("cam2",)),
    "out of view": lambda scene: no_ball(scene, CAMERAS),
    "half out, cam1": half_out,
    "two frames swapped, cam1": lambda scene: swapped(scene, ("cam1",)),
    "two frames swapped, both": lambda scene: swapped(scene, CAMERAS),
    "cam2 a frame late from here on": drift,
    "30 % of each camera black": dropped,
    "30 % of each camera lost, stamps": dropped_stamped,
}


def as_npy(folder: Path, pictures: Pictures) -> dict[str, str]:
    for name, movie in pictures.items():
        np.save(folder / f"{name}.npy", movie)
    return {name: f"{name}.npy" for name in pictures}


def rendered(folder: Path, frames: int, turn_deg: float) -> Scene:
    settings = SynthSettings(
        frames=frames,
        image_size=(240, 240),
        diameter_px=50.0,
        distance_mm=520.0,
        volume_mm=30.0,
        exposure=0.0001,
        exposure_samples=1,
        seed=5,
        omega_rms=float(np.deg2rad(turn_deg) * RATE / np.sqrt(8 / np.pi)),
    )
    write_synthetic_experiment(folder, settings)
    pictures: Pictures = {}
    for name in CAMERAS:
        with open_movie(folder / f"{name}.mkv") as movie:
            pictures[name] = np.stack(list(movie.frames()))
    with h5py.File(folder / "truth.h5") as truth:
        centre = {name: truth[f"{name}/centre_px"][()] for name in CAMERAS}
        return Scene(folder, pictures, settings.background, centre, truth["orientation"][()])


def tracked(
    scene: Scene, spoilt: Spoilt, folder: Path, given: Mapping[str, Learnt] | None
) -> tuple[Trajectory, Mapping[str, Learnt], tuple[str, ...]]:
    """Write the spoilt movies and track them."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for path in scene.folder.iterdir():
        if path.suffix in (".png", ".yaml"):
            shutil.copy(path, folder)
    document = yaml.safe_load((scene.folder / "experiment.yaml").read_text())
    document["movies"] = (spoilt.files or as_npy)(folder, spoilt.pictures)
    document |= {key: value for key, value in spoilt.keys.items() if key != "there"}
    path = folder / "experiment.yaml"
    path.write_text(yaml.safe_dump({key: value for key, value in document.items() if value is not None}))
    settings = load_settings(None, [f"refine.chunk_frames={BLOCK}"])
    known = folder / "learnt.h5"
    track = run(Request(experiment=path, settings=settings, learnt=given, save_learnt=known), MemoryStore())
    return track, load_learnt(known), tuple(track.provenance["remarks"])


def compared(clean: Trajectory, track: Trajectory, rows: NDArray[np.int64]) -> tuple[bool, float, float]:
    """Return whether two tracks are the same in some frames, and their difference in sigmas: rms, largest."""
    pairs = [
        (getattr(clean.cameras[camera], name), getattr(track.cameras[camera], name))
        for camera in clean.cameras
        for name in SEEN
    ]
    same = all(np.array_equal(a[rows], b[rows], equal_nan=True) for a, b in pairs)
    same &= np.allclose(clean.position[rows], track.position[rows], rtol=0, atol=SAME_MM, equal_nan=True)
    move = (track.position - clean.position)[rows] / np.sqrt(np.diagonal(clean.position_cov, axis1=1, axis2=2))[rows]
    turn = so3.log(torch.from_numpy(track.orientation[rows] @ clean.orientation[rows].mT)).numpy()
    turn = turn / np.sqrt(np.diagonal(clean.orientation_cov, axis1=1, axis2=2))[rows]
    both = np.concatenate([move, turn])
    return same, float(np.sqrt(np.nanmean(both**2))), float(np.nanmax(np.abs(both)))


def judged(name: str, scene: Scene, clean: Trajectory, learnt: Mapping[str, Learnt], folder: Path) -> dict[str, Any]:
    """Plant a fault, track twice, and return the row of the table."""
    spoilt = FAULTS[name](scene)
    track, _, remarks = tracked(scene, spoilt, folder, learnt)
    anew, _, _ = tracked(scene, spoilt, folder, None)
    there = spoilt.keys.get("there", np.arange(len(scene.R_lab_body)))
    blocks = {k // BLOCK for k in spoilt.bad}
    outside = np.array([k for k in range(len(clean)) if k // BLOCK not in blocks], dtype=np.int64)
    good = np.setdiff1d(np.arange(len(track)), spoilt.bad)
    row: dict[str, Any] = {
        "fault": name,
        "frames": len(track),
        "spoilt": len(spoilt.bad),
        "valid_before": int(clean.valid.sum()),
        "valid": int(track.valid.sum()),
        "good_lost": int((~track.valid[good]).sum()),
        "reasons": {
            camera: dict(Counter(of.reason[k] for k in spoilt.bad if of.reason[k] != "ok"))
            for camera, of in track.cameras.items()
        },
        "reasons_elsewhere": int(sum(of.reason[k] != "ok" for of in track.cameras.values() for k in good)),
        "worst_deg": worst_deg(track, scene, there),
        "worst_anew_deg": worst_deg(anew, scene, there),
        "outside": len(outside),
        "remarks": [remark.split(": ", 1)[1] for remark in remarks],
    }
    if len(outside):
        row["same"] = compared(clean, track, outside)[0]
        _, row["anew_rms_sigma"], row["anew_most_sigma"] = compared(clean, anew, outside)
    return row


def worst_deg(track: Trajectory, scene: Scene, there: NDArray[np.int64]) -> float:
    """Return the largest error of a valid orientation."""
    R = torch.from_numpy(scene.R_lab_body[there][track.valid])
    error = so3.geodesic_distance(torch.from_numpy(track.orientation[track.valid]), R)
    return float(torch.rad2deg(error).max())


def table(rows: list[dict[str, Any]], clean_worst: float) -> str:
    lines = [
        f"Clean movie: worst error {clean_worst:.2f} degrees.",
        "",
        "| fault | frames with it | valid before | after | good ones lost | reasons in them | worst error, deg "
        "| blocks without it: the same | learnt anew: rms, most, sigma |",
        "|" + "---|" * 9,
    ]
    for row in rows:
        reasons = "; ".join(
            f"{camera} " + ", ".join(f"{count} {why}" for why, count in of.items())
            for camera, of in row["reasons"].items()
            if of
        )
        same = {True: "yes", False: "NO", None: "none left"}[row.get("same")]
        anew = f"{row['anew_rms_sigma']:.3f}, {row['anew_most_sigma']:.2f}" if "same" in row else ""
        lines.append(
            f"| {row['fault']} | {row['spoilt']} | {row['valid_before']} | {row['valid']} of {row['frames']} "
            f"| {row['good_lost']} | {reasons or 'none'} | {row['worst_deg']:.2f} | {same} | {anew} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=96)
    parser.add_argument("--turn", type=float, default=3.0, help="degrees a frame, on average")
    parser.add_argument("--only", nargs="*", choices=list(FAULTS), help="some of the faults")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = rendered(folder / "clean", arguments.frames, arguments.turn)
        clean, learnt, _ = tracked(scene, Spoilt(dict(scene.pictures), []), folder / "spoilt", None)
        clean_worst = worst_deg(clean, scene, np.arange(len(clean)))
        rows = [judged(fault, scene, clean, learnt, folder / "spoilt") for fault in arguments.only or FAULTS]
    print(json.dumps({"clean_worst_deg": clean_worst, "rows": rows}) if arguments.json else table(rows, clean_worst))


if __name__ == "__main__":
    main()
