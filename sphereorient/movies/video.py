"""Movies that FFmpeg decodes, frame by frame, with exact seeks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import av
import numpy as np

from sphereorient.errors import MovieError, refusal
from sphereorient.movies.grey import check_format, grey_dtype, grey_values
from sphereorient.movies.movie import Grey, check_indices, check_range
from sphereorient.movies.packets import Packet, PacketIndex, index_packets

THREADS = 2  # slices of one frame in parallel: 1.8 times faster for FFV1 on 2 cores, and errors keep their frame


class VideoMovie:
    """A movie in a container with one video stream; no file stays open between calls."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with self._container() as container:
            frame = next((frame for _, frame in self._numbered(container, {})), None)
            if frame is None:
                raise self._refusal("a movie with frames", "no frame", "record or export it again")
            check_format(str(path), frame.format)
            self._format = frame.format.name
            self.frame_shape: tuple[int, int] = (frame.height, frame.width)
            self.dtype: np.dtype[Any] = grey_dtype(frame.format)

    def __len__(self) -> int:
        """Return the number of frames, counted once, as packets without decoding them."""
        return self._index.count

    def frames(self, first: int = 0, last: int | None = None) -> Iterator[Grey]:
        """Yield frames first .. last - 1 in order, (H, W) each."""
        last = check_range(self.path, len(self), first, last)
        return self._wanted(list(range(first, last)))

    def sample(self, indices: Sequence[int]) -> Grey:
        """Return any frames in the order asked for, (n, H, W); only what leads to them is decoded."""
        asked = check_indices(self.path, len(self), indices)
        order = sorted(set(asked))
        pictures = np.empty((len(order), *self.frame_shape), self.dtype)
        for place, picture in enumerate(self._wanted(order)):
            pictures[place] = picture
        return pictures[np.searchsorted(order, asked)] if asked else pictures

    def close(self) -> None:
        """Do nothing: every iteration opens the file for itself."""

    def __enter__(self) -> Self:
        """Return the movie."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the movie."""
        self.close()

    def _refusal(self, expected: str, got: str, do: str, frame: int | None = None) -> MovieError:
        name = str(self.path) if frame is None else f"{self.path}, frame {frame}"
        return MovieError(refusal(name, expected=expected, got=got, do=do))

    @cached_property
    def _index(self) -> PacketIndex:
        with self._container() as container:
            try:
                packets: list[Packet] = [
                    (packet.pts, packet.dts, packet.is_keyframe)
                    for packet in container.demux(container.streams.video[0])
                    if packet.size and not packet.is_discard
                ]
            except av.FFmpegError as error:
                do = "export the movie again; the file is damaged"
                raise self._refusal("readable packets", _words(error), do) from error
            # AVI stores no presentation stamps: where frames are reordered, FFmpeg's guesses are wrong after a seek.
            guessed = container.format.name == "avi" and any(pts != dts for pts, dts, _ in packets)
        return index_packets(packets, guessed)

    def _container(self) -> av.container.InputContainer:
        try:
            container = av.open(str(self.path))
        except (av.FFmpegError, OSError, ValueError) as error:
            do = "check that it plays; export it again if not"
            raise self._refusal("a readable movie", _words(error), do) from error
        if not container.streams.video:
            container.close()
            raise self._refusal("a movie with pictures", "no video stream", "name the movie's own file")
        context: Any = container.streams.video[0].codec_context  # None for a codec that FFmpeg does not know
        if context is None:
            container.close()
            raise self._refusal("a movie that FFmpeg decodes", "an unknown codec", "export it as FFV1 in .mkv")
        context.thread_type, context.thread_count = "SLICE", THREADS
        context.options = {"err_detect": "crccheck+explode"}
        return container

    def _wanted(self, numbers: list[int]) -> Iterator[Grey]:
        """Yield the pictures of increasing frame numbers, jumping over what need not be decoded."""
        with self._container() as container:
            for run in self._index.runs(numbers):
                yield from self._run(container, run)

    def _run(self, container: av.container.InputContainer, numbers: list[int]) -> Iterator[Grey]:
        key = self._seek(container, numbers[0])
        pictures = self._pictures(container, numbers, key)
        try:
            first = next(pictures)
        except MovieError:
            if key == 0:
                raise
            # Frames beside a key frame may lean on frames before it (open groups of pictures): only the way from
            # the start tells whether the fault is the file's or the seek's.
            with self._container() as fresh:
                yield from self._pictures(fresh, numbers, 0)
            return
        yield first
        yield from pictures

    def _pictures(self, container: av.container.InputContainer, numbers: list[int], key: int) -> Iterator[Grey]:
        """Yield the pictures of increasing frame numbers, decoding from frame `key`, where the container stands."""
        waiting = iter(numbers)
        wanted = next(waiting, None)
        for number, frame in self._numbered(container, self._index.number_of, key):
            if number == wanted:
                yield self._picture(frame, number)
                wanted = next(waiting, None)
            if wanted is None or number > wanted:
                break
        if wanted is not None:
            raise self._damage("none from the decoder", wanted)

    def _seek(self, container: av.container.InputContainer, number: int) -> int:
        """Go to the last key frame at or before frame `number`, and return that key frame's number."""
        key, stamp = self._index.key_before(number)
        if key > 0:  # a fresh container stands at frame 0 already
            try:
                container.seek(stamp, stream=container.streams.video[0])
            except av.FFmpegError as error:
                raise self._damage(_words(error), number) from error
        return key

    def _numbered(
        self, container: av.container.InputContainer, number_of: dict[int, int], number: int = 0
    ) -> Iterator[tuple[int, av.VideoFrame]]:
        """Decode from where the container stands, with the frame numbers; `number` counts where stamps do not tell."""
        try:
            for frame in container.decode(video=0):
                number = number_of.get(frame.pts, number) if frame.pts is not None else number
                if frame.is_corrupt:
                    raise self._damage("a damaged one", number)
                yield number, frame
                number += 1
        except av.FFmpegError as error:
            raise self._damage(_words(error), number) from error

    def _damage(self, got: str, number: int) -> MovieError:
        do = "export the movie again, or leave the frame out with frames: in the experiment"
        return self._refusal("a decodable picture", got, do, number)

    def _picture(self, frame: av.VideoFrame, number: int) -> Grey:
        if (frame.height, frame.width) != self.frame_shape or frame.format.name != self._format:
            expected, got = f"{self.frame_shape} {self._format}", f"{(frame.height, frame.width)} {frame.format.name}"
            raise self._refusal(f"pictures of one kind, {expected}", got, "split the movie where it changes", number)
        return grey_values(frame)


def _words(error: Exception) -> str:
    """Return an error of FFmpeg in one line, without the file's name, which our message has already."""
    return f"'{getattr(error, 'strerror', None) or str(error).splitlines()[0]}'"
