"""Write docs/parameters.md and the files in configs/ from the settings' own descriptions.

    scripts/make_parameters.py [--check]

With --check nothing is written; the exit code is 1 if a file differs from the settings.
"""

from __future__ import annotations

import argparse
import inspect
import re
import sys
from pathlib import Path

from pydantic import BaseModel

from sphereorient.bench import BenchSettings
from sphereorient.learn.settings import ProposerSettings
from sphereorient.methods.settings import Settings, model_yaml, settings_yaml
from sphereorient.synth import SynthSettings

REPO = Path(__file__).resolve().parents[1]
HEAD = """\
# Parameters

All settings; each heading names the methods that read them. A default in **bold** is the paper's value; where the paper
gives none, the description states the reason. `--settings FILE` reads a file with any of them, `--set room.key=value`
changes one. `configs/paper.yaml` and `configs/precise.yaml` hold what each method reads, `sphereorient settings` writes
all; a command reads a file only where it is named. A track keeps the settings used in its attribute `settings`. Written
by `scripts/make_parameters.py`.
"""

FROM_PAPER = re.compile(r"the paper(:|'s (b|w|\d))")  # "the paper's 12", "the paper: under 5", "the paper's b"


def table(model: type[BaseModel], of_method: bool = True) -> list[str]:
    """One row a key; numbers that the description calls the paper's stand out where they are the method's."""
    return ["| key | default | what |", "|---|---|---|", *rows_of(model(), of_method)]


def rows_of(settings: BaseModel, of_method: bool, branch: str = "") -> list[str]:
    """The rows of a table; those of a branch with its name before the key."""
    rows = []
    for key, field in type(settings).model_fields.items():
        default = getattr(settings, key)
        if isinstance(default, BaseModel):
            rows += rows_of(default, of_method, f"{branch}{key}.")
            continue
        shown = "null" if default is None else str(list(default) if isinstance(default, tuple) else default)
        if of_method and FROM_PAPER.search(field.description or ""):
            shown = f"**{shown}**"
        rows.append(f"| `{branch}{key}` | {shown} | {field.description} |")
    return rows


def parameters() -> str:
    """The page docs/parameters.md."""
    lines = [HEAD]
    for room, field in Settings.model_fields.items():
        model = field.annotation
        assert isinstance(model, type)
        lines += [f"## {room}: {field.description}", "", inspect.cleandoc(model.__doc__ or ""), "", *table(model), ""]
    lines += ["## synth", "", "Of `sphereorient synth`: `--settings configs/synth.yaml`, `--set key=value`.", ""]
    lines += [*table(SynthSettings, of_method=False), ""]
    lines += [
        "## robustness",
        "",
        "Of `sphereorient bench robustness` and `bench scenes`: `--settings configs/robustness.yaml`.",
        "",
    ]
    lines += [*table(BenchSettings, of_method=False), ""]
    how = "Of `sphereorient train configs/train_proposer.yaml`; `--set room.key=value` ([proposer.md](proposer.md))."
    lines += ["## train", "", how, ""]
    for room, field in ProposerSettings.model_fields.items():
        model = field.annotation
        assert isinstance(model, type)
        lines += [f"### train, {room}: {field.description}", "", *table(model, of_method=False), ""]
    return "\n".join(lines)


def pages() -> dict[Path, str]:
    """Every file that this script writes, with its text."""
    return {
        REPO / "docs" / "parameters.md": parameters(),
        REPO / "configs" / "paper.yaml": settings_yaml(method="paper"),
        REPO / "configs" / "precise.yaml": settings_yaml(method="precise"),
        REPO / "configs" / "synth.yaml": model_yaml("A synthetic experiment", SynthSettings()),
        REPO / "configs" / "robustness.yaml": model_yaml("The robustness benchmark", BenchSettings()),
        REPO / "configs" / "train_proposer.yaml": model_yaml("Training of a proposer", ProposerSettings()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true")
    check = parser.parse_args().check
    stale = [path for path, text in pages().items() if not path.is_file() or path.read_text(encoding="utf-8") != text]
    for path in stale:
        if check:
            print(f"stale: {path.relative_to(REPO)}")
        else:
            path.write_text(pages()[path], encoding="utf-8")
    sys.exit(1 if check and stale else 0)


if __name__ == "__main__":
    main()
