"""scripts/moon.py: its ephemeris against one of another source."""

from __future__ import annotations

import csv

import pytest
from conftest import SHARED


@pytest.mark.shared
def test_the_ephemeris_agrees_with_another_one():
    pytest.importorskip("astronomy")
    from moon import ephemeris

    with (SHARED / "real" / "moon" / "truth.csv").open() as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        at = ephemeris(row["utc"], float(row["site_lat_deg"]), float(row["site_lon_deg"]))
        assert at.latitude == pytest.approx(float(row["subobserver_lat_deg"]), abs=0.02)
        assert at.longitude == pytest.approx(float(row["subobserver_lon_deg"]), abs=0.02)
        assert 60 * at.semidiameter == pytest.approx(float(row["semidiameter_arcmin"]), abs=0.01)
        assert at.phase == pytest.approx(float(row["phase_deg"]), abs=0.02)


@pytest.mark.slow
@pytest.mark.shared
def test_a_photograph_of_the_full_moon_shows_the_point_in_whose_zenith_the_camera_is(tmp_path):
    pytest.importorskip("astronomy")
    from moon import ephemeris, row

    folder = SHARED / "real" / "moon"
    with (folder / "truth.csv").open() as file:
        first = next(csv.DictReader(file))
    at = ephemeris(first["utc"], float(first["site_lat_deg"]), float(first["site_lon_deg"]))
    cells = row(first["picture"], folder / f"{first['picture']}_raw" / "experiment.yaml", at, tmp_path, []).split(" | ")
    assert float(cells[3]) < 0.2
