from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import tifffile
from cine_writer import Cine, write_cine
from movie_examples import encode
from numpy.typing import NDArray

Frames = NDArray[Any]
Writer = Callable[[Path, Frames], Path]  # folder and frames (N, H, W) -> what to open


def rgb(frames: Frames) -> Frames:
    return np.repeat(frames[..., None], 3, axis=-1)


def cine(**keys: Any) -> Writer:
    return lambda folder, frames: write_cine(folder / "movie.cine", Cine(frames, **keys))


def colour_cine(folder: Path, frames: Frames) -> Path:
    return write_cine(folder / "movie.cine", Cine(rgb(frames)))


def tiff(**keys: Any) -> Writer:
    def write(folder: Path, frames: Frames) -> Path:
        tifffile.imwrite(folder / "movie.tif", frames, **keys)
        return folder / "movie.tif"

    return write


def colour_tiff(folder: Path, frames: Frames) -> Path:
    return tiff(photometric="rgb")(folder, rgb(frames))


def planar_tiff(folder: Path, frames: Frames) -> Path:
    planes = np.repeat(frames[:, None], 3, axis=1)
    return tiff(photometric="rgb", planarconfig="separate")(folder, planes)


def white_is_zero(folder: Path, frames: Frames) -> Path:
    return tiff(photometric="miniswhite")(folder, np.iinfo(frames.dtype).max - frames)


def turned_tiff(orientation: int, turn: Callable[[Frames], Frames]) -> Writer:
    """TIFF whose orientation tag names another first row or column."""
    return lambda folder, frames: tiff(extratags=[(274, 3, 1, orientation, True)])(folder, turn(frames))


def lzw_tiff(folder: Path, frames: Frames) -> Path:
    assert cv2.imwritemulti(str(folder / "movie.tif"), list(frames), [cv2.IMWRITE_TIFF_COMPRESSION, 5])
    return folder / "movie.tif"


def one_page_tiff(folder: Path, frames: Frames) -> Path:
    """ImageJ's stacks above 4 GB: one page, and the others' values behind it."""
    path = tiff(imagej=True, metadata={"axes": "TYX"})(folder, frames)
    content = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as file:
        fields = len(file.pages[0].tags)
        next_page = file.pages[0].offset + 2 + 12 * fields
        end = file.pages[0].dataoffsets[0] + frames.nbytes
    content[next_page : next_page + 4] = bytes(4)
    path.write_bytes(content[:end])
    return path


def sequence(suffix: str, name: str = "cam1_{:d}", *options: int) -> Writer:
    def write(folder: Path, frames: Frames) -> Path:
        (folder / "pictures").mkdir()
        for number, frame in enumerate(frames, start=7):
            assert cv2.imwrite(str(folder / "pictures" / f"{name.format(number)}.{suffix}"), frame, options)
        return folder / "pictures"

    return write


def colour_sequence(folder: Path, frames: Frames) -> Path:
    return sequence("png")(folder, rgb(frames))


def pattern(folder: Path, frames: Frames) -> Path:
    sequence("png", "run2_{:05d}")(folder, frames)
    cv2.imwrite(str(folder / "pictures" / "background.png"), frames[0])
    return folder / "pictures" / "run2_%05d.png"


def hdf5(dataset: str = "frames", **keys: Any) -> Writer:
    def write(folder: Path, frames: Frames) -> Path:
        with h5py.File(folder / "movie.h5", "w") as file:
            file.create_dataset(dataset, data=frames, **keys)
        return folder / "movie.h5"

    return write


def named_hdf5(folder: Path, frames: Frames) -> Path:
    with h5py.File(folder / "movie.h5", "w") as file:
        file["left/frames"], file["right/frames"] = frames[:, ::-1, ::-1], frames
    return folder / "movie.h5::right/frames"


def npy(folder: Path, frames: Frames) -> Path:
    np.save(folder / "movie.npy", frames)
    return folder / "movie.npy"


def video(name: str, codec: str, pixels: str = "gray", deep: str = "gray16le", **options: str) -> Writer:
    def write(folder: Path, frames: Frames) -> Path:
        chosen = pixels if frames.dtype == np.uint8 else deep
        return encode(folder / name, frames, codec, chosen, options)

    return write


LOSSLESS: dict[str, Writer] = {  # 8 and 16 bit
    "cine": cine(),
    "cine, rows top-down": cine(flip_v=1),
    "cine, columns turned": cine(flip_h=1),
    "cine, cropped": cine(first_number=-5, total=20_000),
    "cine, padded rows": cine(pad_to=4),
    "cine, annotations": cine(annotation=64),
    "cine, gaps": cine(gap=13, annotation=9),
    "cine, images not in order": cine(order=[*range(29, -1, -1)]),
    "cine, colour": colour_cine,
    "tiff": tiff(),
    "tiff, big": tiff(bigtiff=True),
    "tiff, other byte order": tiff(byteorder=">"),
    "tiff, zlib": tiff(compression="zlib"),
    "tiff, strips": tiff(rowsperstrip=5),
    "tiff, tiles": tiff(tile=(16, 16)),
    "tiff, lzw": lzw_tiff,
    "tiff, imagej": tiff(imagej=True),
    "tiff, one page": one_page_tiff,
    "tiff, colour": colour_tiff,
    "tiff, colour planes": planar_tiff,
    "tiff, white is zero": white_is_zero,
    "tiff, bottom-up": turned_tiff(4, lambda frames: frames[:, ::-1]),
    "tiff, right to left": turned_tiff(2, lambda frames: frames[:, :, ::-1]),
    "png": sequence("png"),
    "tif pictures": sequence("tif"),
    "pgm": sequence("pgm"),
    "png, colour": colour_sequence,
    "pattern": pattern,
    "hdf5": hdf5(),
    "hdf5, in a group": hdf5("run/movie"),
    "hdf5, named": named_hdf5,
    "hdf5, chunks": hdf5(chunks=(1, 37, 51), compression="gzip"),
    "hdf5, chunks of many": hdf5(chunks=(8, 10, 20), compression="lzf"),
    "npy": npy,
    "ffv1 mkv": video("movie.mkv", "ffv1"),
    "ffv1 avi": video("movie.avi", "ffv1"),
    "png mov": video("movie.mov", "png", deep="gray16be"),
}
EIGHT_BIT: dict[str, Writer] = {
    "bmp": sequence("bmp"),
    "ffv1 bgra": video("movie.avi", "ffv1", "bgra"),
    "raw avi": video("movie.avi", "rawvideo"),
    "upper case suffix": video("MOVIE.AVI", "rawvideo"),
    "raw bgr avi": video("movie.avi", "rawvideo", "bgr24"),
}
LOSSY: dict[str, Writer] = {
    "mjpeg": video("movie.avi", "mjpeg", "yuvj420p"),
    "h264": video("movie.mp4", "libx264", "yuv420p"),
    "jpg": sequence("jpg"),
}
