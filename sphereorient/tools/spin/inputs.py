import csv
import io
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from sphereorient.errors import PaintError, refusal
from sphereorient.files.whole_file import TABLE_BYTES, read_whole
from sphereorient.sphere import load_texture
from sphereorient.tools.spin.disks import Photograph, Photographs
from sphereorient.tools.spin.dots import DotTable

PICTURE_BYTES = 100_000_000
MOST_PIXELS = 50_000_000
ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
MOST_PHOTOGRAPHS = 1000


def load_photographs(paths: Sequence[Path], times: str) -> Photographs:
    """Read photographs: files in order of time, or one folder by name.

    `times`: a table .csv with the columns file and t_s, s, or pictures per second at equal intervals.

    Raises:
        PaintError: missing or unreadable files, too many of them, or times that do not match.
    """
    files = list(paths)
    if len(files) == 1 and files[0].is_dir():
        files = sorted(path for path in files[0].iterdir() if path.suffix.lower() in ENDINGS)
    if len(files) > MOST_PHOTOGRAPHS:
        expected, do = f"at most {MOST_PHOTOGRAPHS}", "name fewer, or measure a movie with `sphereorient track`"
        raise PaintError(refusal("photographs", expected=expected, got=str(len(files)), do=do))
    time_s = _times(times, files)
    pictures = [_picture(path) for path in files]
    return Photographs(pictures=pictures, time_s=time_s, names=[str(path) for path in files])


def load_ball(path: Path, dot_radius_deg: float | None) -> Tensor | DotTable:
    """Read a texture map, or a table .csv of dots: x, y, z of a direction in each line, no header.

    Raises:
        PaintError: the table is missing, or its lines are no directions.
        TextureError: the map is missing or unreadable.
    """
    if path.suffix.lower() not in (".csv", ".txt"):
        return load_texture(path)
    text, do = _text(path, "a table of dots"), "write x,y,z of one dot a line, without a head"
    try:
        with warnings.catch_warnings(action="ignore"):  # of an empty table, which is refused below
            rows = np.loadtxt(io.StringIO(text), delimiter=",", ndmin=2)
    except ValueError as error:
        got = f"'{str(error).splitlines()[0]}'"
        raise PaintError(refusal(str(path), expected="a table of numbers", got=got, do=do)) from None
    if rows.size and rows.shape[1] != 3:
        raise PaintError(refusal(str(path), expected="three columns", got=str(rows.shape[1]), do=do))
    table = DotTable(direction_body=torch.from_numpy(rows.reshape(-1, 3)))
    return table if dot_radius_deg is None else replace(table, radius_deg=dot_radius_deg)


def _times(times: str, files: Sequence[Path]) -> Tensor:
    try:
        rate_hz = float(times)
    except ValueError:
        return _table_times(Path(times), files)
    if not 0 < rate_hz < float("inf"):
        do = "give the number of pictures a second"
        raise PaintError(refusal("--times", expected="a rate above 0", got=times, do=do))
    return torch.arange(len(files), dtype=torch.float64) / rate_hz


def _table_times(path: Path, files: Sequence[Path]) -> Tensor:
    table = csv.DictReader(io.StringIO(_text(path, "a table of times")))
    if not {"file", "t_s"} <= set(table.fieldnames or ()):
        got, do = ", ".join(table.fieldnames or ()) or "nothing", "write a head with file,t_s"
        raise PaintError(refusal(str(path), expected="the columns file and t_s", got=got, do=do))
    found = {str(row["file"]): str(row["t_s"]) for row in table}
    missing = [file.name for file in files if file.name not in found]
    if missing:
        do = "add a line for each photograph"
        raise PaintError(refusal(str(path), expected=f"a time of {missing[0]}", got="none", do=do))
    try:
        return torch.tensor([float(found[file.name]) for file in files], dtype=torch.float64)
    except ValueError as error:
        got = f"'{error}'"
        raise PaintError(refusal(str(path), expected="times in seconds", got=got, do="correct t_s")) from None


def _text(path: Path, expected: str) -> str:
    content = read_whole(path, TABLE_BYTES, expected, PaintError, "name a file that exists")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        do = "save it as UTF-8 text"
        raise PaintError(refusal(str(path), expected=expected, got="a file that is no text", do=do)) from None


def _picture(path: Path) -> Photograph:
    content = read_whole(path, PICTURE_BYTES, "a picture file", PaintError, "name a file that exists")
    do = "export it again as PNG"
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(content)) as picture:
            if picture.width * picture.height > MOST_PIXELS:
                got, do = f"{picture.width} x {picture.height}", "crop it about the ball"
                expected = f"a picture of at most {MOST_PIXELS / 1e6:g} million pixels"
                raise PaintError(refusal(str(path), expected=expected, got=got, do=do))
            return np.asarray(picture.convert("RGB"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        got = f"'{(str(error) or type(error).__name__).splitlines()[0]}'"
        raise PaintError(refusal(str(path), expected="a picture that can be decoded", got=got, do=do)) from None
