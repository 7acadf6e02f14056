"""The picture of a track: drawn from what is true, it shows what was filmed, whatever the track lacks."""

from __future__ import annotations

from dataclasses import replace

import cv2
import h5py
import numpy as np
import pytest
import torch
from conftest import REPO
from demo_figure import demo_figure
from matplotlib.figure import Figure

from sphereorient.bench import score_track
from sphereorient.errors import ExperimentError
from sphereorient.experiment import Experiment, load_experiment
from sphereorient.trajectory import CameraTrack, Trajectory

EXCERPT = REPO / "synthetic_data" / "excerpt"
TRUTH = EXCERPT / "truth.h5"
RADIUS_MM = 9.0
SIZE = (1320, 1045)  # 12 x 9.5 inches at 110 dots


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return load_experiment(EXCERPT / "experiment.yaml")


def true_track(experiment: Experiment, names: tuple[str, ...], first: int = 0, last: int = 40) -> Trajectory:
    """The track that a perfect tracker would write."""
    with h5py.File(TRUTH) as file:
        keys = ("time", "position", "orientation", "omega_lab")
        true = {key: file[key][first:last] for key in keys}
        centres = {name: file[name]["centre_px"][first:last] for name in names}
    track = Trajectory.empty(true["time"], cameras=names, frame_rate=600.0, method="paper", experiment="excerpt")
    seen = {}
    for name in names:
        camera = experiment.cameras[name]
        position = torch.from_numpy(true["position"])
        side = position + RADIUS_MM * camera.R_cam_lab[0]
        radius = (camera.project(side) - camera.project(position)).norm(dim=1).numpy()
        seen[name] = replace(
            CameraTrack.empty(len(true["time"])),
            centre_px=centres[name],
            radius_px=radius,
            orientation=true["orientation"],
            score=np.ones(len(true["time"])),
            reason=("ok",) * len(true["time"]),
        )
    valid = np.ones(len(true["time"]), bool)
    return replace(track, **{key: true[key] for key in keys}, valid=valid, cameras=seen)


@pytest.fixture
def kept(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Keep figures instead of writing them."""
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    return figures


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Keep figures, drawn in coarse dots: some faults show only then."""
    figures: list[Figure] = []

    def draw(figure: Figure, *_: object, **__: object) -> None:
        figure.set_dpi(20)
        figure.canvas.draw()
        figures.append(figure)

    monkeypatch.setattr(Figure, "savefig", draw)
    return figures


@pytest.mark.parametrize(
    ("names", "scored"), [(("cam1", "cam2"), True), (("cam2",), False)], ids=["two scored", "one unscored"]
)
def test_the_figure_is_a_picture_of_sensible_size(experiment, tmp_path, names, scored):
    track = true_track(experiment, names)
    path = tmp_path / "figure.png"
    demo_figure(track, experiment, path, score_track(track, TRUTH) if scored else None)
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    assert picture.shape == (SIZE[1], SIZE[0], 3)
    assert picture.std() > 20  # neither blank nor black
    assert 50e3 < path.stat().st_size < 2e6
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(("names", "scored"), [(("cam1",), True), (("cam1", "cam2"), False)], ids=["one", "two"])
def test_without_a_truth_the_last_panel_shows_the_cameras(experiment, tmp_path, kept, names, scored):
    track = true_track(experiment, names)
    demo_figure(track, experiment, tmp_path / "figure.png", score_track(track, TRUTH) if scored else None)
    label = kept[0].subfigs[1].axes[3].get_ylabel()
    assert ("error" in label) == scored


@pytest.mark.slow
def test_the_rerendered_sphere_looks_like_the_filmed_one(experiment, tmp_path, kept):
    """True orientations must give the filmed paint, in the same place and neither mirrored nor turned."""
    demo_figure(true_track(experiment, ("cam1", "cam2")), experiment, tmp_path / "figure.png")
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
def test_a_part_of_the_frames_shows_these_frames(experiment, tmp_path, kept):
    """The clock does not restart: frame 12 of the movie belongs to the first row of such a track."""
    whole, part = true_track(experiment, ("cam1",)), true_track(experiment, ("cam1",), 12, 30)
    for track in (whole, part):
        demo_figure(track, experiment, tmp_path / "figure.png")
    first = [figure.subfigs[0].subfigs[0].axes[0].images[0].get_array() for figure in kept]
    with_number_12 = replace(whole, valid=np.arange(40) == 12)
    demo_figure(with_number_12, experiment, tmp_path / "figure.png")
    again = kept[2].subfigs[0].subfigs[0].axes[0].images[0].get_array()
    np.testing.assert_array_equal(first[1], again)
    assert not np.array_equal(first[0], again)


def test_the_curves_are_the_tracks(experiment, tmp_path, kept):
    track = true_track(experiment, ("cam1", "cam2"))
    score = score_track(track, TRUTH)
    demo_figure(track, experiment, tmp_path / "figure.png", score)
    position, angles, omega, errors = kept[0].subfigs[1].axes
    for axis in range(3):
        np.testing.assert_array_equal(position.lines[axis].get_ydata(), track.position[:, axis])
        np.testing.assert_array_equal(omega.lines[axis].get_ydata(), track.omega_lab[:, axis])
    np.testing.assert_allclose(position.lines[0].get_xdata(), 1e3 * track.time)
    assert all(np.nanmax(np.abs(line.get_ydata())) <= 180 for line in angles.lines)
    np.testing.assert_array_equal(errors.lines[2].get_ydata(), score.orientation_deg)


def test_no_line_crosses_the_panel_where_an_angle_wraps(experiment, tmp_path, kept):
    track = true_track(experiment, ("cam1",))
    spin = np.deg2rad(np.arange(40) * 20.0)
    cos, sin, zero, one = np.cos(spin), np.sin(spin), np.zeros(40), np.ones(40)
    Rz = np.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], axis=1).reshape(40, 3, 3)
    demo_figure(replace(track, orientation=Rz), experiment, tmp_path / "figure.png")
    theta_z = kept[0].subfigs[1].axes[1].lines[2].get_ydata()
    assert np.nanmax(np.abs(np.diff(theta_z))) < 21
    assert np.isnan(theta_z).sum() == 2  # 780 degrees: twice across the end of the scale


def blind(track: Trajectory, name: str, frames: slice = slice(None)) -> Trajectory:
    """The same track where one camera has not found the sphere."""
    seen = track.cameras[name]
    lost = {key: getattr(seen, key).copy() for key in ("centre_px", "radius_px", "orientation", "score")}
    for values in lost.values():
        values[frames] = np.nan
    return replace(track, cameras=dict(track.cameras) | {name: replace(seen, **lost)})


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_frames_that_one_camera_lost_are_drawn(experiment, tmp_path, drawn):
    track = blind(true_track(experiment, ("cam1", "cam2")), "cam2", slice(0, 20))
    demo_figure(track, experiment, tmp_path / "figure.png")
    lost = drawn[0].subfigs[0].subfigs[1].axes[0]
    assert len(lost.images) == 1  # the whole picture, and nothing on it
    assert len(lost.lines) == 0


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("scored", [True, False])
def test_a_track_without_a_single_valid_frame_is_drawn(experiment, tmp_path, drawn, scored):
    empty = Trajectory.empty(np.arange(40) / 600.0, cameras=("cam1", "cam2"), frame_rate=600.0)
    demo_figure(empty, experiment, tmp_path / "figure.png", score_track(empty, TRUTH) if scored else None)
    assert len(drawn) == 1


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_positions_without_orientations_are_drawn(experiment, tmp_path, drawn):
    track = replace(true_track(experiment, ("cam1",)), orientation=np.full((40, 3, 3), np.nan))
    demo_figure(track, experiment, tmp_path / "figure.png")
    filmed = drawn[0].subfigs[0].subfigs[0].axes[0]
    assert len(filmed.lines) == 1  # the outline without axes


@pytest.mark.slow
def test_a_pdf_can_be_written(experiment, tmp_path):
    demo_figure(true_track(experiment, ("cam1",), 0, 4), experiment, tmp_path / "figure.pdf")
    assert (tmp_path / "figure.pdf").read_bytes().startswith(b"%PDF")


def test_an_experiment_without_a_map_is_refused(experiment, tmp_path):
    with pytest.raises(ExperimentError, match="texture"):
        demo_figure(
            true_track(experiment, ("cam1",)), experiment.with_sphere(texture_path=None), tmp_path / "figure.png"
        )
    assert not list(tmp_path.iterdir())
