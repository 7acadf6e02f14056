import h5py
import numpy as np
import pytest
from matplotlib.figure import Figure

from sphereorient.movies import open_movie
from sphereorient.movies.survey import survey
from sphereorient.report.inputs import contact_sheet

FRAMES = 40


@pytest.fixture
def path(tmp_path):
    """Grey, bright at top left; frame 39 is black, 13 was never written."""
    frames = np.full((FRAMES, 90, 120), 60, np.uint8) + np.arange(FRAMES, dtype=np.uint8)[:, None, None]
    frames[:, :30, :40] = 250
    frames[39] = 0
    with h5py.File(tmp_path / "movie.h5", "w") as file:
        data = file.create_dataset("frames", frames.shape, np.uint8, chunks=(1, 90, 120))
        for number in range(FRAMES):
            if number != 13:
                data[number] = frames[number]
        file["time"] = 2 + np.arange(FRAMES) / 600
    return tmp_path / "movie.h5"


@pytest.fixture
def kept(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    figures: list[Figure] = []
    monkeypatch.setattr("sphereorient.report.inputs.write_figure", lambda figure, *_, **__: figures.append(figure))
    return figures


def test_frames_are_upright_with_numbers_times_and_faults(path, kept):
    movie = open_movie(path)
    contact_sheet(movie, survey(movie, count=4), path.with_suffix(".png"))
    shown = [ax for ax in kept[0].axes if ax.images]
    assert [ax.get_title() for ax in shown] == [
        "0, 2 s",
        "13, 2.02167 s: undecodable",
        "26, 2.04333 s",
        "39, 2.065 s: black",
    ]
    first = shown[0].images[0]
    assert first.get_array()[0, 0] > first.get_array()[-1, 0]
    assert first.get_array()[0, 0] > first.get_array()[0, -1]
    assert first.get_extent() == [-0.5, 119.5, 89.5, -0.5]  # row 0 on top,
    assert shown[0].get_ylim() == (89.5, -0.5)  # where the axes have what is up
    assert {ax.images[0].get_clim() for ax in shown} == {(60.0, 250.0)}  # one scale, set by the good frames
