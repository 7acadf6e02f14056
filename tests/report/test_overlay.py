"""The overlay draws the track at the right pixels of the movie."""

from contextlib import ExitStack
from dataclasses import replace

import av
import numpy as np
import pytest
import torch
from locate_examples import looking_along_y
from overlay_examples import EXCERPT, RADIUS_MM, camera_changed, changed, command, excerpt, true_track
from scipy.spatial.transform import Rotation

from sphereorient.errors import ExperimentError, TrackError
from sphereorient.pose.lights.disk import light_basis
from sphereorient.report.frame_warnings import FLAG_WORDS, REASON_WORDS, frame_warnings
from sphereorient.report.overlay import FrameSelection, overlay_movie, pictures_by_row, prepared, write_video
from sphereorient.report.overlay_model import (
    LIMB,
    OverlayModel,
    SeenDisk,
    axes_px,
    contrast,
    crop,
    fit_light,
    lit_picture,
    outline_px,
    path_of,
)
from sphereorient.report.overlay_page import (
    AXES,
    BLANK,
    DOUBT,
    LOST,
    OUTLINE,
    Canvas,
    Panel,
    own_distance_px,
    residual_colours,
)
from sphereorient.trajectory import Flag, Reason

K = 20  # a frame


@pytest.fixture(scope="module")
def ready():
    """The page of the true track, the pictures of frame 20, and the model of each camera."""
    with ExitStack() as opened:
        page, streams = prepared(true_track(), excerpt(), None, opened)
        _, pictures = next(pictures_by_row(streams, np.array([K])))
        yield page, pictures


def test_axes_are_drawn_where_designs_check_of_signs_has_them():
    """docs/conventions.md: a camera looks along lab +y, lab z up, 200 mm before the origin."""
    lens = {"T_cam_lab_mm": (0.0, 0.0, 200.0), "centre_px": (100.0, 100.0), "f_px": 1000.0}
    camera = looking_along_y(
        image_size=(201, 201), **{name: torch.tensor(value, dtype=torch.float64) for name, value in lens.items()}
    )
    track = true_track(("cam1",), 0, 1)
    Rz = Rotation.from_euler("z", -90, degrees=True).as_matrix()
    path = path_of(changed(track, 0, position=np.zeros(3), orientation=Rz), 1.0)
    tips, near = axes_px(camera, path, 0)
    assert near.tolist() == [True, False, False]  # x towards the camera; y and z in the picture's plane
    np.testing.assert_allclose(tips, [[100, 100], [105, 100], [100, 95]], atol=1e-9)  # y right, z up


def test_lines_of_sight_through_the_outline_touch_the_sphere():
    track = true_track()
    path = path_of(track, RADIUS_MM)
    for camera in excerpt().cameras.values():
        rays = camera.rays(torch.from_numpy(outline_px(camera, path, K)))
        to_centre = torch.from_numpy(path.position_mm[K]) - rays.origin_lab_mm
        away = torch.linalg.cross(to_centre, rays.direction_lab).norm(dim=-1)
        np.testing.assert_allclose(away.numpy(), RADIUS_MM, rtol=2e-3)


def test_frames_without_a_measurement_are_the_smoothers():
    track = changed(true_track(), 5, position=np.nan, orientation=np.nan)
    path = path_of(track, RADIUS_MM)
    np.testing.assert_array_equal(path.position_mm[5], track.position_smooth[5])
    assert np.flatnonzero(path.smoothed).tolist() == [5]
    lost = path_of(changed(track, 5, position_smooth=np.nan), RADIUS_MM)
    assert not lost.whole[5]
    assert not lost.smoothed.any()


def relative_residual(ready, name: str, R_lab_body=None) -> float:
    page, pictures = ready
    [view] = [view for view in page.balls[0].views if view.name == name]
    path = view.model.path
    if R_lab_body is not None:
        turned = path.R_lab_body.copy()
        turned[K] = R_lab_body
        path = replace(path, R_lab_body=turned)
    model = OverlayModel(camera=view.model.camera, texture=view.model.texture, path=path)
    window = model.window(K, view.half_px, 100)
    filmed = crop(pictures[name], window)
    left = filmed - lit_picture(view.light, model.look(K, window), filmed)
    return float(np.sqrt(np.nanmean(left**2))) / contrast(view.light)


@pytest.mark.parametrize("name", ["cam1", "cam2"])
def test_the_residual_is_small_for_the_true_orientation_only(ready, name):
    track = true_track()
    at_truth = relative_residual(ready, name)
    assert at_truth < 0.13
    for wrong in ([0.2, 0, 0], [0, 0.2, 0], [0, 0, 0.2], [0, 0, np.pi]):
        R = Rotation.from_rotvec(wrong).as_matrix() @ track.orientation[K]
        assert relative_residual(ready, name, R) > 1.8 * at_truth
    assert relative_residual(ready, name, track.orientation[K].T) > 3 * at_truth  # the other reading of R_lab_body


def planted(rng, difference, black):
    """A ball of random paint, black and white, under planted light maps (K,), and its picture."""
    at = np.linspace(-1, 1, 40)
    across = np.stack(np.meshgrid(at, at), axis=-1)
    across[np.hypot(*np.moveaxis(across, -1, 0)) > 1] = np.nan
    basis = light_basis(torch.from_numpy(across).movedim(-1, 0).flatten(1)).numpy()
    paint = np.where(np.isnan(across[..., 0]), np.nan, rng.random((40, 40)).round())
    grey = paint * (difference @ basis).reshape(40, 40) + (black @ basis).reshape(40, 40)
    return SeenDisk(paint=paint.astype(np.float32), across=across.astype(np.float32)), grey.astype(np.float32)


def sloping() -> tuple[np.ndarray, np.ndarray]:
    """Light maps that grow to the right and towards the middle."""
    difference, black = np.zeros((2, light_basis(torch.zeros(2, 1)).shape[0]))
    difference[:3], difference[15], black[:3], black[15] = (120.0, 8.0, -5.0), 40.0, (12.0, 0.0, 3.0), 4.0
    return difference, black


def test_planted_light_is_found_again():
    rng = np.random.default_rng(3)
    pairs = [planted(rng, *sloping()) for _ in range(4)]
    found = fit_light(pairs)
    for seen, grey in pairs:
        inside = np.hypot(*np.moveaxis(seen.across, -1, 0)) < LIMB
        np.testing.assert_allclose(lit_picture(found, seen)[inside], grey[inside], atol=0.5)
    assert contrast(found) == pytest.approx(160, abs=0.5)


def test_brightness_follows_the_frame_within_a_factor_of_two():
    rng = np.random.default_rng(4)
    seen, grey = planted(rng, *sloping())
    light = fit_light([planted(rng, *sloping()) for _ in range(4)])
    np.testing.assert_allclose(lit_picture(light, seen, 0.7 * grey), 0.7 * lit_picture(light, seen, grey), rtol=1e-5)
    bright = lit_picture(light, seen, 9.0 * grey)
    np.testing.assert_allclose(bright, 2.0 * lit_picture(light, seen), rtol=1e-5)
    assert fit_light([]) is None


def test_residuals_have_one_fixed_scale():
    black, orange, blue, half, blank = residual_colours(np.array([[0, 0.5, -3.0, 0.25, np.nan]], np.float32))[0]
    assert black.tolist() == [0, 0, 0]
    assert tuple(orange) == AXES[0]
    assert tuple(blue) == AXES[2]
    assert abs(int(half[0]) - AXES[0][0] / 2) <= 1
    assert blank.tolist() == [BLANK] * 3


@pytest.mark.parametrize("scale", [1.0, 0.5, 3.0])
def test_a_line_lies_on_the_pixel_that_it_names(scale):
    """Whole numbers are the middle of pixels: column 7 of a picture enlarged 3 times is 21 to 23, its middle 22."""
    canvas = Canvas(90, 60)
    size = (round(20 * scale), round(10 * scale))
    panel = Panel(canvas, (10, 10), size, (-0.5, -0.5), scale)
    panel.show(np.zeros((10, 20), np.uint8))
    inside = canvas.pixels[10 : 10 + size[1], 10 : 10 + size[0], 0]
    panel.line(np.array([[7.0, 0.0], [7.0, 9.0]]), (255, 255, 255))
    share = inside.sum(0, dtype=float)
    assert np.average(np.arange(size[0]), weights=share) == pytest.approx(7.5 * scale - 0.5, abs=0.3)
    inside[:] = 0
    panel.line(np.array([[0.0, 4.0], [19.0, 4.0]]), (255, 255, 255))
    share = inside.sum(1, dtype=float)
    assert np.average(np.arange(size[1]), weights=share) == pytest.approx(4.5 * scale - 0.5, abs=0.3)


def test_lines_stop_at_gaps_and_at_the_edge():
    canvas = Canvas(40, 40)
    panel = Panel(canvas, (10, 10), (20, 20), (-0.5, -0.5), 1.0)
    before = canvas.pixels.copy()
    panel.line(np.array([[-1e12, 5.0], [np.nan, 5.0], [30.0, 5.0], [4.0, np.inf]]), (255, 0, 0))
    np.testing.assert_array_equal(canvas.pixels, before)
    panel.line(np.array([[-50.0, 5.0], [50.0, 5.0]]), (255, 0, 0))
    changed_at = np.nonzero((canvas.pixels != before).any(-1))
    assert (changed_at[1].min(), changed_at[1].max()) == (10, 29)


def test_every_flag_and_reason_has_words():
    assert set(FLAG_WORDS) == set(Flag)
    assert set(REASON_WORDS) == set(Reason)
    words = [*FLAG_WORDS.values(), *REASON_WORDS.values()]
    assert len(set(words)) == len(words)


def test_doubts_are_shown_in_words():
    track = true_track()
    assert frame_warnings(track, 3) == []
    bad = changed(track, 3, flags=Flag.SPIKE | Flag.ONE_CAMERA, valid=False)
    bad = camera_changed(bad, "cam2", 3, reason=Reason.DARK)
    assert frame_warnings(bad, 3) == ["not valid", "one camera only", "the orientation jumps", "cam2: too dark"]
    assert frame_warnings(camera_changed(track, "cam2", 3, reason="of_tomorrow"), 3) == ["cam2: of_tomorrow"]


def with_track(page, track, **parts):
    """The page of one ball with another track, and with views `parts`."""
    return replace(page, balls=[replace(page.balls[0], track=track, **parts)])


def test_frames_of_doubt_are_marked(ready):
    page, pictures = ready
    plain, (ball,) = page.draw(K, pictures), page.balls
    assert plain.shape[0] % 2 == plain.shape[1] % 2 == 0
    doubtful = with_track(page, changed(ball.track, K, flags=Flag.DOUBTFUL_FIT))
    lost = with_track(page, changed(ball.track, K, valid=False))
    corner = (slice(62, 65), slice(10, 13))  # of the first camera's frame
    assert (doubtful.draw(K, pictures)[corner] == DOUBT).all()
    assert (lost.draw(K, pictures)[corner] == LOST).all()
    assert not (plain[corner] == DOUBT).all()
    assert "doubt: fit worse than usual" in doubtful.balls[0].state(K)[0]
    assert "not valid" in lost.balls[0].state(K)[0]


def test_a_camera_that_alone_measures_another_pose_is_shown(ready):
    page, pictures = ready
    whole = page.balls[0].track
    centre = whole.cameras["cam1"].centre_px[K]
    off = camera_changed(whole, "cam1", K, centre_px=centre + np.array([6.0, 8.0]), reason=Reason.CONTRADICTS)
    [view, _] = page.balls[0].views
    assert own_distance_px(view, whole.cameras["cam1"], K) < 1e-3
    assert own_distance_px(view, off.cameras["cam1"], K) == pytest.approx(10, abs=1e-3)
    crop_of = (slice(86, 396), slice(460, 770))
    before, after = (with_track(page, track).draw(K, pictures)[crop_of] for track in (whole, off))
    assert (before != after).any(-1).sum() > 200


@pytest.mark.filterwarnings("error")
def test_a_frame_without_pictures_or_measurement_is_drawn(ready):
    page, _ = ready
    (ball,) = page.balls
    nothing = {"position": np.nan, "orientation": np.nan, "position_smooth": np.nan, "orientation_smooth": np.nan}
    track = changed(ball.track, K, valid=False, **nothing)
    for name in track.cameras:
        track = camera_changed(track, name, K, reason=Reason.MISSING, centre_px=np.nan, radius_px=np.nan)
    view = [replace(v, model=replace(v.model, path=path_of(track, 9.0))) for v in ball.views]
    trails = [replace(v, trail_px=np.where(np.arange(40)[:, None] == K, np.nan, v.trail_px)) for v in view]
    drawn = with_track(page, track, views=trails).draw(K, {"cam1": None, "cam2": None})
    assert drawn.std() > 5


def read(path):
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        facts = stream.codec_context.name, stream.codec_context.pix_fmt, float(stream.average_rate)
        return facts, [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]


@pytest.mark.slow
def test_the_movie_is_h264_that_players_show(tmp_path):
    out, steps, chosen = tmp_path / "overlay.mp4", [], FrameSelection(first=10, last=16, every=2)
    count = overlay_movie(true_track(), excerpt(), out, chosen, 12, lambda *at: steps.append(at))
    facts, pictures = read(out)
    assert facts == ("h264", "yuv420p", 12.0)
    assert count == len(pictures) == 3
    assert steps == [(1, 3), (2, 3), (3, 3)]
    assert list(tmp_path.iterdir()) == [out]
    assert not np.array_equal(pictures[0], pictures[1])


@pytest.mark.slow
def test_a_part_of_the_track_shows_its_own_frames(tmp_path):
    """The clock does not restart: frame 12 of the experiment is row 0 of a track of frames 12 to 29."""
    with ExitStack() as opened:
        whole, streams = prepared(true_track(("cam1",)), excerpt(), None, opened)
        part, of_part = prepared(true_track(("cam1",), 12, 30), excerpt(), None, opened)
        assert part.numbers.tolist() == list(range(12, 30))
        assert whole.numbers.tolist() == list(range(40))
        _, first = next(pictures_by_row(of_part, np.array([0])))
        _, same = next(pictures_by_row(streams, np.array([12])))
        np.testing.assert_array_equal(first["cam1"], same["cam1"])
    with pytest.raises(TrackError, match="within 12:30, got 30:"):
        overlay_movie(true_track(("cam1",), 12, 30), excerpt(), tmp_path / "o.mp4", FrameSelection(first=30))


def test_pictures_are_taken_one_by_one(tmp_path):
    """A long movie needs no more memory than a short one: no picture is kept while the next ones are written."""
    import weakref

    alive = []

    def pictures():
        for shade in range(0, 200, 2):
            picture = np.full((64, 64, 3), shade, np.uint8)
            alive.append(weakref.ref(picture))
            yield picture
            del picture
            assert sum(ref() is not None for ref in alive) < 4

    assert write_video(tmp_path / "o.mkv", pictures(), 25) == 100


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"cameras": ["cam3"]}, ExperimentError, "cam3"),
        ({"cameras": []}, ExperimentError, "--cameras"),
        ({"first": 90, "last": 99}, TrackError, "within 0:40, got 90:99"),
    ],
)
def test_refusals_are_one_line(tmp_path, arguments, error, words):
    with pytest.raises(error, match=words) as caught:
        overlay_movie(true_track(), excerpt(), tmp_path / "overlay.mp4", FrameSelection(**arguments))
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_tracks_of_other_times_are_refused(tmp_path):
    late = true_track()
    with pytest.raises(TrackError, match="was measured from"):
        overlay_movie(replace(late, time=late.time + 100), excerpt(), tmp_path / "o.mp4")


def test_without_a_map_outline_and_axes_are_shown(tmp_path):
    """Outline and axes of a ball without a map are drawn all the same."""
    with ExitStack() as opened:
        page, streams = prepared(true_track(("cam1",)), excerpt().with_sphere(texture_path=None), None, opened)
        _, pictures = next(pictures_by_row(streams, np.array([K])))
    assert page.balls[0].views[0].light is None
    drawn = page.draw(K, pictures)
    assert (np.abs(drawn.astype(int) - OUTLINE) < 40).all(-1).sum() > 300
    assert page.balls[0].views[0].why_unlit == "no texture map"


@pytest.mark.slow
def test_the_command_writes_movie_and_sheet(tmp_path, monkeypatch, capsys):
    true_track().save(tmp_path / "track.h5")
    out, sheet = tmp_path / "o.mp4", tmp_path / "worst.png"
    words = ["overlay", EXCERPT / "experiment.yaml", tmp_path / "track.h5", "--cameras", "cam2"]
    code, printed, _ = command(
        monkeypatch, capsys, *words, "--out", out, "--frames", "38:", "--worst", sheet, "--count", 2
    )
    assert code == 0
    assert f"Wrote {out}: 2 frames" in printed
    assert f"Wrote {sheet}: 2 frames" in printed
    assert sorted(path.name for path in tmp_path.iterdir()) == ["o.mp4", "track.h5", "worst.png"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "expected something to write, got neither --out nor --worst"),
        (["--out", "o.mp4", "--frames", "9:3"], "--frames 9:3: expected A:B, A below B"),
        (["--out", "track.h5/o.mp4"], "expected a folder to write in"),
        (["--out", "o.avi"], "expected .mp4 .m4v .mov .mkv, got '.avi'"),
    ],
)
def test_the_command_refuses_in_one_line(tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    true_track().save(tmp_path / "track.h5")
    code, _, errors = command(monkeypatch, capsys, "overlay", EXCERPT / "experiment.yaml", "track.h5", *words)
    assert code == 2
    assert message in errors
    assert errors.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["track.h5"]
