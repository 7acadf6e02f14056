"""Which experiment a track belongs to, and what it says of the sphere and the flow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sphereorient.errors import ExperimentError, refusal
from sphereorient.experiment import Experiment
from sphereorient.statistics import Surroundings
from sphereorient.trajectory import Trajectory

FLOW_KEYS = {
    "viscosity": "viscosity_m2_s",
    "dissipation": "dissipation_w_kg",
    "u_rms": "u_rms_m_s",
    "integral_length": "integral_length_m",
}


def experiments_of(tracks: Mapping[str, Trajectory], experiments: Sequence[Experiment]) -> dict[str, Experiment | None]:
    """Find the experiment of each track by its name; a single one belongs to a single track anyway.

    Args:
        tracks: by the name of their file.
        experiments: those that were given.

    Returns:
        By the name of the file; None where none was given.

    Raises:
        ExperimentError: an experiment of no track, or two of one name.
    """
    if len(tracks) == 1 and len(experiments) == 1:
        return dict.fromkeys(tracks, experiments[0])
    known: dict[str, Experiment] = {}
    for experiment in experiments:
        if experiment.name in known:
            do = "give them different names (key `name`), or report them one by one"
            got = f"{known[experiment.name].path} and {experiment.path}"
            raise ExperimentError(
                refusal(f"--experiment '{experiment.name}'", expected="one of a name", got=got, do=do)
            )
        known[experiment.name] = experiment
    wanted = {track.experiment for track in tracks.values()}
    for name, experiment in known.items():
        if name not in wanted:
            do = "pass the experiment.yaml that the track was measured from"
            names = ", ".join(sorted(wanted)[:5])
            raise ExperimentError(
                refusal(str(experiment.path), expected=f"the name of one of {names}", got=name, do=do)
            )
    return {name: known.get(track.experiment) for name, track in tracks.items()}


def surroundings_of(experiments: Sequence[Experiment]) -> Surroundings:
    """Return what experiments say of the sphere and the flow.

    Args:
        experiments: all of one report; the same sphere in the same flow.

    Raises:
        ExperimentError: they contradict each other.
    """
    known: dict[str, float] = {}
    for experiment in experiments:
        said = {FLOW_KEYS[key]: value for key, value in experiment.flow.items() if key in FLOW_KEYS}
        if experiment.diameter_mm is not None:
            said["diameter_mm"] = experiment.diameter_mm
        for key, value in said.items():
            if known.setdefault(key, value) != value:
                do = "report spheres and flows of one kind together, the others by themselves"
                label, got = f"{experiment.path}, {key}", f"{value:g}"
                raise ExperimentError(refusal(label, expected=f"{known[key]:g} as before", got=got, do=do))
    return Surroundings(**known)
