"""Outputs: sockets, serial ports, LSL, files. A slow reader loses lines; the loop never waits. A new output is a class
and a line in `SOCKETS`, `NAMED` or `FILES`.
"""

import math
import os
import re
import socket
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from threading import Condition, Thread
from typing import IO, Any

import numpy as np

from sphereorient.errors import OutputError, SettingsError, SphereOrientError, error_words, refusal
from sphereorient.files.page_server import HOST
from sphereorient.files.provenance import package
from sphereorient.live.feed import Log
from sphereorient.live.live import TrackBlocks
from sphereorient.live.shared import POSE_BYTES, POSES, SharedFrames
from sphereorient.trajectory import Trajectory, journal

MOST_LINES = 1000  # that wait for one reader; beyond, the oldest is lost
SOON_LINES = 200  # likewise for a serial port: few, so that lines are never late by much
SOON_S, DISK_S = 1.0, 30.0  # to write waiting lines at the end
BLOCK_S = 0.5  # between writes of a track's rows
LEAST_OF = 256  # frames; the least delayed of these sets LSL's clock
UNIT = re.compile(r"_((?:rad|mm|radii)_s|rad|mm|radii|ms|s)(?:_[wxyz])?$")  # unit in the name of a number


class Output:
    """A receiver of lines or frames."""

    def begin(self, blocks: TrackBlocks) -> None:
        """Begin; `blocks` makes tracks of frames."""

    def send(self, thing: Any) -> None:
        """Take a line or frame, and return at once."""

    def close(self) -> None:
        """Write the waiting things, and end."""


class Spool:
    """Passes things to `write` in a thread; if more than `most` wait, the oldest is lost. After an OSError, passed
    to `faulty`, nothing more is written. `pause_s`: least time between writes.
    """

    def __init__(
        self,
        write: Callable[[list[Any]], object],
        faulty: Callable[[OSError], object] = lambda error: None,
        most: int = MOST_LINES,
        pause_s: float = 0.0,
    ) -> None:
        self.gone = False
        self.lost = 0
        self._write, self._faulty, self._pause_s = write, faulty, pause_s
        self._waiting: deque[Any] = deque(maxlen=most)
        self._changed = Condition()
        self._ends = False
        self._thread = Thread(target=self._run, name="spool", daemon=True)
        self._thread.start()

    def send(self, thing: object) -> None:
        """Take a thing, and return at once."""
        with self._changed:
            self.lost += len(self._waiting) == self._waiting.maxlen and not self.gone
            self._waiting.append(thing)
            self._changed.notify()

    def close(self, limit_s: float = SOON_S) -> bool:
        """Write the waiting things within a limit, drop the rest, and return whether writing has ended."""
        with self._changed:
            self._ends = True
            self._changed.notify()
        self._thread.join(limit_s)
        with self._changed:
            self._waiting.clear()
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._ends)
                if not self._waiting:
                    return
                things = list(self._waiting)
                self._waiting.clear()
            try:
                self._write(things)
            except OSError as error:
                self.gone = True
                self._faulty(error)
                return
            with self._changed:
                self._changed.wait_for(lambda: self._ends, self._pause_s)


def no_room(path: Path, error: OSError) -> str:
    """Return the message for a file that cannot be written."""
    do = "make room; tracking goes on without this file"
    return refusal(str(path), expected="a disk with room", got=error_words(error), do=do)


class UdpOutput(Output):
    """One datagram per line, to one address. Raises OutputError: no such host."""

    def __init__(self, host: str, port: int) -> None:
        try:
            self._to = socket.gethostbyname(host), port  # once: name look-up may be slow
        except (OSError, UnicodeError) as error:  # UnicodeError: an impossible name
            do = "correct the name of the host"
            raise OutputError(refusal(f"udp:{host}:{port}", expected="a host", got=error_words(error), do=do)) from None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def send(self, thing: Any) -> None:
        """Send a line."""
        with suppress(OSError):
            self._socket.sendto(self._bytes(thing), self._to)

    def _bytes(self, thing: Any) -> bytes:
        return f"{thing}\n".encode()

    def close(self) -> None:
        """End."""
        self._socket.close()


class OscOutput(UdpOutput):
    """OSC over UDP: a message /sphereorient per frame with all `Forms.numbers` as int32 or float32. Raises OutputError:
    no python-osc, or no such host.
    """

    def __init__(self, host: str, port: int) -> None:
        self._message = package("pythonosc.osc_message_builder", "live").OscMessageBuilder
        super().__init__(host, port)

    def _bytes(self, thing: dict[str, float]) -> bytes:
        message = self._message("/sphereorient")
        for value in thing.values():
            message.add_arg(value, "f" if isinstance(value, float) else "i")
        return bytes(message.build().dgram)


class LslOutput(Output):
    """An LSL stream: a float64 sample per frame of all `Forms.numbers`, with names and units; the least delayed of the
    last frames sets LSL's clock. Visible on this machine only, unless LSLAPICFG names a configuration. Raises
    OutputError: the package pylsl, or its library liblsl, is missing.
    """

    def __init__(self, name: str, log: Log) -> None:
        self._name = name
        try:
            self._lsl = package("pylsl", "live")
        except RuntimeError as error:
            do = "install liblsl, or name its file in the variable PYLSL_LIB"
            raise OutputError(refusal(f"lsl:{name}", expected="liblsl", got=error_words(error), do=do)) from None
        if "LSLAPICFG" not in os.environ:
            self._lsl.set_config_content("[multicast]\nResolveScope = machine\n[log]\nlevel = -2\n")
        self._apart_s: deque[float] = deque(maxlen=LEAST_OF)  # LSL's clock at the arrival, less the frame's time
        self._before_s = -math.inf  # time of the frame before
        self._outlet: Any = None

    def send(self, numbers: dict[str, float]) -> None:
        """Push a sample; LSL keeps 36,000 of them for each reader."""
        self._outlet = self._outlet or self._opened(list(numbers))
        arrived_s = self._lsl.local_clock() - 1e-3 * numbers["latency_ms"]
        if numbers["time_s"] < self._before_s:  # the source began again
            self._apart_s.clear()
        self._before_s = numbers["time_s"]
        self._apart_s.append(arrived_s - numbers["time_s"])
        self._outlet.push_sample(list(numbers.values()), numbers["time_s"] + min(self._apart_s))

    def _opened(self, names: list[str]) -> Any:
        lsl, identity = self._lsl, f"sphereorient {self._name}"
        info = lsl.StreamInfo(self._name, "Pose", len(names), lsl.IRREGULAR_RATE, lsl.cf_double64, identity)
        channels = info.desc().append_child("channels")
        for name in names:
            unit = UNIT.search(name)
            channel = channels.append_child("channel").append_child_value("label", name)
            channel.append_child_value("unit", unit[1].replace("_s", "/s") if unit else "")
        return lsl.StreamOutlet(info)

    def close(self) -> None:
        """End the stream."""
        self._outlet = None


class SharedOutput(Output):
    """A ring of poses in memory (`shared`): all numbers of `lines.Quantities`. Raises OutputError: the file exists, or
    its folder does not.
    """

    def __init__(self, address: str, log: Log) -> None:
        self._ring = SharedFrames(Path(address), POSE_BYTES, POSES)

    def send(self, numbers: dict[str, float]) -> None:
        """Write a pose, without waiting."""
        self._ring.write(numbers["time_s"], [np.fromiter(numbers.values(), np.float64)])

    def close(self) -> None:
        """Mark the end for readers, and remove the file."""
        self._ring.close()


class SerialOutput(Output):
    """A serial port, PORT@BAUD. `log` gets a line if it fails or is too slow; then the oldest lines are lost. Raises
    OutputError: pyserial is missing, or no such port, port in use, or wrong baud rate.
    """

    def __init__(self, address: str, log: Log) -> None:
        self._name, self._log = f"serial:{address}", log
        serial, (port, _, baud) = package("serial", "live"), address.rpartition("@")
        try:
            self._port = serial.Serial(port, int(baud) or -1, exclusive=True)  # 0 hangs up
        except (OSError, ValueError, ArithmeticError) as error:  # the last two: an unsupported rate
            do = "correct it, or end the program that uses the port"
            expected = "PORT@BAUD, a free port and its baud rate"
            raise OutputError(refusal(self._name, expected=expected, got=error_words(error), do=do)) from None
        self._spool = Spool(lambda lines: self._port.write(_joined(lines)), self._failed, SOON_LINES)

    def _failed(self, error: OSError) -> None:
        do = "connect it and restart; tracking goes on without it"
        self._log(refusal(self._name, expected="a port that takes lines", got=error_words(error), do=do))

    def send(self, line: str) -> None:
        """Take a line."""
        before = self._spool.lost
        self._spool.send(line)
        if self._spool.lost > before == 0:
            self._log(f"{self._name}: lines are lost: the port is too slow; try a higher baud rate.")

    def close(self) -> None:
        """Write waiting lines within a second, and close the port."""
        if not self._spool.close():
            self._port.cancel_write()
            self._spool.close()
            with suppress(Exception):  # errors differ between systems
                self._port.reset_output_buffer()  # else the system waits for a reader
        self._port.close()


class ZmqOutput(Output):
    """A PUB socket of ZeroMQ; a slow subscriber loses lines. Raises OutputError: no pyzmq, or the port is in use."""

    def __init__(self, host: str, port: int) -> None:
        name = f"zmq:{host}:{port}"
        zmq = package("zmq", "live")
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.PUB)
        self._socket.set_hwm(MOST_LINES)
        self._socket.set(zmq.LINGER, round(1e3 * SOON_S))
        try:
            self.port = port or self._socket.bind_to_random_port(f"tcp://{host}")
            if port:
                self._socket.bind(f"tcp://{host}:{port}")
        except zmq.ZMQError as error:
            self._context.destroy(0)
            raise _taken(name, error) from None

    def send(self, line: str) -> None:
        """Publish a line."""
        self._socket.send_string(line)  # a PUB socket never waits

    def close(self) -> None:
        """Send waiting lines, and end."""
        self._socket.close()
        self._context.term()


class TcpOutput(Output):
    """A server: each program that connects gets all further lines. Raise OutputError: the port is in use."""

    def __init__(self, host: str, port: int) -> None:
        try:
            self._server = socket.create_server((host, port))
        except (OSError, UnicodeError) as error:
            raise _taken(f"tcp:{host}:{port}", error) from None
        self.port = int(self._server.getsockname()[1])
        self._readers: list[tuple[socket.socket, Spool]] = []
        self._thread = Thread(target=self._accept, name="tcp", daemon=True)
        self._thread.start()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._server.accept()
            except OSError:  # closed
                return

            def write(lines: list[Any], to: socket.socket = connection) -> None:
                to.sendall(_joined(lines))

            spool = Spool(write)
            self._readers = [*(reader for reader in self._readers if not reader[1].gone), (connection, spool)]

    def send(self, line: str) -> None:
        """Send a line to all readers."""
        for _, spool in self._readers:
            spool.send(line)

    def close(self) -> None:
        """End all connections."""
        with suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        for connection, spool in self._readers:
            spool.close()
            connection.close()


def _taken(name: str, error: Exception) -> OutputError:
    do = "choose another port, or end the program that uses it"
    return OutputError(refusal(name, expected="a free port", got=error_words(error), do=do))


def _joined(lines: list[str]) -> bytes:
    return "".join(f"{line}\n" for line in lines).encode()


class FileOutput(Output):
    """A new text file, a flushed line per frame. `log` gets a line if the disk is full or too slow. OutputError:
    the file exists, or its folder does not.
    """

    def __init__(self, path: Path, log: Log, pause_s: float = 0.0) -> None:
        check_new(path)
        self._path, self._log = path, log
        self._file: IO[bytes] | None = None
        self._spool = Spool(self._write, lambda error: log(no_room(path, error)), 100_000, pause_s)  # minutes

    def send(self, thing: Any) -> None:
        """Take a line."""
        self._spool.send(thing)

    def _bytes(self, things: list[Any]) -> bytes:
        return _joined(things)

    def _write(self, things: list[Any]) -> None:
        self._file = self._file or self._path.open("xb")
        self._file.write(self._bytes(things))
        self._file.flush()

    def close(self) -> None:
        """Write waiting lines, and close the file."""
        self._spool.close(DISK_S)
        if self._spool.lost and not self._spool.gone:
            self._log(f"{self._path}: the disk was too slow for {self._spool.lost} frames; they are missing.")
        if self._file is not None:
            with suppress(OSError):
                self._file.close()


class TrackOutput(FileOutput):
    """A new track.h5 (docs/data-format.md): a journal beside it takes the rows until the end."""

    def __init__(self, path: Path, log: Log) -> None:
        check_new(path)
        self._track = path
        self._blocks: TrackBlocks | None = None
        super().__init__(journal.journal_path(path), log, BLOCK_S)

    def begin(self, blocks: TrackBlocks) -> None:
        """Begin the journal; raise OutputError if it cannot be written."""
        self._blocks, head = blocks, journal.head(blocks.head())
        try:
            self._file = self._path.open("xb")
            self._file.write(head)
            self._file.flush()
        except OSError as error:
            raise OutputError(no_room(self._path, error)) from None

    def _bytes(self, frames: list[Any]) -> bytes:
        assert self._blocks is not None  # `begin` comes before frames
        return journal.rows(self._blocks.block(frames))

    def _write(self, frames: list[Any]) -> None:
        super()._write(frames)
        assert self._file is not None
        os.fsync(self._file.fileno())  # a power cut loses at most a second

    def close(self) -> None:
        """Write the track, and remove the journal; if that fails, report it and keep the journal."""
        super().close()
        if self._file is None:
            return
        try:
            Trajectory.load(self._path).save(self._track)
            self._path.unlink()
        except (SphereOrientError, OSError) as error:
            self._log(f"{error} The measured rows are in {self._path}.")


def check_new(path: Path) -> None:
    """Raise OutputError if the file exists, or its folder does not."""
    if path.exists() or not path.parent.is_dir():
        got = "an existing one" if path.exists() else f"no folder {path.parent}"
        raise OutputError(refusal(str(path), expected="a new file", got=got, do="name another one"))


# By prefix (before ":") or suffix: the class, and the attribute of `lines.Forms` that it takes.
SOCKETS: Mapping[str, tuple[Callable[[str, int], Output], str]] = {
    "tcp": (TcpOutput, "marked"),
    "udp": (UdpOutput, "marked"),
    "zmq": (ZmqOutput, "json"),
    "osc": (OscOutput, "numbers"),
}
NAMED: Mapping[str, tuple[Callable[[str, Log], Output], str]] = {
    "serial": (SerialOutput, "marked"),
    "serial-short": (SerialOutput, "short"),
    "lsl": (LslOutput, "numbers"),
    "shared": (SharedOutput, "numbers"),
}
FILES: Mapping[str, tuple[Callable[[Path, Log], Output], str]] = {
    ".dat": (FileOutput, "fictrac"),
    ".jsonl": (FileOutput, "json"),
    ".h5": (TrackOutput, "now"),
}


def open_output(name: str, log: Log) -> tuple[Output, str]:
    """Open an output by name; return it and the attribute of `Told` that it takes. Raises SettingsError: unknown."""
    kind, _, address = name.partition(":")
    host, _, port = address.rpartition(":")
    if kind in SOCKETS and port.isdecimal() and int(port) < 1 << 16:
        to_socket, form = SOCKETS[kind]
        return to_socket(host or HOST, int(port)), form
    if kind in NAMED and address:
        to_name, form = NAMED[kind]
        return to_name(address, log), form
    if (suffix := Path(name).suffix) in FILES:
        to_file, form = FILES[suffix]
        return to_file(Path(name), log), form
    named = "serial:PORT@BAUD", "serial-short:PORT@BAUD", "lsl:NAME", "shared:FILE"
    others = [*named, *(f"NAME{suffix}" for suffix in FILES)]
    expected = ", ".join([*(f"{kind}:PORT" for kind in SOCKETS), *others])
    do = "choose one of these; another address is tcp:HOST:PORT"
    raise SettingsError(refusal("--to", expected=expected, got=name, do=do))
