"""`sphereorient live`."""

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from typer import Option

from sphereorient.cli.app import app, command_line, echo_lines
from sphereorient.cli.options import Cameras, ExperimentPath, Overrides, Quiet, SettingsPath, cameras_of, settings_of
from sphereorient.errors import PaintError


@dataclass(frozen=True, kw_only=True)
class _LiveOptions:
    experiment: ExperimentPath
    source: Annotated[
        str, Option(help="movie: at its rate; movie-fast; -: stdin; camera:0; genicam:X.cti; shared:FILE.")
    ] = "movie"
    to: Annotated[
        list[str] | None,
        Option(help="Repeatable. FicTrac: tcp:PORT, udp:PORT, .dat; JSON: zmq:PORT, .jsonl; track: .h5"),
    ] = None
    learnt: Annotated[Path | None, Option(help="What `track --save-learnt` kept of this set-up: no learning.")] = None
    page: Annotated[int | None, Option(min=0, max=65535, help="Port of a page in the browser; 0: any free one.")] = None
    cameras: Cameras = None
    settings: SettingsPath = None
    set_: Overrides = None
    quiet: Quiet = False


@app.command()
def live(given: _LiveOptions) -> None:
    """Track while the ball turns: each frame from those before it, and a line for each to sockets and files.

    The experiment's movies, of the same set-up, show the empty scene and the light. Without a texture map, that of a
    ball that stays in its place is learnt meanwhile; orientations are relative until it is known.
    """
    from sphereorient.live.loop import open_live, run_live
    from sphereorient.live.outputs import open_output
    from sphereorient.live.page import LivePage, address, open_page
    from sphereorient.live.sources import source_of
    from sphereorient.live.track import TrackBlocks

    chosen, cameras = settings_of(given.settings, given.set_, "precise"), cameras_of(given.cameras)
    source, page = source_of(given.source, _tell), None
    with ExitStack() as opened:
        outputs = [open_output(name, _tell) for name in given.to or ()]
        for output, _ in outputs:
            opened.callback(output.close)
        if given.page is not None:
            page = LivePage()
            server = opened.enter_context(open_page(page, given.page))
            opened.callback(server.shutdown)
            typer.echo(f"page: {address(page, server)}", err=True)
        set_up = opened.enter_context(open_live(given.experiment, chosen, cameras, given.learnt))
        blocks = TrackBlocks(
            recording=set_up.recording,
            tracker=set_up.tracker,
            even=source.even,
            settings=chosen,
            command=command_line(),
        )
        for output, _ in outputs:
            output.begin(blocks)
        monitor = run_live(set_up, source, outputs, page, _tell)
        if set_up.save_map is not None:
            _tell("the map is finished; this takes some seconds")
            try:
                typer.echo(set_up.save_map())
            except PaintError as error:
                _tell(str(error))
    if not given.quiet:
        echo_lines(monitor.summary())


def _tell(line: str) -> None:
    typer.echo(f"note: {line}", err=True)
