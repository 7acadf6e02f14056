"""`sphereorient train` and `sphereorient evaluate`."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from sphereorient.cli.app import app, check_writable, new_table, print_table, progress_bar
from sphereorient.cli.options import Quiet

if TYPE_CHECKING:
    from sphereorient.learn.metrics import ProposerBenchmark

EXAMPLES = 8  # rows of the sheet


@app.command()
def train(
    config: Annotated[Path, Argument(metavar="CONFIG", help="YAML with keys of configs/train_proposer.yaml.")],
    out: Annotated[Path, Option("--out", "-o", help="Folder of checkpoint, log and figures.")] = Path("proposer"),
    set_: Annotated[list[str] | None, Option("--set", help="Override one key, e.g. --set training.minutes=30.")] = None,
    resume: Annotated[bool, Option("--resume", help="Continue from last.ckpt in the folder.")] = False,
    quiet: Quiet = False,
) -> None:
    """Train a network that proposes orientations (docs/proposer.md)."""
    check_writable(out, folder_made=True)
    from sphereorient.files.whole_file import check_target, write_text, writing
    from sphereorient.learn.settings import ProposerSettings
    from sphereorient.methods.settings import model_yaml, read_model

    settings = read_model(ProposerSettings, config, set_ or [])
    from sphereorient.learn.metrics import make_examples
    from sphereorient.learn.train import CHECKPOINT, LAST, prepare, train_proposer
    from sphereorient.report.learning import examples_figure, learning_curve_figure
    from sphereorient.report.plots.style import write_figure

    prepare(settings, out, resume)
    with writing(force=resume), progress_bar(quiet, unit="steps") as advance:  # only into a folder with last.ckpt
        for name in (CHECKPOINT, LAST, "metrics.csv"):
            check_target(out / name)
        if config.resolve() != (out / "settings.yaml").resolve():
            write_text(out / "settings.yaml", model_yaml("Training of a proposer", settings))
        trained = train_proposer(settings, out, resume=resume, progress=advance)
        curve = learning_curve_figure(trained.rows, int(trained.checkpoint.about["best_step"]))
        write_figure(curve, out / "learning_curve.png")
        write_figure(examples_figure(make_examples(trained.checkpoint, EXAMPLES)), out / "examples.png")
    if not quiet:
        metrics = trained.metrics
        typer.echo(
            f"Wrote {out / CHECKPOINT}; {metrics.pictures} validation pictures: right first "
            f"{100 * metrics.recall_1:.1f} %, among five {100 * metrics.recall_5:.1f} %, "
            f"calibration error {metrics.ece:.3f}"
        )


@app.command()
def evaluate(
    checkpoint: Annotated[Path, Argument(metavar="CHECKPOINT", help="proposer.ckpt of `sphereorient train`.")],
    config: Annotated[Path | None, Option(help="YAML with the `pictures` to use; default: as in its training.")] = None,
    pictures: Annotated[int, Option(min=1, help="Pictures of each degradation and level.")] = 240,
    as_json: Annotated[bool, Option("--json", help="Print JSON.")] = False,
    quiet: Annotated[bool, Option("--quiet", "-q", help="No progress.")] = False,
) -> None:
    """Measure the recall of a proposer's checkpoint on held-out balls, one degradation at a time."""
    from sphereorient.learn.checkpoint import load_checkpoint
    from sphereorient.learn.metrics import benchmark_checkpoint
    from sphereorient.learn.settings import ProposerSettings
    from sphereorient.methods.settings import read_model

    loaded = load_checkpoint(checkpoint)
    chosen = loaded.settings if config is None else read_model(ProposerSettings, config)
    with progress_bar(quiet, unit="maps") as advance:
        found = benchmark_checkpoint(loaded, chosen.pictures, pictures, advance)
    if as_json:
        typer.echo(json.dumps({"checkpoint": str(checkpoint), "temperature": loaded.temperature, **asdict(found)}))
    else:
        _print(found)


def _print(found: "ProposerBenchmark") -> None:
    levels = sorted({one.level for one in found.families})
    table = new_table("degradation", *(f"level {level}\nfirst / five" for level in levels))
    for family in dict.fromkeys(one.family for one in found.families):
        row = {one.level: one for one in found.families if one.family == family}
        cells = [f"{100 * row[level].recall_1:.1f} / {100 * row[level].recall_5:.1f} %" for level in levels]
        table.add_row(family, *cells)
    print_table(table)
    mixed = found.mixed
    typer.echo(
        f"{mixed.pictures} mixed pictures: right first {100 * mixed.recall_1:.1f} %, among five "
        f"{100 * mixed.recall_5:.1f} %, calibration error {mixed.ece:.3f}"
    )
    typer.echo(f"{found.pictures_per_s:.0f} pictures/s with {found.threads} threads")
