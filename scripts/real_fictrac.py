"""Learn map and attitudes from FicTrac's sample movie alone, and compare them with FicTrac's result.

    scripts/real_fictrac.py [--folder ../shared/real/fictrac] [--work FOLDER] [--set paint.rounds=20] [--no-track]

Of the camera only the field of view is known; the ball is fixed, of unknown size, and partly hidden by the fly and its
holder. Prints numbers; keeps files only in --work. FicTrac's rotations are those of README.txt there: its q_factors 4,
6 and 10 are also compared with each other, to separate FicTrac's noise from ours.
"""

from __future__ import annotations

import argparse
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient import so3
from sphereorient.experiment import load_experiment
from sphereorient.experiment.recording import open_recording
from sphereorient.files.threads import silent
from sphereorient.mapping import LearntMap, fit_map, take_crops
from sphereorient.mapping.chain import find_chain
from sphereorient.mapping.disks import disks_of
from sphereorient.methods.results import map_track
from sphereorient.methods.settings import Settings, load_settings
from sphereorient.report.plots.style import write_figure
from sphereorient.report.texture_map import compare_pictures, map_figure, write_learnt, write_texture
from sphereorient.trajectory import Trajectory
from sphereorient.trajectory.walk import FICTRAC

REPO = Path(__file__).resolve().parents[1]
SIZE, VFOV_DEG, CENTRE = (384, 288), 45.0, (192.0, 144.0)
FRAME_RATE = 30.0  # Hz
CONE_AXIS, CONE_HALF_RAD = (-0.22939, 0.09997, 0.96819), 0.124815  # FicTrac's own, camera axes
FACTORS = (4, 6, 10)
ENDS = 30  # frames over which a drift is read off
Floats = NDArray[np.float64]

CAMERAS = """\
schema: sphereorient-cameras/1
cameras:
  cam1: {{model: pinhole, image_size: [{0}, {1}], vfov_deg: {2}, centre: [{3}, {4}],
         R: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], T: [0, 0, 0]}}
"""
EXPERIMENT = """\
schema: sphereorient-experiment/1
name: fictrac
frame_rate: {0}
sphere: {{diameter: null, fixed: true{2}}}
cameras: cameras.yaml
masks: {{cam1: mask.png}}
movies: {{cam1: {1}}}
"""


def write_inputs(folder: Path, source: Path, texture: str = "", name: str = "experiment.yaml") -> Path:
    """Write experiment, camera and mask, and return the experiment."""
    (folder / "cameras.yaml").write_text(CAMERAS.format(*SIZE, VFOV_DEG, *CENTRE))
    mask = np.full(SIZE[::-1], 255, np.uint8)
    for polygon in ignored(source / "config.txt"):
        cv2.fillPoly(mask, [polygon], 0)
    cv2.imwrite(str(folder / "mask.png"), mask)
    entry = f", texture: {texture}" if texture else ""
    path = folder / name
    path.write_text(EXPERIMENT.format(FRAME_RATE, (source / "sample.mp4").resolve(), entry))
    return path


def ignored(config: Path) -> list[NDArray[np.int32]]:
    """Read FicTrac's `roi_ignr` polygons, each (n, 2), px."""
    line = next(text for text in config.read_text().splitlines() if text.startswith("roi_ignr"))
    groups = re.findall(r"\{([^{}]+)\}", line)
    return [np.array([int(number) for number in group.split(",")], np.int32).reshape(-1, 2) for group in groups]


def fictrac_turns(path: Path, turned: bool = True) -> torch.Tensor:
    """Return FicTrac's rotation of every frame but the first against the one before, (N - 1, 3), rad, camera axes.

    Args:
        path: its .dat file.
        turned: whether to take the vectors from the frame about the ball's line of sight, in which FicTrac measures
            (README.txt, note 2), to the camera's; else they are unchanged.
    """
    table = np.loadtxt(path, delimiter=",")
    turns = torch.from_numpy(table[1:, 1:4])
    return turns @ to_cone().mT if turned else turns


def to_cone() -> torch.Tensor:
    """Return the smallest rotation that takes z to FicTrac's cone axis, (3, 3)."""
    axis = torch.nn.functional.normalize(torch.tensor(CONE_AXIS, dtype=torch.float64), dim=0)
    across = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), axis)
    angle = torch.atan2(across.norm(), axis[2])
    return so3.exp(across / across.norm() * angle)


def turns_of(R_lab_body: torch.Tensor) -> torch.Tensor:
    """Return rotation vectors from frame to frame, (N - 1, 3), rad; lab axes are the camera's."""
    return so3.log(R_lab_body[1:] @ R_lab_body[:-1].mT)


def apart_deg(a: torch.Tensor, b: torch.Tensor) -> Floats:
    """Return the angles between rotations by vectors (N, 3) and (N, 3), degrees, where both are known."""
    angle = torch.rad2deg(so3.geodesic_distance(so3.exp(a), so3.exp(b))).numpy()
    return angle[np.isfinite(angle)]


def show(name: str, values: Floats) -> None:
    """Print median and 95th percentile."""
    print(f"  {name:42} median {np.median(values):.3f}   95 % {np.percentile(values, 95):.3f}   degrees")


def compare_turns(ours: torch.Tensor, source: Path) -> None:
    """Print differences of our rotations from FicTrac's, and between FicTrac's settings."""
    theirs = {q: fictrac_turns(source / f"fictrac_q{q}.dat") for q in FACTORS}
    print("turn from frame to frame, differences (camera axes):")
    for q in reversed(FACTORS):
        show(f"ours - FicTrac q{q}", apart_deg(ours, theirs[q]))
    show(
        "ours - FicTrac q10, its vectors as they stand",
        apart_deg(ours, fictrac_turns(source / "fictrac_q10.dat", False)),
    )
    show("FicTrac q6 - q10", apart_deg(theirs[6], theirs[10]))
    show("FicTrac q4 - q6", apart_deg(theirs[4], theirs[6]))
    # Three series, pairwise differences: each one's own noise, were they independent (three-cornered hat).
    a, b, c = ours, theirs[10], theirs[6]
    good = torch.isfinite(a).all(-1)
    ab, ac, bc = (float((x - y)[good].square().sum(-1).mean()) for x, y in ((a, b), (a, c), (b, c)))
    parts = [(ab + ac - bc) / 2, (ab + bc - ac) / 2, (ac + bc - ab) / 2]
    words = [
        "negative (below the others' common errors)" if part < 0 else f"{np.rad2deg(part**0.5):.3f}" for part in parts
    ]
    print(f"  noise of each, rms, were they independent: ours {words[0]}, q10 {words[1]}, q6 {words[2]} degrees")
    print("change of the turn from frame to frame (motion and noise together), rms over three axes:")
    for name, turns in (("ours", ours), *((f"FicTrac q{q}", theirs[q]) for q in reversed(FACTORS))):
        change = torch.diff(turns, dim=0)
        change = change[torch.isfinite(change).all(-1)]
        print(f"  {name:42} {np.rad2deg(float(change.square().sum(-1).mean().sqrt())):.3f} degrees")


def compare_attitudes(R_lab_body: torch.Tensor, source: Path) -> None:
    """Print differences of absolute attitudes along the movie, after the best rotation on both sides."""
    print("absolute attitude, after the best constant rotations:")
    valid = torch.isfinite(R_lab_body).flatten(1).all(1)
    for q in reversed(FACTORS):
        theirs = torch.from_numpy(np.loadtxt(source / f"fictrac_q{q}.dat", delimiter=",")[:, FICTRAC["rotation_cam"]])
        C = to_cone()
        R = C @ so3.exp(theirs) @ C.mT
        show(f"ours - FicTrac q{q}", np.rad2deg(so3.geodesic_distance(*aligned(R[valid], R_lab_body[valid])).numpy()))
    a, b = (
        so3.exp(torch.from_numpy(np.loadtxt(source / f"fictrac_q{q}.dat", delimiter=",")[:, FICTRAC["rotation_cam"]]))
        for q in (6, 10)
    )
    show("FicTrac q6 - q10", np.rad2deg(so3.geodesic_distance(*aligned(a, b)).numpy()))


def aligned(R: torch.Tensor, other: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return P R Q nearest to the other (N, 3, 3), and the other."""
    P = Q = torch.eye(3, dtype=torch.float64)
    for _ in range(100):
        Q = so3.nearest_rotation(((P @ R).mT @ other).mean(0))
        P = so3.nearest_rotation((other @ (R @ Q).mT).mean(0))
    return P @ R @ Q, other


def learnt_from(path: Path, settings: Settings) -> tuple[LearntMap, torch.Tensor, Any]:
    """Learn the map; return it, the attitudes of the chain without any loop, and the open experiment's frames."""
    begun = time.perf_counter()
    cpu = time.process_time()
    with open_recording(path, textured=False) as recording:
        crops = take_crops(recording, settings.paint, settings.locate, silent)
        learnt = fit_map(crops, settings.paint, silent)
        seconds, busy = time.perf_counter() - begun, time.process_time() - cpu
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        print(f"map learnt in {seconds:.0f} s ({busy / len(crops):.2f} CPU s a frame), memory {memory:.2f} GB")
        frames = torch.nonzero(crops.seen.any(1))[:, 0]
        open_chain = find_chain(
            disks_of(crops, frames, settings.paint), settings.paint.model_copy(update={"loop_pairs": 1})
        )
        track = map_track(recording.experiment, recording.clock, learnt, "", {})
    return learnt, open_chain.R_lab_body, track


def print_ball(learnt: LearntMap) -> None:
    """Print where the ball is, as a cone, beside FicTrac's."""
    place = learnt.position_lab_mm[learnt.valid].mean(0)
    axis, half = place / place.norm(), float(torch.asin(1 / place.norm()))
    theirs = torch.nn.functional.normalize(torch.tensor(CONE_AXIS, dtype=torch.float64), dim=0)
    off = np.rad2deg(float(torch.acos((axis @ theirs).clamp(-1, 1))))
    print(
        f"ball: half angle {np.rad2deg(half):.3f} degrees (FicTrac {np.rad2deg(CONE_HALF_RAD):.3f}), "
        f"axis {off:.2f} degrees off its"
    )


def print_drift(learnt: LearntMap, chain: torch.Tensor) -> None:
    """Print the effect of closing loops."""
    closure = learnt.closure
    before, after = np.rad2deg([closure.drift_before_rad, closure.drift_after_rad])
    print(
        f"loops: {closure.closed} of {closure.loops} closed; drift over a loop {before:.2f} degrees without, "
        f"{after:.2f} with (rms)"
    )
    R = learnt.R_lab_body[learnt.valid]
    Q = so3.nearest_rotation((chain[:ENDS].mT @ R[:ENDS]).mean(0))
    off = np.rad2deg(so3.geodesic_distance(chain @ Q, R).numpy())
    print(
        f"the chain without loops ends {np.median(off[-ENDS:]):.2f} degrees off the attitudes with them "
        f"(at most {off.max():.2f})"
    )


def print_paint(learnt: LearntMap) -> None:
    """Print how well pictures held out of the map match it."""
    alike = learnt.paint[learnt.paint.isfinite()]
    middle, low = alike.quantile(0.5), alike.quantile(0.05)
    print(f"paint in {len(alike)} pictures held out of the map: correlation {middle:.3f} (median), {low:.3f} (5 %)")
    state = f"{'' if learnt.arrived else 'not '}arrived after {len(learnt.rounds)} iterations"
    print(f"frames at which the rate jumps: {learnt.jumps.tolist()}; {state}")


def main() -> None:
    """Learn, track, compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=REPO.parent / "shared" / "real" / "fictrac")
    parser.add_argument("--work", type=Path, help="keep all files here, with a figure; outside of the project")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("--no-track", action="store_true", help="the learnt attitudes only")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) if options.work is None else options.work
        folder.mkdir(exist_ok=True)
        path = write_inputs(folder, options.folder)
        torch.set_num_threads(1)
        learnt, chain, track = learnt_from(path, load_settings(None, options.overrides))
        seen = 100 * learnt.seen_share
        print(f"frames {len(learnt.valid)}, with the ball {int(learnt.valid.sum())}, sphere seen {seen:.1f} %")
        print_ball(learnt)
        print_drift(learnt, chain)
        write_texture(learnt.texture, folder / "texture.png")
        write_learnt(learnt, track, folder / "texture_map.h5")
        print_paint(learnt)
        if options.work is not None:
            compared = compare_pictures(learnt, track, load_experiment(path), folder / "texture.png")
            write_figure(map_figure(learnt, compared), folder / "texture_map.png")
        print("the attitudes learnt with the map:")
        compare_turns(turns_of(learnt.R_lab_body), options.folder)
        compare_attitudes(learnt.R_lab_body, options.folder)
        if not options.no_track:
            tracked(folder, options.folder)


def tracked(folder: Path, source: Path) -> None:
    """Track the whole movie with the learnt map, frame by frame, and compare its attitudes."""
    path = write_inputs(folder, source, "texture.png", "with_map.yaml")
    begun = time.perf_counter()
    command = [sys.executable, "-m", "sphereorient.cli", "track", str(path), "--quiet"]
    command += ["--out", str(folder / "track.h5")]
    subprocess.run(command, check=True)
    track = Trajectory.load(folder / "track.h5")
    seconds = time.perf_counter() - begun
    valid = f"{int(track.valid.sum())} of {len(track)} frames valid"
    print(f"`sphereorient track` with the learnt map: {valid}, {seconds:.0f} s")
    if track.valid.any():
        R = torch.from_numpy(track.orientation)
        compare_turns(turns_of(R), source)
        compare_attitudes(R, source)


if __name__ == "__main__":
    main()
