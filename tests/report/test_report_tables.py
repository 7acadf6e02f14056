import csv
from dataclasses import replace

import numpy as np
import pyarrow.parquet
import pytest
from ensembles import EnsembleSpec, draw_ensemble, filtered_track

from sphereorient.report import tables
from sphereorient.report.tables import tables_of, write_tables
from sphereorient.statistics import StatisticsSettings, Surroundings, ensemble_of, summarise
from sphereorient.statistics.cameras import camera_distances
from sphereorient.trajectory import CameraTrack, Reason


@pytest.fixture(scope="module")
def tracked():
    spec = EnsembleSpec(segments=12, mean_frames=90.0)
    whole = filtered_track(draw_ensemble(spec, 8), 0.1, 0.05, 8)
    seen = replace(CameraTrack.empty(len(whole)), reason=(Reason.DARK,) * 7 + (Reason.OK,) * (len(whole) - 7))
    turned = replace(seen, orientation=np.tile(np.diag([1.0, -1.0, -1.0]), (len(whole), 1, 1)))
    return replace(whole, cameras={"left": replace(seen, orientation=np.tile(np.eye(3), (len(whole), 1, 1))),
                                   "right": turned})  # fmt: skip


@pytest.fixture(scope="module")
def summary(tracked):
    settings = StatisticsSettings(resamples=100)
    return summarise(tracked, settings, Surroundings(diameter_mm=18.0, viscosity_m2_s=1e-6, dissipation_w_kg=1.0))


@pytest.fixture(scope="module")
def written(tracked, summary, tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables")
    made = tables_of(summary, {"a/track.h5": tracked}, camera_distances(tracked))
    assert write_tables(made, folder) == ["csv", "parquet"]
    return folder, made


def rows_of(folder, name):
    with (folder / f"{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_csv_and_parquet_hold_the_same_numbers_with_all_digits(written):
    folder, made = written
    for table in made:
        by_text = rows_of(folder, table.name)
        by_parquet = pyarrow.parquet.read_table(folder / f"{table.name}.parquet").to_pylist()
        assert len(by_text) == len(by_parquet) == len(table.rows) > 0
        for text, typed in zip(by_text, by_parquet, strict=True):
            for key, value in typed.items():
                assert (
                    np.array_equal(float(text[key]), value, equal_nan=True)
                    if isinstance(value, float)
                    else text[key] == str(value)
                )


def test_table_one_is_that_of_the_samples(written, tracked):
    ensemble = ensemble_of(tracked, StatisticsSettings())
    rows = {(row["quantity"], row["component"]): row for row in rows_of(written[0], "moments")}
    assert len(rows) == 24
    x = ensemble.values["alpha_body"][:, 1]
    row = rows["alpha_body", "y"]
    assert float(row["rms"]) == pytest.approx(x.std())
    assert float(row["flatness"]) == pytest.approx(((x - x.mean()) ** 4).mean() / x.var() ** 2)
    assert row["units"] == "rad/s^2"
    speed = np.linalg.norm(ensemble.values["velocity"], axis=1)
    assert float(rows["velocity", "norm"]["mean"]) == pytest.approx(speed.mean())
    assert float(row["rms_low"]) < float(row["rms"]) < float(row["rms_high"])


def test_densities_are_probabilities(written):
    rows = [row for row in rows_of(written[0], "densities") if (row["quantity"], row["component"]) == ("velocity", "z")]
    step = float(rows[1]["standard_deviations"]) - float(rows[0]["standard_deviations"])
    for law in ("pdf", "gaussian", "stretched_exponential"):
        assert sum(float(row[law]) for row in rows) * step == pytest.approx(1, abs=0.02)


def test_angles_and_distances_are_in_the_units_of_their_names(written):
    rows = rows_of(written[0], "camera_distance")
    assert {row["cameras"] for row in rows} == {"left right"}
    assert float(rows[-1]["to_deg"]) == pytest.approx(180)
    assert sum(float(row["pdf_per_deg"]) * (float(row["to_deg"]) - float(row["from_deg"])) for row in rows) == (
        pytest.approx(1)
    )
    angles = [row for row in rows_of(written[0], "angles") if row["angle"] == "theta_y"]
    assert (float(angles[0]["from_deg"]), float(angles[-1]["to_deg"])) == pytest.approx((-90, 90))


def test_lost_frames_and_the_flow_are_listed(written):
    (row,) = rows_of(written[0], "tracks")
    assert (row["file"], row["lost"]) == ("a/track.h5", "left: 7; right: 7")
    assert 0 < float(row["stated_error_deg"]) < 5
    assert int(row["doubtful"]) <= int(row["valid"]) <= int(row["frames"])
    flow = {row["formula"]: float(row["value"]) for row in rows_of(written[0], "comparisons")}
    assert flow["(nu^3 / epsilon)^(1/4)"] == pytest.approx(1e-6**0.75)


def test_a_single_segment_gives_only_numbers_without_an_interval(tracked):
    first = tracked.at(np.flatnonzero(tracked.segment == tracked.segment[np.argmax(np.bincount(tracked.segment))]))
    one = first.at(np.flatnonzero(first.segment == np.bincount(first.segment).argmax()))
    found = tables_of(summarise(one, StatisticsSettings(min_frames=10)), {"one": one}, [])
    assert [table.name for table in found] == ["tracks", "segments", "moments"]


def test_without_pyarrow_there_is_csv(written, tmp_path, monkeypatch):
    def missing(name, extra):
        raise tables.OutputError("no")

    monkeypatch.setattr(tables, "package", missing)
    assert write_tables(written[1], tmp_path) == ["csv"]
    assert {path.suffix for path in tmp_path.iterdir()} == {".csv"}
