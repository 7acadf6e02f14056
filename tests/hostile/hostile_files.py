"""Families of hostile binary files: pictures, HDF5, movies; and tables of times."""

from __future__ import annotations

import functools
import struct
import sys
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from conftest import REPO
from hostile_judge import Case, Load
from hostile_kinds import garbage, no_files, no_text, spoilt_bytes
from hostile_texts import CELLS, Family, Generated
from hypothesis import strategies as st

sys.path.append(str(REPO / "tests" / "movies"))
from movie_examples import pictures as noise
from movie_examples import smooth
from movie_formats import EIGHT_BIT, LOSSLESS, Frames, Writer, cine, video
from movie_formats import tiff as tiff_writer

from sphereorient.experiment.recording import load_background
from sphereorient.experiment.timeline import load_times
from sphereorient.movies import open_movie
from sphereorient.sphere import load_texture
from sphereorient.trajectory import CameraTrack, Trajectory

HUGE = [(0, 0), (1, 0), (16, 8), (32, 16), (65_536, 32_768), (10**6, 5 * 10**5), (2**31 - 1, 2**30), (2**31, 2**30)]
HUGE += [(20_000, 10_000), (30_000, 15_000), (2**32 - 1, 2**31), (10**9, 1), (1, 10**9)]


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(width: int, height: int, rows: bytes = b"", depth: int = 8, colour: int = 0, more: bytes = b"") -> bytes:
    """A PNG file by hand, with any claim in its header."""
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + more + chunk(b"IDAT", rows or zlib.compress(b"")) + chunk(b"IEND", b"")


@functools.cache
def bomb_png(width: int, height: int) -> bytes:
    """A PNG whose zeros are all there: a thousand times smaller than its pixels."""
    packer = zlib.compressobj(1)
    row = bytes(width + 1)
    return png(width, height, b"".join(packer.compress(row) for _ in range(height)) + packer.flush())


def tiff(width: int, height: int, big: bool = False, entries: int = 0) -> bytes:
    """The header of a TIFF file, with any claim."""
    order = ">" if big else "<"
    tags = [(256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 8), (259, 3, 1, 1), (262, 3, 1, 1), (273, 4, 1, 200)]
    tags += [(277, 3, 1, 1), (278, 4, 1, height), (279, 4, 1, 2**32 - 1)]
    short = 16 if big else 0  # a number of 16 bits stands in the first half of its field
    body = b"".join(
        struct.pack(f"{order}HHII", tag, kind, count, (value << short if kind == 3 else value) % 2**32)
        for tag, kind, count, value in tags
    )
    head = (b"MM\0*" if big else b"II*\0") + struct.pack(f"{order}I", 8)
    return head + struct.pack(f"{order}H", entries or len(tags)) + body + bytes(500)


def encoded(suffix: str, picture: Any) -> bytes:
    ok, content = cv2.imencode(suffix, picture)
    assert ok
    return content.tobytes()


def pattern(shape: tuple[int, int] = (16, 32), dtype: Any = np.uint8) -> Any:
    values = np.arange(shape[0] * shape[1]).reshape(shape) * 37 % 251
    return values.astype(dtype)


@functools.cache
def pictures() -> dict[str, bytes]:
    valid = {f"8 bit {suffix}": encoded(suffix, pattern()) for suffix in (".png", ".tif", ".jpg", ".bmp", ".pgm")}
    valid |= {f"16 bit {suffix}": encoded(suffix, pattern(dtype=np.uint16)) for suffix in (".png", ".tif")}
    return valid


def picture_cases() -> list[Case]:
    nan = pattern(dtype=np.float32)
    nan[3, 4] = np.nan
    formats = {f"claims {size} png": png(*size) for size in HUGE if max(size) < 2**32}
    formats |= {f"claims {size} tiff {big}": tiff(*size, big) for size in HUGE for big in (False, True)}
    formats |= {f"claims {size} pgm": f"P5 {size[0]} {size[1]} 255\n".encode() + bytes(100) for size in HUGE}
    formats |= {
        f"claims {size} bmp": encoded(".bmp", pattern())[:18]
        + struct.pack("<ii", *(n % 2**31 for n in size))
        + encoded(".bmp", pattern())[26:]
        for size in HUGE
    }
    formats |= {
        "claims much jpg": encoded(".jpg", pattern()).replace(b"\x00\x10\x00\x20", b"\xff\xff\xff\xff"),
        "bomb": bomb_png(20_000, 10_000),
        "bomb that fits": bomb_png(32, 16) + bytes(1000),
        "too many tags": tiff(32, 16, entries=65_535),
        "text bomb": png(32, 16, more=chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(50_000_000)))),
        "palette": png(32, 16, zlib.compress(bytes(33 * 16)), colour=3),
        "depth 3": png(32, 16, zlib.compress(bytes(33 * 16)), depth=3),
        "32 bit": encoded(".tiff", pattern(dtype=np.float32)),
        "not a number": encoded(".tiff", nan),
        "64 bit": encoded(".tiff", pattern(dtype=np.float64)),
        "one grey": encoded(".png", pattern() * 0),
        "square": encoded(".png", pattern((16, 16))),
        "tiny": encoded(".png", pattern((2, 4))),
        "colour": encoded(".png", np.dstack([pattern()] * 3)),
        "with opacity": encoded(".png", np.dstack([pattern()] * 4)),
        "web picture": encoded(".webp", np.dstack([pattern()] * 3)),
        "text": b"no picture",
        "graphic": b"<svg xmlns='http://www.w3.org/2000/svg' width='1000000' height='500000'/>",
        "gif": b"GIF89a\xff\xff\xff\xff\x80\0\0" + bytes(50),
        "radiance": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 100000 +X 200000\n" + bytes(50),
        "open exr": b"v/1\x01\x02\0\0\0" + bytes(200),
        "jpeg 2000": bytes.fromhex("0000000c6a5020200d0a870a") + bytes(200),
        "float map": b"Pf\n200000 100000\n-1.0\n" + bytes(50),
        "any map": b"P7\nWIDTH 200000\nHEIGHT 100000\nDEPTH 1\nMAXVAL 255\nTUPLTYPE GRAYSCALE\nENDHDR\n",
        "sun": bytes.fromhex("59a66a95") + struct.pack(">7I", 10**6, 10**5, 8, 0, 1, 0, 0),
        "empty": b"",
    }
    return [Case(name, content) for name, content in formats.items()]


def picture_family(name: str, file: str, load: Load) -> Family:
    def cases(folder: Path) -> list[Case]:
        return [*no_files(pictures()["8 bit .png"]), *picture_cases()]

    def more(folder: Path) -> Generated:
        valid = list(pictures().values())
        size = st.tuples(st.integers(0, 2**31 - 1), st.integers(0, 2**31 - 1))
        claims = size.map(lambda side: Case(f"claims {side}", png(*side)))
        return st.one_of(spoilt_bytes(valid), spoilt_bytes(valid), spoilt_bytes(valid), claims, garbage())

    return Family(name, file, load, cases, more)


@functools.cache
def track_bytes(libver: str = "earliest") -> bytes:
    """A small track with two cameras, as `save` writes it, or in HDF5's newest form."""
    time_s = np.arange(5) / 600
    track = Trajectory.empty(time_s, cameras=("cam1", "cam2"), frame_rate=600.0, method="paper", provenance={"a": 1})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "track.h5"
        track.save(path)
        if libver != "earliest":
            newest = Path(folder) / "newest.h5"
            with h5py.File(path) as old, h5py.File(newest, "w", libver=libver) as new:
                for name in old:
                    old.copy(name, new)
                for name, value in old.attrs.items():
                    new.attrs[name] = value
            path = newest
        return path.read_bytes()


def track_with(folder: Path, change: Callable[[h5py.File], None]) -> bytes:
    """The bytes of the track after something was done to it with HDF5's own means."""
    path = folder / "made.h5"
    path.write_bytes(track_bytes())
    with h5py.File(path, "r+") as file:
        change(file)
    content = path.read_bytes()
    path.unlink()
    return content


def replaced(place: str, make: Callable[[h5py.Group, str], Any]) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        group, _, name = place.rpartition("/")
        del file[place]
        make(file[group or "/"], name)

    return change


def plain(value: Any, dtype: Any = None) -> Callable[[h5py.Group, str], Any]:
    return lambda group, name: group.create_dataset(name, data=value, dtype=dtype)


def linked(link: Any) -> Callable[[h5py.Group, str], Any]:
    def make(group: h5py.Group, name: str) -> None:
        group[name] = link

    return make


def _external(group: h5py.Group, name: str) -> None:
    group.create_dataset(name, (5,), "f8", external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)])


def _virtual(group: h5py.Group, name: str) -> None:
    layout = h5py.VirtualLayout((5,), "f8")
    layout[:] = h5py.VirtualSource("other.h5", "time", (5,))
    group.create_virtual_dataset(name, layout)


def _of_references(group: h5py.Group, name: str) -> None:
    group.create_dataset(name, data=[group.ref] * 5, dtype=h5py.ref_dtype)


KINDS: dict[str, Callable[[h5py.Group, str], Any]] = {
    "nothing": lambda group, name: None,
    "a group": lambda group, name: group.create_group(name),
    "a group in itself": lambda group, name: group.create_group(name).__setitem__("again", group),
    "a type": lambda group, name: group.__setitem__(name, np.dtype("f8")),
    "a number": plain(1.0),
    "no space": lambda group, name: group.create_dataset(name, data=h5py.Empty("f8")),
    "too short": plain(np.zeros(4)),
    "too deep": plain(np.zeros((5, 1, 1, 1))),
    "no row": plain(np.zeros(0)),
    "whole numbers": plain(np.arange(5)),
    "complex": plain(np.zeros(5, complex)),
    "half": plain(np.zeros(5, "f2")),
    "texts": plain(["a"] * 5),
    "bytes": plain(np.array([b"\xff\xfe"] * 5)),
    "text": plain("text"),
    "compound": plain(np.zeros(5, [("a", "f8"), ("b", "i4")])),
    "opaque": plain(np.zeros(5, "V16")),
    "ragged": lambda group, name: group.create_dataset(name, (5,), h5py.vlen_dtype("f8")),
    "references": _of_references,
    "enum": lambda group, name: group.create_dataset(name, (5,), h5py.enum_dtype({"a": 1}, "i1")),
    "a trillion rows": lambda group, name: group.create_dataset(name, (10**12,), "f8", chunks=(1024,)),
    "a trillion rows unchunked": lambda group, name: _late(group, name, (10**12,)),
    "a billion chunked": lambda group, name: group.create_dataset(name, (10**9,), "f8", chunks=(10**6,)),
    "a huge chunk": lambda group, name: group.create_dataset(name, (5,), "f8", chunks=(5 * 10**8,), maxshape=(None,)),
    "a full chunk": lambda group, name: group.create_dataset(
        name, data=np.zeros(10**7), chunks=(10**7,), compression="gzip"
    ),
    "an outer file": linked(h5py.ExternalLink("other.h5", "/time")),
    "an outer file elsewhere": linked(h5py.ExternalLink("/etc/passwd", "/time")),
    "a device": linked(h5py.ExternalLink("/dev/zero", "/time")),
    "a loose link": linked(h5py.SoftLink("/nowhere")),
    "a link to itself": lambda group, name: group.__setitem__(name, h5py.SoftLink(f"{group.name}/{name}")),
    "outer bytes": _external,
    "outer rows": _virtual,
}
PLACES = ["time", "valid", "position", "orientation_cov", "segment", "flags", "cameras", "cameras/cam1"]
PLACES += ["cameras/cam1/reason", "cameras/cam1/centre_px", "cameras/cam1/candidates", "cameras/cam1/candidates/offset"]
PLACES += ["cameras/cam1/candidates/orientation", "margin"]
DEEP = "[" * 100_000 + "]" * 100_000
TEXTS: list[Any] = ["", "x" * 60_000, "a\nb\x1b", "{", DEEP, '{"a": 1e999}', "[]", "null", b"\xff\xfe"]
TEXTS += [np.bytes_(b"\0")]
TEXTS += [1, np.nan, np.inf, -1.0, [1.0, 2.0], ["a", "b"], h5py.Empty("f8"), np.zeros(3, [("a", "f8")]), 10**18]
ATTRIBUTES = ["schema", "provenance", "method", "settings", "experiment", "frame_rate"]


def _late(group: h5py.Group, name: str, shape: tuple[int, ...]) -> None:
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plist.set_alloc_time(h5py.h5d.ALLOC_TIME_LATE)
    space = h5py.h5s.create_simple(shape)
    h5py.h5d.create(group.id, name.encode(), h5py.h5t.IEEE_F64LE, space, plist)


def _with_attribute(name: str, value: Any) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        del file.attrs[name]
        if value is not None:
            file.attrs[name] = value

    return change


def _many_groups(file: h5py.File) -> None:
    group = file["cameras"]
    for _ in range(400):
        group = group.create_group("deeper")


def track_changes() -> dict[str, Callable[[h5py.File], None]]:
    changes = {f"{place} is {kind}": replaced(place, make) for place in PLACES for kind, make in KINDS.items()}
    changes |= {
        f"{name} = {str(value)[:20]!r}": _with_attribute(name, value)
        for name in ATTRIBUTES
        for value in [None, *TEXTS]
        if len(str(value)) < 64_000
    }
    for offsets in ([0, 0, 0, 0, 0, -1], [0, 5, 2, 9, 1, 10**18], [0] * 5 + [np.nan], [0, 0, 0, 0, 0, 3]):
        changes[f"offsets {offsets}"] = replaced("cameras/cam1/candidates/offset", plain(offsets))
    changes["deep groups"] = _many_groups
    changes["a camera in a camera"] = lambda file: file["cameras"].__setitem__("again", file["cameras"])
    changes["a name of a line"] = lambda file: file["cameras"].move("cam1", "a\nb" + "c" * 2000)
    changes["every row gone"] = lambda file: [replaced(place, plain(np.zeros(0)))(file) for place in ("time", "valid")]
    return changes


def track_family() -> Family:
    def cases(folder: Path) -> list[Case]:
        made = [Case(name, track_with(folder, change)) for name, change in track_changes().items()]
        other = [
            Case("an empty HDF5", track_with(folder, lambda file: [file.__delitem__(name) for name in list(file)]))
        ]
        return [*no_files(track_bytes()), Case("text", b"track"), Case("empty"), *other, *made]

    def more(folder: Path) -> Generated:
        return st.one_of(*[spoilt_bytes([track_bytes(), track_bytes("latest")])] * 3, garbage())

    def load(path: Path) -> None:
        track = Trajectory.load(path)
        assert len(track) < 10**6
        assert all(isinstance(camera, CameraTrack) for camera in track.cameras.values())

    def beside(folder: Path) -> None:
        with h5py.File(folder / "other.h5", "w") as other:
            other["time"] = np.arange(5.0)

    return Family("track.h5", "track.h5", load, cases, more, beside)


def times_family() -> Family:
    valid = "time\n" + "".join(f"{k / 600:.9f}\n" for k in range(50))

    def cases(folder: Path) -> list[Case]:
        cells = [Case(f"cell {cell[:10]!r}", valid.replace("0.005000000", cell).encode()) for cell in CELLS]
        texts = {
            "two columns": valid.replace("\n", ",1\n"),
            "backwards": "\n".join(reversed(valid.splitlines()[1:])),
            "equal": "1.0\n1.0\n",
            "only a head": "time\n",
            "only comments": "# a\n# b\n",
            "long": "9" * 2_000_000,
            "many": "0\n" * 500_000,
            "blank lines": "\n" * 500_000,
            "steps of nothing": "".join(f"{k}e-320\n" for k in range(9)),
        }
        return [
            *no_files(valid.encode()),
            *no_text(valid.encode()),
            *cells,
            *(Case(n, t.encode()) for n, t in texts.items()),
        ]

    return Family(
        "times.csv", "times.csv", load_times, cases, lambda folder: st.one_of(spoilt_bytes([valid.encode()]), garbage())
    )


MOVIE = np.stack([pattern((10, 14)) + k for k in range(8)]).astype(np.uint8)


def timed_hdf5(folder: Path, frames: Frames) -> Path:
    with h5py.File(folder / "movie.h5", "w", libver="latest") as file:
        file["pictures"], file["time"] = frames, np.arange(len(frames)) / 600
    return folder / "movie.h5"


def watch(path: Path) -> None:
    """Open a movie, read from its beginning and its end: each undecodable frame must be refused by itself."""
    with open_movie(path) as movie:
        count = len(movie)
        assert count > 0
        assert movie.times_s is None or movie.times_s.shape == (count,)
        assert all(remark.isprintable() for remark in movie.remarks)
        for picture in movie.readable(0, min(count, 4)):
            assert picture is None or (picture.shape == movie.frame_shape and picture.dtype == movie.dtype)
        for _ in movie.readable(count - 1, count):
            pass
        movie.sample([0, count - 1])


PREDICTED = {"g": "5", "bf": "2", "qp": "2", "b_strategy": "0"}
FORMATS: dict[str, dict[str, Writer]] = {
    "npy": {"npy": LOSSLESS["npy"]},
    "cine": {name: LOSSLESS[name] for name in ("cine", "cine, annotations", "cine, colour")}
    | {"stamps": cine(stamps_s=np.arange(12) / 1000), "setup": cine(flip_v=1, setup_length=1000)}
    | {"packed": lambda folder, frames: cine(packed_bits=10, real_bits=10)(folder, frames.astype(np.uint16) << 2)},
    "tif": {name: LOSSLESS[f"tiff{name}"] for name in ("", ", zlib", ", lzw", ", imagej", ", one page", ", strips")}
    | {"big": tiff_writer(compression="zlib", bigtiff=True), "other order": LOSSLESS["tiff, other byte order"]},
    "h5": {name: LOSSLESS[f"hdf5{name}"] for name in ("", ", chunks", ", chunks of many")} | {"times": timed_hdf5},
    "mkv": {"ffv1": LOSSLESS["ffv1 mkv"]},
    "avi": {
        "ffv1": LOSSLESS["ffv1 avi"],
        "raw": EIGHT_BIT["raw avi"],
        "h264": video("movie.avi", "libx264", "yuv420p", **PREDICTED),
        "mpeg4": video("movie.avi", "mpeg4", "yuv420p"),
    },
    "mp4": {
        "h264": video("movie.mp4", "libx264", "yuv420p", **PREDICTED),
        "mpeg4": video("movie.mp4", "mpeg4", "yuv420p"),
    },
}


@functools.cache
def movie_bytes(kind: str) -> list[bytes]:
    """Valid movies of one kind, the first with one byte a pixel; kinds without predicted frames also with two."""
    with tempfile.TemporaryDirectory() as name:
        found = []
        for number, (form, write) in enumerate(FORMATS[kind].items()):
            coded = form in ("h264", "mpeg4")
            shown = [smooth((12, 38, 52))] if coded else [noise(shape=(12, 37, 51))]
            if form in ("npy", "setup", "", "ffv1"):
                shown.append(noise(np.uint16, (12, 37, 51)))
            for k, frames in enumerate(shown):
                folder = Path(name) / f"{number} {k}"
                folder.mkdir()
                found.append(write(folder, frames).read_bytes())
    return found


def npy(header: str, content: bytes = bytes(200), version: bytes = b"\x01\x00") -> bytes:
    size = struct.pack("<H" if version[0] == 1 else "<I", len(header) + 1)
    return b"\x93NUMPY" + version + size + header.encode() + b"\n" + content


NPY_SHAPES = ["()", "(8,)", "(8, 10)", "(8, 10, 14, 3)", "(0, 10, 14)", "(8, 0, 14)", "(10**9, 10, 14)", "(-1, 10, 14)"]
NPY_SHAPES += ["(1000000000, 1000, 1000)", "(9223372036854775807, 2, 2)", "(8, 1000000000, 1000000000)"]
NPY_SHAPES += ["(1, 2**62, 4)"]
NPY_SHAPES += ["('a', 1, 1)", "(1.5, 1, 1)", "None", "(True, 10, 14)", "(" * 90 + ")" * 90, "(1," * 3000, "9" * 5000]
NPY_TYPES = ["|O", "O", "<f8", "|S10", "<U4", "<M8[s]", "|V8", "c16", "<i2", "[('a', '<u1')]", "x", "", "<u1000000000"]
NPY_TYPES += [">u2", "|b1", "<u4", "|u9", "__import__('os').system('true')"]


def npy_cases() -> list[Case]:
    head = "{{'descr': {}, 'fortran_order': {}, 'shape': {}, }}"
    shapes = {f"shape {shape[:30]}": head.format("'|u1'", "False", shape) for shape in NPY_SHAPES}
    types = {f"type {kind}": head.format(repr(kind), "False", "(2, 10, 10)") for kind in NPY_TYPES}
    other = {
        "column first": head.format("'|u1'", "True", "(2, 10, 10)"),
        "order is none": head.format("'|u1'", "7", "(2, 10, 10)"),
        "a key missing": "{'descr': '|u1'}",
        "a list": "[1, 2]",
        "a call": "__import__('os').system('true')",
        "open": "{'descr': '|u1', 'shape': (",
        "deep": "[" * 50_000,
        "zero byte": head.format("'|u1'", "False", "(2, 10, 10)\0"),
    }
    written = [Case(name, npy(text)) for name, text in (shapes | types | other).items()]
    long = [Case(f"header {n}", b"\x93NUMPY\x02\x00" + struct.pack("<I", n) + b"{" * 50) for n in (0, 10**6, 2**32 - 1)]
    versions = [Case(f"version {v}", npy(other["column first"], version=bytes([v, 0]))) for v in (0, 2, 3, 9)]
    return [*written, *long, *versions, Case("a pickle", b"\x80\x04cos\nsystem\n(S'true'\ntR.")]


def h5_movie_cases(folder: Path) -> list[Case]:
    shapes = {"a billion": (10**9, 10, 14), "wide": (8, 10**6, 10**6), "a trillion wide": (8, 10**12, 1)}
    made: dict[str, Callable[[h5py.File], Any]] = {
        f"{name} {chunks}": functools.partial(_create, shape=shape, chunks=chunks)
        for name, shape in shapes.items()
        for chunks in (None, (1, 10, 1), (1, 1, 1))
    }
    made |= {f"movie is {kind}": functools.partial(make, name="pictures") for kind, make in KINDS.items()}
    made |= {
        "outer bytes of a movie": lambda file: file.create_dataset(
            "pictures", (8, 10, 14), "u1", external=[("/etc/passwd", 0, 1120)]
        ),
        "two": lambda file: [file.create_dataset(name, data=MOVIE) for name in "ab"],
        "times a trillion": lambda file: (_create(file, (8, 10, 14), None), _late(file, "time", (10**12,))),
        "times of words": lambda file: (file.create_dataset("pictures", data=MOVIE), plain(["a"] * 8)(file, "time")),
        "times of NaN": lambda file: (file.create_dataset("pictures", data=MOVIE), plain([np.nan] * 8)(file, "time")),
        "units of lines": _odd_units,
        "many sets": lambda file: [file.create_dataset(f"a\nb{k}", data=MOVIE) for k in range(300)],
    }
    cases = []
    for name, make in made.items():
        path = folder / "made.h5"
        with h5py.File(path, "w") as file:
            make(file)
        cases.append(Case(name, path.read_bytes()))
        path.unlink()
    return cases


def _create(file: h5py.File, shape: tuple[int, ...], chunks: Any) -> None:
    if chunks is not None:
        file.create_dataset("pictures", shape, "u1", chunks=chunks)
        return
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plist.set_alloc_time(h5py.h5d.ALLOC_TIME_LATE)
    h5py.h5d.create(file.id, b"pictures", h5py.h5t.STD_U8LE, h5py.h5s.create_simple(shape), plist)


def _odd_units(file: h5py.File) -> None:
    file.create_dataset("pictures", data=MOVIE)
    file.create_dataset("time", data=np.arange(8.0)).attrs["units"] = "a\nb" + "c" * 1000


def movie_family(kind: str) -> Family:
    def cases(folder: Path) -> list[Case]:
        valid = movie_bytes(kind)[0]
        written: list[Case] = {
            "npy": lambda: npy_cases(),
            "h5": lambda: h5_movie_cases(folder),
            "tif": lambda: [Case(f"claims {size} {big}", tiff(*size, big)) for size in HUGE for big in (False, True)],
            "cine": lambda: cine_cases(valid),
        }.get(kind, list)()
        # FFmpeg searches zeros for a next frame, 70 MB/s: as long as reading them takes, so less of them for it.
        places = [case for case in no_files(valid) if kind not in VIDEO or case.place != "sparse"]
        cuts = [Case("cut", one[: len(one) * part // 24]) for one in movie_bytes(kind) for part in range(25)]
        return [*places, Case("empty"), Case("text", b"movie" * 100), Case("zeros", bytes(3000)), *written, *cuts]

    def more(folder: Path) -> Generated:
        return st.one_of(*[spoilt_bytes(movie_bytes(kind))] * 4, garbage())

    return Family(f"movie {kind}", f"movie.{kind}", watch, cases, more, many=2 * len(movie_bytes(kind)))


VIDEO = ("mkv", "avi", "mp4")
CINE_FIELDS = {"images": 20, "total": 12, "bitmap": 24, "setup": 28, "offsets": 32, "width": 48, "height": 52}
CINE_FIELDS |= {"bits": 58, "packing": 60, "size": 64, "colours": 80, "setup length": 84 + 142, "kind": 0, "head": 2}
EXTREMES = [0, 1, 3, 255, 65_535, 10**9, 2**31 - 1, 2**31, 2**32 - 1]


def cine_cases(valid: bytes) -> list[Case]:
    cases = []
    for name, at in CINE_FIELDS.items():
        for value in EXTREMES:
            cases.append(Case(f"{name} {value}", valid[:at] + struct.pack("<I", value) + valid[at + 4 :]))
    table = struct.unpack_from("<I", valid, 32)[0]
    for value in (0, 1, -1, 44, len(valid) - 1, len(valid), 2**62, -(2**63)):
        offset = struct.pack("<q", value)
        cases.append(Case(f"first offset {value}", valid[:table] + offset + valid[table + 8 :]))
        cases.append(Case(f"all offsets {value}", valid[:table] + offset * 8 + valid[table + 64 :]))
    return cases


def sequence_family(suffix: str) -> Family:
    """The folder is the movie, and its only picture is spoilt."""

    def load(path: Path) -> None:
        watch(path.parent)

    def first(folder: Path) -> list[Case]:
        return [*no_files(pictures()["8 bit .png"]), *picture_cases()]

    def more(folder: Path) -> Generated:
        valid = [content for name, content in pictures().items() if (".tif" in name) == (suffix == ".tif")]
        return st.one_of(*[spoilt_bytes(valid)] * 4, garbage())

    return Family(f"movie sequence {suffix}", f"f001{suffix}", load, first, more, many=8)


@functools.cache
def file_families() -> dict[str, Family]:
    """All families of binary files by name."""
    families = [
        picture_family("texture", "texture.png", load_texture),
        picture_family("background", "empty.png", lambda path: load_background(path, (16, 32))),
        track_family(),
        times_family(),
        *map(movie_family, FORMATS),
        sequence_family(".png"),
        sequence_family(".tif"),
    ]
    return {family.name: family for family in families}
