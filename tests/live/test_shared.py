"""A ring of poses in memory: read in order by another program; a slow reader finds which ones it lost."""

import os
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from live_examples import LIMIT_S, rows, until
from overlay_examples import true_track

from sphereorient.errors import MovieError, OutputError
from sphereorient.live.lines import FicTracLines, Forms, Quantities
from sphereorient.live.outputs import open_output
from sphereorient.live.shared import POSES, shared_poses
from sphereorient.trajectory.walk import FicTracAxes

NAMES = list(Forms(next(rows(true_track())), FicTracLines(FicTracAxes.of_lab(np.eye(3))), Quantities(True)).numbers)
READER = """
import sys
from pathlib import Path
from sphereorient.live.shared import shared_poses
from sphereorient.trajectory.walk import FicTracAxes
print("begun", flush=True)
for count, pose in shared_poses(Path(sys.argv[1])):
    print(count, int(pose[0]), pose[1], pose[-1], flush=False)
"""


def numbers(k: int) -> dict[str, float]:
    return {name: 1000.0 * place + k for place, name in enumerate(NAMES)} | {"frame": k, "time_s": 0.001 * k}


def test_a_slot_is_the_pose_as_numbers_in_the_documented_order(tmp_path):
    path = tmp_path / "poses"
    output, form = open_output(f"shared:{path}", pytest.fail)
    assert form == "numbers"
    output.send(numbers(7) | {"valid": True, "position_lab_mm_x": float("nan")})
    content = path.read_bytes()
    assert content[:8] == b"SPHEREO1"
    slots, size, written, ended = struct.unpack_from("<4Q", content, 8)
    assert (slots, size, written, ended) == (POSES, 8 * 33, 1, 0)
    row = struct.unpack_from("<33d", content, 8 * (5 + slots))
    assert row[:3] == (7.0, 0.007, 1.0)
    assert np.isnan(row[3])
    assert row[-1] == 32_007.0
    assert struct.unpack_from("<d", content, 40) == (0.007,)
    output.close()
    assert not path.exists()


def test_a_slow_reader_finds_lost_poses_by_the_count(tmp_path):
    path = tmp_path / "poses"
    with pytest.raises(MovieError, match="expected a ring"):
        next(shared_poses(path))
    output, _ = open_output(f"shared:{path}", pytest.fail)
    output.send(numbers(0))
    poses = shared_poses(path)
    assert next(poses)[0] == 0
    for k in range(1, POSES + 100):
        output.send(numbers(k))
    rest = [next(poses) for _ in range(POSES - 1)]
    assert [count for count, _ in rest] == [int(pose[0]) for _, pose in rest] == list(range(101, POSES + 100))
    poses.close()
    output.close()


def test_a_file_that_is_there_is_not_written_over(tmp_path):
    path = tmp_path / "poses"
    path.write_text("mine")
    with pytest.raises(OutputError, match="expected a new file"):
        open_output(f"shared:{path}", pytest.fail)
    assert path.read_text() == "mine"


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="of POSIX")
def test_a_disk_without_room_for_a_ring_is_refused_before_it_is_written(tmp_path, monkeypatch):
    def full(*given: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(OutputError, match="No space left"):
        open_output(f"shared:{tmp_path / 'poses'}", pytest.fail)
    assert not [*tmp_path.iterdir()]


def test_a_ring_in_the_making_does_not_end_the_reading_of_the_one_before(tmp_path, monkeypatch):
    monkeypatch.setattr("sphereorient.live.shared.REPLACED_S", 0.0)
    path, looks = tmp_path / "poses", []
    killed, _ = open_output(f"shared:{path}", pytest.fail)
    killed.send(numbers(0))
    poses = shared_poses(path)
    assert next(poses)[0] == 0
    path.unlink()
    path.write_bytes(bytes(4096))

    def sleep(seconds: float) -> None:
        looks.append(seconds)
        if len(looks) == 3:
            path.unlink()
            open_output(f"shared:{path}", pytest.fail)[0].send(numbers(5))

    monkeypatch.setattr("sphereorient.live.shared.time.sleep", sleep)
    count, pose = next(poses)
    assert (count, pose[0]) == (1, 5.0)


@pytest.mark.slow  # ten seconds of poses
def test_ten_thousand_poses_at_1_khz_reach_a_reader_process_in_order(tmp_path):
    path, received = tmp_path / "poses", tmp_path / "received"
    output, _ = open_output(f"shared:{path}", pytest.fail)
    output.send(numbers(0))
    with received.open("wb") as file:
        reader = subprocess.Popen([sys.executable, "-c", READER, str(path)], stdout=file)
        until(lambda: received.read_text().startswith("begun"), 3 * LIMIT_S)
        time.sleep(0.5)
        begun = time.perf_counter()
        for k in range(1, 10_001):
            output.send(numbers(k))
            time.sleep(max(0.0, begun + 0.001 * k - time.perf_counter()))
        time.sleep(0.5)
        output.close()
        assert reader.wait(LIMIT_S) == 0
    lines = [line.split() for line in received.read_text().splitlines()[1:]]
    assert [int(count) for count, *_ in lines] == list(range(10_001))
    assert [int(frame) for _, frame, *_ in lines] == list(range(10_001))
    assert all(float(last) == 32_000.0 + int(frame) for _, frame, _, last in lines)
    assert not Path(path).exists()
