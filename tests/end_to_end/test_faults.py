"""Every fault of a movie: the run finishes, spoilt frames carry their reason, good ones come out as without it."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import pytest
from conftest import REPO

# The reasons of the spoilt frames, camera by camera, and how many frames stay valid of 96.
EXPECTED: dict[str, tuple[dict[str, dict[str, int]], int]] = {
    "truncated movie, cam2": ({"cam2": {"missing": 21}}, 96),
    "corrupt frames, cam1": ({"cam1": {"undecodable": 3}}, 96),
    "black, cam1": ({"cam1": {"dark": 6}}, 96),
    "black, both": ({"cam1": {"dark": 6}, "cam2": {"dark": 6}}, 90),
    "lamp off, cam2": ({"cam2": {"low_score": 6}}, 96),
    "white, cam1": ({"cam1": {"saturated": 6}}, 96),
    "repeated, cam1": ({"cam1": {"repeated": 6}}, 96),
    "repeated, both": ({"cam1": {"repeated": 6}, "cam2": {"repeated": 6}}, 90),
    "one camera without the ball": ({"cam2": {"low_score": 6}}, 96),
    "out of view": ({"cam1": {"not_found": 6}, "cam2": {"not_found": 6}}, 90),
    "two frames swapped, cam1": ({"cam1": {"contradicts": 2}}, 96),
    "two frames swapped, both": ({"cam1": {"low_score": 2}, "cam2": {"low_score": 2}}, 94),
    "cam2 a frame late from here on": ({"cam2": {"repeated": 1, "contradicts": 58}}, 96),
}


def rows_of(*more: str) -> dict[str, dict[str, Any]]:
    words = [sys.executable, REPO / "scripts" / "faults.py", "--json", *more]
    run = subprocess.run(words, capture_output=True, text=True, timeout=1500, check=False)
    assert run.returncode == 0, run.stderr
    result = json.loads(run.stdout)
    return {row["fault"]: row | {"clean_worst_deg": result["clean_worst_deg"]} for row in result["rows"]}


def most_worse(fault: str) -> float:
    """Return the largest ratio of the worst errors with and without a fault; a camera that goes on alone has more."""
    return 2.25 if max(EXPECTED[fault][0].get("cam2", {}).values(), default=0) > 20 else 2.0


def check(row: dict[str, Any], frames: int = 96) -> None:
    reasons, valid = EXPECTED[row["fault"]]
    assert {camera: why for camera, why in row["reasons"].items() if why} == reasons
    assert (row["valid_before"], row["valid"]) == (frames, valid - 96 + frames)
    assert row["good_lost"] == 0
    assert row["reasons_elsewhere"] == 0
    assert row["worst_deg"] < most_worse(row["fault"]) * row["clean_worst_deg"]
    assert row["same"]  # with the appearance of the clean run: the same bits in all blocks without the fault


@pytest.mark.slow
def test_a_fault_costs_its_own_frames_only():
    """The shortest movie with a block before, with and after the fault; all faults, at full length, are slow."""
    row = rows_of("--frames", "48", "--only", "black, cam1")["black, cam1"]
    check(row, 48)
    # An estimate from 42 frames in place of 48 differs by sqrt(6 / 42) of the error that lasts, half a sigma: 0.19.
    assert row["anew_rms_sigma"] <= 0.13


@pytest.fixture(scope="module")
def everything() -> dict[str, dict[str, Any]]:
    return rows_of()


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPECTED)
def test_each_fault_costs_its_own_frames_only(everything, name):
    check(everything[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in EXPECTED if name != "cam2 a frame late from here on"])
def test_good_frames_are_the_same_to_a_tenth_of_a_sigma_when_all_is_learnt_anew(everything, name):
    # A frame beside lost ones has a less certain path for its orientation; cam2 reports 21 frames less.
    bars = {"out of view": (0.125, 0.4), "truncated movie, cam2": (0.11, 0.45)}
    rms_sigma, most_sigma = bars.get(name, (0.11, 0.3))
    assert everything[name]["anew_rms_sigma"] <= rms_sigma
    assert everything[name]["anew_most_sigma"] <= most_sigma
    assert everything[name]["worst_anew_deg"] < most_worse(name) * everything[name]["clean_worst_deg"]


@pytest.mark.slow
def test_a_ball_half_out_of_view_is_measured_as_well_as_its_half_allows(everything):
    row = everything["half out, cam1"]
    assert row["valid"] == 96
    assert row["same"]
    assert row["worst_deg"] < 3 * row["clean_worst_deg"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["30 % of each camera black", "30 % of each camera lost, stamps"])
def test_a_third_of_the_frames_lost_costs_those_frames(everything, name):
    """No camera saw nine in a hundred instants; all others are measured."""
    row = everything[name]
    seen_by_none = row["frames"] - row["valid"]
    assert row["good_lost"] == 0
    assert seen_by_none <= 15
    assert row["worst_deg"] < 2 * row["clean_worst_deg"]
