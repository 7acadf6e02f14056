"""The figures of section IV: planted values are drawn, in the units of the labels."""

import re
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from conftest import slow
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy import stats
from scipy.spatial.transform import Rotation

from sphereorient.errors import OutputError, TrackError
from sphereorient.report import plots
from sphereorient.report.plots import style
from sphereorient.report.plots.style import interval_text
from sphereorient.report.plots.track import shown_part
from sphereorient.statistics import Interval, Moments, Summary
from sphereorient.statistics.cameras import CameraDistance, camera_distances
from sphereorient.statistics.density import Density, StretchedFit, density_of
from sphereorient.statistics.isotropy import EulerDensity, Isotropy, Uniformity
from sphereorient.statistics.lags import Correlation, Increments
from sphereorient.statistics.noise import WidthCurve
from sphereorient.statistics.segments import UNITS, durations
from sphereorient.trajectory import CameraTrack, Trajectory

RATE_HZ = 500.0
RATES = ("velocity", "omega_lab", "acceleration", "alpha_lab")  # in the order of the panels
UNITS_OF_LABELS = (
    "mm|m/s|m/s²|rad/s|rad/s²|degrees|ms|s|%|–|1/degree|standard deviations|1/standard deviation|number in a bin"
)
UNIT = rf"\(({UNITS_OF_LABELS})\)$"


def interval(value: object, below: float = 0.1, above: float = 0.2) -> Interval:
    """Values with intervals that are not symmetrical."""
    x = np.asarray(value, np.float64)
    return Interval(value=x, low=x - below, high=x + above, error=np.full_like(x, (below + above) / 2))


def planted_track(frames: int = 60, cameras: tuple[str, ...] = ("a", "b")) -> Trajectory:
    """A sphere that moves along x, falls along z and rotates about z by 20 degrees a frame."""
    time = np.arange(frames) / RATE_HZ
    position = np.stack([100 * time, np.zeros(frames), -50 * time**2], axis=1)
    R = Rotation.from_euler("z", 20.0 * np.arange(frames)[:, None], degrees=True).as_matrix()
    rates = {name: np.stack([k + time, 0 * time, k - time], axis=1) for k, name in enumerate(RATES, 1)}
    sigmas = {f"{name}_sigma": np.tile([0.1, 0.2, 0.3], (frames, 1)) for name in RATES}
    seen = {name: replace(CameraTrack.empty(frames), orientation=R) for name in cameras}
    return replace(
        Trajectory.empty(time, cameras=cameras, frame_rate=RATE_HZ, method="precise"),
        valid=np.ones(frames, dtype=bool),
        segment=np.zeros(frames, dtype=np.int64),
        position=position + 1.0,
        position_smooth=position,
        position_smooth_cov=np.tile(np.diag([1.0, 4.0, 9.0]), (frames, 1, 1)),
        orientation=R,
        orientation_smooth=R,
        orientation_smooth_cov=np.tile(np.deg2rad(1.0) ** 2 * np.diag([1.0, 4.0, 9.0]), (frames, 1, 1)),
        cameras=seen,
        **rates,
        **sigmas,
    )


def blank_track(frames: int, cameras: tuple[str, ...] = ()) -> Trajectory:
    return Trajectory.empty(np.arange(frames) / RATE_HZ, cameras=cameras, frame_rate=RATE_HZ)


def planted_density(a: float = 0.5, counts: object = (0, 3, 9, 4, 0)) -> Density:
    counts = np.asarray(counts)
    edges = np.linspace(-5, 5, len(counts) + 1)
    pdf = counts / counts.sum() / (edges[1] - edges[0])
    bounds = Interval(value=pdf, low=0.5 * pdf, high=1.5 * pdf, error=0.2 * pdf)
    flatness = interval(1.8 * np.exp(4 * a**2))
    fit = StretchedFit(a=interval(a, 0.01, 0.02), flatness=flatness, log_likelihood=0.0, log_likelihood_gaussian=0.0)
    return Density(edges=edges, pdf=bounds, counts=counts, fit=fit)


def planted_moments(quantity: str, share: tuple[float, ...] = (0.002, 0.03, 0.4), flatness: float = 5.0) -> Moments:
    four = {name: interval(np.full(4, 1.0)) for name in ("mean", "skewness", "corrected_rms", "corrected_flatness")}
    noise = np.array([*share, np.nan])
    return Moments(
        quantity=quantity,
        units=UNITS[quantity],
        **four,
        rms=interval([1.0, 2.0, 3.0, 4.0]),
        flatness=interval(np.full(4, flatness)),
        noise_share=Interval(value=noise, low=0.5 * noise, high=2 * noise, error=0.2 * noise),
        samples=1000,
        segments=10,
    )


def planted_correlation(
    quantity: str = "velocity", reached: tuple[bool, ...] = (True, False, True, True)
) -> Correlation:
    lag_s = np.arange(11) * 0.002
    curves = np.stack([np.cos(lag_s * w) for w in (160.0, 60.0, 180.0, 200.0)], axis=1)
    return Correlation(
        quantity=quantity,
        lag_s=lag_s,
        value=interval(curves),
        pairs=np.full(11, 100),
        integral_time_s=interval([0.004, 0.005, 0.006, 0.007], 0.0005, 0.001),
        reached_zero=np.array(reached),
    )


def planted_widths(quantity: str = "acceleration") -> WidthCurve:
    width_s = np.array([0.001, 0.002, 0.004])
    level = np.array([[3.0, 4.0, 5.0]])
    return WidthCurve(
        quantity=quantity,
        width_s=width_s,
        rms=interval(level + 1 / np.array([[1.0], [2.0], [4.0]])),
        flatness=interval(np.full((3, 3), 6.0)),
        corrected_rms=interval(np.repeat(level, 3, axis=0)),
        corrected_flatness=interval(np.full((3, 3), 7.0)),
        noise_share=interval(np.array([[0.5], [0.2], [0.1]]) * np.array([[1.0, 0.9, 0.8]]), 0.01, 0.02),
    )


def planted_isotropies() -> dict[str, Isotropy]:
    shares = {"velocity": (0.2, 0.3, 0.5), "omega_body": (0.33, 0.34, 0.33)}
    p_values = {"velocity": 0.0001, "omega_body": 0.62}
    return {
        name: Isotropy(
            quantity=name,
            variance_share=interval(share, 0.02, 0.03),
            cross_correlation=interval(np.zeros(3)),
            p_value=p_values[name],
        )
        for name, share in shares.items()
    }


def planted_angles() -> list[EulerDensity]:
    """Uniform attitudes: 1 / 2 pi, cos(theta_y) / 2, 1 / 2 pi."""
    out = []
    for i, name in enumerate(("theta_x", "theta_y", "theta_z")):
        half = np.pi / 2 if i == 1 else np.pi
        edges = np.linspace(-half, half, 13)
        law = np.diff(np.sin(edges)) / 2 / (edges[1] - edges[0]) if i == 1 else np.full(12, 1 / (2 * np.pi))
        out.append(EulerDensity(name=name, edges_rad=edges, pdf=interval(1.1 * law, 0.02, 0.03), uniform=law))
    return out


def uniformity(p_value: float) -> Uniformity:
    return Uniformity(statistic=30.0, p_value=p_value, samples=12_345, effective=210.4, segments=77)


def planted_distance(rough: bool = True) -> CameraDistance:
    rng = np.random.default_rng(3)
    near, far = (np.deg2rad(rng.rayleigh(s, 4000)) for s in (1.0, 3.0))
    edges = np.linspace(0, max(near.max(), far.max()), 41)
    pdfs = [np.histogram(x, edges)[0] / len(x) / np.diff(edges) for x in (near, far)]
    return CameraDistance(
        cameras=("left", "right"),
        distance_rad=near,
        edges_rad=edges,
        pdf=pdfs[0],
        uncorrected_rad=far if rough else None,
        uncorrected_pdf=pdfs[1] if rough else None,
    )


def planted_increments() -> SimpleNamespace:
    """The part of `Distributions` that the figure reads."""
    frames = np.array([1, 5, 20])
    flat = np.stack([[9.0, 6.0, 4.0], [8.0, 5.5, 3.5], [7.0, 5.0, 3.2], [8.5, 5.6, 3.6]], axis=1)
    steps = Increments(
        lag_s=frames / RATE_HZ,
        lag_frames=frames,
        rms=interval(np.ones((3, 4))),
        flatness=interval(flat),
        pairs=np.full(3, 50),
    )
    shown = {20: planted_density(counts=(1, 5, 9, 5, 1)), 1: planted_density(counts=(0, 2, 9, 2, 0))}
    return SimpleNamespace(increments=steps, increment_densities=shown)


def summary_of(densities: dict[str, tuple[Density, ...]] | None) -> Summary:
    """The part of `Summary` that the figure of the densities reads."""
    more = None if densities is None else SimpleNamespace(densities=densities)
    return SimpleNamespace(distributions=more, ensemble=SimpleNamespace(segments=1))  # type: ignore[return-value]


def all_densities() -> dict[str, tuple[Density, ...]]:
    return {name: tuple(planted_density(a) for a in (0.3, 0.6, 0.9)) for name in UNITS}


TABLE = {name: planted_moments(name, flatness=f) for name, f in zip(UNITS, (3, 3, 4, 4, 8, 8), strict=True)}
SPANS = np.random.default_rng(8).exponential(0.3, 500) + 0.1
FIGURES: dict[str, Callable[[], Figure]] = {
    "track": lambda: plots.track_figure(planted_track()),
    "path": lambda: plots.path_figure(planted_track()),
    "cameras": lambda: plots.camera_distance_figure([planted_distance()]),
    "densities": lambda: plots.densities_figure(summary_of(all_densities())),
    "increments": lambda: plots.increments_figure(planted_increments(), TABLE),
    "durations": lambda: plots.durations_figure(durations(SPANS, 0.1)),
    "angles": lambda: plots.angles_figure(planted_angles(), uniformity(0.4)),
    "correlations": lambda: plots.correlations_figure({q: planted_correlation(q) for q in RATES}),
    "widths": lambda: plots.widths_figure({q: planted_widths(q) for q in ("velocity", "acceleration", "alpha_lab")}),
    "isotropy": lambda: plots.isotropy_figure(planted_isotropies()),
    "noise": lambda: plots.noise_figure(TABLE),
}
every_figure = pytest.mark.parametrize("name", FIGURES)


def named(axes: Axes, start: str) -> Line2D:
    """The one line whose label begins so."""
    [line] = [line for line in axes.lines if str(line.get_label()).startswith(start)]
    return line


def bars(axes: Axes) -> np.ndarray:
    """Ends (K, 2, 2) of all vertical bars, in the order of drawing."""
    parts = [c.get_segments() for c in axes.collections if isinstance(c, LineCollection)]
    return np.array([segment for part in parts for segment in part])


def legend_texts(figure: Figure) -> list[str]:
    legends = [*figure.legends, *(axes.get_legend() for axes in figure.axes)]
    return [text.get_text() for legend in legends if legend for text in legend.get_texts()]


def note_of(figure: Figure) -> str:
    return " ".join(figure.get_supxlabel().split())


@every_figure
def test_every_axis_names_its_unit(name):
    figure = FIGURES[name]()
    assert figure.axes
    for axes in figure.axes:
        labels = [axes.get_ylabel(), axes.get_zlabel()] if axes.name == "3d" else [axes.get_ylabel()]
        shares_y = axes.get_subplotspec().colspan.start > 0 and name == "angles"
        for label in [] if shares_y else labels:
            assert re.search(UNIT, label), label
        inner = name in ("track", "densities", "widths") and not axes.get_subplotspec().is_last_row()
        if not inner:
            assert re.search(UNIT, axes.get_xlabel()), axes.get_xlabel()


@every_figure
def test_legends_cover_no_data_and_leave_the_page_nowhere(name):
    figure = FIGURES[name]()
    figure.canvas.draw()
    renderer = figure.canvas.get_renderer()
    legends = [legend for legend in [*figure.legends, *(axes.get_legend() for axes in figure.axes)] if legend]
    assert legends
    boxes = [legend.get_window_extent(renderer) for legend in legends]
    words = figure.findobj(lambda artist: artist is getattr(figure, "_supxlabel", None))
    boxes += [text.get_window_extent(renderer) for text in words]
    for box in boxes:
        assert box.x0 > -1
        assert box.y0 > -1
        assert box.x1 < figure.bbox.x1 + 1
        assert box.y1 < figure.bbox.y1 + 1
        for axes in figure.axes:
            area = axes.get_window_extent(renderer)
            if axes.name != "3d":  # whose window is far larger than its box
                assert (
                    min(box.x1, area.x1) - max(box.x0, area.x0) < 1 or min(box.y1, area.y1) - max(box.y0, area.y0) < 1
                )
    for one, other in combinations(boxes, 2):
        assert not one.overlaps(other)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["densities", *(slow(name) for name in FIGURES if name != "densities")])
def test_the_same_input_gives_the_same_bytes_with_any_style_of_the_user(name, tmp_path):
    first = plots.write_figure(FIGURES[name](), tmp_path / "first.one")
    with matplotlib.rc_context({"font.size": 20, "lines.linewidth": 7, "axes.facecolor": "yellow", "pdf.fonttype": 3}):
        again = plots.write_figure(FIGURES[name](), tmp_path / "again")
        assert matplotlib.rcParams["font.size"] == 20  # it is still the user's afterwards
    assert [path.name for path in first] == ["first.one.png", "first.one.pdf"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(p.name for p in (*first, *again))
    for one, other in zip(first, again, strict=True):
        assert one.read_bytes() == other.read_bytes()
    assert first[0].read_bytes().startswith(b"\x89PNG")
    pdf = first[1].read_bytes()
    assert pdf.startswith(b"%PDF")
    assert b"/FontFile2" in pdf  # TrueType, embedded
    assert b"/Type3" not in pdf
    assert b"CreationDate" not in pdf


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "none").touch()
    with pytest.raises(OutputError, match=r"figure\.png"):
        plots.write_figure(FIGURES["noise"](), tmp_path / "none" / "figure")


@every_figure
def test_a_component_has_its_colour_in_every_figure(name):
    """Orange, green, blue and black, also for colour-blind readers."""
    colours = {"x": "#d55e00", "y": "#009e73", "z": "#0072b2", "all": "#000000"}
    figure = FIGURES[name]()
    artists = [line for axes in figure.axes for line in axes.lines]
    artists += [handle for legend in figure.legends for handle in legend.legend_handles]
    artists += [h for axes in figure.axes if axes.get_legend() for h in axes.get_legend().legend_handles]
    labelled = [(str(artist.get_label()), artist) for artist in artists]
    labelled += [(box.get_label(), box.patches[0]) for axes in figure.axes for box in axes.containers]
    found = set()
    for label, artist in labelled:
        words = re.match(r"(?:body axis )?(x|y|z|all)(?:$|:|,)", label) or re.match(r"theta_(x|y|z)$", label)
        if words:
            colour = artist.get_color() if isinstance(artist, Line2D) else artist.get_facecolor()
            assert to_hex(colour) == colours[words[1]], label
            found.add(words[1])
    assert found >= {"x", "y", "z"} or name in ("cameras", "durations")


def test_looks_differ_in_grey_print_too():
    looks = (*style.COMPONENTS, style.ALL, style.SECOND)
    for one, other in combinations(looks, 2):
        grey = [np.dot(to_rgb(look.colour), (0.299, 0.587, 0.114)) for look in (one, other)]
        assert one.marker != other.marker
        assert one.line != other.line or abs(grey[0] - grey[1]) > 0.3
    assert len({look.hatch for look in style.COMPONENTS}) == 3


def test_the_track_is_drawn_in_the_units_of_its_labels():
    track = planted_track()
    figure = plots.track_figure(track)
    for i, name in enumerate("xyz"):
        line = named(figure.axes[0], name)
        np.testing.assert_allclose(line.get_xdata(), 1e3 * track.time)
        np.testing.assert_array_equal(line.get_ydata(), track.position_smooth[:, i])
    for axes, name, label in zip(figure.axes[2:], RATES, ("velocity", "ω", "acceleration", "α"), strict=True):
        assert axes.get_ylabel().startswith(label)
        for i, component in enumerate("xyz"):
            np.testing.assert_array_equal(named(axes, component).get_ydata(), getattr(track, name)[:, i])
    assert [axes.get_xlabel() for axes in figure.axes[4:]] == ["time (ms)"] * 2


def test_bands_are_two_standard_deviations_wide():
    figure = plots.track_figure(planted_track())
    for axes, halves in zip(figure.axes[2:], [(0.2, 0.4, 0.6)] * 4, strict=True):
        for line, area, half in zip("xyz", axes.collections, halves, strict=False):
            y = named(axes, line).get_ydata()
            drawn = area.get_paths()[0].vertices[:, 1]
            assert drawn.min() == pytest.approx(y.min() - half)
            assert drawn.max() == pytest.approx(y.max() + half)
    widths = [np.ptp(area.get_paths()[0].vertices[:, 1]) for area in figure.axes[0].collections[:2]]
    assert widths[1] == pytest.approx(2 * 2 * 2.0)  # y rests: 4 standard deviations of 2 mm


def test_measurements_are_dots():
    track = planted_track()
    axes = plots.track_figure(track).axes[0]
    dots = [line for line in axes.lines if line.get_marker() == "."]
    np.testing.assert_array_equal(np.stack([line.get_ydata() for line in dots], axis=1), track.position)
    assert all(line.get_alpha() < 0.5 and line.get_linestyle() == "None" for line in dots)


def test_angles_are_in_degrees_with_their_own_sign_and_cut_where_they_wrap():
    axes = plots.track_figure(planted_track()).axes[1]
    x, y, z = (np.asarray(named(axes, name).get_ydata()) for name in "xyz")
    assert z[1] == pytest.approx(20.0)  # about +z, against the clock
    assert np.nanmax(np.abs(np.diff(z))) == pytest.approx(20.0)
    assert np.isnan(z).sum() == 3  # 1180 degrees: three times across the end of the scale
    assert len(z) == 60 + 3  # and no frame is lost by it
    np.testing.assert_allclose([x, y], 0.0, atol=1e-9)


def test_the_scale_of_angles_is_that_of_the_motion_and_the_whole_circle_where_they_go_round():
    rocks = Rotation.from_rotvec(np.deg2rad(3.0) * np.sin(np.arange(60) / 5)[:, None] * [1.0, 0.0, 0.0]).as_matrix()
    small = replace(planted_track(), orientation=rocks, orientation_smooth=rocks)
    low, high = plots.track_figure(small).axes[1].get_ylim()
    assert -10 < low < -3 < 3 < high < 10
    assert plots.track_figure(planted_track()).axes[1].get_ylim() == (-185, 185)


def test_bands_of_angles_agree_with_drawn_orientations():
    """Oracle: errors of the orientation in lab components, drawn and converted to angles one by one."""
    theta_deg, cov = np.array([40.0, 50.0, -70.0]), np.deg2rad(0.2) ** 2 * np.diag([1.0, 9.0, 4.0])
    cov[0, 2] = cov[2, 0] = np.deg2rad(0.2) ** 2 * 1.5
    R = Rotation.from_euler("XYZ", theta_deg, degrees=True)  # Rx Ry Rz
    frames = 5
    track = replace(
        planted_track(frames),
        orientation_smooth=np.tile(R.as_matrix(), (frames, 1, 1)),
        orientation_smooth_cov=np.tile(cov, (frames, 1, 1)),
    )
    axes = plots.track_figure(track).axes[1]
    errors = Rotation.from_rotvec(np.random.default_rng(1).multivariate_normal(np.zeros(3), cov, 40_000))
    expected = (errors * R).as_euler("XYZ", degrees=True).std(0)
    for i, area in enumerate(axes.collections[:3]):
        drawn = area.get_paths()[0].vertices[:, 1]
        assert named(axes, "xyz"[i]).get_ydata()[0] == pytest.approx(theta_deg[i])
        assert np.ptp(drawn) / 4 == pytest.approx(expected[i], rel=0.02)


def test_gaps_are_open_in_every_panel():
    """Frames 10 to 14 have no values; 30 to 39 are not in the track at all; at 50 another segment begins."""
    track = planted_track()
    lost = slice(10, 15)
    names = ("position", "position_smooth", "orientation", "orientation_smooth", *RATES)
    values = {name: getattr(track, name).copy() for name in names}
    for one in values.values():
        one[lost] = np.nan
    segment = np.where(np.arange(60) < 50, 0, 1)
    track = replace(track, segment=segment, **values).at(np.delete(np.arange(60), np.arange(30, 40)))
    for axes in plots.track_figure(track).axes:
        for name in "xyz":
            line = named(axes, name)
            y = np.asarray(line.get_ydata())
            runs = np.diff(np.concatenate([[0], np.isfinite(y), [0]]).astype(int))
            starts = np.rint(np.asarray(line.get_xdata())[np.flatnonzero(runs == 1)] * RATE_HZ / 1e3).astype(int)
            assert {0, 15, 40, 50} <= set(starts.tolist())
            ends = np.rint(np.asarray(line.get_xdata())[np.flatnonzero(runs == -1) - 1] * RATE_HZ / 1e3).astype(int)
            assert {9, 29, 49, 59} <= set(ends.tolist())


def test_frames_that_are_not_valid_are_shaded():
    valid = np.ones(60, dtype=bool)
    valid[20:30] = valid[59] = False
    figure = plots.track_figure(replace(planted_track(), valid=valid))
    for axes in figure.axes:
        [shade] = [c for c in axes.collections if c.get_label() == "not valid"]
        spans = [(path.vertices[:, 0].min(), path.vertices[:, 0].max()) for path in shade.get_paths()]
        np.testing.assert_allclose(spans, [(39.0, 59.0), (117.0, 119.0)])  # ms, half a step to either side
    assert not [c for c in plots.track_figure(planted_track()).axes[0].collections if c.get_label() == "not valid"]


def test_the_best_part_of_the_longest_segment_of_a_long_track_is_shown_and_named():
    """Segments of 1000, 5000 and 3000 frames; of the longest, all but frames 3500 to 5499 are half lost."""
    track = planted_track(9000, cameras=())
    segment = np.repeat([0, 1, 2], [1000, 5000, 3000])
    valid = np.arange(9000) % 2 == 0
    valid[3500:5500] = True
    valid[6000:] = True
    track = replace(track, segment=segment, valid=valid)
    figure = plots.track_figure(track)
    line = named(figure.axes[0], "x")
    np.testing.assert_allclose(line.get_xdata(), track.time[3500:5500])
    assert figure.axes[4].get_xlabel() == "time (s)"
    assert note_of(figure) == "shown: frames 3,500 to 5,499 of 9,000, the best 2,000 frames of the longest segment"
    assert "3,500 to 5,499" in note_of(plots.path_figure(track))
    assert plots.track_figure(planted_track(2000)).get_supxlabel() == ""


def test_a_part_of_many_short_segments_is_a_whole_segment():
    segment = np.repeat([0, 1, -1, 2], [900, 1000, 500, 600])
    part = shown_part(replace(planted_track(3000, cameras=()), segment=segment))
    np.testing.assert_allclose(part.track.time, np.arange(900, 1900) / RATE_HZ)
    assert part.words.endswith("the longest segment")


def test_wide_errors_at_the_ends_do_not_flatten_the_curve():
    track = planted_track()
    sigma = track.alpha_lab_sigma.copy()
    sigma[-1] = 1e4
    axes = plots.track_figure(replace(track, alpha_lab_sigma=sigma)).axes[5]
    assert np.ptp(axes.get_ylim()) < 4 * np.ptp(track.alpha_lab)


def test_the_path_is_to_scale_and_the_tripods_are_the_columns_of_the_orientation():
    track = planted_track()
    [axes] = plots.path_figure(track).axes
    limits = np.array([np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim()), np.ptp(axes.get_zlim())])
    np.testing.assert_allclose(limits / axes._box_aspect, (limits / axes._box_aspect)[0])
    np.testing.assert_array_equal(np.array(named(axes, "path").get_data_3d()).T, track.position_smooth)
    np.testing.assert_array_equal(np.ravel(named(axes, "start").get_data_3d()), track.position_smooth[0])
    for i, name in enumerate("xyz"):
        arms = np.array(named(axes, f"body axis {name}").get_data_3d()).T.reshape(-1, 3, 3)[:, :2]
        arrows = arms[:, 1] - arms[:, 0]
        at = [int(np.flatnonzero((track.position_smooth == start).all(1))[0]) for start in arms[:, 0]]
        assert len(at) > 8
        size = np.linalg.norm(arrows, axis=1, keepdims=True)
        np.testing.assert_allclose(arrows / size, track.orientation_smooth[at][:, :, i], atol=1e-9)
        box = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
        assert (arms >= box[:, 0] - 1e-9).all()
        assert (arms <= box[:, 1] + 1e-9).all()


@pytest.mark.parametrize("outlier_deg", [0.0, 170.0], ids=["even bins", "with an outlier"])
def test_distances_are_in_degrees_and_their_density_is_one_in_all(outlier_deg):
    distance = planted_distance()
    if outlier_deg:
        far = np.append(distance.distance_rad, np.deg2rad(outlier_deg))
        distance = replace(distance, distance_rad=far, edges_rad=np.linspace(0, far.max(), 41))
    figure = plots.camera_distance_figure([distance])
    [axes] = figure.axes
    shown = {}
    for patch in axes.patches:
        values, edges, _ = patch.get_data()
        shown[patch.get_linestyle()] = (values, edges)
        assert np.nansum(values * np.diff(edges)) == pytest.approx(1.0, abs=0.002)
        assert edges[-1] == pytest.approx(max(np.rad2deg(distance.edges_rad[-1]), outlier_deg))
    assert len(shown) == 2
    medians = [line.get_xdata()[0] for line in axes.lines]
    np.testing.assert_allclose(medians, np.sqrt(np.log(4)) * np.array([1.0, 3.0]), rtol=0.04)  # Rayleigh's
    assert [line.get_linestyle() for line in axes.lines] == ["-", "--"]
    for text, median, what in zip(legend_texts(figure), medians, ("corrected", "not corrected"), strict=True):
        assert f"median {median:.2g}°" in text
        assert what in text
    assert axes.get_xscale() == ("log" if outlier_deg else "linear")
    if outlier_deg:  # the near ones do not all fall into one bin
        values, edges = next(iter(shown.values()))
        assert np.nanmax(values * np.diff(edges)) < 0.3


def test_every_pair_of_cameras_has_a_panel_without_a_note_on_perspective_where_nothing_is_compared():
    distance = planted_distance(rough=False)
    figure = plots.camera_distance_figure([distance, replace(distance, cameras=("left", "top"))])
    assert legend_texts(figure)[0].startswith("distance: median 1.2° of 4,000 frames")
    assert [axes.get_legend().get_title().get_text() for axes in figure.axes] == ["left and right", "left and top"]


def test_the_density_of_a_gaussian_lies_on_the_dashed_line():
    rng = np.random.default_rng(4)
    segment = np.repeat(np.arange(100), 2000)
    gaussian = density_of(3.0 * rng.standard_normal(len(segment)) + 1.0, segment, 100)
    figure = plots.densities_figure(summary_of({"velocity": (gaussian,) * 3}), ["velocity"])
    [axes] = figure.axes
    law = named(axes, "_gaussian")
    assert law.get_linestyle() == "--"
    np.testing.assert_allclose(law.get_ydata(), stats.norm.pdf(law.get_xdata()), rtol=1e-12)
    markers = next(line for line in axes.lines if line.get_marker() == "o")
    x, y = markers.get_data()
    near = np.abs(x) < 3
    assert near.sum() > 15
    np.testing.assert_allclose(y[near], np.interp(x[near], *law.get_data()), rtol=0.12)
    ends = bars(axes)[: len(x)]
    np.testing.assert_allclose(ends[:, 0, 0], x)
    held = (ends[:, 0, 1] <= stats.norm.pdf(x)) & (stats.norm.pdf(x) <= ends[:, 1, 1])
    assert held[near].mean() > 0.8
    assert axes.get_yscale() == "log"


def test_bins_without_counts_are_not_drawn_and_bars_are_the_intervals():
    density = planted_density()
    [axes] = plots.densities_figure(summary_of({"alpha_lab": (density,) * 3}), ["alpha_lab"]).axes
    markers = [line for line in axes.lines if line.get_marker() in "os^"]
    assert [line.get_marker() for line in markers] == ["o", "s", "^"]
    np.testing.assert_allclose(markers[0].get_xdata(), [-2.0, 0.0, 2.0])
    np.testing.assert_allclose(markers[0].get_ydata(), np.array([3, 9, 4]) / 16 / 2)
    np.testing.assert_allclose(bars(axes)[:3, :, 1], np.outer(np.array([3, 9, 4]) / 32, (0.5, 1.5)))


def test_each_component_has_its_own_fit_named_in_the_legend():
    figure = plots.densities_figure(summary_of(all_densities()), ["velocity", "alpha_body"])
    for axes, symbol in zip(figure.axes, ("v", "α body"), strict=True):
        assert axes.get_ylabel() == f"PDF of {symbol} (1/standard deviation)"
        for name, a, F in (("x", 0.3, "2.58"), ("y", 0.6, "7.60"), ("z", 0.9, "46.0")):
            curve = named(axes, f"{name}: a = ")
            assert curve.get_label() == f"{name}: a = {a:.3f} ({a - 0.01:.3f} to {a + 0.02:.3f}), F = {F}"
            at_zero = curve.get_ydata()[len(curve.get_ydata()) // 2]
            # a uniform number on +-sqrt(3) s, s log-normal with <s^2> = 1: at 0 the density is <1/s> / (2 sqrt 3)
            assert at_zero == pytest.approx(np.exp(1.5 * a**2) / (2 * np.sqrt(3)), rel=1e-6)
    assert sum(text.startswith("x: a = ") for text in legend_texts(figure)) == 2


def test_densities_of_a_single_segment_are_refused():
    with pytest.raises(TrackError, match="two segments"):
        plots.densities_figure(summary_of(None))


def test_increments_are_shifted_by_decades_with_their_lags_in_milliseconds():
    left, _ = plots.increments_figure(planted_increments(), TABLE).axes
    short, long = [line for line in left.lines if line.get_marker() == "o"]
    np.testing.assert_allclose(short.get_ydata(), np.array([2, 9, 2]) / 13 / 2)
    np.testing.assert_allclose(long.get_ydata(), 10 * np.array([1, 5, 9, 5, 1]) / 21 / 2)
    texts = {text.get_text(): text.get_position()[1] for text in left.texts}
    assert list(texts) == ["2 ms", "40 ms"]
    assert 9 / 26 < texts["2 ms"] < 10 * 9 / 42 < texts["40 ms"]  # each above its own curve
    dashed = [line for line in left.lines if line.get_label() == "_gaussian"]
    assert [line.get_ydata().max() for line in dashed] == pytest.approx([0.39894, 3.9894], rel=1e-4)


def test_the_flatness_of_increments_is_drawn_against_the_lag_with_the_levels_that_are_known():
    figure = plots.increments_figure(planted_increments(), TABLE)
    right = figure.axes[1]
    for name, first in (("x", 9.0), ("y", 8.0), ("z", 7.0), ("all", 8.5)):
        line = named(right, name)
        np.testing.assert_allclose(line.get_xdata(), [2.0, 10.0, 40.0])
        assert line.get_ydata()[0] == first
    drawn = right.collections[0].get_paths()[0].vertices[:, 1]
    assert (drawn.min(), drawn.max()) == pytest.approx((3.9, 9.2))
    # components of flatness F and rms 1, 2, 3 together: F (1 + 16 + 81) / 3 / (14 / 3)^2 = 1.5 F
    levels = {line.get_label(): line.get_ydata()[0] for line in right.lines if ": " in str(line.get_label())}
    assert levels == pytest.approx({"Gaussian: 3": 3.0, "ω lab: 6": 6.0, "α lab: 12": 12.0})
    right = plots.increments_figure(planted_increments()).axes[1]
    assert [line.get_label() for line in right.lines if ": " in str(line.get_label())] == ["Gaussian: 3"]


def test_durations_are_counted_in_milliseconds_or_seconds_with_their_decay():
    found = durations(SPANS[SPANS < 1.5], 0.1)
    figure = plots.durations_figure(found)
    [axes] = figure.axes
    counts, edges, _ = axes.patches[0].get_data()
    np.testing.assert_array_equal(np.nan_to_num(counts), np.histogram(1e3 * SPANS[SPANS < 1.5], edges)[0])
    assert edges[0] == pytest.approx(100.0)
    assert not (counts == 0).any()  # none on a logarithmic axis
    law = named(axes, "exponential")
    assert law.get_label() == f"exponential, decay time {interval_text(found.decay_time_s, 'ms', 1e3)}"
    assert 200 < float(re.search(r"time (\d+) ms", law.get_label())[1]) < 350
    x, y = law.get_data()
    slope = np.polyfit(x, np.log(y), 1)[0]
    assert -1 / slope == pytest.approx(1e3 * float(found.decay_time_s.value), rel=1e-6)
    drawn = axes.collections[0].get_paths()[0].vertices
    first = drawn[np.isclose(drawn[:, 0], x[0]), 1]
    assert first.min() < y[0] < first.max()
    assert axes.get_yscale() == "log"
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("duration (ms)", "segments (number in a bin)")
    [axes] = plots.durations_figure(durations(100 * SPANS, 10.0)).axes
    assert axes.get_xlabel() == "duration (s)"
    assert axes.patches[0].get_data()[1][0] == pytest.approx(10.0)


def test_angles_have_densities_by_degree_beside_the_uniform_law():
    figure = plots.angles_figure(planted_angles(), uniformity(0.4))
    for axes, half in zip(figure.axes, (180, 90, 180), strict=True):
        [law] = axes.patches
        values, edges, _ = law.get_data()
        assert np.sum(values * np.diff(edges)) == pytest.approx(1.0)
        assert (edges[0], edges[-1]) == pytest.approx((-half, half))
        [points] = axes.lines
        np.testing.assert_allclose(points.get_ydata(), 1.1 * values)
        np.testing.assert_allclose(points.get_xdata(), (edges[1:] + edges[:-1]) / 2)
        width = bars(axes)[:, 1, 1] - bars(axes)[:, 0, 1]
        np.testing.assert_allclose(width, 0.05 * np.pi / 180)
    middle = figure.axes[1].patches[0].get_data().values
    assert middle[6] > 5 * middle[0]  # cos(theta_y)
    assert [axes.get_xlabel() for axes in figure.axes] == [rf"$\theta_{n}$ (degrees)" for n in "xyz"]


@pytest.mark.parametrize(
    ("p_value", "words"),
    [
        (0.4, "the orientations agree with uniformity: p = 0.40"),
        (0.012, "the orientations are not uniform: p = 0.012"),
        (1e-5, "the orientations are not uniform: p < 0.001"),
        (np.nan, "uniformity of the orientations could not be tested"),
    ],
)
def test_the_test_of_uniformity_is_reported_in_words(p_value, words):
    note = note_of(plots.angles_figure(planted_angles(), uniformity(p_value)))
    assert note.startswith(words)
    assert np.isnan(p_value) or "12,345 frames in 77 segments, worth 210 independent" in note


def test_correlations_are_drawn_in_milliseconds_with_their_integral_times():
    planted = planted_correlation()
    figure = plots.correlations_figure({"velocity": planted, "alpha_lab": planted})
    assert [axes.get_ylabel() for axes in figure.axes] == ["autocorrelation of v (–)", "autocorrelation of α lab (–)"]
    for axes in figure.axes:
        for i, name in enumerate(("x", "y", "z", "all")):
            line = named(axes, f"{name}:")
            np.testing.assert_allclose(line.get_xdata(), np.arange(11) * 2.0)
            np.testing.assert_array_equal(line.get_ydata(), planted.value.value[:, i])
        single = [line for line in axes.lines if line.get_marker() in "os^D" and len(line.get_xdata()) == 1]
        assert [line.get_xdata()[0] for line in single] == pytest.approx([4.0, 5.0, 6.0, 7.0])
        spans = [c.get_segments()[0][:, 0] for c in axes.collections if isinstance(c, LineCollection)]
        np.testing.assert_allclose(spans, [(t - 0.5, t + 1.0) for t in (4, 5, 6, 7)])
        drawn = axes.collections[0].get_paths()[0].vertices[:, 1]
        assert (drawn.max(), drawn.min()) == pytest.approx((1.2, np.cos(160 * 0.02) - 0.1))
    assert legend_texts(figure)[:2] == ["x: 4.0 ms (3.5 to 5.0)", "y: above 5.0 ms (4.5 to 6.0), no zero"]


def test_widths_show_the_corrected_plateau_and_what_was_measured_without_the_velocity():
    figure = plots.widths_figure({"alpha_lab": planted_widths("alpha_lab")})
    rms, flatness, share = figure.axes
    words = "rms of α lab (rad/s²)", "flatness of α lab (–)", "noise in the variance of α lab (%)"
    assert tuple(axes.get_ylabel() for axes in figure.axes) == words
    for i, name in enumerate("xyz"):
        corrected, measured = named(rms, f"{name}, corrected"), named(rms, f"{name}, measured")
        np.testing.assert_allclose(corrected.get_ydata(), 3.0 + i)
        np.testing.assert_allclose(measured.get_ydata(), 3.0 + i + np.array([1.0, 0.5, 0.25]))
        assert measured.get_markerfacecolor() == "white"
        assert (measured.get_linestyle(), corrected.get_linestyle() != "None") == ("None", True)
        np.testing.assert_allclose(corrected.get_xdata(), [1.0, 2.0, 4.0], atol=0.05)
        np.testing.assert_allclose(named(flatness, f"{name}, corrected").get_ydata(), 7.0)
        np.testing.assert_allclose(named(flatness, f"{name}, measured").get_ydata(), 6.0)
        np.testing.assert_allclose(named(share, name).get_ydata(), np.array([50.0, 20.0, 10.0]) * (1 - 0.1 * i))
    assert named(share, "_10 %").get_ydata()[0] == pytest.approx(10.0)
    assert rms.get_ylim()[0] == 0.0
    labels = [axes.get_ylabel() for axes in FIGURES["widths"]().axes]
    assert len(labels) == 6
    assert not any("rms of v" in label for label in labels)


def test_shares_of_the_variance_are_in_percent_around_a_third():
    figure = plots.isotropy_figure(planted_isotropies())
    [axes] = figure.axes
    drawn = {marker: [l for l in axes.lines if l.get_marker() == marker] for marker in "os^"}
    for marker, expected in zip("os^", [(20, 33), (30, 34), (50, 33)], strict=True):
        assert [line.get_ydata()[0] for line in drawn[marker]] == pytest.approx(expected)
    assert [round(line.get_xdata()[0]) for line in drawn["o"]] == [0, 1]
    np.testing.assert_allclose(np.diff(bars(axes)[:, :, 1], axis=1), 5.0)
    assert named(axes, "a third").get_ydata()[0] == pytest.approx(33.333, abs=0.01)
    ticks = [tick.get_text() for tick in axes.get_xticklabels()]
    assert ticks == ["v lab\np < 0.001", "ω body\np = 0.62"]


def test_shares_of_noise_are_bars_in_percent_with_intervals_and_the_limit():
    figure = plots.noise_figure(TABLE)
    [axes] = figure.axes
    for box, share in zip(axes.containers, (0.2, 3.0, 40.0), strict=True):
        tops = [bar.get_y() + bar.get_height() for bar in box]
        assert tops == pytest.approx([share] * 6)
    ends = bars(axes)[:, :, 1].reshape(3, 6, 2)
    np.testing.assert_allclose(ends[:, 0], [(0.1, 0.4), (1.5, 6.0), (20.0, 80.0)])
    assert named(axes, "10 %").get_ydata()[0] == pytest.approx(10.0)
    assert axes.get_yscale() == "log"
    assert [tick.get_text() for tick in axes.get_xticklabels()][:3] == ["v lab", "a lab", "ω lab"]
    assert axes.get_ylabel() == "noise in the variance (%)"
    assert len({bar.patches[0].get_hatch() for bar in axes.containers}) == 3


def test_the_loss_of_a_smoother_is_not_called_noise_and_without_any_the_axis_is_linear():
    [axes] = plots.noise_figure(TABLE, "removed").axes
    assert axes.get_ylabel() == "variance smoothed away (%)"
    [axes] = plots.noise_figure({"velocity": planted_moments("velocity", (0.0, 0.0, 0.0))}).axes
    assert axes.get_yscale() == "linear"
    assert axes.get_ylim()[1] > 10


@pytest.mark.parametrize(
    ("value", "low", "high", "words"),
    [
        (0.9213, 0.9049, 0.9381, "0.921 (0.905 to 0.938)"),
        (1234.4, 1100.0, 1400.0, "1234 (1100 to 1400)"),
        (0.00512, 0.0049, 0.0054, "0.00512 (0.00490 to 0.00540)"),
        (2.0, np.nan, np.nan, "2"),
        (np.nan, 1.0, 2.0, "unknown"),
    ],
)
def test_an_interval_is_printed_with_its_significant_digits(value, low, high, words):
    of = Interval(value=np.array(value), low=np.array(low), high=np.array(high), error=np.array(0.1))
    assert interval_text(of) == words
    if np.isfinite(low):
        assert interval_text(of, "ms", 1e3).startswith(words if np.isnan(value) else f"{1e3 * value:.0f}"[:2])


def unknown(of: Interval) -> Interval:
    nothing = np.full_like(of.value, np.nan)
    return Interval(value=nothing, low=nothing, high=nothing, error=nothing)


def without_values(record: object) -> object:
    """The record with NaN in all its intervals."""
    parts = {name: unknown(x) for name, x in vars(record).items() if isinstance(x, Interval)}
    return replace(record, **parts)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("frames", [0, slow(1), slow(2), 50, slow(100_000)])
@pytest.mark.parametrize("cameras", [(), ("one",), ("one", "two")], ids=len)
def test_tracks_without_anything_measured_are_drawn(frames, cameras, tmp_path):
    track = blank_track(frames, cameras)
    figures = [plots.track_figure(track), plots.path_figure(track)]
    if distances := camera_distances(track):
        figures.append(plots.camera_distance_figure(distances))
    for figure in figures:
        figure.canvas.draw()
        words = [text.get_text() for axes in figure.axes for text in axes.texts]
        assert len(words) == len(figure.axes)  # every panel notes that it is empty
    if frames > 2000:
        assert "none of them in a segment" in note_of(figures[0])
    assert not any(np.isfinite(line.get_ydata()).any() for line in figures[0].axes[1].lines), "angles of NaN are not 0"


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "draw",
    [
        lambda: plots.densities_figure(
            summary_of({"velocity": (replace(planted_density(), counts=np.zeros(5, int)),) * 3}), ["velocity"]
        ),
        lambda: plots.correlations_figure({"velocity": without_values(planted_correlation())}),
        lambda: plots.widths_figure({"acceleration": without_values(planted_widths())}),
        lambda: plots.isotropy_figure({q: without_values(one) for q, one in planted_isotropies().items()}),
        lambda: plots.noise_figure({"velocity": without_values(planted_moments("velocity"))}),
        lambda: plots.angles_figure([without_values(one) for one in planted_angles()], uniformity(np.nan)),
        lambda: plots.track_figure(planted_track(50, ("one",))),
        lambda: plots.path_figure(replace(planted_track(50), orientation_smooth=np.full((50, 3, 3), np.nan))),
    ],
)
def test_unknown_numbers_are_drawn_without_complaint(draw):
    figure = draw()
    figure.canvas.draw()
    for axes in figure.axes:
        for line in axes.lines:
            assert "nan" not in str(line.get_label())
