"""Lines that no reader can hold up."""

from __future__ import annotations

import socket
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from threading import Event

import pytest
from live_examples import LIMIT_S, until

from sphereorient.errors import OutputError
from sphereorient.live.outputs import MOST_LINES, FileOutput, Spool, TcpOutput, UdpOutput, ZmqOutput


def test_a_tcp_reader_gets_lines_and_one_that_went_away_holds_nothing_up():
    output = TcpOutput("127.0.0.1", 0)
    try:
        with socket.create_connection(("127.0.0.1", output.port)) as first:
            until(lambda: output._readers)
            output.send("FT, 1")
            assert first.makefile().readline() == "FT, 1\n"
        for k in range(2 * MOST_LINES):
            output.send(f"FT, {k}, {'x' * 200}")
        with socket.create_connection(("127.0.0.1", output.port)) as again:
            until(lambda: not output._readers[-1][1].gone and len(output._readers) <= 2)
            time.sleep(0.2)
            output.send("FT, again")
            assert again.makefile().readline() == "FT, again\n"
    finally:
        output.close()


def test_a_slow_reader_loses_lines_and_takes_no_time():
    output = TcpOutput("127.0.0.1", 0)
    try:
        with socket.create_connection(("127.0.0.1", output.port)) as reader:
            until(lambda: output._readers)
            begun = time.monotonic()
            for k in range(20_000):
                output.send(f"{k}, {'x' * 1000}")
            assert time.monotonic() - begun < LIMIT_S
            assert len(output._readers[0][1]._waiting) <= MOST_LINES
            numbers = []
            for line in reader.makefile():
                number, rest = line.split(", ")
                assert rest == "x" * 1000 + "\n", "lines are whole, also where the reader took a part of one"
                numbers.append(int(number))
                if numbers[-1] == 19_999:
                    break
            assert numbers == sorted(set(numbers))
            assert len(numbers) < 20_000
    finally:
        output.close()


def test_a_port_in_use_is_told():
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(OutputError, match="expected a free port"):
        TcpOutput("127.0.0.1", taken.getsockname()[1])


def test_udp_sends_a_datagram_a_line():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as reader:
        reader.bind(("127.0.0.1", 0))
        reader.settimeout(LIMIT_S)
        output = UdpOutput("127.0.0.1", reader.getsockname()[1])
        output.send("FT, 7")
        assert reader.recv(100) == b"FT, 7\n"
        output.close()
        UdpOutput("127.0.0.1", 9).send("nobody is there")


def test_a_host_that_nobody_knows_is_told():
    with pytest.raises(OutputError, match="expected a host"):
        UdpOutput("no such host", 9)


def test_a_file_grows_line_by_line_and_replaces_none(tmp_path):
    path = tmp_path / "a.dat"
    output = FileOutput(path, pytest.fail)
    output.send("1, 2")
    until(lambda: path.exists() and path.read_text() == "1, 2\n")  # before it is closed
    output.close()
    with pytest.raises(OutputError, match="expected a new file"):
        FileOutput(path, pytest.fail)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a full device")
def test_a_full_disk_is_told_once_and_does_not_stop(tmp_path):
    told: list[str] = []
    output = FileOutput(tmp_path / "full.dat", told.append)
    output._file = Path("/dev/full").open("wb")  # noqa: SIM115
    output.send("1")
    until(lambda: told)
    output.send("2")
    output.close()
    assert len(told) == 1
    assert "expected a disk with room" in told[0]


def test_a_disk_that_hangs_holds_nobody_up_and_what_is_lost_is_counted():
    going, written = Event(), []

    def write(things: list[int]) -> None:
        going.wait(LIMIT_S)
        written.extend(things)

    spool = Spool(write, most=3)
    spool.send(0)
    until(lambda: not spool._waiting)
    for k in range(1, 11):
        spool.send(k)
    assert spool.lost == 7
    going.set()
    spool.close()
    assert written == [0, 8, 9, 10]


# --- ZeroMQ ---


@pytest.fixture
def published():
    pytest.importorskip("zmq", reason="the extra `live`")
    output = ZmqOutput("127.0.0.1", 0)
    yield output
    output.close()


@contextmanager
def subscribed(output: ZmqOutput, most: int = 0):
    """A subscriber whose subscription has arrived."""
    import zmq

    with zmq.Context() as context, context.socket(zmq.SUB) as reader:
        reader.set_hwm(most)
        reader.set(zmq.RCVTIMEO, round(1e3 * LIMIT_S))
        reader.connect(f"tcp://127.0.0.1:{output.port}")
        reader.subscribe("")

        def there() -> bool:
            output.send("hello")
            return bool(reader.poll(20))

        until(there)
        yield reader


def test_zmq_subscribers_get_lines(published):
    with subscribed(published) as one, subscribed(published) as two:
        published.send('{"frame": 7}')
        for reader in (one, two):
            while (line := reader.recv_string()) == "hello":
                pass
            assert line == '{"frame": 7}'


def test_a_zmq_subscriber_that_does_not_read_loses_lines_and_takes_no_time(published):
    with subscribed(published, most=10) as reader:
        begun = time.monotonic()
        for k in range(50_000):
            published.send(f"{k} {'x' * 1000}")
        assert time.monotonic() - begun < LIMIT_S
        count = 0
        while reader.poll(200):
            reader.recv_string()
            count += 1
        assert 0 < count < 50_000


def test_a_zmq_port_in_use_is_told(published):
    with pytest.raises(OutputError, match="expected a free port"):
        ZmqOutput("127.0.0.1", published.port)


def test_without_zeromq_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "zmq", None)
    with pytest.raises(OutputError, match=r"pip install 'sphereorient\[live\]'"):
        ZmqOutput("127.0.0.1", 5555)
