"""The whole way on one page: the only place that knows the order.

movies -> locate -> orient -> assemble -> motion -> Trajectory
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch

from sphereorient.errors import SettingsError, refusal
from sphereorient.experiment import Experiment, input_files
from sphereorient.experiment.recording import Progress, Recording, open_recording, silent
from sphereorient.files.provenance import provenance, sha256
from sphereorient.methods import results
from sphereorient.methods.learnt import Learnt
from sphereorient.methods.paper import track_paper
from sphereorient.methods.precise import track_precise
from sphereorient.methods.proposers import checkpoint_path
from sphereorient.methods.settings import DEFAULT_METHOD, METHODS, Settings, settings_yaml
from sphereorient.trajectory import Trajectory


def track_movies(
    experiment: Experiment | str | Path,
    *,
    method: str = DEFAULT_METHOD,
    settings: Settings | None = None,
    cameras: Sequence[str] | None = None,
    device: str = "cpu",
    learnt: Learnt | None = None,
    proposer: str | Path | None = None,
    progress: Progress = silent,
    command: str = "sphereorient.track_movies",
) -> Trajectory:
    """Measure position and absolute orientation of the sphere in every frame.

    Args:
        experiment: as loaded, or the path of its experiment.yaml.
        method: "precise", refined poses with covariances; "paper", Zimmermann et al. 2011 with the corrections of
            docs/paper-map.md.
        settings: None: the method's defaults.
        cameras: names of those to use; None: all.
        device: where fits are computed, as torch names it: cpu, cuda, cuda:1.
        learnt: what another run learnt of the empty scene, the light and the motion; None learns it (precise only).
        proposer: a trained network's checkpoint that proposes orientations, "default" for the one that comes along
            (docs/proposer.md); None: what the settings say, without any the template search.
        progress: told how far each stage is.
        command: what the track's provenance names as its origin.

    Returns:
        The trajectory, frame by frame; lengths mm, angles rad, see docs/data-format.md.

    Raises:
        SphereOrientError: inputs that are missing, unreadable or do not fit together.
    """
    check_method(method, learnt is not None)
    there = torch_device(device)
    settings = with_proposer(settings or Settings(), proposer)
    with open_recording(experiment, cameras) as recording, one_thread():
        if method == "paper":
            track = track_paper(recording, settings, progress)
        else:
            track, _ = track_precise(recording, settings, there, learnt, progress)
        return finished(track, recording, method, settings, command)


def finished(track: Trajectory, recording: Recording, method: str, settings: Settings, command: str) -> Trajectory:
    """Return a track with what the calibration's errors do to it, and with where it comes from."""
    track = results.with_systematic_errors(track, recording.cameras, recording.covariance, recording.radius_mm)
    origin = provenance(
        input_files(recording.experiment, list(recording.cameras)), recording.experiment.folder, command
    )
    origin["remarks"] = list(recording.remarks)
    if settings.propose.checkpoint is not None:
        origin["proposer_sha256"] = sha256(checkpoint_path(settings.propose.checkpoint))
    return replace(track, method=method, settings=settings_yaml(settings), provenance=origin)


def with_proposer(settings: Settings, proposer: str | Path | None) -> Settings:
    """Return settings with a checkpoint that proposes; as they are for None."""
    if proposer is None:
        return settings
    return settings.model_copy(update={"propose": settings.propose.model_copy(update={"checkpoint": str(proposer)})})


def check_method(method: str, learnt: bool) -> None:
    """Refuse a method that there is not, and knowledge that a method has no use for."""
    if method not in METHODS:
        raise SettingsError(refusal("method", expected=" or ".join(METHODS), got=repr(method), do="name one of these"))
    if learnt and method != "precise":
        do = "leave it out, or use method precise"
        raise SettingsError(refusal("learnt", expected="method precise", got=f"method {method}", do=do))


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep torch to one thread for a while: its tensors here are small, and idle threads that spin starve decoding."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def torch_device(name: str) -> torch.device:
    """Return a device that is there.

    Raises:
        SettingsError: torch cannot use it.
    """
    try:
        device = torch.device(name)
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        got, do = f"'{name}': {str(error).splitlines()[0]}", "name cpu, or install torch for your GPU"
        raise SettingsError(refusal("device", expected="a device that torch can use", got=got, do=do)) from None
    return device
