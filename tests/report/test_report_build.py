import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import PIL.Image
import pytest
from ensembles import EnsembleSpec, draw_ensemble, filtered_track
from overlay_examples import command

from sphereorient.errors import OutputError
from sphereorient.pose.worn import CELLS, UNUSED_PAINT, worn_text
from sphereorient.report.build import check_report_folder
from sphereorient.sphere.texture_table import octahedral_directions
from sphereorient.trajectory import Trajectory

QUICK = ["--set", "statistics.resamples=100"]


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """Tracks, good ones and bad ones."""
    folder = tmp_path_factory.mktemp("report")
    whole = filtered_track(draw_ensemble(EnsembleSpec(segments=24, mean_frames=80.0), 2), 0.1, 0.05, 2)
    half = len(whole) // 2
    (folder / "a").mkdir()
    (folder / "b").mkdir()
    whole.at(np.arange(half)).save(folder / "a" / "track.h5")
    whole.at(np.arange(half, len(whole))).save(folder / "b" / "track.h5")
    draw_ensemble(EnsembleSpec(segments=24, mean_frames=80.0), 3).save(folder / "precise.h5")
    longest = np.bincount(whole.segment).argmax()
    whole.at(np.flatnonzero(whole.segment == longest)).save(folder / "one.h5")
    empty = Trajectory.empty(np.arange(90) / 600, cameras=["cam1"], frame_rate=600.0, method="precise")
    empty.save(folder / "empty.h5")
    (folder / "text.h5").write_text("no track")
    whole.save(folder / "newer.h5")
    with h5py.File(folder / "newer.h5", "r+") as file:
        file.attrs["schema"] = "sphereorient-track/9"
    with h5py.File(folder / "other.h5", "w") as file:
        file["numbers"] = np.arange(5)
    return folder


@pytest.fixture
def report(capsys, monkeypatch):
    return partial(command, monkeypatch, capsys, "report")


BAD = {
    "text.h5": "expected an HDF5 file",
    "none.h5": "got no file",
    "other.h5": "schema",
    "newer.h5": "expected sphereorient-track/1, got sphereorient-track/9",
    "empty.h5": "got no valid frame",
    "one.h5 precise.h5": "tracks of one method",
    "one.h5 one.h5": "each track once",
}


@pytest.mark.parametrize(("names", "words"), BAD.items(), ids=list(BAD))
def test_bad_input_is_one_line_and_leaves_nothing(place, report, tmp_path, names, words):
    code, _, errors = report(*(place / name for name in names.split()), "--out", tmp_path / "page", "--quiet")
    assert code == 2
    assert len(errors.strip().splitlines()) == 1
    assert words in errors
    assert not list(tmp_path.iterdir())


def test_a_folder_with_other_things_in_it_is_left_alone(place, report, tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    code, _, errors = report(place / "precise.h5", "--out", tmp_path, "--quiet", *QUICK)
    assert code == 2
    assert "an older report only" in errors
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_file_in_place_of_a_folder_is_refused_before_any_work(place, report, tmp_path):
    code, _, errors = report(place / "precise.h5", "--out", place / "precise.h5" / "page")
    assert code == 2
    assert "a folder to write in" in errors


@pytest.mark.slow
def test_one_segment_has_a_page_and_a_line_on_what_is_missing(place, report, tmp_path):
    code, out, errors = report(place / "one.h5", "--out", tmp_path / "page", "--quiet")
    assert code == 0
    assert out == ""
    (line,) = [line for line in errors.splitlines() if line.startswith("Segments")]
    assert "no intervals" in line
    page = (tmp_path / "page" / "index.html").read_text()
    assert "figure-track" in page
    assert "figure-densities" not in page


@pytest.mark.slow
def test_paint_that_was_not_used_is_drawn(place, report, tmp_path):
    worn = octahedral_directions(CELLS)[:, 2] > 0.5
    track = Trajectory.load(place / "one.h5")
    replace(track, provenance={**track.provenance, UNUSED_PAINT: worn_text(worn)}).save(tmp_path / "worn.h5")
    code, _, _ = report(tmp_path / "worn.h5", "--out", tmp_path / "page", "--quiet")
    assert code == 0
    assert (tmp_path / "page" / "figures" / "unused_paint_1.png").stat().st_size > 2000
    assert "figure-unused_paint_1" in (tmp_path / "page" / "index.html").read_text()


@pytest.mark.slow
def test_many_tracks_make_one_page_that_needs_nothing_beside_it(place, report, tmp_path):
    out = tmp_path / "page"
    code, printed, _ = report(place / "a/track.h5", place / "b/track.h5", "--out", out, *QUICK)
    assert code == 0
    assert printed.rstrip().endswith(f"Wrote {out / 'index.html'}")
    page = (out / "index.html").read_text()
    assert "a/track.h5" in page
    assert "b/track.h5" in page
    assert not re.findall(r"""(?:src|href)\s*=\s*["'](?!data:|#|tables/)""", page)
    assert not re.findall(r"@import|url\((?!data:)", page)
    drawn = {path.stem for path in (out / "figures").iterdir()}
    assert "2 tracks compared" in page
    widths = {name: int(px) for name, px in re.findall(r'id="figure-(\w+)" style="width:(\d+)px"', page)}
    scales = {PIL.Image.open(out / "figures" / f"{name}.png").width / px for name, px in widths.items()}
    assert max(scales) - min(scales) < 0.01  # text of one size
    assert re.findall(r"<b>([^<]* of the paper\))", page) == [
        "Track of b/track.h5 (Figure 7 of the paper)",
        "Angles (Figure 10 of the paper)",
        "PDFs (Figures 11 and 12 of the paper)",
        "Increments (Figure 11 of the paper)",
        "Durations (Figure 9 of the paper)",
    ]
    assert {"track", "densities", "increments", "durations", "correlations", "angles", "isotropy"} <= drawn
    files = [out / "figures" / f"{name}.{suffix}" for name in drawn for suffix in ("png", "pdf")]
    assert all(path.stat().st_size > 2000 for path in files)
    links = re.findall(r'href="(tables/[^"]+)"', page)
    assert len(links) >= 2 * 12
    assert all((out / link).is_file() for link in links)
    assert {path.name for path in out.iterdir()} == {"index.html", "figures", "tables"}
    assert [path.name for path in tmp_path.iterdir()] == ["page"]


@pytest.mark.slow
def test_a_report_is_replaced_by_the_next_one(place, report, tmp_path):
    out = tmp_path / "page"
    assert report(place / "a/track.h5", "--out", out, *QUICK, "--quiet")[0] == 0
    assert (out / "figures" / "densities.png").exists()
    assert report(place / "one.h5", "--out", out, "--quiet")[0] == 0
    assert not (out / "figures" / "densities.png").exists()
    assert "one.h5" in (out / "index.html").read_text()


@pytest.mark.slow
def test_same_tracks_same_numbers_and_same_pictures(place, report, tmp_path):
    for name in ("first", "second"):
        assert report(place / "a/track.h5", "--out", tmp_path / name, *QUICK, "--quiet")[0] == 0
    files = sorted(path.relative_to(tmp_path / "first") for path in (tmp_path / "first").rglob("*.*"))
    for path in files:
        if path.name != "index.html":  # which holds its date
            assert (tmp_path / "first" / path).read_bytes() == (tmp_path / "second" / path).read_bytes(), path


@pytest.mark.slow
def test_settings_of_the_statistics_are_obeyed_and_shown(place, report, tmp_path):
    changed = [*QUICK, "--set", "statistics.min_frames=70", "-q"]
    assert report(place / "a/track.h5", "--out", tmp_path / "page", *changed)[0] == 0
    page = (tmp_path / "page" / "index.html").read_text()
    assert "min_frames: 70" in page
    rows = (tmp_path / "page" / "tables" / "segments.csv").read_text().splitlines()[1:]
    assert rows
    assert all(int(row.rsplit(",", 1)[1]) >= 50 for row in rows)


def test_an_experiment_of_another_name_is_refused(place, report, tmp_path):
    excerpt = Path(__file__).parents[2] / "synthetic_data" / "excerpt" / "experiment.yaml"
    tracks = [place / "a/track.h5", place / "b/track.h5"]
    code, _, errors = report(*tracks, "--experiment", excerpt, "--out", tmp_path / "page", "-q")
    assert code == 2
    assert "the experiment.yaml that the track was measured from" in errors


@pytest.mark.slow
def test_half_a_report_never_stands_under_its_name(place, report, tmp_path, monkeypatch):
    from sphereorient.report import build

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(build, "write_figure", full)
    code, _, errors = report(place / "a/track.h5", "--out", tmp_path / "page", *QUICK, "--quiet")
    assert code == 2
    assert "No space left on device" in errors
    assert not list(tmp_path.iterdir())


def test_names_of_tracks_are_as_short_as_they_can_be(place):
    from sphereorient.cli.show import load_tracks

    names = load_tracks([place / "a/track.h5", place / "b/track.h5", place / "precise.h5"], None)
    assert list(names) == ["a/track.h5", "b/track.h5", "precise.h5"]
    assert replace(names["precise.h5"]).method == "precise"


@pytest.mark.parametrize(
    "name", ["notes.txt", "tables/mine.txt", "figures/a.txt", "tables/mine.csv", "figures/own.png", "figures/own.pdf"]
)
def test_a_file_of_the_users_in_a_report_stays(tmp_path, name):
    """Before: only the names in the folder itself were looked at, then those with other endings than a report's."""
    out = tmp_path / "report"
    (out / name).parent.mkdir(parents=True)
    page = '<!doctype html>\n<meta name="generator" content="made by sphereorient">\n'
    (out / "index.html").write_text(page + '<a href="tables/moments.csv">csv</a> figures/track.png, .pdf')
    for made in ("tables/moments.csv", "figures/track.png", "figures/track.pdf"):
        (out / made).parent.mkdir(exist_ok=True)
        (out / made).write_text("of the report")
    check_report_folder(out)
    (out / name).write_text("mine")
    with pytest.raises(OutputError, match="got other files in it"):
        check_report_folder(out)
    (out / name).unlink()
    (out / "index.html").write_text("<!doctype html>\n<p>my own page</p>")
    with pytest.raises(OutputError, match="got other files in it"):
        check_report_folder(out)
