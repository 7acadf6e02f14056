"""The check on one page: read a few frames, look at each thing that could be wrong, say what to do."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from sphereorient.errors import SettingsError
from sphereorient.experiment import Experiment, load_experiment, open_movies
from sphereorient.experiment.recording import Progress, silent
from sphereorient.experiment.timeline import Timeline, timeline
from sphereorient.locate import expected_diameter_px
from sphereorient.methods.settings import Settings
from sphereorient.movies import Movie
from sphereorient.preflight import alike, diameter, exposure, files, gap, match, offset, paint
from sphereorient.preflight.finding import Finding, Severity, worst
from sphereorient.preflight.look import Look, look_at, look_closer
from sphereorient.search import GreySearch
from sphereorient.sphere import load_texture


@dataclass(frozen=True, kw_only=True, eq=False)
class Preflight:
    """What a check found, and the arrays of its figure; made by `preflight`, read by report and the command line."""

    experiment: Experiment
    findings: tuple[Finding, ...]
    looks: tuple[Look, ...]
    steps: offset.Steps | None  # None with one camera
    texture: Tensor | None  # (H, 2 H)
    paint: paint.Paint | None
    alike: alike.Alike | None

    @property
    def severity(self) -> Severity:
        """The worst of all findings."""
        return worst(list(self.findings))


def preflight(
    experiment: Experiment | Path | str, settings: Settings | None = None, progress: Progress = silent
) -> Preflight:
    """Check an experiment in seconds, before hours of work: files, cameras, movies, ball, paint, light.

    Args:
        experiment: as loaded, or the path of its experiment.yaml.
        settings: of the run that is meant; None: the defaults.
        progress: told how far each stage is.

    Raises:
        SphereOrientError: a file is missing, unreadable, or does not fit the others at all.
    """
    if not isinstance(experiment, Experiment):
        experiment = load_experiment(Path(experiment))
    settings = settings or Settings()
    movies = open_movies(experiment)
    return _checked(experiment, movies, timeline(experiment, movies), settings, progress)


def _checked(
    experiment: Experiment, movies: Mapping[str, Movie], when: Timeline, settings: Settings, progress: Progress
) -> Preflight:
    texture = None if experiment.texture_path is None else load_texture(experiment.texture_path)
    sizes, impossible = _sizes(experiment, settings)
    with ThreadPoolExecutor(3) as pool:  # decoding, outlines and products leave the interpreter free
        progress("frames", 0, len(movies))
        looking = [
            pool.submit(look_at, name, experiment, movie, when, sizes[name], settings.locate)
            for name, movie in movies.items()
        ]
        painted = texture is not None and pool.submit(paint.measure_paint, texture)
        pair = texture is not None and pool.submit(alike.most_alike, texture, settings.search)
        search = texture is not None and pool.submit(GreySearch, texture, settings.search)
        looks = [one.result() for one in looking]
        progress("frames", len(looks), len(looks))
        closer = _stretches(looks, when, settings)
        steps = _steps(looks, closer) if len(looks) == 2 else None
        progress("paint", 0, 1)
        matches = match.match_map(search.result(), looks) if search else []
        measures, twins = (painted.result() if painted else None), (pair.result() if pair else None)
        progress("paint", 1, 1)
    findings = [files.clock(experiment, when), *files.outside(experiment), *impossible]
    for k, look in enumerate(looks):
        near = [stretch[k] for stretch in closer]
        findings += [
            files.movie(look),
            files.pictures([look, *near]),
            files.empty_scene(look, experiment),
            files.ball(look),
        ]
    findings += _of_the_cameras(experiment, looks, steps)
    findings += _of_the_paint(looks, measures, twins, matches, in_step=steps is None or steps.shift == 0)
    for look in looks:
        findings += [
            exposure.exposure(look.name, exposure.levels_of(look)),
            exposure.sharpness(look, exposure.limb_blur_px(look)),
            exposure.smear(look, experiment.exposure_s, when.frame_s),
        ]
    return Preflight(
        experiment=experiment,
        findings=tuple(findings),
        looks=tuple(looks),
        steps=steps,
        texture=texture,
        paint=measures,
        alike=twins,
    )


def _sizes(experiment: Experiment, settings: Settings) -> tuple[dict[str, float | None], list[Finding]]:
    """Return the diameter to look for in each camera, px, None where it is unknown; and what is wrong with it."""
    sizes: dict[str, float | None] = dict.fromkeys(experiment.cameras, settings.locate.diameter_px)
    findings = []
    for name in experiment.cameras:
        if sizes[name] is not None or experiment.diameter_mm is None:
            continue
        try:
            sizes[name] = expected_diameter_px(name, experiment.cameras, experiment.diameter_mm)
        except SettingsError as error:
            title = f"expected size {name}"
            advice = "check sphere.diameter and the lengths in cameras.yaml: all are mm"
            findings.append(Finding(title=title, severity=Severity.FAULT, measured=str(error), advice=advice))
    return sizes, findings


def _stretches(looks: Sequence[Look], when: Timeline, settings: Settings) -> list[list[Look]]:
    """Look at consecutive frames of two cameras where the ball moves most; nowhere with one camera."""
    if len(looks) != 2:
        return []
    ranges = offset.liveliest_stretches(looks, len(when))
    with ThreadPoolExecutor(2) as pool:
        parts = [[pool.submit(look_closer, look, when, frames, settings.locate) for look in looks] for frames in ranges]
        return [[look.result() for look in part] for part in parts]


def _steps(looks: Sequence[Look], closer: Sequence[Sequence[Look]]) -> offset.Steps:
    """Measure how the gap depends on the shift between the movies."""
    centres = [(first.sightings.centre_px, second.sightings.centre_px) for first, second in closer]
    return offset.gap_by_offset([look.name for look in looks], [look.camera for look in looks], centres)


def _of_the_cameras(experiment: Experiment, looks: Sequence[Look], steps: offset.Steps | None) -> list[Finding]:
    if steps is None or experiment.diameter_mm is None:
        alone = [diameter.size_of_one(look) for look in looks]
    if steps is None:
        return alone
    findings = [
        gap.lines_of_sight(looks, steps.in_step_px if steps.shift else None),
        offset.step(steps, experiment.start),
    ]
    if experiment.diameter_mm is None:
        return [*findings, *alone]
    ratios = diameter.size_ratios(looks, experiment.diameter_mm)
    radius_px = {look.name: float(look.sightings.radius_px.nanmedian()) for look in looks}
    return [*findings, diameter.size(ratios, radius_px, experiment.diameter_mm)]


def _of_the_paint(
    looks: Sequence[Look],
    measures: paint.Paint | None,
    twins: alike.Alike | None,
    matches: Sequence[match.Match],
    in_step: bool,
) -> list[Finding]:
    if measures is None or twins is None:
        advice = "give sphere.texture, the map of the paint: orientations are told by it"
        return [Finding(title="paint", severity=Severity.WARNING, measured="no map is given", advice=advice)]
    seen = [look.sightings.radius_px.nanmedian() for look in looks]
    radius_px = min((float(r) for r in seen if not math.isnan(r)), default=looks[0].diameter_px / 2)
    findings = [paint.paint(measures, radius_px)]
    if findings[0].severity is Severity.FAULT:  # nothing more can be said of one colour
        return findings
    findings.append(alike.look_alikes(twins))
    findings += [match.map_fits(one, matches) for one in matches]
    # Two instants, or two views that cannot be told apart, would be laid to the cameras.
    if len(matches) == 2 and in_step and findings[1].severity is not Severity.FAULT:
        findings.append(match.one_ball(matches))
    return findings
