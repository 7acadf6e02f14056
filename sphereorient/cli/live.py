"""`sphereorient live`."""

import gc
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sphereorient.cli.app import app, command_line, echo_lines
from sphereorient.cli.options import Cameras, ExperimentPath, Overrides, Quiet, SettingsPath, cameras_of, settings_of
from sphereorient.errors import SettingsError, refusal

if TYPE_CHECKING:
    from sphereorient.experiment.recording import Recording
    from sphereorient.experiment.stream import CameraStream
    from sphereorient.live.feed import Arrival
    from sphereorient.live.outputs import Output

SWITCH_S = 0.0002  # longest that a thread that computes holds up the one that reads
WAITING = 64  # frames of a camera that wait at most


@app.command()
def live(
    experiment: ExperimentPath,
    source: Annotated[
        str,
        typer.Option(
            help="movie: the experiment's, at its rate; movie-fast; -: stdin; camera:0; genicam:X.cti; shared:FILE."
        ),
    ] = "movie",
    to: Annotated[
        list[str] | None,
        typer.Option(
            help="FicTrac's line to tcp:PORT, udp:PORT, .dat; JSON to zmq:PORT, .jsonl; a track to .h5. Repeatable."
        ),
    ] = None,
    learnt: Annotated[
        Path | None, typer.Option(help="What `track --save-learnt` kept of this set-up: begins without looking again.")
    ] = None,
    page: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="Port of a page that shows all this in a browser; 0: any free one."),
    ] = None,
    cameras: Cameras = None,
    settings: SettingsPath = None,
    set_: Overrides = None,
    quiet: Quiet = False,
) -> None:
    """Track while the ball turns: each frame from those before it, and a line for each to sockets and files.

    The experiment's movies, of the same set-up, show the empty scene and the light. Without a texture map, that of a
    ball that stays in its place is learnt meanwhile; orientations are relative until it is known.
    """
    from sphereorient.live.feed import Feed
    from sphereorient.live.lines import OF_JSON, FicTracLines, JsonLines, fictrac_line, worded
    from sphereorient.live.live import measured
    from sphereorient.live.monitor import Monitor
    from sphereorient.live.page import LivePage, address, open_page
    from sphereorient.live.prepare import open_live
    from sphereorient.live.track import TrackBlocks, TrackOutput

    chosen, named = settings_of(settings, set_ or [], "precise"), cameras_of(cameras)
    taken = _source(source)
    outputs = [_output(name) for name in to or []]
    kinds = {kind for kind, _ in outputs}
    table, json = bool(kinds - {*OF_JSON, "h5"}), bool(kinds & {*OF_JSON})
    shown = LivePage()
    server = None if page is None else open_page(shown, page)
    if server is not None:
        typer.echo(f"page: {address(shown, server)}", err=True)
    try:
        with open_live(experiment, chosen, named, learnt) as opened:
            recording, tracker = opened.recording, opened.tracker
            views = tracker.appearance.fitter.views
            lines, json_lines = FicTracLines(views[0].camera), JsonLines(recording.experiment.fixed)
            for _, output in outputs:
                if isinstance(output, TrackOutput):
                    blocks = TrackBlocks(recording=recording, tracker=tracker, even=taken.even)
                    output.begin(blocks, blocks.head(chosen, command_line()))
            gc.collect()
            gc.freeze()  # what is here stays: no pause looks through it
            sys.setswitchinterval(SWITCH_S)
            feed = Feed(taken.frames(recording), WAITING, wait=taken.waits, tell=_tell)
            monitor, number = Monitor(feed, _tell), tracker.number
            shown.views, shown.radius_mm, shown.monitor = views, recording.experiment.radius_mm, monitor
            shown.save_map = opened.save_map
            try:
                with suppress(KeyboardInterrupt):
                    for now in measured(tracker, views, monitor):
                        columns = lines.columns(now) if table or server is not None else None
                        line = fictrac_line(columns) if table and columns is not None else ""
                        as_json = json_lines.line(now) if json else ""
                        for kind, output in outputs:
                            output.send(worded(kind, now, line, as_json))
                        monitor.saw(now, columns)
                        if number == 0 < now.map_number:
                            number = now.map_number
                            _tell(f"frame {now.number}: orientations are by the map from here on")
            finally:
                feed.close()
            if opened.save_map is not None:
                _save(opened.save_map)
    finally:
        for _, output in outputs:
            output.close()
        if server is not None:
            server.shutdown()
            server.server_close()
    if not quiet:
        echo_lines(monitor.summary())


def _save(save_map: "Callable[[], str]") -> None:
    from sphereorient.errors import PaintError

    _tell("the map is finished; this takes some seconds")
    try:
        typer.echo(save_map())
    except PaintError as error:
        _tell(str(error))


def _tell(line: str) -> None:
    typer.echo(f"note: {line}", err=True)


@dataclass(frozen=True, kw_only=True)
class _Source:
    frames: "Callable[[Recording], Iterator[Arrival]]"
    waits: bool = False  # for the tracking, instead of dropping frames
    even: bool = False  # at the rate of the experiment


def _source(name: str) -> _Source:
    """Return the source of a name; raise SettingsError for an unknown one."""
    from sphereorient.live.feed import camera_pictures, device_frames, movie_frames, rate_of, raw_frames
    from sphereorient.live.genicam import genicam_pictures
    from sphereorient.live.shared import shared_frames

    kind, _, where = name.partition(":")
    match kind, bool(where):
        case (("movie" | "movie-fast"), False):
            paced = kind == "movie"
            return _Source(frames=partial(movie_frames, paced=paced), waits=not paced, even=True)
        case "-", False:
            return _Source(
                frames=lambda opened: raw_frames(sys.stdin.buffer, opened.streams, rate_of(opened)),
                waits=True,
                even=True,
            )
        case "shared", True:
            return _Source(frames=lambda opened: shared_frames(Path(where), opened.streams))
        case "genicam", True:
            pictures = partial(genicam_pictures, where)
            return _Source(frames=lambda opened: device_frames(name, pictures, _only_stream(opened), _tell))
        case "camera", True:
            device = int(where) if where.isdigit() else where
            taken = partial(camera_pictures, device)
            again = None if Path(where).is_file() else _tell  # a movie ends
            return _Source(frames=lambda opened: device_frames(f"camera {where}", taken, _only_stream(opened), again))
    expected = "movie, movie-fast, -, camera:NUMBER, genicam:PRODUCER.cti or shared:FILE"
    raise SettingsError(refusal("--source", expected=expected, got=name, do="choose one of these"))


def _only_stream(recording: "Recording") -> "CameraStream":
    if len(recording.streams) > 1:
        do = "add --cameras with one name"
        raise SettingsError(refusal("--source", expected="one camera", got=f"{len(recording.streams)}", do=do))
    return recording.streams[0]


def _output(name: str) -> "tuple[str, Output]":
    from sphereorient.live.outputs import HOST, FileOutput, TcpOutput, UdpOutput, ZmqOutput
    from sphereorient.live.track import TrackOutput

    kind, colon, address = name.partition(":")
    sockets: dict[str, Callable[[str, int], Output]] = {"tcp": TcpOutput, "udp": UdpOutput, "zmq": ZmqOutput}
    if kind in sockets and colon:
        host, between, port = address.rpartition(":")
        if port.isdigit() and int(port) < 1 << 16:
            return kind, sockets[kind](host if between else HOST, int(port))
    suffix = Path(name).suffix.removeprefix(".")
    if suffix in ("dat", "jsonl"):
        return suffix, FileOutput(Path(name), _tell)
    if suffix == "h5":
        return suffix, TrackOutput(Path(name), _tell)
    expected = "tcp:PORT, udp:PORT, zmq:PORT, NAME.dat, NAME.jsonl or NAME.h5"
    raise SettingsError(
        refusal("--to", expected=expected, got=name, do="choose one of these; another machine is tcp:HOST:PORT")
    )
