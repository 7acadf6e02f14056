"""The command line's frame: the application, what all commands share, and how errors end."""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from sphereorient import __version__
from sphereorient.errors import OutputError, SphereOrientError, refusal


class InOrder(TyperGroup):
    """Commands in the order in which a user meets them, not in that of their files."""

    ORDER = (
        *("track", "report", "overlay", "export", "view"),
        *("check", "movie", "convert", "calibrate", "check-cameras", "map", "compare-maps", "spin", "synth", "texture"),
        *("bench", "train", "evaluate", "settings", "info"),
    )

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names, those that are not in the order last."""
        known = {name: place for place, name in enumerate(self.ORDER)}
        return sorted(super().list_commands(ctx), key=lambda name: known.get(name, len(known)))


app = typer.Typer(
    cls=InOrder,
    name="sphereorient",
    help="Measure position and absolute orientation of a painted sphere from high-speed movies.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

EXIT_REFUSED = 2  # something that the user can mend
EXIT_INTERRUPTED = 130  # Ctrl-C, as shells have it

ExperimentPath = Annotated[Path, typer.Argument(metavar="EXPERIMENT", help="experiment.yaml (docs/data-format.md)")]


@app.callback(invoke_without_command=True)
def common(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    """Measure position and absolute orientation of a painted sphere from high-speed movies."""
    if version:
        typer.echo(f"sphereorient {__version__}")
        raise typer.Exit


def check_writable(out: Path) -> None:
    """Refuse an output place before hours of work, not after."""
    folder = out.parent
    do = "choose another --out"
    if not folder.is_dir():
        raise OutputError(
            refusal(f"--out {out}", expected=f"an existing folder {folder}", got="none", do="make it first")
        )
    if not os.access(folder, os.W_OK):
        raise OutputError(refusal(f"--out {out}", expected="a writable folder", got=f"{folder}, which is not", do=do))


def camera_names(text: str | None) -> list[str] | None:
    """Return the names in cam1,cam2; None where nothing was said."""
    return None if text is None else [name.strip() for name in text.split(",") if name.strip()]


def frame_range(text: str) -> tuple[int | None, int | None] | None:
    """Return first and last + 1 of A:B, None where left out; None for anything else."""
    found = re.fullmatch(r"(\d{0,12}):(\d{0,12})", text.strip())
    if not found:
        return None
    return (int(found[1]) if found[1] else None, int(found[2]) if found[2] else None)


Advance = Callable[[str, int, int], None]


@contextmanager
def progress_bar(quiet: bool = False, unit: str = "frames") -> Iterator[Advance]:
    """Show one line of progress a stage, with units per second, if any, and time left; nothing where `quiet`."""
    if quiet:
        yield lambda stage, done, total: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns: list[Any] = [
        TextColumn("{task.description:13}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]:>14}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    ]
    bar = Progress(*columns, console=Console(stderr=True))
    tasks: dict[str, Any] = {}
    with ExitStack() as shown:

        def advance(stage: str, done: int, total: int) -> None:
            if not tasks:
                shown.enter_context(bar)  # not before: a command that is refused at once prints one line
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total, rate="")
            elapsed = bar.tasks[bar.task_ids.index(tasks[stage])].elapsed
            rate = f"{done / elapsed:.1f} {unit}/s" if unit and done and elapsed else ""
            bar.update(tasks[stage], completed=done, total=total, rate=rate)

        yield advance


def main() -> None:
    """Run the command line; errors that a user can mend become one line and a non-zero exit code."""
    # On a busy machine torch's threads spin while they wait for a core that another program has: 136 s instead of 9 s
    # for the excerpt beside two busy processes. Read by OpenMP when torch is imported, so before any command.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(EXIT_INTERRUPTED))
    try:
        # Without its standalone mode the parser hands exit codes back, that of Ctrl-C among them.
        code = app(standalone_mode=False) or 0
    except SphereOrientError as error:
        typer.echo(f"sphereorient: {error}", err=True)
        code = EXIT_REFUSED
    except (KeyboardInterrupt, typer.Abort):
        code = EXIT_INTERRUPTED
    except Exception as error:
        code = _usage_error(error)
    if code == EXIT_INTERRUPTED:
        typer.echo("sphereorient: interrupted; no result was written.", err=True)
    sys.exit(code)


def _usage_error(error: Exception) -> int:
    """Print a mistake in the arguments as the parser words it; let faults of the program through."""
    show = getattr(error, "show", None)
    if show is None:
        raise error
    show()
    return int(getattr(error, "exit_code", EXIT_REFUSED))
