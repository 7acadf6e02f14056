"""Where lines go: TCP, UDP, a file. A slow or dead reader loses lines; it never holds up who writes."""

import socket
from collections import deque
from contextlib import suppress
from pathlib import Path
from threading import Condition, Thread
from typing import IO, Protocol

from sphereorient.errors import OutputError, error_words, refusal

HOST = "127.0.0.1"
MOST_LINES = 1000  # that wait for one reader; then the oldest is lost
SOON_S = 1.0  # to write what waits, at the end


class Output(Protocol):
    """Takes lines."""

    def send(self, line: str) -> None:
        """Take a line, and return at once."""

    def close(self) -> None:
        """Write what waits, and end."""


class UdpOutput:
    """A datagram a line, to one address."""

    def __init__(self, host: str, port: int) -> None:
        self._to = host, port
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def send(self, line: str) -> None:
        """Send a line; nobody may be there."""
        with suppress(OSError):
            self._socket.sendto(f"{line}\n".encode(), self._to)

    def close(self) -> None:
        """End."""
        self._socket.close()


class _Reader:
    """One connection of a TCP output, written to in a thread of its own."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._lines: deque[bytes] = deque(maxlen=MOST_LINES)
        self._changed = Condition()
        self.gone = self._ends = False
        self._thread = Thread(target=self._write, name="reader", daemon=True)
        self._thread.start()

    def send(self, line: bytes) -> None:
        with self._changed:
            self._lines.append(line)
            self._changed.notify()

    def close(self) -> None:
        with self._changed:
            self._ends = True
            self._changed.notify()
        self._thread.join(SOON_S)
        self._connection.close()

    def _write(self) -> None:
        while True:
            with self._changed:
                while not self._lines and not self._ends:
                    self._changed.wait()
                if not self._lines:
                    return
                waiting = b"".join(self._lines)
                self._lines.clear()
            try:
                self._connection.sendall(waiting)
            except OSError:  # it went away; it may come back as another one
                self.gone = True
                return


class TcpOutput:
    """A server: each program that connects gets all further lines.

    Raises:
        OutputError: the port is in use.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            self._server = socket.create_server((host, port))
        except OSError as error:
            do = "choose another port, or end the program that has it"
            raise OutputError(
                refusal(f"tcp:{host}:{port}", expected="a free port", got=error_words(error), do=do)
            ) from None
        self.port = int(self._server.getsockname()[1])
        self._readers: list[_Reader] = []
        self._thread = Thread(target=self._accept, name="tcp", daemon=True)
        self._thread.start()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._server.accept()
            except OSError:  # closed
                return
            self._readers = [*(reader for reader in self._readers if not reader.gone), _Reader(connection)]

    def send(self, line: str) -> None:
        """Hand a line to all readers."""
        for reader in self._readers:
            reader.send(f"{line}\n".encode())

    def close(self) -> None:
        """End all connections."""
        with suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        for reader in self._readers:
            reader.close()


class FileOutput:
    """A new text file that grows by a line a frame; what is in it survives the end of the program.

    Raises:
        OutputError: there is such a file, or no folder for it.
    """

    def __init__(self, path: Path) -> None:
        self.fault: OutputError | None = None  # why nothing is written any more
        self._path = path
        self._file: IO[str] | None = None
        if path.exists() or not path.parent.is_dir():
            got = "one that is there" if path.exists() else f"no folder {path.parent}"
            raise OutputError(refusal(str(path), expected="a new file", got=got, do="name another one"))

    def send(self, line: str) -> None:
        """Write a line; after a fault nothing more."""
        if self.fault is not None:
            return
        try:
            if self._file is None:
                self._file = self._path.open("x", encoding="utf-8", buffering=1)
            self._file.write(f"{line}\n")
        except OSError as error:
            do, got = "make room; tracking goes on without this file", error_words(error)
            self.fault = OutputError(refusal(str(self._path), expected="a disk with room", got=got, do=do))

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
