"""Options shared by several commands, and the parsing of their texts."""

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Argument, Option

from sphereorient.errors import SphereOrientError, refusal

if TYPE_CHECKING:
    from sphereorient.methods.settings import Settings
    from sphereorient.trajectory import Tracks

YAML = (".yaml", ".yml")
ExperimentPath = Annotated[Path, Argument(metavar="EXPERIMENT", help="experiment.yaml (docs/data-format.md)")]
TrackPath = Annotated[Path, Argument(metavar="TRACK", help="track.h5 that `sphereorient track` wrote.")]
SphereName = Annotated[str | None, Option("--sphere", help="Of several balls, only this one.")]
Align = Annotated[
    str, Option(help="Constant rotations to remove first: none; body: of the body axes; both: of the lab axes too.")
]
FicTracConfigPath = Annotated[
    Path | None,
    Option("--axes", metavar="CONFIG", help="FicTrac's config.txt: write its table in its axes; default: lab axes."),
]
Cameras = Annotated[str | None, Option(help="Use these cameras only, e.g. cam1 or cam1,cam2.")]
SettingsPath = Annotated[Path | None, Option(help="YAML as `sphereorient settings` writes it.")]
Overrides = Annotated[list[str] | None, Option("--set", help="Override one setting, e.g. --set locate.diameter_px=90.")]


def _without_cache(chosen: bool) -> bool:
    if chosen:
        from sphereorient.files.cache import WITHOUT

        os.environ[WITHOUT] = "1"  # workers inherit it
    return chosen


NoCache = Annotated[
    bool,
    Option(
        "--no-cache",
        callback=_without_cache,
        help="Neither read nor write the user's cache folder.",
    ),
]
Resume = Annotated[bool, Option("--resume", help="Continue an interrupted run from its files beside --out.")]
Quiet = Annotated[bool, Option("--quiet", "-q", help="No progress, no summary.")]


@dataclass(frozen=True, kw_only=True)
class CommonOptions:
    """Options of a command that reads settings."""

    settings: SettingsPath = None
    set_: Overrides = None
    quiet: Quiet = False

    def chosen(self, method: str, *also: str) -> "Settings":
        """Read the settings of a method, with further overrides; print remarks on those that it does not use."""
        from sphereorient.methods.settings import METHODS, read_settings

        overrides = [*(self.set_ or ()), *also]
        settings, remarks = read_settings(self.settings, overrides, method if method in METHODS else None)
        for remark in remarks:
            typer.echo(f"note: {remark}", err=True)
        return settings


@dataclass(frozen=True, kw_only=True)
class CameraOptions(CommonOptions):
    """Options of a command that also chooses cameras."""

    cameras: Cameras = None

    @property
    def names(self) -> tuple[str, ...] | None:
        """Names of the cameras; None: all."""
        return cameras_of(self.cameras)


def tracks_in(path: Path, sphere: str | None) -> "Tracks":
    """Read the tracks of a file, or that of one sphere."""
    from sphereorient.trajectory import Tracks

    return Tracks.load(path).picked(sphere)


def names_in(text: str) -> list[str]:
    """Return the names in cam1,cam2."""
    return [name.strip() for name in text.split(",") if name.strip()]


def cameras_of(text: str | None) -> tuple[str, ...] | None:
    """Return the names in cam1,cam2; None without a text: all."""
    return None if text is None else tuple(names_in(text))


def ball_words(name: str) -> str:
    """Return the start of a line about a ball; empty without a name."""
    return f"ball {name}: " if name else ""


def file_of(out: Path, ball: str) -> Path:
    """Return the file of a ball: `out` without a name, else out_NAME."""
    return out.with_name(f"{out.stem}_{ball}{out.suffix}") if ball else out


def frames_of(text: str, error: type[SphereOrientError], count: int | None = None) -> tuple[int, int | None]:
    """Return first and last + 1 of A:B in a movie of `count` frames; None: open end. Raise `error` for other texts."""
    found = re.fullmatch(r"(\d{0,12}):(\d{0,12})", text.strip())
    first, last = (int(found[1] or 0), int(found[2]) if found[2] else count) if found else (0, 0)
    if last is not None and not first < last <= (count or last):
        within = f"A:B{'' if count is None else f' within 0:{count}'}, A below B"
        do = "write e.g. --frames 100:200"
        raise error(refusal(f"--frames {text}", expected=within, got=f"'{text}'", do=do))
    return first, last
