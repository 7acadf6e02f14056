"""`sphereorient spin` from photographs to a result, and bad input in one line."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import torch
from overlay_examples import command
from spin_examples import dot_directions, photograph, spinning

from sphereorient import so3

STEP_S = 0.004
OMEGA = torch.tensor([30.0, 250.0, -80.0], dtype=torch.float64)


@pytest.fixture
def flight(tmp_path):
    """Six photographs of a spinning ball, their times and the table of dots."""
    time_s = STEP_S * torch.tensor([0.0, 1, 2, 4, 5, 6], dtype=torch.float64)
    directions = dot_directions()
    R = spinning(OMEGA, so3.random_rotations((), generator=torch.Generator().manual_seed(4)), time_s)
    (tmp_path / "pictures").mkdir()
    for k, one in enumerate(R):
        picture = photograph(one, directions, seed=k)
        cv2.imwrite(str(tmp_path / "pictures" / f"{k}.png"), picture[..., ::-1])
    lines = ["file,t_s", *(f"{k}.png,{float(time)}" for k, time in enumerate(time_s))]
    (tmp_path / "times.csv").write_text("\n".join(lines))
    np.savetxt(tmp_path / "dots.csv", directions.numpy(), delimiter=",")
    return tmp_path


def options(folder):
    return ("--times", folder / "times.csv", "--texture", folder / "dots.csv", "--out", folder / "spin.json")


@pytest.mark.slow
def test_a_spin_is_measured_and_written(flight, monkeypatch, capsys):
    code, output, err = command(
        monkeypatch, capsys, "spin", flight / "pictures", *options(flight), "--dot-radius", 7, "--omega-max", 700
    )
    assert code == 0, err
    result = json.loads((flight / "spin.json").read_text())
    first = result["spins"][0]
    assert first["omega_view_rad_s"] == pytest.approx(OMEGA.tolist(), abs=6.0)
    assert first["rate_sigma_rad_s"] < 6.0
    assert [one["file"].rsplit("/", 1)[1] for one in result["photographs"]] == [f"{k}.png" for k in range(6)]
    assert all(one["residual_deg"] < 8 for one in result["photographs"])
    assert "6 of 6 follow the spin" in output
    assert cv2.imread(str(flight / "spin.png")).shape[1] > 500


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"times.csv": "name,time\n"}, "the columns file and t_s"),
        ({"times.csv": "file,t_s\n0.png,0\n"}, "a time of 1.png"),
        ({"times.csv": "file,t_s\n" + "".join(f"{k}.png,now\n" for k in range(6))}, "times in seconds"),
        ({"times.csv": "file,t_s\n" + "".join(f"{k}.png,1\n" for k in range(6))}, "one of them twice"),
        ({"times.csv": b"\xff\xfe\x00"}, "not UTF-8"),
        ({"dots.csv": "a,b,c\n"}, "a table of numbers"),
        ({"dots.csv": "1,0\n"}, "three columns, got 2"),
        ({"dots.csv": "20,0,0\n"}, "directions of length 1"),
        ({"dots.csv": ""}, "no rows"),
        ({"pictures/3.png": "no picture"}, "a picture that can be decoded"),
    ],
)
def test_inputs_that_are_damaged_are_refused_in_one_line(flight, monkeypatch, capsys, changed, words):
    for name, content in changed.items():
        (flight / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    code, _, err = command(monkeypatch, capsys, "spin", flight / "pictures", *options(flight))
    assert code == 2
    assert words in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--times", "0"), "a rate above 0"),
        (("--times", "nan"), "a rate above 0"),
        (("--times", "missing.csv"), "no such file"),
        (("--dot-radius", "90"), "0.5 .. 45 degrees"),
        (("--out", "/dev/null/spin.json"), "a folder to write in"),
        (("--out", "spin.txt"), "expected .json"),
        (("--texture", "missing.png"), "no such file"),
    ],
)
def test_options_that_are_impossible_are_refused_in_one_line(flight, monkeypatch, capsys, arguments, words):
    code, _, err = command(monkeypatch, capsys, "spin", flight / "pictures", *options(flight), *arguments)
    assert code == 2
    assert words in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("rate", ["inf", "nan", "0", "1e7"])
def test_a_fastest_spin_out_of_range_is_refused(flight, monkeypatch, capsys, rate):
    """Before: inf ended in an OverflowError."""
    code, _, err = command(monkeypatch, capsys, "spin", flight / "pictures", *options(flight), "--omega-max", rate)
    assert code == 2
    assert "Invalid value for '--omega-max'" in err
    assert not (flight / "spin.json").exists()


def test_too_few_photographs_and_missing_ones_are_refused(flight, monkeypatch, capsys):
    code, _, err = command(monkeypatch, capsys, "spin", flight / "pictures" / "0.png", *options(flight))
    assert code == 2
    assert "at least 3 photographs, got 1" in err
    code, _, err = command(
        monkeypatch, capsys, "spin", *(flight / "pictures" / f"{k}.png" for k in (0, 1, 9)), *options(flight)
    )
    assert code == 2
    assert "9.png" in err
