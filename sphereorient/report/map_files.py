"""Files of a texture map: the picture that tracking reads, the pictures per texel, and all other results."""

from dataclasses import fields
from pathlib import Path

import cv2
import h5py
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.errors import OutputError, TextureError, refusal
from sphereorient.files.outputs import put_aside
from sphereorient.files.picture import decoded_grey
from sphereorient.mapping import LearntMap
from sphereorient.mapping.grid import texel_areas
from sphereorient.trajectory import Trajectory

UNSEEN = 128  # grey of texels that no picture shows
MOST = 255  # counts beyond are written as this


def seen_path(texture: Path) -> Path:
    """Return the path of the counts of a texture map: texture_seen.png beside texture.png."""
    return texture.with_name(f"{texture.stem}_seen.png")


def write_texture(texture: Tensor, path: Path) -> None:
    """Write a texture map (H, 2 H), 0 .. 1 or NaN (mid-grey), as 8-bit picture; may raise OutputError."""
    grey = torch.where(torch.isfinite(texture), 255 * texture, float(UNSEEN))
    _write_picture(grey.round().clamp(0, 255).byte().numpy(), path)


def write_seen(seen: Tensor, path: Path) -> None:
    """Write counts (H, 2 H) as 8-bit picture, limited to 255; may raise OutputError."""
    _write_picture(seen.clamp(0, MOST).byte().numpy(), path)


def _write_picture(grey: NDArray[np.uint8], path: Path) -> None:
    with put_aside(path) as aside:
        if not cv2.imwrite(str(aside), grey):
            raise OSError("the picture could not be written")


def read_seen(path: Path) -> Tensor | None:
    """Read the counts beside a texture map, (H, 2 H); None without a file. A file of another form: TextureError."""
    if not path.is_file():
        return None
    counts = decoded_grey(path.read_bytes())
    if counts is None or counts.dtype != np.uint8 or counts.shape[1] != 2 * counts.shape[0]:
        got = "no picture" if counts is None else f"{counts.shape[1]} x {counts.shape[0]} of {counts.dtype}"
        do = "take the one that `sphereorient map` wrote, or move it away"
        raise TextureError(refusal(str(path), expected="8-bit counts, twice as wide as high", got=got, do=do))
    return torch.from_numpy(counts.astype(np.int64))


def write_learnt(learnt: LearntMap, track: Trajectory, path: Path) -> None:
    """Write the orientations as a track, and all other results in its group `map`; may raise OutputError."""
    with put_aside(path, also=(RuntimeError,)) as aside:
        track.save(aside)
        with h5py.File(aside, "a") as file:
            _write_map(learnt, file.create_group("map"))


def _write_map(learnt: LearntMap, group: h5py.Group) -> None:
    _put(group, "texture", learnt.texture.numpy(), "1", "paint, 0 black .. 1 white; NaN where never seen")
    _put(group, "seen", learnt.seen.numpy(), "1", "pictures that show the texel")
    _put(group, "sigma", learnt.sigma.numpy(), "1", "standard deviation of the paint by noise alone; inf: never seen")
    _put(group, "fitted", learnt.fitted.numpy(), "1", "frames that the map was fitted to; the others follow them")
    if learnt.rounds:
        names = [field.name for field in fields(learnt.rounds[0])]
        table = np.array([[getattr(one, name) for name in names] for one in learnt.rounds], np.float64)
        _put(group, "rounds", table, "as named", f"one row a round: {', '.join(names)}")
    for field in fields(learnt.closure):
        group.attrs[field.name] = getattr(learnt.closure, field.name)
    group.attrs["blur_px"], group.attrs["arrived"] = learnt.blur_px, learnt.arrived


def _put(group: h5py.Group, name: str, values: NDArray[np.generic], units: str, description: str) -> None:
    dataset = group.create_dataset(name, data=values, track_times=False, compression="gzip")
    dataset.attrs["units"], dataset.attrs["description"] = units, description


def check_picture_name(path: Path) -> None:
    """Raise OutputError for a suffix other than .png, .tif or .tiff: other formats lose grey values."""
    if path.suffix.lower() not in (".png", ".tif", ".tiff"):
        do = "choose a name such as texture.png"
        raise OutputError(refusal(f"--out {path}", expected=".png or .tif", got=path.suffix or "no ending", do=do))


def shares_seen(seen: Tensor, counts: tuple[int, ...]) -> list[float]:
    """Return the shares of the sphere that at least so many pictures show."""
    area = texel_areas(len(seen))
    return [float((area * (seen >= count)).sum() / area.sum()) for count in counts]
