"""`sphereorient convert-cameras`."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sphereorient.cli.app import app, camera_names, check_writable
from sphereorient.cli.calibrate import check_other_yaml
from sphereorient.errors import CameraError, refusal

if TYPE_CHECKING:
    from sphereorient.cameras import Camera

OPENCV = (".yml", ".yaml", ".xml", ".json")


@app.command("convert-cameras")
def convert_cameras(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE...", help="One file a camera: OpenCV's .yml, .yaml, .xml, .json or OpenPTV's .ori"
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="cameras.yaml to write.")],
    names: Annotated[
        str | None, typer.Option(help="Names of the cameras, such as cam1,cam2; otherwise those of the files.")
    ] = None,
    image_size: Annotated[
        str | None, typer.Option(metavar="W,H", help="Picture size, px, for OpenCV files without it.")
    ] = None,
    par: Annotated[
        Path | None, typer.Option(help="OpenPTV's ptv.par: sensor, indices, thickness of the wall. Needed for .ori.")
    ] = None,
) -> None:
    """Convert cameras of OpenCV or OpenPTV to cameras.yaml. A .addpar beside its .ori is read too."""
    check_writable(out)
    for source in sources:
        check_other_yaml(out, source)
    known = _names(sources, names)
    size = _size(image_size)
    from sphereorient.cameras import save_cameras

    cameras = {name: _load(source, size, par) for name, source in zip(known, sources, strict=True)}
    save_cameras(out, cameras, f"X_cam = R X_lab + T, mm; made by {' '.join(['sphereorient', *sys.argv[1:]])}")
    typer.echo(f"Wrote {out}: {', '.join(cameras)}")


def _load(source: Path, image_size: tuple[int, int] | None, par: Path | None) -> Camera:
    from sphereorient.cameras.io.opencv import load_opencv
    from sphereorient.cameras.io.openptv import load_openptv, load_ptv_par

    if source.suffix in OPENCV:
        return load_opencv(source, image_size)
    if source.suffix != ".ori":
        expected, do = f"a file ending in {', '.join(OPENCV)} or .ori", "name a calibration file of OpenCV or OpenPTV"
        raise CameraError(refusal(str(source), expected=expected, got=f"'{source.name}'", do=do))
    if par is None:
        raise CameraError(refusal("--par", expected="OpenPTV's ptv.par", got="none", do="add --par parameters/ptv.par"))
    addpar = source.with_suffix(".addpar")
    return load_openptv(source, load_ptv_par(par), addpar if addpar.exists() else None)


def _names(sources: list[Path], text: str | None) -> list[str]:
    names = camera_names(text)
    if names is None:
        names = [source.name.partition(".")[0] for source in sources]
    if len(names) != len(sources):
        got, do = f"{len(names)} for {len(sources)} files", "name every camera once, in the order of the files"
        raise CameraError(refusal("--names", expected="one name a file", got=got, do=do))
    if len(set(names)) < len(names):
        got, do = ", ".join(names), "give each camera its own name, such as --names cam1,cam2"
        raise CameraError(refusal("--names", expected="different names", got=got, do=do))
    return names


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"\s*(\d{1,6})\s*,\s*(\d{1,6})\s*", text)
    if found is None:
        got, do = f"'{text[:20]}'", "write it as 1280,1024"
        raise CameraError(refusal("--image-size", expected="width and height in pixels", got=got, do=do))
    return int(found[1]), int(found[2])
