"""`sphereorient track` and `live`."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from sphereorient.cli.app import app, check_writable, command_line, echo_lines, new_table, print_table, progress_bar
from sphereorient.cli.options import CameraOptions, ExperimentPath, FicTracConfigPath, NoCache, Resume, ball_words
from sphereorient.errors import OutputError, PaintError, SettingsError, SphereOrientError, refusal
from sphereorient.files.whole_file import check_ending

if TYPE_CHECKING:
    from sphereorient.experiment import Experiment
    from sphereorient.methods.settings import Settings
    from sphereorient.run import Outcome, Request
    from sphereorient.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class _TrackOptions(CameraOptions):
    experiments: Annotated[
        list[Path], Argument(metavar="EXPERIMENT...", help="experiment.yaml (docs/data-format.md), or several.")
    ]
    out: Annotated[Path, Option("--out", "-o", help="HDF5 file to write; for several experiments a folder.")]
    method: Annotated[
        str, Option(help="precise: refined poses with covariances; paper: Zimmermann et al. 2011, corrected.")
    ] = "precise"
    device: Annotated[str, Option(help="Where fits are computed: cpu, cuda, cuda:1.")] = "cpu"
    jobs: Annotated[int, Option("--jobs", "-j", min=1, help="Worker processes on this machine.")] = 1
    cluster: Annotated[str | None, Option(help="Dask cluster: address or file of its scheduler, or local.")] = None
    resume: Resume = False
    learnt: Annotated[Path | None, Option(help="Use a file that --save-learnt wrote for these cameras.")] = None
    save_learnt: Annotated[Path | None, Option(help="Write what is learnt: empty scenes, light, scores, noise.")] = None
    proposer: Annotated[str | None, Option(help="Proposer's checkpoint, or default (docs/proposer.md).")] = None
    no_learn_paint: Annotated[bool, Option("--no-learn-paint", help="Use the map even where paint differs.")] = False
    no_cache: NoCache = False


@app.command()
def track(given: _TrackOptions) -> None:
    """Track the sphere of an experiment, or of many: position and orientation of every frame."""
    many = len(given.experiments) > 1 or given.out.is_dir()
    check_writable(given.out / "tracks" if many else given.out)
    if given.save_learnt is not None:
        check_writable(given.save_learnt)
        if many:
            name, do = f"--save-learnt {given.save_learnt}", "track them one by one"
            raise SettingsError(refusal(name, expected="one experiment", got="several", do=do))
    from sphereorient.run import FolderStore, Request
    from sphereorient.run.many import tracks_of
    from sphereorient.run.stages import run_tracks, with_proposer

    also = ["refine.learn_paint=false"] if given.no_learn_paint else []
    chosen = with_proposer(given.chosen(given.method, *also), given.proposer)
    requests = [
        Request(
            experiment=_with_map(experiment, given, chosen),
            out=path,
            method=given.method,
            settings=chosen,
            cameras=given.names,
            device=given.device,
            learnt=given.learnt,
            save_learnt=given.save_learnt,
            command=command_line(),
        )
        for experiment, path in zip(given.experiments, tracks_of(given.experiments, given.out), strict=True)
    ]
    if many or given.jobs > 1 or given.cluster is not None:
        _track_side_by_side(requests, given.jobs, given.cluster, given.resume, given.quiet)
        return
    with _kept(requests), progress_bar(given.quiet) as advance:
        tracks = run_tracks(requests[0], FolderStore(requests[0].parts), resume=given.resume, progress=advance)
    if not given.quiet:
        for name, track in tracks.items():
            _print_summary(track, name)
        typer.echo(f"Wrote {given.out}")


def _with_map(path: Path, given: _TrackOptions, settings: "Settings") -> "Path | Experiment":
    """Return an experiment with a map; for a single ball without one, learn and write it."""
    from sphereorient.experiment import load_experiment

    try:
        experiment = load_experiment(path)
    except SphereOrientError:  # its run reports it: the other experiments go on
        return path
    if given.method != "precise" or given.learnt is not None or not experiment.mapless:
        return path
    from sphereorient.experiment.experiment import MAP
    from sphereorient.files.whole_file import has_mark, writing
    from sphereorient.methods.map import first_map_of
    from sphereorient.report.texture_map import write_map
    from sphereorient.sphere import unseen_share

    beside = experiment.folder / MAP
    if given.resume and experiment.texture_path is None and has_mark(beside):  # learnt by the interrupted run
        return experiment.with_sphere(texture_path=beside)
    target = experiment.new_map_path()
    check_writable(target)
    with progress_bar(given.quiet) as advance:
        found, remarks = first_map_of(experiment, settings, given.names, advance)
    with writing(force=False):
        write_map(found, target)
    if not given.quiet:
        share = 100 if found.unseen is None else 100 * (1 - unseen_share(found.unseen))
        about = f"{share:.0f} % of the ball, from the first frames; its axes are the lab axes at the first frame"
        typer.echo(f"note: no map: wrote {target}, {about}; `sphereorient map` learns a finer one.")
        for remark in remarks:
            typer.echo(f"note: {remark}")
        if experiment.texture_path is None:
            typer.echo(f"next: add texture: {target.name} under sphere: in {path}")
    return experiment.with_sphere(texture_path=target)


@contextmanager
def _kept(requests: "Sequence[Request]") -> Iterator[None]:
    """Print what is kept when the user stops a run."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit):
        for request in requests:
            if request.parts.is_dir():
                kept = f"the finished part of {request.out} is kept; continue with --resume."
                typer.echo(f"sphereorient: {kept}", err=True)
        raise


def _track_side_by_side(
    requests: "Sequence[Request]", jobs: int, cluster: str | None, resume: bool, quiet: bool
) -> None:
    from sphereorient.run import run_many
    from sphereorient.run.many import ProcessExecutor, dask_executor

    executor = ProcessExecutor(jobs) if cluster is None else dask_executor(cluster, jobs if jobs > 1 else None)
    with _kept(requests), progress_bar(quiet) as advance:
        outcomes = run_many(requests, executor, resume=resume, progress=advance)
    failed = [outcome for outcome in outcomes if outcome.error is not None]
    if len(outcomes) == 1 and failed:
        raise OutputError(str(failed[0].error))
    if not quiet:
        _print_table(outcomes)
    for outcome in failed:
        typer.echo(f"sphereorient: {outcome.name}: {outcome.error}", err=True)
    if failed:
        raise typer.Exit(1)


def _print_table(outcomes: "Sequence[Outcome]") -> None:
    table = new_table("track", "frames", "valid", "s", "frames/s", "")
    for column in table.columns[1:5]:
        column.justify = "right"
    for outcome in outcomes:
        rate = f"{outcome.frames / outcome.seconds:.1f}" if outcome.frames else ""
        counts = (str(outcome.frames), str(outcome.valid)) if outcome.error is None else ("", "")
        state = str(outcome.request.out) if outcome.error is None else "failed, see below"
        table.add_row(outcome.name, *counts, f"{outcome.seconds:.0f}", rate, state)
    print_table(table)


def _print_summary(result: "Trajectory", name: str) -> None:
    from sphereorient.calibration.self_calibration import contradiction_lines
    from sphereorient.trajectory import span_words

    summary = result.summary()
    echo_lines(f"note: {remark}" for remark in result.provenance.get("remarks", []))
    valid = f"{summary['valid']} of {summary['frames']}"
    typer.echo(f"{ball_words(name)}{valid} frames valid (position and orientation measured)")
    if summary["no_ball"]:
        typer.echo(f"  no ball in view in {summary['no_ball']}: {span_words(result.without_ball)}")
    for name, lost in summary["lost"].items():
        text = ", ".join(f"{count} {reason}" for reason, count in lost.items()) or "none"
        typer.echo(f"  {name}: frames lost: {text}")
    echo_lines(contradiction_lines(result))


@dataclass(frozen=True, kw_only=True)
class _LiveOptions(CameraOptions):
    experiment: ExperimentPath
    source: Annotated[
        str,
        Option(help="movie; movie-fast; - (stdin); shared:FILE; camera:0; genicam:X.cti#A; pylon:A,B; vimba:A"),
    ] = "movie"
    to: Annotated[
        list[str] | None,
        Option(
            help="Repeatable: tcp:PORT, udp:, zmq:, osc:, serial:PORT@BAUD, lsl:NAME, shared:FILE, .dat, .jsonl, .h5"
        ),
    ] = None
    record: Annotated[Path | None, Option(help="Record the pictures: a new .mkv or .h5 per camera.")] = None
    learnt: Annotated[Path | None, Option(help="File of `track --save-learnt`: skips the learning.")] = None
    axes: FicTracConfigPath = None
    page: Annotated[int | None, Option(min=0, max=65535, help="Port of the page in the browser; 0: any.")] = None


@app.command()
def live(given: _LiveOptions) -> None:
    """Track while the ball rotates: each pose from earlier frames, a line per frame to sockets and files.

    The experiment's movies give the empty scene and the light. Without a map, the map of a fixed ball is learnt.
    """
    from sphereorient.experiment import load_experiment
    from sphereorient.live.live import TrackBlocks
    from sphereorient.live.loop import open_live, run_live
    from sphereorient.live.outputs import open_output
    from sphereorient.live.page import PageProcess
    from sphereorient.live.sources import recorded, source_of
    from sphereorient.movies import flipped
    from sphereorient.movies.record import Recorder

    chosen, experiment = given.chosen("precise"), load_experiment(given.experiment)
    source, page, movies = source_of(given.source, _log), None, _movies_of(given, experiment)
    with ExitStack() as opened:
        outputs = []
        opened.callback(source.close)
        for name in given.to or ():
            outputs.append(open_output(name, _log))
            opened.callback(outputs[-1][0].close)
        if len(experiment.names) > 1 and any(form != "json" for _, form in outputs):
            got, do = ", ".join(given.to or ()), "name zmq:PORT or NAME.jsonl: other outputs do not name the ball"
            raise SettingsError(refusal("--to", expected="JSON for several balls", got=got, do=do))
        if given.axes is not None and not {"fictrac", "marked"} & {form for _, form in outputs}:
            got, do = ", ".join(given.to or ()) or "none", "add --to tcp:PORT, or leave out --axes"
            raise SettingsError(refusal("--axes", expected="an output with FicTrac's table", got=got, do=do))
        if given.page is not None:
            page = PageProcess(given.experiment, given.names, given.page, _log)
            opened.callback(page.close)
            typer.echo(f"page: {page.address}", err=True)
        set_up = opened.enter_context(open_live(experiment, chosen, given.names, given.learnt))
        recording, command = set_up.recording, command_line()
        blocks = TrackBlocks(recording, set_up.tracker, even=source.even, settings=chosen, command=command)
        for output, _ in outputs:
            output.begin(blocks)
        recorders, frame_s = [], recording.timeline.frame_s
        for stream in recording.streams if movies else ():
            filmed = flipped(stream.movie, experiment.flip.get(stream.name, "none"))
            recorders.append(Recorder(movies[stream.name], filmed, frame_s, _log, wait=source.waits))
            opened.callback(recorders[-1].close)
        monitor = run_live(set_up, recorded(source, recorders) if movies else source, outputs, page, _log, given.axes)
        if set_up.save_map is not None:
            _log("finishing the map; this takes some seconds")
            try:
                typer.echo(set_up.save_map())
            except PaintError as error:
                _log(str(error))
    if not given.quiet:
        echo_lines([*monitor.summary(), *(one.summary() for one in recorders)])


def _movies_of(given: _LiveOptions, experiment: "Experiment") -> dict[str, Path]:
    """Return the movie to record per camera; of several NAME.CAMERA.mkv. Raise OutputError if one exists."""
    from sphereorient.live.outputs import check_new
    from sphereorient.movies.write import WRITERS, times_path

    if (path := given.record) is None:
        return {}
    check_ending(path, "--record", WRITERS)
    if str(path) in (given.to or ()):
        raise OutputError(refusal("--record", expected="a file of its own", got="that of --to", do="name another one"))
    names = given.names or tuple(experiment.movie_paths)
    movies = {name: path.with_name(f"{path.stem}.{name}{path.suffix}") if len(names) > 1 else path for name in names}
    for new in (*movies.values(), *(times_path(movie) for movie in movies.values() if path.suffix.lower() == ".mkv")):
        check_new(new)
    return movies


def _log(line: str) -> None:
    typer.echo(f"note: {line}", err=True)
