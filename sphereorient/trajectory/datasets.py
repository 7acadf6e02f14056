"""Datasets of a track file: axes, unit, description and type of each record field."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import Reason, ShapeError, TrackError, refusal
from sphereorient.files.whole_file import LARGEST_RATIO

KEY = "column"
SPANS = 4  # most named stretches of frames


@dataclass(frozen=True)
class DatasetSpec:
    """One dataset of the file."""

    units: str
    description: str
    tail: tuple[int, ...] = ()  # axes after the first
    dtype: str = "float64"
    fill: float = np.nan  # value if not measured
    since: str = ""  # first version with this dataset; blank for older files
    rows: str = "frames"  # frames, offsets (frames + 1) or candidates
    of_several: bool = False  # whether only tracks of several spheres have it


def stored(units: str, description: str, *tail: int, **more: Any) -> Any:
    """Declare a record field that is a dataset of the file."""
    return field(metadata={KEY: DatasetSpec(units, description, tail, **more)})


def in_length(text: str, length_unit: str) -> str:
    """Return a unit or label with its lengths, in mm or m, in the length unit: mm^2, velocity (m/s)."""
    return text if length_unit == "mm" else re.sub(r"\bmm?\b", length_unit, text)


def stored_fields(record: Any) -> Iterator[tuple[str, DatasetSpec]]:
    """Yield name and specification of every dataset of a record (or its class: in mm), in order."""
    unit = getattr(record, "length_unit", "mm")
    alone = not isinstance(record, type) and not getattr(record, "sphere", True)
    for entry in fields(record):
        spec = entry.metadata.get(KEY)
        if spec is not None and not (alone and spec.of_several):
            yield entry.name, spec if unit == "mm" else replace(spec, units=in_length(spec.units, unit))


def blank_datasets(record: type[Any], frames: int) -> dict[str, NDArray[Any]]:
    """Return every dataset of a record with fill values."""
    rows = {"frames": frames, "offsets": frames + 1, "candidates": 0}
    return {name: np.full((rows[c.rows], *c.tail), c.fill, c.dtype) for name, c in stored_fields(record)}


def check_shapes(record: object, rows: Mapping[str, int]) -> None:
    """Raise ShapeError if a dataset of a record differs from its declared shape."""
    for name, c in stored_fields(type(record)):
        expected, got = (rows[c.rows], *c.tail), np.shape(getattr(record, name))
        if got != expected:
            label = f"{type(record).__name__}.{name}"
            do = "give every dataset one row per frame"
            raise ShapeError(refusal(label, expected=f"shape {expected}", got=str(got), do=do))


def write_datasets(record: Any, group: h5py.Group) -> None:
    """Write all datasets of a record."""
    for name, c in stored_fields(record):
        write_dataset(group, _place(name), np.asarray(getattr(record, name), c.dtype), c)


def write_dataset(group: h5py.Group, place: str, values: NDArray[Any], spec: DatasetSpec) -> None:
    """Write one dataset with unit and description; without timestamps: equal arrays give equal bytes."""
    dataset = group.create_dataset(place, data=values, track_times=False)
    dataset.attrs["units"], dataset.attrs["description"] = spec.units, spec.description


def read_datasets(group: h5py.Group, record: type[Any]) -> dict[str, NDArray[Any]]:
    """Return all datasets of a record by field name; datasets newer than the file are blank."""
    known = {
        name: read_dataset(group, _place(name), c.dtype).astype(c.dtype)
        for name, c in stored_fields(record)
        if not (c.since or c.of_several) or _place(name) in group
    }
    if len(known) == sum(1 for _ in stored_fields(record)):
        return known
    return blank_datasets(record, len(next(iter(known.values())))) | known


def read_dataset(group: h5py.Group, place: str, dtype: str) -> NDArray[Any]:
    """Return a dataset's values; raise TrackError, before reading, if it is external or impossibly large."""
    dataset = inside(group, place)
    got = ""
    if not isinstance(dataset, h5py.Dataset) or dataset.shape is None:
        got = "none"
    elif dataset.external or dataset.is_virtual:
        got = "one that lies in other files"
    elif dataset.nbytes > LARGEST_RATIO * Path(group.file.filename).stat().st_size:
        got = f"one that claims {dataset.nbytes / 1e6:.3g} MB"
    elif not (dataset.dtype.kind == "S" if dtype == "S" else np.can_cast(dataset.dtype, dtype, "same_kind")):
        got = f"values of type {dataset.dtype}"[:100]
    if got:
        name, do = f"{group.file.filename}: {group.name.rstrip('/')}/{place}", "write the track again"
        raise TrackError(refusal(name, expected="a dataset", got=got, do=do))
    return np.asarray(dataset[()])


def inside(group: h5py.Group, place: str) -> Any:
    """Return the object at a place in a group; None if missing or a link, which may lead to other files."""
    here: Any = group
    for part in place.split("/"):
        if not isinstance(here, h5py.Group) or not isinstance(here.get(part, getlink=True), h5py.HardLink):
            return None
        here = here[part]
    return here


def named_group(parent: h5py.Group, name: str) -> h5py.Group:
    """Return a group in another one; TrackError for a link, a dataset, or an unprintable name."""
    group = inside(parent, name)
    if not isinstance(group, h5py.Group) or not name.isprintable() or len(name) > 100:
        label, do = f"{parent.file.filename}: {parent.name.strip('/')}", "write the track again"
        raise TrackError(refusal(label, expected="groups with names", got=repr(name)[:60], do=do))
    return group


def _place(name: str) -> str:
    return name.replace("candidate_", "candidates/")


def runs_of(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return first and last + 1 of the runs of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def nearest_rows(known: NDArray[Any], wanted: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the rows of increasing known times nearest to the wanted ones, and where they are within half a step,
    of whichever has the shorter ones.
    """
    after = np.clip(np.searchsorted(known, wanted), 0, len(known) - 1)
    before = np.maximum(after - 1, 0)
    row = np.where(np.abs(known[before] - wanted) < np.abs(known[after] - wanted), before, after)
    step = min((float(np.median(np.diff(one))) for one in (known, wanted) if len(one) > 1), default=np.inf)
    return row, np.abs(known[row] - wanted) <= step / 2


def span_words(mask: NDArray[np.bool_], number: NDArray[np.int64] | None = None) -> str:
    """Return the frames (N,) of a mask as text, "0 to 79, 280 to 319", the longest ones; `number`: of each frame."""
    number = np.arange(len(mask)) if number is None else number
    runs = runs_of(mask)
    longest = sorted(sorted(runs, key=lambda run: run[0] - run[1])[:SPANS])
    words = [f"{number[a]} to {number[b - 1]}" if b > a + 1 else f"{number[a]}" for a, b in longest]
    return ", ".join(words) + (f" and {len(runs) - SPANS} stretches more" if len(runs) > SPANS else "")


def reasons_of(texts: Any) -> tuple[str, ...]:
    """Return stored texts (N,), bytes, as reasons; unknown texts of newer files stay texts."""
    known = {str(reason): reason for reason in Reason}
    return tuple(known.get(text, text) for text in (each.decode() for each in texts.tolist()))
