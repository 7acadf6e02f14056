"""The command-line application: helpers of its commands, `settings`, `doctor`, and exit codes of errors."""

import inspect
import json
import math
import os
import re
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Option
from typer.core import TyperGroup

from sphereorient import __version__
from sphereorient.errors import SettingsError, SphereOrientError, error_words, refusal
from sphereorient.files.whole_file import check_folder, check_target, write_text, writing

if TYPE_CHECKING:
    from rich.table import Table


class InOrder(TyperGroup):
    """Commands in the order of use, not of their files."""

    ORDER = (
        *("init", "mark", "track", "live", "report", "overlay", "export"),
        *("check", "movie", "convert", "calibrate", "check-cameras", "convert-cameras"),
        *("map", "compare-maps", "spin", "synth", "texture"),
        *("score", "bench", "train", "evaluate", "settings", "doctor"),
    )

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names, unknown ones last."""
        known = {name: place for place, name in enumerate(self.ORDER)}
        return sorted(super().list_commands(ctx), key=lambda name: known.get(name, len(known)))


OUTPUTS = {"out", "target", "save", "save_learnt", "worst"}  # parameters; all other paths are inputs
FORCE = Option("--force", help="Replace files that sphereorient did not make, but never an input.")


class Commands(typer.Typer):
    """Commands; those that write take --force, and replace none of their inputs."""

    def command(self, name: str | None = None, **more: Any) -> Callable[[Any], Any]:
        """Register a command like `typer.Typer.command`. A dataclass as its only argument gives an option per field."""
        return lambda function: super(Commands, self).command(name, **more)(_guarded(function, name != "map"))


def _guarded(function: Callable[..., None], textured: bool) -> Callable[..., None]:
    """Add the options of a command's record, and --force if it writes; `textured`: the experiment's map is an input."""
    record = next((one.annotation for one in inspect.signature(function).parameters.values()), None)
    record = record if isinstance(record, type) and is_dataclass(record) else None
    options = list(inspect.signature(record or function).parameters.values())
    options.sort(
        key=lambda one: record is not None and one.name not in vars(record)["__annotations__"]
    )  # own ones first
    writes = any(one.name in OUTPUTS for one in options)

    @wraps(function)
    def guarded(force: bool = False, **given: Any) -> None:
        values = [each if isinstance(each, list) else [each] for name, each in given.items() if name not in OUTPUTS]
        paths = [path for each in values for path in each if isinstance(path, Path)] if writes else []
        with writing((file for path in paths for file in _read(path, textured)), force=force):
            function(record(**given)) if record else function(**given)

    if writes:
        annotation = Annotated[bool, FORCE]
        options.append(inspect.Parameter("force", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=annotation))
    vars(guarded)["__signature__"] = inspect.Signature(options)
    guarded.__annotations__ = {one.name: one.annotation for one in options}
    return guarded


def _read(path: Path, textured: bool) -> Iterator[Path]:
    """Yield an input file and, if it is YAML, the files named in it; of movies all pictures."""
    yield path
    if path.suffix.lower() in (".yaml", ".yml"):
        from sphereorient.files.yaml_file import read_yaml
        from sphereorient.movies import movie_files

        with suppress(SphereOrientError):  # the command reports the error
            for text in _texts(read_yaml(path, SettingsError), textured):
                with suppress(SphereOrientError, OSError, ValueError):
                    yield from movie_files(path.parent / text)


def _texts(document: Any, textured: bool) -> list[str]:
    if isinstance(document, dict):
        document = [value for key, value in document.items() if textured or key != "texture"]
    if isinstance(document, list):
        return [text for value in document for text in _texts(value, textured)]
    return [document] if isinstance(document, str) else []


app = Commands(
    cls=InOrder,
    name="sphereorient",
    help="Measure position and absolute orientation of a painted sphere from high-speed movies.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

LINE_S = 60.0  # between progress lines of a stage, without a terminal
SLOWEST = 0.05  # units per second; of slower stages only the time left is printed
EXIT_REFUSED = 2  # an error that the user can correct
NO_MEMORY = re.compile("(not enough|out of|insufficient|n't allocate|not allocate|to allocate) memory|bad_alloc", re.I)
EXIT_INTERRUPTED = 130  # Ctrl-C, as in shells


@app.callback(invoke_without_command=True)
def common(
    version: Annotated[bool, Option("--version", help="Print the version and exit.")] = False,
) -> None:
    """Measure position and absolute orientation of a painted sphere from high-speed movies."""
    if version:
        typer.echo(f"sphereorient {__version__}")
        raise typer.Exit


def check_writable(out: Path, *, folder_made: bool = False) -> None:
    """Check before the work that a file can be written and replaces no file of the user, or that a folder can be."""
    check_folder(out, f"--out {out}")
    if not folder_made:
        check_target(out)


def command_line() -> str:
    """Return the command as it was typed, for the provenance of results."""
    return " ".join(["sphereorient", *sys.argv[1:]])


def echo_lines(lines: Iterable[str]) -> None:
    """Print lines."""
    for line in lines:
        typer.echo(line)


def new_table(*columns: Any, **options: Any) -> "Table":
    """Return an empty table of rich, which is imported here: else each command would wait for it."""
    from rich.table import Table

    return Table(*columns, **options)


def print_table(table: "Table") -> None:
    """Print a table of rich; without a terminal, at least 140 characters wide."""
    from rich.console import Console

    console = Console()
    console.width = console.width if console.is_terminal else max(console.width, 140)
    console.print(table)


Progress = Callable[[str, int, int], None]


@contextmanager
def progress_bar(quiet: bool = False, unit: str = "frames") -> Iterator[Progress]:
    """Show a line of progress for each stage, with units per second and the time left; nothing if `quiet`.
    Without a terminal: print a line when a stage begins, each minute, and when a stage of over a second ends.
    """
    if quiet:
        yield lambda stage, done, total: None
        return
    from rich import progress
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines(unit)
        return
    columns = ("{task.description:16}", progress.BarColumn(), progress.TimeElapsedColumn(), "{task.fields[rate]}")
    bar = progress.Progress(*columns, console=console)
    tasks: dict[str, Any] = {}
    with ExitStack() as shown:

        def advance(stage: str, done: int, total: int) -> None:
            if not tasks:
                shown.enter_context(bar)  # not earlier: a refusal prints one line only
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total or None, rate="")
            elapsed = bar.tasks[bar.task_ids.index(tasks[stage])].elapsed or 0.0
            bar.update(tasks[stage], completed=done, total=total or None, rate=_rate(done, total, elapsed, unit))

        yield advance


def _rate(done: int, total: int, elapsed_s: float, unit: str) -> str:
    """Return progress, rate and time left as text; empty for a stage of one step."""
    if total == 1 or (not done and not total):
        return ""
    words = [f"{done} of {total}" if total else f"{done}"]
    if done and elapsed_s > 0:
        per_s = done / elapsed_s
        words += [f"{per_s:.1f} {unit}/s"] if unit and per_s >= SLOWEST else []
        words += [f"{_duration((total - done) / per_s)} left"] if total > done else []
    return ", ".join(words)


def _duration(seconds: float) -> str:
    """Return a duration as text: 40 s, 3 min, 2.5 h."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def _lines(unit: str) -> Progress:
    begun = time.monotonic()
    first: dict[str, float] = {}  # by stage, when it began
    last: dict[str, float] = {}  # when its last line was printed

    def advance(stage: str, done: int, total: int) -> None:
        now = time.monotonic()
        since = first.setdefault(stage, now)
        ended = done == total > 1 and now - since > 1.0
        if ended or now - last.get(stage, -math.inf) >= LINE_S:
            last[stage] = now
            rate = _rate(done, total, now - since, unit)
            typer.echo(f"{now - begun:6.0f} s  {stage}{': ' if rate else ''}{rate}", err=True)

    return advance


@app.command()
def settings(
    out: Annotated[Path | None, Option("--out", "-o", help="File to write; the screen without it.")] = None,
    method: Annotated[str | None, Option(help="precise, paper, map or report; all without it.")] = None,
) -> None:
    """Write the settings of all methods, or of one, with defaults and explanations."""
    from sphereorient.methods.settings import METHODS, settings_yaml

    if method not in (None, *METHODS):
        raise SettingsError(refusal("--method", expected=", ".join(METHODS), got=repr(method)[:40], do="choose one"))
    text = settings_yaml(method=method)
    if out is None:
        typer.echo(text)
        return
    check_writable(out)
    write_text(out, text)


@app.command()
def doctor(as_json: Annotated[bool, Option("--json", help="Print one JSON object.")] = False) -> None:
    """Print what is installed, the speed of a fit, the rates that `live` can hold. Exit code 1: something is broken."""
    from sphereorient.files.provenance import lacking, package_faults, versions, without_nan

    faults = package_faults()
    found: dict[str, Any] = {**versions(), "not_installed": lacking()}
    if not faults:  # else the rest is unreliable, or its import fails
        from sphereorient.bench.doctor import machine

        here, faults = machine()
        found |= here
    if as_json:
        typer.echo(json.dumps(without_nan({**found, "broken": faults}), indent=1))
    else:
        _print_findings(found)
        for line in faults:
            typer.echo(f"broken: {line}", err=True)
    if faults:
        raise typer.Exit(1)


def _print_findings(found: dict[str, Any]) -> None:
    fits = found.pop("live_one_camera", [])
    for name, value in found.items():
        lines = [f"{key}: {_words(one)}" for key, one in value.items()] if isinstance(value, dict) else [_words(value)]
        for words in lines or ["none"]:
            typer.echo(f"{name.replace('_', ' '):24} {words}")
    if fits:
        table = new_table(*fits[0], title="live, one camera: time per frame, and the rates that it can hold")
        for fit in fits:
            table.add_row(*(f"{number:.3g}" for number in fit.values()))
        print_table(table)
        typer.echo(f"Measured with {found['free_cores']} of {found['cores']} cores free.")


def _words(value: Any) -> str:
    return (", ".join(value) if isinstance(value, list) else str(value if value is not None else "")) or "none"


def main() -> None:
    """Run the command line; errors that a user can correct become one line and a non-zero exit code."""
    # Else torch's waiting threads keep the cores busy: 136 s instead of 9 s beside two busy processes. Read at import.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    warnings.formatwarning = lambda message, *_: f"sphereorient: {message}\n"
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(EXIT_INTERRUPTED))
    try:
        # Without standalone mode the parser returns exit codes, also for Ctrl-C.
        code = app(standalone_mode=False) or 0
    except SphereOrientError as error:
        typer.echo(f"sphereorient: {error}", err=True)
        code = EXIT_REFUSED
    except (KeyboardInterrupt, typer.Abort):
        code = EXIT_INTERRUPTED
    except Exception as error:
        show, code = getattr(error, "show", None), int(getattr(error, "exit_code", EXIT_REFUSED))
        if isinstance(error, MemoryError) or NO_MEMORY.search(str(error)):
            do = "close other programs, use fewer --jobs, or set frames: in the experiment"
            words = refusal("memory", expected="room for the data", got=error_words(error), do=do)
            typer.echo(f"sphereorient: {words}", err=True)
        elif show is None:
            raise
        else:
            show()  # an error of the arguments, in the parser's words
    if code == EXIT_INTERRUPTED:
        typer.echo("sphereorient: interrupted; no result was written.", err=True)
    sys.exit(code)
