"""Movies that FFmpeg decodes, frame by frame, with exact seeks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import MovieError, refusal
from sphereorient.movies.ffv1_sums import sums_are_right
from sphereorient.movies.grey import check_format, grey_dtype, grey_values
from sphereorient.movies.movie import Grey, HoldsNothing, check_indices, check_range
from sphereorient.movies.packets import Packet, PacketIndex, index_packets
from sphereorient.movies.stream import frame_step, loss, opened, stream_remarks, words

NOTHING = "none from the decoder"
PACKETS_TRIED = 8  # of FFV1: one whose check sums are right tells that all should have them


class VideoMovie(HoldsNothing):
    """A movie in a container with one video stream; no file stays open between calls."""

    times_s: NDArray[np.float64] | None = None  # MKV rounds stamps to 1 ms, AVI has none: see Movie

    def __init__(self, path: Path) -> None:
        self.path = path
        with opened(path) as container:
            frame = _first_frame(container)
            if frame is None:
                raise self._refusal("a movie with frames", "no frame", "record or export it again")
            check_format(str(path), frame.format)
            self._format = frame.format.name
            codec = container.streams.video[0].codec_context
            self.format = f"{path.suffix[1:].lower()}, codec {codec.name} ({loss(codec)}), pixels {frame.format.name}"
            self.frame_shape: tuple[int, int] = (frame.height, frame.width)
            self.dtype: np.dtype[Any] = grey_dtype(frame.format)

    def __len__(self) -> int:
        """Return the number of frames, counted once, as packets without decoding them."""
        return self._index.count

    @cached_property
    def remarks(self) -> tuple[str, ...]:
        """What a user should know: see Movie."""
        with opened(self.path) as container:
            return (*self._read_error, *stream_remarks(container, self._format, len(self), self._index.missing))

    def frames(self, first: int = 0, last: int | None = None) -> Iterator[Grey]:
        """Yield frames first .. last - 1 in order, (H, W) each."""
        last = check_range(self.path, len(self), first, last)
        return self._wanted(list(range(first, last)))

    def readable(self, first: int = 0, last: int | None = None) -> Iterator[Grey | None]:
        """Yield frames first .. last - 1 in order, None for those that cannot be decoded."""
        last = check_range(self.path, len(self), first, last)
        for got in self._recovered(list(range(first, last))):
            yield None if isinstance(got, MovieError) else got

    def sample(self, indices: Sequence[int]) -> Grey:
        """Return any frames in the order asked for, (n, H, W); only what leads to them is decoded."""
        asked = check_indices(self.path, len(self), indices)
        order = sorted(set(asked))
        pictures = np.empty((len(order), *self.frame_shape), self.dtype)
        for place, picture in enumerate(self._wanted(order)):
            pictures[place] = picture
        return pictures[np.searchsorted(order, asked)] if asked else pictures

    def _refusal(self, expected: str, got: str, do: str, frame: int | None = None) -> MovieError:
        name = str(self.path) if frame is None else f"{self.path}, frame {frame}"
        return MovieError(refusal(name, expected=expected, got=got, do=do))

    @cached_property
    def _packets(self) -> tuple[PacketIndex, str]:
        """The table of packets, and in words where reading it broke off."""
        packets: list[Packet] = []
        broken = ""
        with opened(self.path) as container:
            try:
                for packet in container.demux(container.streams.video[0]):
                    if packet.size and not packet.is_discard:
                        packets.append(Packet(packet.pts, packet.dts, packet.is_keyframe, packet.pos))
            except av.FFmpegError as error:
                broken = words(error)
            # AVI stores no presentation stamps: where frames are reordered, FFmpeg's guesses are wrong after a seek.
            guessed = container.format.name == "avi" and any(packet.pts != packet.dts for packet in packets)
            step = frame_step(container)
        return index_packets(packets, guessed, step), broken

    @cached_property
    def _summed(self) -> bool:
        """Whether the packets carry check sums that can be held against them."""
        with opened(self.path) as container:
            if container.streams.video[0].codec_context.name != "ffv1":
                return False
            return any(sums_are_right(bytes(packet)) for packet in islice(_demuxed(container), PACKETS_TRIED))

    @property
    def _index(self) -> PacketIndex:
        return self._packets[0]

    @property
    def _read_error(self) -> tuple[str, ...]:
        count, broken = self._index.count, self._packets[1]
        return (f"damaged: reading it breaks off after {count} frames, {broken}",) if broken else ()

    def _wanted(self, numbers: list[int]) -> Iterator[Grey]:
        """Yield the pictures of increasing frame numbers, jumping over what need not be decoded."""
        for got in self._recovered(numbers):
            if isinstance(got, MovieError):
                raise got
            yield got

    def _recovered(self, numbers: list[int]) -> Iterator[Grey | MovieError]:
        """Yield a picture or the reason why there is none for each of increasing frame numbers."""
        with opened(self.path) as container:
            for run in self._index.runs(numbers):
                yield from self._run(container, run)

    def _run(self, container: av.container.InputContainer, numbers: list[int]) -> Iterator[Grey | MovieError]:
        key = self._seek(container, numbers[0])
        pictures = self._pictures(container, numbers, key)
        first = next(pictures)
        if isinstance(first, MovieError) and key > 0 and not self._index.each_alone:
            # Frames beside a key frame may lean on frames before it (open groups of pictures): only the way from
            # the start tells whether the fault is the file's or the seek's.
            with opened(self.path) as fresh:
                yield from self._pictures(fresh, numbers, 0)
            return
        yield first
        yield from pictures

    def _seek(self, container: av.container.InputContainer, number: int) -> int:
        """Go to the last key frame at or before frame `number`, and return that key frame's number."""
        key, stamp = self._index.key_before(number)
        if key > 0:  # a fresh container stands at frame 0 already
            try:
                container.seek(stamp, stream=container.streams.video[0])
            except av.FFmpegError as error:
                raise self._damage(words(error), number) from error
        return key

    def _pictures(
        self, container: av.container.InputContainer, numbers: list[int], key: int
    ) -> Iterator[Grey | MovieError]:
        """Yield for each of increasing frame numbers its picture or the reason why there is none.

        Args:
            container: stands at frame `key`, or before it.
            numbers: of the frames wanted.
            key: what is damaged before this frame does not count, since the seek may have cut off what it leans on.
        """
        waiting = iter(numbers)
        wanted = next(waiting, None)
        spoilt: dict[int, str] = {}
        for number, frame in self._decoded(container):
            if wanted is None:
                return
            if isinstance(frame, str):
                if number >= key:
                    spoilt |= {lost: frame for lost in self._index.spoilt_by(number) if lost not in spoilt}
                continue
            while wanted is not None and wanted < number:
                yield self._damage(spoilt.get(wanted, NOTHING), wanted)
                wanted = next(waiting, None)
            if wanted == number:
                yield self._damage(spoilt[number], number) if number in spoilt else self._picture(frame, number)
                wanted = next(waiting, None)
                if wanted is None:
                    return
        while wanted is not None:
            yield self._damage(spoilt.get(wanted, NOTHING), wanted)
            wanted = next(waiting, None)

    def _decoded(self, container: av.container.InputContainer) -> Iterator[tuple[int, av.VideoFrame | str]]:
        """Decode from where the container stands: frames with their numbers, and in words what cannot be decoded."""
        following = 0  # for movies whose frames can only be counted, from the start
        for packet in _demuxed(container):
            number = self._index.number(packet.pts, packet.pos)
            if number is not None:
                packet.pts = number  # the decoder hands it on to the frame, whatever the order
            if packet.size and self._summed and not sums_are_right(bytes(packet)):
                yield (following if number is None else number), "one whose check sum is wrong"
                continue
            try:
                frames = packet.decode()
            except av.FFmpegError as error:
                yield (following if number is None else number), words(error)
                continue
            for frame in frames:
                number = following if frame.pts is None or not self._index.number_of else frame.pts
                following = number + 1
                yield number, ("a damaged one" if frame.is_corrupt else frame)

    def _damage(self, got: str, number: int) -> MovieError:
        do = "export the movie again, or leave the frame out with frames: in the experiment"
        return self._refusal("a decodable picture", got, do, number)

    def _picture(self, frame: av.VideoFrame, number: int) -> Grey | MovieError:
        if (frame.height, frame.width) != self.frame_shape or frame.format.name != self._format:
            expected, got = f"{self.frame_shape} {self._format}", f"{(frame.height, frame.width)} {frame.format.name}"
            return self._refusal(f"pictures of one kind, {expected}", got, "split the movie where it changes", number)
        return grey_values(frame)


def _demuxed(container: av.container.InputContainer) -> Iterator[Any]:
    """Yield the packets as far as the file can be read, the empty one that ends decoding last."""
    try:
        yield from container.demux(container.streams.video[0])
    except av.FFmpegError:
        return  # told in the remarks: the table of packets broke off at the same place


def _first_frame(container: av.container.InputContainer) -> av.VideoFrame | None:
    """Return the first frame that can be decoded, None where there is none."""
    for packet in _demuxed(container):
        try:
            frames: list[av.VideoFrame] = packet.decode()
        except av.FFmpegError:
            continue  # a dead frame at the start does not make the movie unreadable
        if frames:
            return frames[0]
    return None
