"""`sphereorient live`."""

import gc
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sphereorient.cli.app import app, command_line, echo_lines
from sphereorient.cli.options import Cameras, ExperimentPath, Overrides, Quiet, SettingsPath, cameras_of, settings_of
from sphereorient.errors import SettingsError, refusal

if TYPE_CHECKING:
    from sphereorient.experiment.recording import Recording
    from sphereorient.live.feed import Arrival
    from sphereorient.live.outputs import Output

SWITCH_S = 0.0002  # longest that a thread that computes holds up the one that reads
WAITING = 16  # frames of a camera that wait at most


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
    from sphereorient.live.lines import FicTracLines, fictrac_line, worded
    from sphereorient.live.live import measured
    from sphereorient.live.monitor import Monitor
    from sphereorient.live.page import LivePage, address, open_page
    from sphereorient.live.prepare import open_live
    from sphereorient.live.track import TrackBlocks, TrackOutput

    chosen, named = settings_of(settings, set_ or [], "precise"), cameras_of(cameras)
    _check_source(source)
    outputs = [_output(name) for name in to or []]
    table = any(kind not in ("jsonl", "zmq", "h5") for kind, _ in outputs)
    shown = LivePage()
    server = None if page is None else open_page(shown, page)
    if server is not None:
        typer.echo(f"page: {address(shown, server)}", err=True)
    try:
        with open_live(experiment, chosen, named, learnt) as opened:
            recording, tracker = opened.recording, opened.tracker
            views = tracker.appearance.fitter.views
            lines = FicTracLines(views[0].camera)
            for _, output in outputs:
                if isinstance(output, TrackOutput):
                    even = source.startswith(("movie", "-"))
                    blocks = TrackBlocks(recording=recording, tracker=tracker, even=even)
                    output.begin(blocks, blocks.head(chosen, command_line()))
            gc.collect()
            gc.freeze()  # what is here stays: no pause looks through it
            sys.setswitchinterval(SWITCH_S)
            feed = Feed(_frames(source, recording), WAITING, wait=source in ("movie-fast", "-"), tell=_tell)
            monitor, number = Monitor(feed, _tell), tracker.number
            shown.views, shown.radius_mm, shown.monitor = views, recording.experiment.radius_mm, monitor
            shown.save_map = opened.save_map
            try:
                with suppress(KeyboardInterrupt):
                    for now in measured(tracker, views, monitor):
                        columns = lines.columns(now) if table or server is not None else None
                        line = fictrac_line(columns) if table and columns is not None else ""
                        for kind, output in outputs:
                            output.send(worded(kind, now, line))
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


def _check_source(name: str) -> None:
    kind, _, where = name.partition(":")
    if name not in ("movie", "movie-fast", "-") and (kind not in ("camera", "genicam", "shared") or not where):
        expected = "movie, movie-fast, -, camera:NUMBER, genicam:PRODUCER.cti or shared:FILE"
        do = "choose one of these"
        raise SettingsError(refusal("--source", expected=expected, got=name, do=do))


def _frames(name: str, recording: "Recording") -> "Iterator[Arrival]":
    from sphereorient.live.feed import camera_pictures, device_frames, movie_frames, rate_of, raw_frames
    from sphereorient.live.genicam import genicam_pictures
    from sphereorient.live.shared import shared_frames

    if name in ("movie", "movie-fast"):
        return movie_frames(recording, paced=name == "movie")
    if name == "-":
        return raw_frames(sys.stdin.buffer, recording.streams, rate_of(recording))
    kind, _, where = name.partition(":")
    if kind == "shared":
        return shared_frames(Path(where), recording.streams)
    if len(recording.streams) > 1:
        do = "add --cameras with one name"
        raise SettingsError(refusal("--source", expected="one camera", got=f"{len(recording.streams)}", do=do))
    if kind == "genicam":
        return device_frames(name, partial(genicam_pictures, where), recording.streams[0], _tell)
    device = int(where) if where.isdigit() else where
    again = None if Path(where).is_file() else _tell  # a movie ends
    return device_frames(f"camera {where}", partial(camera_pictures, device), recording.streams[0], again)


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
