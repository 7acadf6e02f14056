import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from torch import Tensor

from sphereorient.errors import SettingsError, SphereOrientError
from sphereorient.experiment import Experiment
from sphereorient.experiment.recording import CameraStream, Recording, given_scene, open_recording
from sphereorient.experiment.timeline import Timeline
from sphereorient.files.threads import Progress, silent
from sphereorient.locate import find_scenes, known_diameter_px
from sphereorient.methods.proposers import as_near
from sphereorient.methods.settings import Settings
from sphereorient.preflight import cameras, movies, texture_map
from sphereorient.preflight.finding import FAULT, Finding, Severity, judged, warning
from sphereorient.preflight.in_step import OffsetScan, liveliest_stretches, scan_offsets
from sphereorient.preflight.sample import MovieSample, sample_more, sample_movie
from sphereorient.preflight.scene import SceneView, look_at_scene
from sphereorient.search import GreySearch
from sphereorient.sphere import load_texture, load_unseen

BRIEF = {"appearance_frames": 8, "chunks": 1}  # settings that suffice for a short stretch


@dataclass(frozen=True, kw_only=True, eq=False)
class Preflight:
    """Measurements and findings of a check; made by `preflight`, read by the report and the command line."""

    experiment: Experiment
    timeline: Timeline
    samples: tuple[MovieSample, ...] = ()
    closer: tuple[tuple[MovieSample, ...], ...] = ()  # consecutive frames: by stretch, then by camera
    scans: tuple[OffsetScan, ...] = ()  # of each other camera against the first
    texture: Tensor | None = None  # (H, 2 H)
    unseen: Tensor | None = None  # (H, 2 H) bool, texels of unseen paint; None: all are seen
    measures: texture_map.TextureMeasures | None = None
    similar: texture_map.ViewPair | None = None
    tracked: cameras.Tracked = cameras.NOT_TRACKED  # a short stretch; no findings with one camera or without a map
    matches: tuple[texture_map.TextureMatch, ...] = ()
    fitted: tuple[str, ...] = ()  # cameras in which the tracker fits the map, but the search by outlines fails
    scene: tuple[SceneView, ...] = ()  # of several balls: a picture of each camera
    findings: tuple[Finding, ...] = ()

    @property
    def severity(self) -> Severity:
        """The worst of all findings; OK if there are none."""
        return max((one.severity for one in self.findings), key=list(Severity).index, default=Severity.OK)


def preflight(
    experiment: Experiment | Path | str, settings: Settings | None = None, progress: Progress = silent
) -> Preflight:
    """Check an experiment before a run: files, cameras, movies, ball, paint, light; `settings`: of the planned run.
    Raises SphereOrientError: a file is missing or unreadable, or contradicts the others.
    """
    settings = settings or Settings()
    with open_recording(experiment, textured=False) as recording, ThreadPoolExecutor(3) as pool:
        # Threads: decoding, outlines and matrix products release the interpreter lock.
        experiment = recording.experiment
        if not experiment.alone:
            scene, found = look_at_scene(recording, settings, progress)
            checked = Preflight(experiment=experiment, timeline=recording.timeline, scene=scene)
            return replace(checked, findings=tuple(_findings(checked, found)))
        image, unseen = None, None
        if experiment.texture_path is not None and experiment.texture_path.exists():
            image, unseen = load_texture(experiment.texture_path), load_unseen(experiment.texture_path)
        sizes, wrong_sizes = _expected_sizes(recording, settings)
        progress("frames", 0, len(recording.streams))
        refine = settings.refine.model_copy(update=BRIEF)
        planned = Settings(locate=settings.locate, search=settings.search, refine=refine)
        both = image is not None and len(recording.streams) > 1
        learning = pool.submit(cameras.learn_appearance, experiment, planned) if both else None
        sampling = [pool.submit(_sample, recording, one, sizes[one.name], settings) for one in recording.streams]
        measures = image is not None and pool.submit(texture_map.measure_texture, image)
        similar = image is not None and pool.submit(texture_map.most_similar_views, image, settings.search)
        samples = tuple(one.result() for one in sampling)
        most = max((one.frame for one in samples), key=len).tolist()  # more of a camera without a ball
        samples = tuple(
            one if len(one.frame) == len(most) else sample_more(one, most, settings.locate) for one in samples
        )
        near = as_near(settings.search, [(sample.camera, sample.diameter_px) for sample in samples])
        search = image is not None and pool.submit(GreySearch, image, near)
        progress("frames", len(samples), len(samples))
        closer, scans = _offsets(samples, settings, pool)
        progress("paint", 0, 1)
        matches = tuple(texture_map.match_texture(search.result(), samples) if search else ())
        doubted = [match.name for match in matches if texture_map.shows_no_map(match)]
        alone = {name: pool.submit(cameras.learn_appearance, experiment, planned, (name,)) for name in doubted}
        tracked = cameras.NOT_TRACKED
        if learning is not None and closer and any(sample.balls for sample in samples):
            first = int(recording.timeline.number[closer[0][0].frame[0]])
            tracked = cameras.track_stretch(experiment, planned, learning, closer[0], first)
        checked = Preflight(
            experiment=experiment,
            timeline=recording.timeline,
            samples=samples,
            closer=closer,
            scans=scans,
            texture=image,
            unseen=unseen,
            matches=matches,
            fitted=tuple(name for name, one in alone.items() if one.exception() is None),
            measures=measures.result() if measures else None,
            similar=similar.result() if similar else None,
            tracked=tracked,
        )
        progress("paint", 1, 1)
        return replace(checked, findings=tuple(_findings(checked, wrong_sizes)))


def _sample(recording: Recording, stream: CameraStream, size_px: float | None, settings: Settings) -> MovieSample:
    scene, empty = None, given_scene(recording.experiment, stream.name, stream.movie.frame_shape)
    with suppress(SphereOrientError):  # the findings report what a tracker would refuse
        (scene,) = find_scenes(recording, stream, settings.refine.background_frames, settings.locate).values()
    return sample_movie(stream, size_px, settings.locate, empty, scene, recording.experiment.sphere.in_place)


def _findings(seen: Preflight, first: Sequence[Finding]) -> Iterator[Finding]:
    """Yield all findings, `first` those that are known."""
    yield movies.frames(seen.experiment, seen.timeline)
    yield from movies.outside(seen.experiment)
    yield from first
    for k, sample in enumerate(seen.samples):
        yield movies.movie_file(sample)
        yield movies.pictures([sample, *(stretch[k] for stretch in seen.closer)])
        yield movies.background(sample, seen.experiment)
        yield movies.ball(sample)
    yield from cameras.camera_findings(seen.experiment, seen.samples, seen.scans, seen.tracked)
    if seen.samples:
        yield from _texture_findings(seen)
    for sample in seen.samples:
        yield movies.exposure(sample)
        yield movies.sharpness(sample)
        yield movies.motion_blur(sample, seen.experiment.exposure_s, seen.timeline.frame_s)


def _texture_findings(seen: Preflight) -> Iterator[Finding]:
    if seen.measures is None or seen.similar is None:
        path = seen.experiment.texture_path
        measured = "no texture map is given" if path is None else f"no texture map yet: {path.name} does not exist"
        target = path or seen.experiment.folder / "texture.png"
        do = f"track learns one; a finer one: sphereorient map {seen.experiment.path} --out {target}"
        yield warning("paint", measured, do if path else f"{do}; then add it under sphere: as texture:")
        return
    radii = [float(sample.sightings.radius_px.nanmedian()) for sample in seen.samples]
    least_px = min((r for r in radii if not math.isnan(r)), default=seen.samples[0].diameter_px / 2)
    yield (paint := texture_map.judge_contrast(seen.measures, least_px))
    if paint.severity is FAULT:  # a map of one colour makes the other checks meaningless
        return
    yield texture_map.look_alikes(seen.similar)
    if seen.unseen is not None:
        yield texture_map.unknown_paint(seen.unseen)
    yield from (texture_map.map_fits(match, seen.matches, match.name in seen.fitted) for match in seen.matches)


def _expected_sizes(recording: Recording, settings: Settings) -> tuple[dict[str, float | None], list[Finding]]:
    """Return the expected diameter in each camera, px, None if unknown, and findings for impossible ones."""
    sizes: dict[str, float | None] = dict.fromkeys(recording.experiment.cameras, settings.locate.diameter_px)
    findings = []
    for stream in recording.streams if recording.experiment.diameter_mm is not None else ():
        try:
            sizes[stream.name] = known_diameter_px(recording, stream, settings.locate)
        except SettingsError as error:
            advice = "check sphere.diameter and the lengths in cameras.yaml: all are mm"
            findings.append(judged(f"expected size {stream.name}", str(error), (True, FAULT, advice)))
    return sizes, findings


def _offsets(
    samples: Sequence[MovieSample], settings: Settings, pool: ThreadPoolExecutor
) -> tuple[tuple[tuple[MovieSample, ...], ...], tuple[OffsetScan, ...]]:
    """Sample the stretches with most motion, and scan the offset between the first movie and each other one."""
    if len(samples) < 2:
        return (), ()
    parts = [
        [pool.submit(sample_more, sample, frames, settings.locate) for sample in samples]
        for frames in liveliest_stretches(samples)
    ]
    closer = tuple(tuple(one.result() for one in part) for part in parts)
    first, *others = samples

    def scan(k: int, other: MovieSample) -> OffsetScan:
        centres = [(stretch[0].sightings.centre_px, stretch[k].sightings.centre_px) for stretch in closer]
        return scan_offsets((first.name, other.name), (first.camera, other.camera), centres)

    return closer, tuple(scan(k, other) for k, other in enumerate(others, 1))
