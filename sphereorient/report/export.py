"""A track for other programs: CSV, Parquet, MATLAB, xarray (docs/export.md)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sphereorient.errors import OutputError, refusal
from sphereorient.report.export_columns import Column, as_text, columns, metadata, package
from sphereorient.report.export_mat import write_mat
from sphereorient.report.export_xarray import to_xarray
from sphereorient.trajectory import Trajectory

if TYPE_CHECKING:
    import pyarrow as pa

__all__ = ["export_track", "format_of", "to_arrow", "to_xarray"]

SUFFIXES = {".csv": "csv", ".parquet": "parquet", ".pq": "parquet", ".mat": "mat"}
ROWS = 50_000  # written at once
Advance = Callable[[int, int], None]


def export_track(track: Trajectory, path: Path, to: str, progress: Advance = lambda done, total: None) -> None:
    """Write all frame-wise datasets of a track, with their units in the names and what the track says of itself.

    Args:
        track: what to write; NaN stays NaN.
        path: the file; it is written in place, so pass a name aside where an old one matters.
        to: csv, parquet or mat.
        progress: called with frames done and all frames.

    Raises:
        OutputError: an unknown format, a package that is not installed, or a file that cannot be written.
    """
    if to not in WRITERS:
        do = f"choose one of {', '.join(WRITERS)}"
        raise OutputError(refusal("--to", expected="a known format", got=repr(to)[:60], do=do))
    try:
        WRITERS[to](track, path, progress)
    except OSError as error:
        do = "choose a folder that exists, may be written and has room"
        got = f"'{error.strerror or error}'"
        raise OutputError(refusal(str(path), expected="a file that can be written", got=got, do=do)) from error


def format_of(path: Path, to: str | None) -> str:
    """Return the format that a name and an option ask for together.

    Args:
        path: the file to write.
        to: csv, parquet or mat; None: what the name's suffix says.

    Raises:
        OutputError: neither says it, or they contradict each other.
    """
    by_name = SUFFIXES.get(path.suffix.lower())
    if to is not None and to not in WRITERS:
        do = "write --to csv, parquet or mat"
        raise OutputError(refusal("--to", expected=f"one of {', '.join(WRITERS)}", got=repr(to)[:60], do=do))
    if to is None and by_name is None:
        do = "add --to csv, parquet or mat, or end the name in one of these"
        got = f"'{path.suffix}'"
        raise OutputError(refusal(f"--out {path}", expected=" ".join(SUFFIXES), got=got, do=do))
    if to is not None and by_name not in (None, to):
        do = "let --to and the name agree"
        raise OutputError(refusal(f"--out {path}", expected=f"a name for {to}", got=f"'{path.suffix}'", do=do))
    return to or str(by_name)


def to_arrow(track: Trajectory) -> pa.Table:
    """Return a track as an Arrow table, one row a frame, each field with `units` and `description`.

    Raises:
        OutputError: pyarrow is not installed.
    """
    arrow = package("pyarrow", "table")
    parts = list(columns(track))
    schema = arrow.schema(
        [arrow.field(c.name, _arrow_values(arrow, c).type, metadata=_described(c)) for c in parts],
        metadata={key: as_text(value) for key, value in metadata(track).items()},
    )
    return arrow.table([_arrow_values(arrow, c) for c in parts], schema=schema)


def _write_csv(track: Trajectory, path: Path, progress: Advance) -> None:
    """Comment lines, the names, one line a frame."""
    package("pyarrow", "table")
    import pyarrow.csv as arrow_csv

    table = to_arrow(track)
    valid = table.schema.get_field_index("valid")
    table = table.set_column(valid, "valid", table["valid"].cast("int8"))  # 1 and 0 are read by every program
    plain = arrow_csv.WriteOptions(include_header=False, quoting_style="none")
    with path.open("wb") as file:
        for line in _comments(track):
            file.write(f"# {line}".rstrip().encode() + b"\n")
        file.write(",".join(table.column_names).encode() + b"\n")
        for first in range(0, len(table), ROWS):
            part = table.slice(first, ROWS)
            arrow_csv.write_csv(part, file, plain)
            progress(first + len(part), len(table))


def _comments(track: Trajectory) -> list[str]:
    """What a track says of itself, line by line."""
    about = metadata(track)
    settings = about.pop("settings")
    lines = [f"{key}: {' '.join(as_text(value).split())}" for key, value in about.items()]
    lines += ["quaternions: of R_lab_body, w first; units stand at the end of the names", "settings:"]
    return lines + [f"  {line}" for line in settings.splitlines()]


def _write_parquet(track: Trajectory, path: Path, progress: Advance) -> None:
    """A Parquet file with the schema's metadata."""
    table = to_arrow(track)
    import pyarrow.parquet as arrow_parquet

    with arrow_parquet.ParquetWriter(path, table.schema, compression="zstd") as writer:
        for first in range(0, max(len(table), 1), ROWS):
            part = table.slice(first, ROWS)
            writer.write_table(part)
            progress(first + len(part), len(table))


WRITERS: dict[str, Callable[[Trajectory, Path, Advance], None]] = {
    "csv": _write_csv,
    "parquet": _write_parquet,
    "mat": write_mat,
}


def _arrow_values(arrow: Any, column: Column) -> Any:
    text = column.values.dtype == object
    return arrow.array(column.values, type=arrow.string() if text else None, from_pandas=False)


def _described(column: Column) -> dict[str, str]:
    return {"units": column.units, "description": column.description}
