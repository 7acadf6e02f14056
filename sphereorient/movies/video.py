"""Videos decoded by FFmpeg: exact seeks, exact grey values, no pictures from damaged data."""

import ctypes
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import av
import numpy as np

from sphereorient.errors import MovieError, error_words
from sphereorient.files.picture import OnDemand, luma
from sphereorient.movies.ffv1 import SliceDecoder, SlicedPicture, split_slices
from sphereorient.movies.movie import COLOUR_REMARK, GAMMA_CODED, Grey, Movie, movie_error
from sphereorient.movies.packets import Packet, PacketIndex, index_packets
from sphereorient.movies.stamps import Stamps, rate_of, spacing

Found = TypeVar("Found")
LOSSLESS = "lossless"
PLANE_0_IS_GREY = ("gray", "yuv", "nv", "p01")  # beginnings of pixel formats that may have a grey first plane
NOTHING = "none from the decoder"
PACKETS_TRIED = 8  # of FFV1: if the check sums of one are right, all packets have check sums
TURNED_REMARK = "read as stored: players and ffmpeg rotate it by {} degrees clockwise, by its rotation tag"
FIELDS_REMARK = "interlaced, two instants a frame; separate: ffmpeg -i MOVIE -vf bwdif=send_field -c:v ffv1 NEW.mkv"
UNKNOWN, PROGRESSIVE = 0, 1  # field orders of FFmpeg; others are interlaced
COARSE = 0.1  # of the usual time between frames: coarser time stamps are not used
SHOWN = 8  # missing frames named in a remark
SLACK = 1.5  # largest excess of a rounded duration, frames


class VideoMovie(Movie):
    """A container with one video stream."""

    def __init__(self, path: Path) -> None:
        with _opened(path) as container:
            frame = _first_frame(container)
            if frame is None:
                raise movie_error(path, "a movie with frames", "no frame", "record or export it again")
            check_format(str(path), frame.format)
            self._pixels = frame.format.name
            codec = container.streams.video[0].codec_context
            form = f"{path.suffix[1:].lower()}, codec {codec.name} ({_loss(codec)}), pixels {self._pixels}"
            by_stream = getattr(codec, "field_order", UNKNOWN) not in (UNKNOWN, PROGRESSIVE)
            interlaced = frame.interlaced_frame or by_stream
            rate = container.streams.video[0].average_rate
            self.played_hz = float(rate) if rate else None
            bits = frame.format.components[0].bits
            self.full_scale = float(2**bits - 1) if 8 < bits <= 14 else None  # 16 may hold fewer
        self._checked = False  # whether the packets have verifiable check sums
        with _opened(path) as container:
            self._index, end_s, broken = self._read_index(container)
            count = self._index.count
            super().__init__(path, form, count, (frame.height, frame.width), grey_dtype(frame.format))
            damaged = (f"damaged: reading it breaks off after {count} frames, {broken}",) if broken else ()
            cut_off = self._truncated(_stated_frames(path, container, count, end_s))
            turned = (TURNED_REMARK.format(-frame.rotation % 360),) if frame.rotation else ()
            fields = (FIELDS_REMARK,) if interlaced else ()
            self.times_s, spaced = _uneven_times(self._index, container.streams.video[0].time_base)
            known = _remarks(container, self._pixels, self._index)
            self.remarks = (*damaged, *cut_off, *turned, *fields, *spaced, *known)

    def _read_index(self, container: av.container.InputContainer) -> tuple[PacketIndex, float, str]:
        """Return the packet table, the end of the last frame, s, and the error that ended the table, if any."""
        stream = container.streams.video[0]
        packets: list[Packet] = []
        end, broken = 0, ""
        try:
            for number, packet in enumerate(container.demux(stream)):
                if number < PACKETS_TRIED and stream.codec_context.name == "ffv1":
                    self._checked |= split_slices(bytes(packet)) is not None
                if packet.size and not packet.is_discard:
                    packets.append(Packet(packet.pts, packet.dts, packet.is_keyframe, packet.pos))
                    end = max(end, (packet.pts or 0) + (packet.duration or 0))
        except av.FFmpegError as error:
            broken = error_words(error)
        # AVI stores no presentation stamps: for reordered frames, FFmpeg's guesses are wrong after a seek.
        guessed = container.format.name == "avi" and any(packet.pts != packet.dts for packet in packets)
        step: Fraction | None = None
        if stream.average_rate and stream.time_base:
            step = 1 / (stream.average_rate * stream.time_base)
        return index_packets(packets, guessed, step), float(end * (stream.time_base or 0)), broken

    def _read(self, numbers: Sequence[int]) -> Iterator[Grey]:
        for got in self._decode(numbers):
            if isinstance(got, MovieError):
                raise got
            yield got

    def _read_on(self, numbers: Sequence[int]) -> Iterator[Grey | None]:
        return (None if isinstance(got, MovieError) else got for got in self._decode(numbers))

    def on_demand(self, pool: Executor, first: int = 0, last: int | None = None) -> Iterator[Grey | OnDemand | None]:
        """Yield frames as `readable`; slices of FFV1 with independent frames are decoded on request."""
        if self._slice_decoder is None:
            yield from self.readable(first, last)
            return
        before: SlicedPicture | None = None
        for _, packet in self._packets(self._range(first, last)):
            slices = None if packet is None else split_slices(packet)
            picture = None if slices is None else SlicedPicture(self._slice_decoder, slices, pool)
            if before is not None:
                before.following = picture
            before = picture
            yield picture

    @cached_property
    def _slice_decoder(self) -> SliceDecoder | None:
        """Decoder of separate slices; None for other videos, and if its pictures differ from whole frames."""
        alone = self._index.number_of is not None and self._index.each_alone
        if not (self._checked and alone and self._pixels.startswith("gray")):
            return None
        packets = (packet for _, packet in self._packets(range(self._count)) if packet is not None)
        packet = next((packet for packet in packets if split_slices(packet) is not None), None)
        if packet is None:
            return None
        with _opened(self.path) as container:
            context: Any = container.streams.video[0].codec_context
            decoder = SliceDecoder(context, _plane_0)
            frames = context.decode(av.Packet(packet))
            whole = _plane_0(frames[0]) if frames else None
        alike = whole is not None and whole.shape == self.frame_shape and decoder.matches(packet, whole)
        return decoder if alike else None

    def _packets(self, numbers: range) -> Iterator[tuple[int, bytes | None]]:
        """Yield increasing frame numbers with their packets, None for frames without a packet."""
        if not numbers:
            return
        with _opened(self.path) as container:
            self._seek(container, numbers[0])
            packets = ((self._index.number(each.pts, each.pos), bytes(each)) for each in _demuxed(container))
            yield from _aligned(numbers, packets)

    def _decode(self, numbers: Sequence[int]) -> Iterator[Grey | MovieError]:
        with _opened(self.path) as container:
            for run in self._index.runs(numbers):
                key = self._seek(container, run[0])
                pictures = self._pictures(container, run, key)
                first = next(pictures)
                if isinstance(first, MovieError) and key > 0 and not self._index.each_alone:
                    # In open groups of pictures frames beside a key frame depend on frames before it: only decoding
                    # from the start shows whether the file or the seek is at fault.
                    with _opened(self.path) as fresh:
                        yield from self._pictures(fresh, run, 0)
                else:
                    yield first
                    yield from pictures

    def _seek(self, container: av.container.InputContainer, number: int) -> int:
        """Go to the last key frame at or before frame `number`; return its number."""
        key, stamp = self._index.key_before(number)
        if key > 0:  # a fresh container is at frame 0 already
            try:
                container.seek(stamp, stream=container.streams.video[0])
            except av.FFmpegError as error:
                raise self._damage(number, error_words(error)) from error
        return key

    def _pictures(
        self, container: av.container.InputContainer, numbers: list[int], key: int
    ) -> Iterator[Grey | MovieError]:
        """Yield picture or error of increasing frame numbers; ignore damage before `key`, which the seek may cause."""
        spoilt: dict[int, str] = {}

        def undamaged() -> Iterator[tuple[int, av.VideoFrame]]:
            for number, frame in self._decoded(container):
                if not isinstance(frame, str):
                    yield number, frame
                elif number >= key:
                    spoilt.update({lost: frame for lost in self._index.spoilt_by(number) if lost not in spoilt})

        for number, frame in _aligned(numbers, undamaged()):
            if frame is None or number in spoilt:
                yield self._damage(number, spoilt.get(number, NOTHING))
            else:
                yield self._picture(frame, number)

    def _decoded(self, container: av.container.InputContainer) -> Iterator[tuple[int, av.VideoFrame | str]]:
        """Decode from the container's position on; yield frame numbers with the frame or the error as text."""
        following = 0  # for videos whose frames can only be counted from the start
        for packet in _demuxed(container):
            number = self._index.number(packet.pts, packet.pos)
            if number is not None:
                packet.pts = number  # the decoder passes the number on to the frame, in any order
            if packet.size and self._checked and split_slices(bytes(packet)) is None:
                yield (following if number is None else number), "one whose check sum is wrong"
                continue
            try:
                frames = packet.decode()
            except av.FFmpegError as error:
                yield (following if number is None else number), error_words(error)
                continue
            for frame in frames:
                number = following if frame.pts is None or not self._index.number_of else frame.pts
                following = number + 1
                yield number, ("a damaged one" if frame.is_corrupt else frame)

    def _picture(self, frame: av.VideoFrame, number: int) -> Grey | MovieError:
        if (frame.height, frame.width) == self.frame_shape and frame.format.name == self._pixels:
            return grey_values(frame)
        expected = f"pictures of one kind, {self.frame_shape} {self._pixels}"
        got, do = f"{(frame.height, frame.width)} {frame.format.name}", "split the movie where it changes"
        return movie_error(f"{self.path}, frame {number}", expected, got, do)


def _aligned(numbers: Sequence[int], found: Iterable[tuple[int | None, Found]]) -> Iterator[tuple[int, Found | None]]:
    """Yield increasing frame numbers with the results for them, None without; other results are left out."""
    waiting = deque(numbers)
    for number, thing in found:
        while waiting and number is not None and waiting[0] < number:
            yield waiting.popleft(), None
        if waiting and waiting[0] == number:
            yield waiting.popleft(), thing
        if not waiting:
            return
    yield from ((number, None) for number in waiting)


def _opened(path: Path) -> av.container.InputContainer:
    """Open a video so that damage raises an error instead of being concealed."""
    try:
        container = av.open(str(path))
    except (av.FFmpegError, OSError, ValueError) as error:
        do = "check that it plays; export it again if not"
        raise movie_error(path, "a readable movie", error_words(error), do) from error
    if not container.streams.video:
        container.close()
        raise movie_error(path, "a movie with pictures", "no video stream", "name the movie's own file")
    context: Any = container.streams.video[0].codec_context  # None for a codec that FFmpeg does not know
    if context is None:
        container.close()
        raise movie_error(path, "a movie that FFmpeg decodes", "an unknown codec", "export it as FFV1 in .mkv")
    # Slices of one frame in parallel: 1.8 times faster for FFV1 on 2 cores; errors stay with their frame.
    context.thread_type, context.thread_count = "SLICE", 2
    context.options = {"err_detect": "crccheck+explode"}
    return container


def _demuxed(container: av.container.InputContainer) -> Iterator[Any]:
    """Yield the packets up to the end or damage of the file, then the empty one that ends decoding."""
    try:
        yield from container.demux(container.streams.video[0])
    except av.FFmpegError:
        return  # reported in the remarks: the packet table ended at the same place


def _first_frame(container: av.container.InputContainer) -> av.VideoFrame | None:
    """Return the first decodable frame; damage at the start does not make the movie unreadable."""
    for packet in _demuxed(container):
        try:
            frames: list[av.VideoFrame] = packet.decode()
        except av.FFmpegError:
            continue
        if frames:
            return frames[0]
    return None


def _remarks(container: av.container.InputContainer, pixels: str, index: PacketIndex) -> Iterator[str]:
    stream = container.streams.video[0]
    if index.missing:
        some = ", ".join(map(str, index.missing[:SHOWN])) + (" ..." if len(index.missing) > SHOWN else "")
        yield f"frames are missing by its time stamps and count as unreadable ({len(index.missing)}): {some}"
    if _loss(stream.codec_context) != LOSSLESS:
        yield f"codec {stream.codec_context.name} ({_loss(stream.codec_context)}): fine detail may be lost"
    if av.VideoFormat(pixels).is_rgb:
        yield COLOUR_REMARK
    elif not pixels.startswith("gray"):
        yield f"stored as colour ({pixels}): its brightness is used unchanged; {GAMMA_CODED}"


def _uneven_times(index: PacketIndex, tick: Fraction | None) -> tuple[Stamps | None, tuple[str, ...]]:
    """Return unevenly spaced stamps of a recorder, (N,), s, with a remark; None for even ones, of players."""
    marks, tick_s = sorted({} if index.by_place else index.number_of or {}), float(tick or 0)
    times_s = np.array(marks, np.float64) * tick_s
    even, words = spacing(times_s, tick_s) if index.count == len(marks) > 2 else (True, "")
    if even:
        return None, ()
    coarse = tick_s * rate_of(times_s) > COARSE
    use = "too coarse for times: movies" if coarse else "times: movies uses them"
    remark = f"time stamps in steps of {1e3 * tick_s:.3g} ms, {words}; {use}"
    return (None if coarse else times_s), (remark,)


def _stated_frames(path: Path, container: av.container.InputContainer, count: int, end_s: float) -> int:
    """Return the number of frames by the header; 0 without, or if not more than the file holds."""
    stream = container.streams.video[0]
    if stream.frames > count:  # an edit list hides frames of a movie cut without encoding
        with av.open(str(path), options={"ignore_editlist": "1"}) as whole, suppress(av.FFmpegError):
            count = sum(bool(packet.size) for packet in whole.demux(whole.streams.video[0]))
        return int(stream.frames) if count < stream.frames else 0
    matroska = "matroska" in container.format.name and len(container.streams) == 1
    if not (matroska and container.duration and stream.average_rate):
        return 0
    rate = float(stream.average_rate)
    # Use the end for unevenly spaced frames, the number for several frames per step of stamps.
    missing = min(container.duration * rate / av.time_base - count, (container.duration / av.time_base - end_s) * rate)
    return count + round(missing) if missing > SLACK else 0


def _loss(context: av.CodecContext) -> str:
    if not context.codec.lossy:
        return LOSSLESS
    return "may be lossy" if context.codec.lossless else "lossy"


def grey_dtype(pixel_format: av.VideoFormat) -> np.dtype[Any]:
    """Return uint8, or uint16 for a format with more than 8 bits."""
    return np.dtype(np.uint8 if pixel_format.components[0].bits <= 8 else np.uint16)


def check_format(name: str, pixel_format: av.VideoFormat) -> None:
    """Refuse pixel formats without exact grey values: neither an integer grey plane nor colour (MovieError)."""
    colour = (pixel_format.is_rgb or pixel_format.has_palette) and not pixel_format.is_bit_stream
    if not (colour or _has_grey_plane(pixel_format)):
        do = "convert it, lossless: ffmpeg -i MOVIE -c:v ffv1 -pix_fmt gray MOVIE.mkv"
        raise movie_error(name, "grey, planar YUV or RGB pixels", pixel_format.name, do)


def grey_values(frame: av.VideoFrame) -> Grey:
    """Return the first plane of grey and YUV frames unchanged, the luma of RGB frames; (H, W), row 0 on top."""
    if _has_grey_plane(frame.format):
        return _plane_0(frame)
    # FFmpeg only interleaves the channels here; its grey formula differs from that of other formats.
    deep = grey_dtype(frame.format).itemsize == 2
    interleaved = frame.reformat(format="rgb48le" if deep else "rgb24")
    values = _plane_0(interleaved, samples=3).reshape(frame.height, frame.width, 3)
    if deep:
        values = values >> (16 - frame.format.components[0].bits)  # 10 and 12 bit are scaled to 16
    return luma(*np.moveaxis(values, 2, 0))


def _has_grey_plane(pixel_format: av.VideoFormat) -> bool:
    """Return whether plane 0 holds only grey; in packed formats (yuyv422, ya8) it does not."""
    grey, *others = pixel_format.components
    alone = all(other.plane != grey.plane for other in others)
    return alone and pixel_format.name.startswith(PLANE_0_IS_GREY) and "f32" not in pixel_format.name


def _plane_0(frame: av.VideoFrame, samples: int = 1) -> Grey:
    plane, height, width = frame.planes[0], frame.height, frame.width * samples
    dtype = grey_dtype(frame.format)
    stored = dtype.newbyteorder(">" if frame.format.is_big_endian else "<")
    # Rows are padded to line_size, negative for pictures stored bottom-up: then buffer_ptr is the top row, the last in
    # memory. Read by address: the start of PyAV's buffer differs between releases.
    reach = (height - 1) * plane.line_size
    size = abs(reach) + width * dtype.itemsize
    memory = memoryview((ctypes.c_uint8 * size).from_address(plane.buffer_ptr + min(reach, 0))).cast("B")
    strides = (plane.line_size, dtype.itemsize)
    rows: Grey = np.ndarray((height, width), stored, buffer=memory, offset=max(-reach, 0), strides=strides)
    return rows.astype(dtype, order="C")  # a copy, as the memory belongs to the frame
