"""Lines that no reader can hold up."""

import math
import os
import socket
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread
from types import SimpleNamespace

import numpy as np
import pytest
from live_examples import LIMIT_S, until

from sphereorient.errors import OutputError
from sphereorient.live.outputs import (
    MOST_LINES,
    SOON_LINES,
    FileOutput,
    LslOutput,
    OscOutput,
    SerialOutput,
    Spool,
    TcpOutput,
    UdpOutput,
    ZmqOutput,
    open_output,
)

LINES = 10_000


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


def test_a_port_in_use_is_refused():
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


def test_an_unknown_host_is_refused():
    with pytest.raises(OutputError, match="expected a host"):
        UdpOutput("no such host", 9)
    with pytest.raises(OutputError, match="expected a host"):
        UdpOutput("a..b", 9)
    with pytest.raises(OutputError, match="expected a free port"):
        TcpOutput("a..b", 9)


def test_an_empty_host_is_this_machine_alone():
    output, _ = open_output("tcp::0", pytest.fail)
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.2", output.port), 0.5)
    output.close()


def test_a_file_grows_line_by_line_and_replaces_none(tmp_path):
    path = tmp_path / "a.dat"
    output = FileOutput(path, pytest.fail)
    output.send("1, 2")
    until(lambda: path.exists() and path.read_text() == "1, 2\n")  # before it is closed
    output.close()
    with pytest.raises(OutputError, match="expected a new file"):
        FileOutput(path, pytest.fail)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a full device")
def test_a_full_disk_is_reported_once_and_does_not_stop(tmp_path):
    messages: list[str] = []
    output = FileOutput(tmp_path / "full.dat", messages.append)
    output._file = Path("/dev/full").open("wb")  # noqa: SIM115
    output.send("1")
    until(lambda: messages)
    output.send("2")
    output.close()
    assert len(messages) == 1
    assert "expected a disk with room" in messages[0]


def test_a_disk_that_hangs_holds_nothing_up_and_lost_lines_are_counted():
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


@pytest.fixture
def line():
    """A pseudo terminal: the end that a program reads, and the name of the other one."""
    pty = pytest.importorskip("pty", reason="of POSIX")
    tty = pytest.importorskip("tty", reason="of POSIX")
    pytest.importorskip("serial", reason="the extra `live`")
    reader, port = pty.openpty()
    tty.setraw(port)
    yield reader, os.ttyname(port)
    for end in (reader, port):
        with suppress(OSError):
            os.close(end)


def test_a_serial_reader_gets_all_lines_in_order(line):
    reader, port = line
    output, got = SerialOutput(f"{port}@115200", pytest.fail), bytearray()

    def read() -> None:
        while got.count(b"\n") < LINES:
            got.extend(os.read(reader, 10_000))

    thread = Thread(target=read, daemon=True)
    thread.start()
    for k in range(LINES):
        until(lambda at=k: got.count(b"\n") > at - SOON_LINES // 2) if k % 50 == 0 else None
        output.send(f"FT, {k}, {'x' * 300}")
    thread.join(LIMIT_S)
    output.close()
    assert got.decode().splitlines() == [f"FT, {k}, {'x' * 300}" for k in range(LINES)]


def test_a_serial_reader_that_does_not_read_holds_nothing_up_and_is_reported(line):
    _, port = line
    messages: list[str] = []
    output = SerialOutput(f"{port}@115200", messages.append)
    for k in range(LINES):
        output.send(f"{k}, {'x' * 300}")
    output.close()
    (only,) = messages
    assert "lines are lost" in only
    SerialOutput(f"{port}@115200", pytest.fail).close()  # the port is free again


def test_a_serial_port_that_vanishes_is_reported_once(line):
    reader, port = line
    messages: list[str] = []
    output = SerialOutput(f"{port}@115200", messages.append)
    os.close(reader)
    output.send("1")
    until(lambda: messages)
    for k in range(2 * SOON_LINES):
        output.send(str(k))
    output.close()
    (only,) = messages
    assert "expected a port that takes lines" in only


@pytest.mark.parametrize("rate", ["", "@", "@fast", "@0", "@-9600", "@²", "@99999999999999999999"])
def test_an_impossible_baud_rate_is_refused(line, rate):
    with pytest.raises(OutputError, match="baud rate") as messages:
        SerialOutput(f"{line[1]}{rate}", pytest.fail)
    assert "\n" not in str(messages.value)


def test_a_serial_port_in_use_or_missing_and_a_file_are_refused(line, tmp_path):
    (tmp_path / "file").write_text("mine")
    output = SerialOutput(f"{line[1]}@9600", pytest.fail)
    for port in (line[1], tmp_path / "none", tmp_path / "file"):
        with pytest.raises(OutputError, match="baud rate"):
            SerialOutput(f"{port}@9600", pytest.fail)
    output.close()
    assert (tmp_path / "file").read_text() == "mine"


UNITS = {"time_s": "s", "valid": "", "position_radii_x": "radii", "quaternion_w": "", "velocity_radii_s_z": "radii/s"}
UNITS |= {"position_lab_mm_y": "mm", "sigma_omega_rad_s_x": "rad/s", "sigma_rad_x": "rad", "latency_ms": "ms"}


def numbers(k: int) -> dict[str, float]:
    unknown = dict.fromkeys(UNITS, math.nan)
    return {"frame": k} | unknown | {"time_s": 7000 + 1e-3 * k, "valid": k % 2 == 0, "latency_ms": 2.0}


def test_an_osc_reader_gets_a_message_a_frame_in_order():
    dispatcher = pytest.importorskip("pythonosc.dispatcher", reason="the extra `live`")
    server = pytest.importorskip("pythonosc.osc_server", reason="the extra `live`")
    got: list[tuple[float, ...]] = []
    messages = dispatcher.Dispatcher()
    messages.map("/sphereorient", lambda address, *values: got.append(values))
    with server.BlockingOSCUDPServer(("127.0.0.1", 0), messages) as reader:
        Thread(target=reader.serve_forever, args=(0.01,), daemon=True).start()
        output = OscOutput("127.0.0.1", reader.server_address[1])
        for k in range(LINES):
            until(lambda at=k: len(got) >= at) if k % 50 == 0 else None  # UDP loses what does not fit its memory
            output.send(numbers(k))
        until(lambda: len(got) == LINES)
        reader.shutdown()
        output.close()
    assert [values[0] for values in got] == list(range(LINES))
    assert got[1] == pytest.approx([float(value) for value in numbers(1).values()], nan_ok=True, abs=1e-3)


@pytest.fixture
def stream():
    pytest.importorskip("pylsl", reason="the extra `live`")
    output = LslOutput(f"ball {os.getpid()}", pytest.fail)
    output.send(numbers(-1))  # so that readers find the stream from the first frame on
    yield output
    output.close()


def inlet():
    import pylsl

    (info,) = pylsl.resolve_byprop("name", f"ball {os.getpid()}", timeout=LIMIT_S)
    reader = pylsl.StreamInlet(info)
    reader.open_stream(LIMIT_S)
    return reader


def test_an_lsl_reader_gets_all_samples_in_order_with_names_units_and_lsl_times(stream):
    import pylsl

    reader, frames, stamps = inlet(), [], []
    channel, labels = reader.info().desc().child("channels").child("channel"), {}
    while not channel.empty():
        labels[channel.child_value("label")] = channel.child_value("unit")
        channel = channel.next_sibling("channel")
    assert labels == {"frame": ""} | UNITS
    begun_s = pylsl.local_clock()
    for k in range(LINES):
        stream.send(numbers(k))

    def pulled() -> bool:
        samples, times = reader.pull_chunk(timeout=0.1)
        frames.extend(sample[0] for sample in samples)
        stamps.extend(times)
        return len(frames) >= LINES

    until(pulled)
    assert frames == list(range(LINES))
    assert begun_s - 0.1 < stamps[0] < begun_s + LIMIT_S  # by LSL's clock, for any clock of the source
    reader.close_stream()


def test_an_lsl_reader_that_does_not_read_holds_nothing_up(stream):
    reader = inlet()
    for k in range(5 * LINES):
        stream.send(numbers(k))
    assert reader.samples_available() < 5 * LINES
    reader.close_stream()


@pytest.fixture
def lsl_times(monkeypatch):
    """A stream with a clock that the test sets, and the times of its samples."""
    pytest.importorskip("pylsl", reason="the extra `live`")
    pushed: list[float] = []
    clock = SimpleNamespace(now_s=100.0)
    stream = LslOutput("ball", pytest.fail)
    monkeypatch.setattr("pylsl.local_clock", lambda: clock.now_s)
    monkeypatch.setattr("pylsl.StreamOutlet.push_sample", lambda self, values, time_s: pushed.append(time_s))
    return stream, clock, pushed


def test_lsl_times_are_those_of_the_source_less_the_least_delay(lsl_times):
    stream, clock, pushed = lsl_times
    for k, late_s in enumerate((0.004, 0.0, 0.03, 0.001)):  # on the way from the exposure
        clock.now_s = 100.0 + 1e-3 * k + late_s + 0.002
        stream.send(numbers(k))
    assert pushed == pytest.approx([100.004, 100.001, 100.002, 100.003])


def test_lsl_times_go_on_where_the_source_begins_again(lsl_times):
    stream, clock, pushed = lsl_times
    for k in (*range(900), *range(90)):
        clock.now_s += 0.001
        stream.send(numbers(k))
    assert np.diff(pushed) == pytest.approx(np.full(989, 0.001))


@pytest.mark.parametrize(
    ("kind", "name"),
    [("serial", "serial:/dev/x@9600"), ("pylsl", "lsl:x"), ("pythonosc", "osc:9"), ("zmq", "zmq:5555")],
)
def test_without_its_package_an_output_names_the_extra(kind, name, monkeypatch):
    for module in [kind, *(one for one in sys.modules if one.startswith(f"{kind}."))]:
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(OutputError, match=r"pip install 'sphereorient\[live\]'"):
        open_output(name, pytest.fail)


def test_without_liblsl_the_refusal_is_one_line(monkeypatch):
    def absent(name: str, extra: str) -> None:
        raise RuntimeError("LSL binary library file was not found.\nPlease make sure ...")

    monkeypatch.setattr("sphereorient.live.outputs.package", absent)
    with pytest.raises(OutputError, match="install liblsl"):
        LslOutput("ball", pytest.fail)
