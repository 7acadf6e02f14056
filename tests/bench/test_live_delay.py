"""`sphereorient bench live`: the delay from a picture in memory to its line."""

from __future__ import annotations

import os
import re
import time
from pathlib import Path

import pytest
from conftest import REPO
from typer.testing import CliRunner

from sphereorient.bench.live import neighbours
from sphereorient.cli import app

EXCERPT = REPO / "synthetic_data" / "excerpt"


@pytest.mark.slow  # two programs
def test_the_bench_times_each_line(tmp_path):
    run = CliRunner().invoke(app, ["bench", "live", str(EXCERPT / "experiment.yaml"), "--rate", "20", "--seconds", "2"])
    assert run.exit_code == 0, run.output
    came, written = (int(number) for number in re.findall(r"(\d+) lines of (\d+) frames", run.output)[0])
    assert came > 20
    assert came <= written
    assert 0 < float(re.findall(r"delay: ([0-9.]+) ms", run.output)[0]) < 5000
    assert float(re.findall(r"([0-9.]+)° in the last", run.output)[0]) < 0.2, "against the excerpt's truth"


@pytest.mark.slow  # two programs, twice
def test_the_bench_prints_a_row_for_each_rate_beside_other_programs(tmp_path):
    command = ["bench", "live", str(EXCERPT / "experiment.yaml"), "--rate", "10,20", "--seconds", "2", "--load", "1"]
    run = CliRunner().invoke(app, [*command, "--cameras", "cam1"], env={"COLUMNS": "200"})
    assert run.exit_code == 0, run.output
    assert "other busy programs: 1" in run.output
    rows = [re.findall(r"[0-9.]+", line) for line in run.output.splitlines() if re.match(r"\W*[12]0 +\W", line)]
    assert [row[0] for row in rows] == ["10", "20"]
    for (_, frames, dropped, lost, middle, slow, slowest, error, *_), least in zip(rows, (10, 20), strict=True):
        assert least <= int(frames) - int(dropped)
        assert int(lost) == 0
        assert 0 < float(middle) <= float(slow) <= float(slowest)
        assert float(error) < 0.2


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="no /proc")
def test_neighbours_keep_cores_busy_and_end():
    def children() -> list[str]:
        return Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()

    before, used = children(), 0
    with neighbours(2):
        busy = sorted(set(children()) - set(before))
        assert len(busy) == 2
        end = time.monotonic() + 60
        while used < 2 and time.monotonic() < end:  # on a machine with other work it takes longer
            used = sum(int(Path(f"/proc/{one}/stat").read_text().rsplit(")")[-1].split()[11]) > 10 for one in busy)
            time.sleep(0.1)
    assert used == 2, "clock ticks of each"
    assert children() == before


@pytest.mark.parametrize("rate", ["0", "x", ",", "nan", "100,-5"])
def test_rates_that_are_none_are_refused(rate, monkeypatch):
    monkeypatch.setattr("sphereorient.bench.live.delays", lambda *_, **__: pytest.fail("too late"))
    run = CliRunner().invoke(app, ["bench", "live", str(EXCERPT / "experiment.yaml"), "--rate", rate])
    assert run.exit_code != 0
    assert "100,200,500" in str(run.exception)
