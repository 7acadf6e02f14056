"""Print a new user's first hour as a protocol: commands, their times, and the messages about wrong inputs.

    scripts/first_hour.py tank|fictrac|wrong|notebook [--shared ../shared] [--work FOLDER]

`tank`: two movies and plate pictures in a folder, nothing else. `fictrac`: the folder of FicTrac's sample movie. Both
run the commands that `init` names. `wrong`: the first journey with a wrong input at each step. `notebook`: the
toolkit's tutorial cell by cell, further calls of a user, and mistakes with their messages. Values that cannot be
measured are given once, by `--set`. Prints Markdown; errors against the truth if there is one, by the shared
score_track.py.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import re
import resource
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

REPO = Path(__file__).resolve().parents[1]
PROGRAM = [sys.executable, "-m", "sphereorient.cli"]
KNOWN = ["frame_rate=600", "sphere.diameter=18", "exposure=0.0004"]  # of the tank: what cannot be measured
CASES = """
camera_files_of_others: convert-cameras ros_camera_info.yaml --out ros.yaml
camera_files_of_others: convert-cameras anipose.toml --out anipose.yaml
camera_files_of_others: convert-cameras colmap_cameras.txt --out colmap.yaml
edit_list: movie cut.mp4
fictrac_camera_source: init --from-fictrac config.txt
fictrac_empty_ignore: init --from-fictrac config.txt
fictrac_fisheye: init --from-fictrac config.txt
fictrac_no_c2a_r: init --from-fictrac config.txt
hdf5_four_axes: movie nchw.h5
hdf5_four_axes: movie pkg.slp
interlaced: movie interlaced.mp4
matlab_hdf5: movie matlab73.mat
matlab_hdf5: movie h5create.h5
opencv_two_intrinsics: convert-cameras a.yml b.yml --names cam1,cam2 --out c.yaml
openptv_par: convert-cameras cam1.ori cam2.ori --par pyptv.yaml --out c.yaml
time_units: init ms.h5 --vfov 30 --set sphere.diameter=null
variable_rate: movie vfr.mp4
near_ball: check experiment.yaml
sharp_pictures: check experiment.yaml
"""  # of ../shared/cases: files of other programs that once were read wrongly
SHOWN = 60  # letters of a word in the protocol
CALLS = """
import sphereorient; from sphereorient import Trajectory, load_texture
texture = load_texture("texture.png")
bank = TemplateBank(texture.numpy(), size_px=40)
bank = TemplateBank(texture.double(), size_px=40)
disk = SphereRenderer(texture, size_px=40)
bank(disk(R_true))
bank((255 * disk(R_true)).byte().numpy())
track = sphereorient.track_movies("experiment.yaml")
track[10:50].plot()
track[50:10].plot()
"""  # after the tutorial's cells, in a folder with an experiment
MISTAKES = """
load_texture("nofile.png")
load_texture("cam1.mkv")
TemplateBank("texture.png")
TemplateBank(texture.T)
TemplateBank((255 * texture).int())
TemplateBank(255 * texture.numpy())
TemplateBank(texture, size_px=0)
bank(disk(R_true)[1:])
bank(float("nan") * disk(R_true))
SphereRenderer(texture)
disk(2 * R_true)
disk(-R_true)
disk(so3.log(R_true))
PoseFitter("cameras.yaml", texture, radius_mm=9.0, diameter_px=79.0)
PoseFitter(camera, texture, radius_mm=0.0, diameter_px=79.0)
fitter(grey[1:], R_true, truth)
fitter(float("nan") * grey, R_true, truth)
fitter(grey, R_true + 0.1, truth)
PathLayer()(candidates, score[1:], time_s)
PathLayer()(2 * candidates, score, time_s)
PathLayer()(candidates, score, -time_s)
track["a"]
track[3]
sphereorient.track("cam1.mkv")
sphereorient.track_movies("cam1.mkv")
sphereorient.track_movies(["cam1.mkv", "cam2.mkv"])
sphereorient.track_movies("experiment.yaml", method="fast")
Trajectory.load("nofile.h5")
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("journey", choices=("tank", "fictrac", "wrong", "notebook"))
    parser.add_argument("--shared", type=Path, default=REPO.parent / "shared")
    parser.add_argument("--work", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = arguments.work or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        {"tank": tank, "fictrac": fictrac, "wrong": wrong, "notebook": notebook}[arguments.journey](
            arguments.shared, folder
        )


def run(folder: Path, *words: str, wrong: bool = False) -> None:
    """Run a command of the program and print its row; of a wrong one also the refusal or the warnings."""
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run([*PROGRAM, *words], cwd=folder, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - begun
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    lines = [line for line in done.stdout.splitlines() if line.startswith(("doubtful", "fault", "warning", "remark"))]
    if done.returncode == 2:
        lines = done.stderr.strip().splitlines()[-1:]
    last = f"{done.returncode}: " + " / ".join(lines) if wrong else ""
    shown = shlex.join(word if len(word) <= SHOWN else f"{word[:SHOWN]} .." for word in words)
    print(f"| `{shown}` | {wall:.1f} | {cpu:.1f} | {last.replace('|', ' ')} |", flush=True)
    warned = words[0] == "check" and done.returncode == 1
    if done.returncode and not wrong and not warned:
        raise SystemExit(f"{shlex.join(words)}: status {done.returncode}\n{done.stderr}")


def head(what: str) -> None:
    print(f"\n| {what} | wall s | CPU s | message |\n|---|---|---|---|")


def sets(values: Sequence[str]) -> list[str]:
    return [word for value in values for word in ("--set", value)]


def tank_inputs(shared: Path, folder: Path) -> list[str]:
    """Copy movies and plate pictures; return the sizes of the plates for `--set`."""
    for movie in ("cam1.mkv", "cam2.mkv"):
        shutil.copy(shared / "tank" / movie, folder)
    shutil.copytree(shared / "tank" / "calibration", folder / "plates", ignore=shutil.ignore_patterns("*.yaml", "*.h5"))
    known = yaml.safe_load((shared / "tank" / "calibration" / "calibration.yaml").read_text())
    values = {"pixel_pitch": known["pixel_pitch"], "plate.pitch": known["plate"]["pitch"]}
    values |= {f"surveyed.{name}": known["surveyed"][name] for name in ("R_lab_plate", "T_lab_plate")}
    values |= {f"ports.{name}": wall for name, wall in known["ports"].items()}
    return [f"{name}={json.dumps(value)}" for name, value in values.items()]


def tank(shared: Path, folder: Path) -> None:
    """From movies and plate pictures to a report."""
    plates = tank_inputs(shared, folder)
    head("command")
    run(folder, "init", "cam1.mkv", "cam2.mkv", *sets(KNOWN))
    run(folder, "init", "--plate", "plates", *sets(plates))
    run(folder, "calibrate", "calibration.yaml", "--out", "cameras.yaml")
    run(folder, "check", "experiment.yaml")
    run(folder, "track", "experiment.yaml", "--out", "track.h5")
    run(folder, "report", "track.h5", "--experiment", "experiment.yaml", "--out", "report")
    score(shared, folder / "track.h5", shared / "tank" / "truth.h5", "body")


def fictrac(shared: Path, folder: Path) -> None:
    """From FicTrac's folder to a walk."""
    for name in ("config.txt", "sample.mp4"):
        shutil.copy(shared / "real" / "fictrac" / name, folder)
    head("command")
    run(folder, "init", "--from-fictrac", "config.txt", "--set", "frame_rate=30")
    run(folder, "check", "experiment.yaml")
    run(folder, "track", "experiment.yaml", "--out", "track.h5")
    run(folder, "report", "track.h5", "--experiment", "experiment.yaml", "--out", "report")
    run(folder, "export", "track.h5", "--experiment", "experiment.yaml", "--to", "fictrac", "--out", "walk.dat")
    table = np.loadtxt(folder / "walk.dat", delimiter=",")
    print(f"\n{len(table)} rows of {table.shape[1]} columns; {int(np.isfinite(table[:, 1]).sum())} with a rotation")


def wrong(shared: Path, folder: Path) -> None:
    """Make a mistake at each step of the first journey, then correct it."""
    plates = tank_inputs(shared, folder)
    head("command, with a wrong input")
    run(folder, "init", "cam1.mkv", "cam3.mkv", *sets(KNOWN), wrong=True)
    run(folder, "init", "cam1.mkv", "plates/cam1_00.png", *sets(KNOWN), wrong=True)
    run(folder, "init", "cam1.mkv", "cam2.mkv", *sets(["sphere.diameter=eighteen"]), wrong=True)
    run(folder, "init", "--plate", "plate", wrong=True)
    run(folder, "track", "cam1.mkv", "--out", "track.h5", wrong=True)
    run(folder, "init", "cam1.mkv", "cam2.mkv", "-q")
    run(folder, "check", "experiment.yaml", wrong=True)
    run(folder, "init", "cam1.mkv", "cam2.mkv", *sets(KNOWN), "--force", "-q")
    run(folder, "track", "experiment.yaml", "--out", "track.h5", wrong=True)
    pitch = [part for part in plates if not part.startswith("plate.pitch")]
    run(folder, "init", "--plate", "plates", *sets([*pitch, "plate.pitch=6"]), "-q")
    run(folder, "calibrate", "calibration.yaml", "--out", "cameras.yaml", wrong=True)
    walls = [part for part in plates if not part.startswith("ports")]
    run(folder, "init", "--plate", "plates", *sets(walls), "--force", "-q")
    run(folder, "calibrate", "calibration.yaml", "--out", "cameras.yaml", wrong=True)
    run(folder, "init", "--plate", "plates", *sets(plates), "--force", "-q")
    run(folder, "calibrate", "calibration.yaml", "--out", "cameras.yaml", "-q")
    run(folder, "track", "experiment.yaml", "--out", "track.h5", wrong=True)
    (folder / "texture_seen.png").unlink()  # of the map that this run has learnt
    picture = cv2.imread(str(folder / "plates" / "cam1_00.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(folder / "texture.png"), cv2.resize(picture, (512, 256)))
    run(folder, "track", "experiment.yaml", "--out", "track.h5", wrong=True)
    shutil.copy(shared / "experiment" / "texture.png", folder)
    run(folder, "track", "experiment.yaml", "--out", "track.h5", wrong=True)
    shutil.copy(shared / "tank" / "texture.png", folder)
    swapped = (
        (folder / "experiment.yaml")
        .read_text()
        .replace("{cam1: cam1.mkv, cam2: cam2.mkv}", "{cam1: cam2.mkv, cam2: cam1.mkv}")
    )
    (folder / "swapped.yaml").write_text(swapped)
    run(folder, "check", "swapped.yaml", wrong=True)
    run(folder, "track", "swapped.yaml", "--out", "track.h5", wrong=True)
    run(folder, "track", "experiment.yaml", "--out", "plates", wrong=True)
    run(folder, "report", "experiment.yaml", "--out", "report", wrong=True)
    head("command, with a file of another program")
    for case in CASES.strip().splitlines():
        name, words = case.split(": ")
        shutil.copytree(shared / "cases" / name, folder / name, dirs_exist_ok=True)
        run(folder / name, *words.split(), "--force", wrong=True)


def notebook(shared: Path, folder: Path) -> None:
    """Run the toolkit's tutorial as a notebook does, in this process, which has not imported the package yet."""
    os.environ.setdefault("MPLBACKEND", "agg")
    for path in (shared / "experiment").glob("*.*"):
        shutil.copy(path, folder)
    os.chdir(folder)
    names: dict[str, Any] = {"__name__": "__main__"}
    parts = re.split(r"^# %%", (REPO / "docs" / "tutorials" / "toolkit.py").read_text(), flags=re.MULTILINE)[1:]
    cells = [part for part in parts if not part.startswith(" [markdown]")]
    head("cell")
    first, begun = "", (time.perf_counter(), time.process_time())
    for number, cell in enumerate(cells, start=1):
        row(f"cell {number}", cell, names)
        if not first and names["plt"].get_fignums():
            wall, cpu = time.perf_counter() - begun[0], time.process_time() - begun[1]
            first = f"{wall:.1f} s, CPU {cpu:.1f} s"
    print(f"\n{len(cells)} cells, 0 files edited by hand; to the first figure {first}")
    head("further call")
    for call in CALLS.strip().splitlines():
        row(f"`{call}`", call, names)
    head("mistake")
    for call in MISTAKES.strip().splitlines():
        row(f"`{call}`", call, names, wrong=True)


def row(title: str, code: str, names: dict[str, Any], wrong: bool = False) -> None:
    """Run code in a namespace and print its row, with its output or, of a mistake, the error."""
    printed, error = io.StringIO(), ""
    wall, cpu = time.perf_counter(), time.process_time()
    with contextlib.redirect_stdout(printed):
        try:
            exec(code, names)
        except Exception as problem:
            if not wrong:
                raise
            error = f"{type(problem).__name__}: {problem}"
    message = " / ".join((error if wrong else printed.getvalue()).splitlines()) or ("no error" if wrong else "")
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(f"| {title} | {wall:.1f} | {cpu:.1f} | {message.replace('|', ' ')} |", flush=True)


def score(shared: Path, track: Path, truth: Path, align: str) -> None:
    """Print the errors: of orientations after one rotation of the body frame, of positions as they are."""
    command = [sys.executable, str(shared / "score_track.py"), str(track), str(truth)]
    found: dict[str, float] = {}
    for name, more in (("position", []), ("orientation", ["--align", align])):
        output = subprocess.run([*command, *more], capture_output=True, text=True, check=True, env=os.environ).stdout
        found |= {key: value for key, value in json.loads(output).items() if key.startswith(name)}
    names = ("orientation_p50_deg", "orientation_p95_deg", "position_p50_mm", "position_p95_mm")
    print("\n" + "; ".join(f"{name} {found[name]:.4g}" for name in names if found.get(name) is not None))


if __name__ == "__main__":
    main()
