"""Movies that FFmpeg decodes, frame by frame, with exact seeks."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import av
import numpy as np

from sphereorient.errors import MovieError, refusal
from sphereorient.movies.grey import check_format, grey_dtype, grey_values
from sphereorient.movies.movie import Grey, check_indices, check_range

THREADS = 2  # slices of one frame in parallel: 1.8 times faster for FFV1 on 2 cores, and errors keep their frame


@dataclass(frozen=True)
class PacketIndex:
    """What demuxing alone tells: how many frames there are and where decoding may start."""

    count: int
    number_of: dict[int, int]  # presentation time stamp -> frame number; empty where stamps do not tell
    keys: tuple[tuple[int, int], ...]  # (frame number, time stamp) of the key frames, increasing

    def key_before(self, number: int) -> tuple[int, int]:
        """Return number and time stamp of the last key frame at or before frame `number`."""
        return self.keys[max(bisect_right(self.keys, number, key=lambda key: key[0]) - 1, 0)]

    def runs(self, numbers: list[int]) -> list[list[int]]:
        """Cut increasing frame numbers where a seek saves decoding: where a key frame lies in a gap."""
        runs: list[list[int]] = []
        for number in numbers:
            if runs and self.key_before(number)[0] <= runs[-1][-1] + 1:
                runs[-1].append(number)
            else:
                runs.append([number])
        return runs


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
                packets = [
                    (packet.pts, packet.is_keyframe)
                    for packet in container.demux(container.streams.video[0])
                    if packet.size and not packet.is_discard
                ]
            except av.FFmpegError as error:
                do = "export the movie again; the file is damaged"
                raise self._refusal("readable packets", _words(error), do) from error
        return _index_of(packets)

    def _container(self) -> av.container.InputContainer:
        try:
            container = av.open(str(self.path))
        except (av.FFmpegError, OSError, ValueError) as error:
            do = "check that it plays; export it again if not"
            raise self._refusal("a readable movie", _words(error), do) from error
        if not container.streams.video:
            container.close()
            raise self._refusal("a movie with pictures", "no video stream", "name the movie's own file")
        context = container.streams.video[0].codec_context
        context.thread_type, context.thread_count = "SLICE", THREADS
        context.options = {"err_detect": "crccheck+bitstream+buffer+explode"}
        return container

    def _wanted(self, numbers: list[int]) -> Iterator[Grey]:
        """Yield the pictures of increasing frame numbers, jumping over what need not be decoded."""
        with self._container() as container:
            for run in self._index.runs(numbers):
                yield from self._run(container, run)

    def _run(self, container: av.container.InputContainer, numbers: list[int]) -> Iterator[Grey]:
        key, stamp = self._index.key_before(numbers[0])
        if key > 0:
            container.seek(stamp, stream=container.streams.video[0])
        waiting = iter(numbers)
        wanted = next(waiting, None)
        for number, frame in self._numbered(container, self._index.number_of, key):
            if number == wanted:
                yield self._picture(frame, number)
                wanted = next(waiting, None)
            if wanted is None or number > wanted:
                break
        if wanted is not None:
            do = "export the movie again, or leave the frame out with frames: in the experiment"
            raise self._refusal("a picture", "none from the decoder", do, wanted)

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


def _index_of(packets: list[tuple[int | None, bool]]) -> PacketIndex:
    """Number the packets by their time stamps, if those are all there and differ."""
    stamps = sorted({stamp for stamp, _ in packets if stamp is not None})
    if len(stamps) < len(packets):  # absent, or two of one value: MKV counts whole ms, so above 1 kHz stamps repeat
        return PacketIndex(count=len(packets), number_of={}, keys=((0, 0),))
    number_of = {stamp: number for number, stamp in enumerate(stamps)}
    keys = sorted((number_of[stamp], stamp) for stamp, is_key in packets if is_key and stamp is not None)
    return PacketIndex(count=len(packets), number_of=number_of, keys=tuple(keys) or ((0, 0),))


def _words(error: Exception) -> str:
    """Return an error of FFmpeg in one line, without the file's name, which our message has already."""
    return f"'{getattr(error, 'strerror', None) or str(error).splitlines()[0]}'"
