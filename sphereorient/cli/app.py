"""The application of the command line, the helpers of its commands, and the end of errors."""

from __future__ import annotations

import inspect
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast, get_type_hints

import typer
from typer.core import TyperGroup

from sphereorient import __version__
from sphereorient.errors import OutputError, SphereOrientError, refusal

if TYPE_CHECKING:
    from sphereorient.methods.settings import Settings


class InOrder(TyperGroup):
    """Commands in the order of use, not of their files."""

    ORDER = (
        *("track", "report", "overlay", "export", "view"),
        *("check", "movie", "convert", "calibrate", "check-cameras", "convert-cameras"),
        *("map", "compare-maps", "spin", "synth", "texture"),
        *("score", "bench", "train", "evaluate", "settings", "info"),
    )

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names, unknown ones last."""
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

EXIT_REFUSED = 2  # an error that the user can correct
EXIT_INTERRUPTED = 130  # Ctrl-C, as in shells

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
    """Check that the output folder exists and can be written, before hours of work."""
    folder, name = out.parent, f"--out {out}"
    if not folder.is_dir():
        raise OutputError(refusal(name, expected=f"an existing folder {folder}", got="none", do="make it first"))
    if not os.access(folder, os.W_OK):
        do = "choose another --out"
        raise OutputError(refusal(name, expected="a writable folder", got=f"{folder}, which is not", do=do))


def settings_of(path: Path | None, overrides: list[str] | None, method: str | None) -> Settings:
    """Read the settings that a method reads, and print remarks on the others."""
    from sphereorient.methods.settings import BRANCHES, read_settings

    loaded = read_settings(path, overrides or [], method if method in BRANCHES else None)
    for remark in loaded.remarks:
        typer.echo(f"note: {remark}", err=True)
    return loaded.settings


def camera_names(text: str | None) -> list[str] | None:
    """Return the names in cam1,cam2; None without a text."""
    return None if text is None else [name.strip() for name in text.split(",") if name.strip()]


def frame_range(text: str) -> tuple[int | None, int | None] | None:
    """Return first and last + 1 of A:B, None for an omitted end; None for another text."""
    found = re.fullmatch(r"(\d{0,12}):(\d{0,12})", text.strip())
    if not found:
        return None
    return (int(found[1]) if found[1] else None, int(found[2]) if found[2] else None)


def with_options(command: Callable[[Any], None]) -> Callable[..., None]:
    """Let a command take one record: each field of the dataclass becomes an option."""
    record = next(iter(get_type_hints(command).values()))
    signature = inspect.signature(record, eval_str=True)
    with_fields: Any = wraps(command)(lambda **values: command(record(**values)))
    with_fields.__signature__ = signature
    with_fields.__annotations__ = {name: one.annotation for name, one in signature.parameters.items()}
    return cast(Callable[..., None], with_fields)


Advance = Callable[[str, int, int], None]


@contextmanager
def progress_bar(quiet: bool = False, unit: str = "frames") -> Iterator[Advance]:
    """Show a line of progress for each stage, with units per second and remaining time; nothing if `quiet`."""
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
                shown.enter_context(bar)  # not earlier: a refusal prints one line only
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total, rate="")
            elapsed = bar.tasks[bar.task_ids.index(tasks[stage])].elapsed
            rate = f"{done / elapsed:.1f} {unit}/s" if unit and done and elapsed else ""
            bar.update(tasks[stage], completed=done, total=total, rate=rate)

        yield advance


def main() -> None:
    """Run the command line; errors that a user can correct become one line and a non-zero exit code."""
    # Without it torch's threads spin while another program has their core: 136 s instead of 9 s for the excerpt beside
    # two busy processes. OpenMP reads it when torch is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(EXIT_INTERRUPTED))
    try:
        # Without its standalone mode the parser returns exit codes, also that of Ctrl-C.
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
    """Print an error of the arguments in the parser's words; raise any other error again."""
    show = getattr(error, "show", None)
    if show is None:
        raise error
    show()
    return int(getattr(error, "exit_code", EXIT_REFUSED))
