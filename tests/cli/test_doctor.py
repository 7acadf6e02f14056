"""`doctor` on a machine in order, and on machines with a fault."""

from __future__ import annotations

import json
import sys
from importlib.metadata import PackageNotFoundError, version

import numpy as np
import pytest

from sphereorient.bench.doctor import fit_speed, machine
from sphereorient.bench.score import orientations_at
from sphereorient.cli import main
from sphereorient.trajectory.rotations import rotations

FIT = {"diameter_px": 40.0, "error_deg": 0.1, "cpu_ms": 2.0, "now_ms": 4.0, "hz_free_core": 350.0}
SEEN = {"opencv": ["camera:0 (640 x 480 px)"], "pylon": "no answer within 10 s"}


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """One small ball, and calibrated cameras."""
    monkeypatch.setattr("sphereorient.bench.doctor.LIMITS_DEG", {40.0: 0.3})
    monkeypatch.setattr("sphereorient.bench.doctor.cameras_here", lambda: SEEN)


@pytest.fixture
def no_fit(monkeypatch):
    """Fits that are not computed."""
    monkeypatch.setattr("sphereorient.bench.doctor.fit_speed", lambda px: FIT)


@pytest.fixture
def command(monkeypatch, capsys):
    """Run a command in this process; return its exit code, output and the lines of its errors."""

    def run(*words: str) -> tuple[int, str, list[str]]:
        monkeypatch.setattr(sys, "argv", ["sphereorient", *words])
        with pytest.raises(SystemExit) as stopped:
            main()
        printed = capsys.readouterr()
        return int(stopped.value.code or 0), printed.out, printed.err.splitlines()

    return run


def test_a_machine_in_order_is_printed_as_one_object(command):
    code, output, errors = command("doctor", "--json")
    found = json.loads(output)
    assert (code, errors, found["broken"]) == (0, [], [])
    assert found["torch"] == version("torch")
    assert found["cameras"] == SEEN
    assert 0 <= found["free_cores"] <= found["cores"]
    (fit,) = found["live_one_camera"]
    assert fit["diameter_px"] == 40
    assert fit["error_deg"] < 0.3
    assert fit["hz_free_core"] == pytest.approx(2 * fit["hz_shared_core"])
    assert fit["hz_free_core"] * fit["cpu_ms"] < 1000, "the loop cannot compute all the time"


def test_findings_are_printed(no_fit, command):
    code, output, errors = command("doctor")
    assert (code, errors) == (0, [])
    for words in ("torch ", "camera:0 (640 x 480 px)", "pylon: no answer", "hz_free_core", "cores free"):
        assert words in output


@pytest.mark.slow
def test_a_fit_that_is_wrong_by_a_degree_is_broken(monkeypatch):
    turn = rotations(np.array([[0.0, 0.0, np.radians(1.0)]]))[0]
    monkeypatch.setattr("sphereorient.bench.doctor.orientations_at", lambda *where: turn @ orientations_at(*where))
    (line,) = machine()[1]
    assert line.startswith("fit of a ball of 40 px: ")


def test_a_frame_without_a_pose_is_broken(monkeypatch, command):
    monkeypatch.setattr("sphereorient.bench.doctor.fit_speed", lambda px: FIT | {"error_deg": float("nan")})
    code, output, errors = command("doctor", "--json")
    found = json.loads(output)
    assert (code, errors) == (1, [])
    assert found["live_one_camera"][0]["error_deg"] is None
    assert found["broken"][0].startswith("fit of a ball of 40 px: ")


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), RuntimeError("no kernel")], ids=str)
def test_a_fit_that_cannot_be_tried_is_broken_and_the_rest_is_reported(monkeypatch, command, error):
    def fails(px: float) -> dict[str, float]:
        raise error

    monkeypatch.setattr("sphereorient.bench.doctor.fit_speed", fails)
    code, output, errors = command("doctor")
    assert code == 1
    assert "camera:0 (640 x 480 px)" in output
    (line,) = errors
    assert line.startswith("broken: fit of a ball of 40 px: ")
    assert str(error.args[-1]) in line


def test_a_torch_that_computes_wrongly_is_broken(no_fit, monkeypatch):
    assert machine()[1] == []
    monkeypatch.setattr("torch.linalg.inv", lambda A: A)
    (line,) = machine()[1]
    assert line.startswith("torch: expected ")


def test_a_package_too_old_is_one_line_with_the_command_that_mends_it(no_fit, monkeypatch, command):
    monkeypatch.setattr(
        "sphereorient.files.provenance.version", lambda name: "1.9" if name == "kornia" else version(name)
    )
    assert command("doctor")[0] == 0, "1.9 is above 0.9"
    monkeypatch.setattr(
        "sphereorient.files.provenance.version", lambda name: "0.8" if name == "kornia" else version(name)
    )
    code, output, errors = command("doctor")
    assert code == 1
    (line,) = errors
    assert "got 0.8; run `pip install 'kornia>=0.9.0'`" in line
    assert "hz" not in output, "nothing that it measured could be trusted"


def test_a_package_that_is_missing_or_does_not_load_is_one_line(monkeypatch, command):
    def gone(name: str) -> str:
        if name in ("av", "pyzmq"):
            raise PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr("sphereorient.files.provenance.version", gone)
    monkeypatch.setitem(sys.modules, "h5py", None)
    code, output, errors = command("doctor", "--json")
    assert (code, errors) == (1, [])
    found = json.loads(output)
    missing, damaged = found["broken"]
    assert missing.startswith("av: expected >=")
    assert damaged.startswith("h5py: ")
    assert "pyzmq" in found["not_installed"]["live"], "an extra is reported, but breaks nothing"


@pytest.mark.slow
@pytest.mark.parametrize("diameter_px", [90.0, 160.0])
def test_larger_balls_are_right_to_a_tenth_of_a_degree(diameter_px):
    assert fit_speed(diameter_px)["error_deg"] < 0.1
