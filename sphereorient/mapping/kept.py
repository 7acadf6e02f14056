"""The file of an unfinished map: tensors with checksums."""

from pathlib import Path

import h5py
import torch
from torch import Tensor

from sphereorient.files.hdf5 import DAMAGE, whole_hdf5
from sphereorient.files.whole_file import writing

SCHEMA = "sphereorient-unfinished-map/1"


def write_kept(path: Path, parts: dict[str, Tensor]) -> None:
    """Write tensors by name, over a damaged file too: it lies in the run's own folder; may raise OutputError."""
    with writing(force=True), whole_hdf5(path, "check the space left, then run again with --resume") as file:
        file.attrs["schema"] = SCHEMA
        for name, part in parts.items():
            file.create_dataset(name, data=part.numpy(), fletcher32=bool(part.numel() and part.ndim), track_times=False)


def read_kept(path: Path) -> dict[str, Tensor] | None:
    """Return what `write_kept` wrote; None without a file, or if it is damaged: the run starts over."""
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("schema") != SCHEMA:
                return None
            return {name: torch.as_tensor(file[name][()]) for name in file}
    except DAMAGE:
        return None
