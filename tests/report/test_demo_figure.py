"""The picture of a track: drawn from the truth, it shows the filmed ball, also for tracks with gaps."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from demo_figure import demo_figure
from matplotlib.figure import Figure
from overlay_examples import EXCERPT, excerpt, true_track

from sphereorient.bench import score_track
from sphereorient.errors import ExperimentError
from sphereorient.trajectory import Trajectory

TRUTH = EXCERPT / "truth.h5"
SIZE = (1320, 1045)  # 12 x 9.5 inches at 110 dots


@pytest.fixture
def kept(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Keep figures instead of writing them."""
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    return figures


@pytest.mark.parametrize(
    ("names", "scored"), [(("cam1", "cam2"), True), (("cam2",), False)], ids=["two scored", "one unscored"]
)
def test_the_figure_is_a_picture_of_sensible_size(tmp_path, names, scored):
    track = true_track(names)
    path = tmp_path / "figure.png"
    demo_figure(track, excerpt(), path, score_track(track, TRUTH) if scored else None)
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    assert picture.shape == (SIZE[1], SIZE[0], 3)
    assert picture.std() > 20  # neither blank nor black
    assert 50e3 < path.stat().st_size < 2e6
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(("names", "scored"), [(("cam1",), True), (("cam1", "cam2"), False)], ids=["one", "two"])
def test_without_a_truth_the_last_panel_shows_the_cameras(tmp_path, kept, names, scored):
    track = true_track(names)
    demo_figure(track, excerpt(), tmp_path / "figure.png", score_track(track, TRUTH) if scored else None)
    label = kept[0].subfigs[1].axes[3].get_ylabel()
    assert ("error" in label) == scored


@pytest.mark.slow
def test_the_rerendered_sphere_looks_like_the_filmed_one(tmp_path, kept):
    """True orientations must give the filmed paint, in the same place and neither mirrored nor rotated."""
    demo_figure(true_track(("cam1", "cam2")), excerpt(), tmp_path / "figure.png")
    [top, _] = kept[0].subfigs
    assert len(top.subfigs) == 2
    for beside in top.subfigs:
        filmed, rendered = np.array(beside.axes).reshape(2, -1)
        assert len(filmed) == 4
        assert [axes.get_title().endswith(" ms") for axes in filmed] == [True] * 4
        for above, below in zip(filmed, rendered, strict=True):
            outline = above.lines[0].get_xydata()
            centre, radius = (outline.max(0) + outline.min(0)) / 2, np.ptp(outline, axis=0).mean() / 2
            template = below.images[0].get_array()
            crop = cut(above.images[0].get_array(), centre, radius, template.shape[0])
            right = likeness(crop, template)
            assert right > 0.75
            assert below.images[0].get_extent()[2:] == [len(template) / 2, -len(template) / 2]  # row 0 on top,
            assert below.get_ylim()[1] < 0 < below.get_ylim()[0]  # where the axes have what is up
            assert above.get_ylim()[1] < above.get_ylim()[0]
            assert right > likeness(crop, template[:, ::-1]) + 0.2
            assert right > likeness(crop, template.T) + 0.2


def cut(picture: np.ndarray, centre: np.ndarray, radius: float, size: int) -> np.ndarray:
    at = ((np.arange(size) + 0.5) * 2 / size - 1) * radius
    u, v = np.meshgrid(centre[0] + at, centre[1] + at)
    return cv2.remap(picture.astype(np.float32), u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)


def likeness(a: np.ndarray, b: np.ndarray) -> float:
    """Correlation inside nine tenths of the disk."""
    at = (np.arange(len(a)) + 0.5) * 2 / len(a) - 1
    inside = at[:, None] ** 2 + at**2 < 0.81
    return float(np.corrcoef(a[inside], b[inside])[0, 1])


@pytest.mark.slow
def test_a_part_of_the_frames_shows_these_frames(tmp_path, kept):
    """The clock does not restart: frame 12 of the movie belongs to the first row of such a track."""
    whole, part = true_track(("cam1",)), true_track(("cam1",), 12, 30)
    for track in (whole, part):
        demo_figure(track, excerpt(), tmp_path / "figure.png")
    first = [figure.subfigs[0].subfigs[0].axes[0].images[0].get_array() for figure in kept]
    with_number_12 = replace(whole, valid=np.arange(40) == 12)
    demo_figure(with_number_12, excerpt(), tmp_path / "figure.png")
    again = kept[2].subfigs[0].subfigs[0].axes[0].images[0].get_array()
    np.testing.assert_array_equal(first[1], again)
    assert not np.array_equal(first[0], again)


def test_the_curves_are_the_tracks(tmp_path, kept):
    track = true_track(("cam1", "cam2"))
    score = score_track(track, TRUTH)
    demo_figure(track, excerpt(), tmp_path / "figure.png", score)
    position, angles, omega, errors = kept[0].subfigs[1].axes
    for axis in range(3):
        np.testing.assert_array_equal(position.lines[axis].get_ydata(), track.position[:, axis])
        np.testing.assert_array_equal(omega.lines[axis].get_ydata(), track.omega_lab[:, axis])
    np.testing.assert_allclose(position.lines[0].get_xdata(), 1e3 * track.time)
    assert all(np.nanmax(np.abs(line.get_ydata())) <= 180 for line in angles.lines)
    np.testing.assert_array_equal(errors.lines[2].get_ydata(), score.orientation_deg)


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("scored", [True, False])
def test_a_track_without_a_single_valid_frame_is_drawn(tmp_path, scored):
    empty = Trajectory.empty(np.arange(40) / 600.0, cameras=("cam1", "cam2"), frame_rate=600.0)
    demo_figure(empty, excerpt(), tmp_path / "figure.png", score_track(empty, TRUTH) if scored else None)
    assert (tmp_path / "figure.png").stat().st_size > 10_000


def test_an_experiment_without_a_map_is_refused(tmp_path):
    with pytest.raises(ExperimentError, match="texture"):
        demo_figure(true_track(("cam1",)), excerpt().with_sphere(texture_path=None), tmp_path / "figure.png")
    assert not list(tmp_path.iterdir())
