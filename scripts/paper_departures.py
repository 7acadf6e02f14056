"""Measure what each departure from the paper changes (docs/paper-map.md): method `paper`, then with one undone.

    scripts/paper_departures.py EXPERIMENT_FOLDER [--only NAME ...] [--list]

The folder holds experiment.yaml and truth.h5. Prints a Markdown table, a row a departure: errors of the orientation, of
each camera's own path and of its best candidate, frames wrong by more than 10 degrees, errors of omega and of the
position. Stages before the departure are computed once: a row takes seconds to a minute.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

from sphereorient import assemble, so3
from sphereorient.assemble import two_cameras
from sphereorient.bench.score import score_track, true_orientations
from sphereorient.cameras import R_cam_view
from sphereorient.locate import scene
from sphereorient.methods import paper
from sphereorient.methods.settings import load_settings
from sphereorient.motion import measure
from sphereorient.run.stages import track_movies
from sphereorient.search import template_bank
from sphereorient.trajectory import Trajectory
from sphereorient.trajectory.rotations import distance_deg

STAGES = ("locate_sphere", "propose_orientations")
# Number of unchanged stages, settings, and a context that replaces code.
Change = tuple[int, tuple[str, ...], Callable[[], Any] | None]


def setting(kept: int, *overrides: str) -> Change:
    return kept, overrides, None


def plain_mean(pictures: np.ndarray, *rest: Any, learn: Callable[..., Any] = scene.learn_background) -> Any:
    """The paper's background: the mean of all frames, the ball's included."""
    return replace(learn(pictures, *rest), mean=pictures.mean(axis=0, dtype=np.float32))


def majority(disks: Tensor, inside: Tensor, settings: Any) -> Tensor:
    """Paint by two of Otsu's three votes instead of all three."""
    grey = template_bank.stretch_contrast(disks, inside, settings.black_share, settings.white_share)
    one_hot = template_bank._one_hot(grey, inside)
    threshold, _ = template_bank.otsu(one_hot.sum((-2, -1)))
    votes = [grey > threshold[:, None, None]]
    for share in settings.regions:
        votes.append(grey > template_bank._moving_threshold(one_hot, threshold, share, settings.region_contrast_min))
    return torch.where(sum(vote.int() for vote in votes) >= 2, 1.0, -1.0) * inside


@contextmanager
def perspective_after() -> Iterator[None]:
    """Remove the perspective from each camera's finished path, as the paper does, instead of from its candidates."""
    turns: dict[str, Tensor] = {}

    def uncorrected(proposals: Any, camera: Any, centre_px: Tensor) -> Any:
        direction_cam = camera.rays(centre_px).direction_lab @ camera.R_cam_lab.mT
        turns[str(len(turns))] = camera.R_cam_lab.mT @ R_cam_view(direction_cam) @ camera.R_cam_lab
        return replace(proposals, R_lab_view=camera.R_cam_lab.mT.expand(len(proposals), 3, 3))

    def paths(candidates: Any, clock: Tensor, settings: Any) -> Any:
        chosen = assemble_paths(candidates, clock, settings)
        for name, turn in zip(candidates, turns.values(), strict=True):
            view = candidates[name].R_lab_view
            object.__setattr__(candidates[name], "R_lab_view", turn @ view)
            chosen[name] = replace(chosen[name], R_lab_body=turn @ chosen[name].R_lab_body)
        return chosen

    assemble_paths = assemble.assemble_paths
    with patch.object(paper, "in_the_lab", uncorrected), patch.object(assemble, "assemble_paths", paths):
        yield


def forward(R: Tensor, dt_s: float, separations: Any, *, segment: Tensor | None = None, **rest: Any) -> Any:
    """Give omega as in the paper: the plain mean over m of the turn from frame k to k + m."""
    found = [so3.log(R[m:] @ R[:-m].mT) / (m * dt_s) for m in separations]
    found = [torch.nn.functional.pad(one, (0, 0, 0, len(R) - len(one)), value=torch.nan) for one in found]
    omega = torch.stack(found).mean(0)
    return omega, torch.full_like(omega, torch.nan)


def limits_off() -> Any:
    stack = ExitStack()
    for name in ("VARIANCE_RANGE", "CAMERAS_RATIO_MAX"):
        stack.enter_context(patch.object(two_cameras, name, 1e12))
    return stack


def changes() -> dict[str, Change]:
    """Return the change that undoes each departure, by name."""
    return {
        "as it is": setting(0),
        "background: plain mean, the ball in it": (0, (), lambda: patch.object(scene, "learn_background", plain_mean)),
        "no outliers replaced": setting(0, "locate.outlier_px=1000.0"),
        "disks of 64 px": setting(1, "orient.size_px=64"),
        "Otsu by majority": (1, (), lambda: patch.object(template_bank, "extract_paint", majority)),
        "moving regions always count": setting(1, "orient.region_contrast_min=0.0"),
        "templates as sharp as one ray a pixel": (
            1,
            (),
            lambda: patch.object(template_bank, "REAL", template_bank.HALF),
        ),
        "within 0.96 of the radius": setting(1, "orient.disk_share=0.96"),
        "twins not merged": (
            1,
            (),
            lambda: patch.object(
                template_bank, "distinct", lambda R, apart: torch.ones(R.shape[:-2], dtype=torch.bool)
            ),
        ),
        "groups of 45 degrees": setting(1, "orient.group_deg=45.0"),
        "no runaways": setting(1, "orient.groups_max=1000"),
        "perspective removed after the path": (1, (), perspective_after),
        "spikes of any angle": setting(2, "assemble.spike_min_deg=0.001"),
        "no repair": setting(2, "assemble.repair_deg=180.0"),
        "leader by continuity": setting(2, "assemble.repair_margin=2.0"),
        "weights not limited": (2, (), limits_off),
        "omega from frame k to k + m": (2, (), lambda: patch.object(measure, "omega_from_orientations", forward)),
        "fine grid to 8.5 degrees": setting(1, "orient.fine_radius_deg=8.5"),
        "fine grid with all pixels": (1, (), lambda: patch.object(template_bank, "SEMIFINALISTS", 1)),
    }


def tracked(folder: Path, name: str, kept: dict[tuple[str, str], Any]) -> Trajectory:
    """Track with one change; stages before it are taken from `kept`, which the run "as it is" fills."""
    stay, overrides, change = changes()[name]

    def stage(label: str, of: Callable[..., Any], *arguments: Any) -> Any:
        stream = next(one for one in arguments if hasattr(one, "movie"))
        place = (label, stream.name)
        if STAGES.index(label) >= stay:
            found = of(*arguments)
            if name != "as it is":
                return found
            kept[place] = found
        return replace(kept[place])

    with ExitStack() as stack:
        if change is not None:
            stack.enter_context(change())
        for label in STAGES:
            stack.enter_context(patch.object(paper, label, partial(stage, label, getattr(paper, label))))
        return track_movies(folder / "experiment.yaml", method="paper", settings=load_settings(None, overrides))


def row(track: Trajectory, truth: Path, name: str) -> str:
    score = score_track(track, truth)
    R_true = true_orientations(truth, track.time)
    p50, p95, _, largest = score.percentiles_deg()
    own, best = [], []
    for camera, errors in score.camera_orientation_deg.items():
        own.append(f"{np.nanmedian(errors):.2f}, {np.sum(errors > 10)}")
        one = track.cameras[camera]
        frame = np.repeat(np.arange(len(track)), np.diff(one.candidate_offset))
        errors = distance_deg(one.candidate_orientation, R_true[frame])
        nearest = [errors[frame == k].min() for k in np.unique(frame)]
        best.append(f"{np.median(nearest):.2f}, {len(frame) / len(track):.1f}")
    cells = [
        name,
        f"{score.valid.sum()} of {len(track)}",
        f"{p50:.3f} / {p95:.2f} / {largest:.2f}",
        f"{np.sum(score.orientation_deg > 10)}",
        " - ".join(own),
        " - ".join(best),
        f"{100 * score.relative_rms['omega_lab']:.2f} %",
        f"{score.percentiles_mm()[0]:.3f}",
    ]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="*", help="names of departures; default: all")
    parser.add_argument("--list", action="store_true", help="print the names")
    options = parser.parse_args()
    names = list(changes())
    if options.list:
        print("\n".join(names))
        return
    heads = "changed, valid, fused p50 / p95 / max °, wrong, own p50 °; wrong, best candidate p50 °; number, omega, mm"
    print("| " + heads.replace(", ", " | ") + " |\n|" + "---|" * len(heads.split(", ")))
    kept: dict[tuple[str, str], Any] = {}
    for name in [names[0], *(options.only or names[1:])]:
        print(row(tracked(options.folder, name, kept), options.folder / "truth.h5", name), flush=True)


if __name__ == "__main__":
    main()
