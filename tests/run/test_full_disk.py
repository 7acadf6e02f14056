"""A disk that fills up at any moment: one line, earlier results intact, nothing half-written."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from run_examples import EXCERPT, SHORT_BLOCKS, datasets, run

COMMAND = [sys.executable, "-c", "from sphereorient.cli import main; main()", "track"]


resource = pytest.importorskip("resource")  # not on Windows


def limited(size: int):
    """No file may grow beyond some bytes, as on a full disk."""

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    return limit


def track(out: Path, size: int, *more: str) -> subprocess.CompletedProcess[str]:
    words = [*COMMAND, str(EXCERPT), "--out", str(out), "-q", "--force", *SHORT_BLOCKS, *more]
    return subprocess.run(words, capture_output=True, text=True, timeout=300, check=False, preexec_fn=limited(size))


@pytest.mark.slow
@pytest.mark.parametrize("size", [40, 20_000], ids=["no room at all", "half of what was learnt"])
def test_a_full_disk_is_one_line_and_the_earlier_track_stays(tmp_path, size):
    out = tmp_path / "track.h5"
    out.write_bytes(b"an earlier track")
    result = track(out, size)
    assert result.returncode == 2
    assert len(result.stderr.strip().splitlines()) == 1, result.stderr
    assert "Traceback" not in result.stderr
    assert "space left" in result.stderr or "has room" in result.stderr
    assert out.read_bytes() == b"an earlier track"
    assert not list(tmp_path.glob(".*"))


@pytest.mark.slow
def test_when_there_is_room_again_the_run_goes_on(tmp_path):
    clean = tmp_path / "clean.h5"
    out = tmp_path / "track.h5"
    learnt = tmp_path / "learnt.h5"
    assert run(EXCERPT, "--out", clean, "-q", *SHORT_BLOCKS, "--save-learnt", learnt).returncode == 0
    result = track(out, 100_000, "--learnt", str(learnt))
    assert result.returncode == 2
    assert list((tmp_path / "track.h5.parts").glob("poses-*"))
    again = run(EXCERPT, "--out", out, "-q", *SHORT_BLOCKS, "--learnt", learnt, "--resume")
    assert again.returncode == 0, again.stderr
    assert datasets(out) == datasets(clean)


@pytest.mark.slow
def test_a_folder_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "none").touch()
    result = run(EXCERPT, "--out", tmp_path / "none" / "track.h5")
    assert result.returncode == 2
    assert "expected a folder to write in" in result.stderr
    result = run(EXCERPT, "--out", "/proc/track.h5")
    assert result.returncode == 2
    assert len(result.stderr.strip().splitlines()) == 1, result.stderr
