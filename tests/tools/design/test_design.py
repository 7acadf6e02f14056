"""Paint before it is on the ball: its coarseness, the information of its views, and strips of true size."""

import json
import math
import re
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch
from conftest import REPO, assert_close
from matplotlib.backends.backend_agg import FigureCanvasAgg

from sphereorient import cli, so3
from sphereorient.errors import PaintError
from sphereorient.sphere import Sampling, load_texture, sample_texture
from sphereorient.sphere.texture import map_directions
from sphereorient.tools.design.bound import cramer_rao_bound
from sphereorient.tools.design.gores import Gores, gores_figure, instructions
from sphereorient.tools.design.judge import DesignSettings, design_texture, greatest_similarity, judge_texture
from sphereorient.tools.design.patterns import (
    PATTERNS,
    border_length,
    facing,
    patterned_texture,
    stroke_deg,
    view_directions,
)

FEW = DesignSettings(diameter_px=24, views=12)


def bands(width_deg: float, height: int = 360) -> torch.Tensor:
    """Rings about the axis, of given width, painted in turn from the equator on."""
    latitude = torch.rad2deg(torch.asin(map_directions(height)[..., 2]))
    return ((latitude / width_deg).floor() % 2).float()


def test_directions_are_spread_evenly():
    points = view_directions(200)
    assert_close(points.norm(dim=-1), torch.ones(200, dtype=torch.float64))
    assert_close(points.T @ points / 200, torch.eye(3, dtype=torch.float64) / 3, atol=2e-3)
    nearest = torch.acos((points @ points.T - 2 * torch.eye(200)).amax(1).clamp(-1, 1))
    assert float(nearest.max() / nearest.min()) < 1.8


def test_a_direction_faces_the_camera_with_north_up_and_east_right():  # convention
    R = facing(torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.0, 0.0, 1.0]], dtype=torch.float64))
    assert_close(R[0], torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]], dtype=torch.float64))
    assert_close(R @ R.mT, torch.eye(3, dtype=torch.float64).expand(3, 3, 3))
    assert_close(torch.linalg.det(R), torch.ones(3, dtype=torch.float64))
    assert_close(R[1] @ torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64), torch.tensor([0.0, 0.0, -1.0]).double())
    assert float((R[1] @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))[1]) < 0  # north is up: v grows downwards


@pytest.mark.slow
@pytest.mark.parametrize("width", [12.0, 20.0])
def test_rings_take_a_brush_of_their_width(width):  # oracle
    # A brush as wide as a ring just fits; the lattice of points gives widths to a degree or two.
    assert stroke_deg(bands(width)) == pytest.approx(width, abs=2.0)


@pytest.mark.slow
def test_the_thinner_paint_decides():
    latitude = torch.rad2deg(torch.asin(map_directions(360)[..., 2]))
    ring = (latitude.abs() < 4).float()
    assert stroke_deg(ring) == stroke_deg(1 - ring) == pytest.approx(8.0, abs=2.0)


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 2.0, 3.0)])
def test_the_border_of_a_half_ball_is_a_great_circle(axis):  # oracle
    half = (map_directions(256) @ torch.tensor(axis, dtype=torch.float64) > 0).float()
    # A border of whole texels is jagged, and a circle along it crosses it more than once.
    assert border_length(half) == pytest.approx(2 * math.pi, rel=0.07)


def test_the_border_of_caps_is_the_sum_of_their_circles():  # oracle
    z = map_directions(512)[..., 2]
    caps = ((z > math.cos(0.4)) | (z < -math.cos(0.9))).float()
    assert border_length(caps) == pytest.approx(2 * math.pi * (math.sin(0.4) + math.sin(0.9)), rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("kind", sorted(PATTERNS))
def test_paint_of_twice_the_size_has_half_the_border_and_takes_twice_the_brush(kind):
    fine, coarse = (patterned_texture(kind, size, 3, 256) for size in (14.0, 28.0))
    assert border_length(fine) / border_length(coarse) == pytest.approx(2.0, rel=0.25)
    assert stroke_deg(coarse) > 1.5 * stroke_deg(fine)
    assert torch.equal(fine, patterned_texture(kind, 14.0, 3, 256))
    assert not torch.equal(fine, patterned_texture(kind, 14.0, 4, 256))


@pytest.mark.parametrize(
    ("kind", "size", "got"), [("stripes", 10.0, "'stripes'"), ("dots", 0.1, "0.1"), ("dots", math.nan, "nan")]
)
def test_an_unknown_kind_or_size_of_paint_is_refused(kind, size, got):
    with pytest.raises(PaintError, match=got):
        patterned_texture(kind, size, 0)


@pytest.mark.slow
def test_the_two_faces_of_a_ball_painted_twice_alike_are_found():  # planted
    texture = patterned_texture("blobs", 25.0, 1, 128)
    twice = torch.cat([texture[:, :128], texture[:, :128]], dim=1)  # half a turn about z changes nothing
    R = facing(view_directions(12))
    alike, two = greatest_similarity(twice, R, 20.0)
    assert alike > 0.98
    half_turn = so3.exp(torch.tensor([0.0, 0.0, math.pi], dtype=torch.float64))
    assert math.degrees(float(so3.geodesic_distance(two[0] @ half_turn, two[1]))) < 4
    assert greatest_similarity(texture, R, 20.0)[0] < 0.95


@pytest.mark.slow
def test_views_that_are_near_each_other_are_not_counted_as_alike():
    texture = patterned_texture("patches", 20.0, 2, 128)
    R = facing(view_directions(12))
    for apart in (20.0, 60.0):
        _, two = greatest_similarity(texture, R, apart)
        assert math.degrees(float(so3.geodesic_distance(two[0], two[1]))) > apart - 0.01


@pytest.mark.slow
def test_the_judgement_is_that_of_the_bound_and_finds_the_view_without_paint():
    # Dots on one half only: the other half's middle is white, without information.
    direction = map_directions(128)
    texture = patterned_texture("dots", 15.0, 1, 128)
    texture = torch.where(direction[..., 0] > 0, texture, torch.ones_like(texture))
    judged = judge_texture(texture, FEW)
    expected = cramer_rao_bound(
        texture, facing(judged.direction_body).float(), diameter_px=24, sampling=Sampling(supersampling=6)
    )
    assert_close(judged.bound_rad, expected.orientation_rms_rad.double(), atol=1e-9)
    x = judged.direction_body[:, 0]
    assert float(x[judged.bound_rad.argmax()]) < -0.5 < 0.2 < float(x[judged.bound_rad.argmin()])
    assert float(judged.white.max()) > 0.97
    assert json.loads(json.dumps(judged.as_dict(), allow_nan=False))["views"] == 12


@pytest.mark.slow  # a dozen judgements
def test_paint_is_made_for_the_brush_and_the_same_seed_gives_the_same():
    one, judged, words = design_texture(["blobs"], 12.0, FEW, tries=3)
    two, _, again = design_texture(["blobs"], 12.0, FEW, tries=3)
    assert torch.equal(one, two)
    assert words == again
    assert judged.stroke_deg >= 11
    with pytest.raises(PaintError, match="none of 1"):
        design_texture(["patches"], 40.0, FEW, tries=1)


def place_mm(gores, direction):
    """Where directions (..., 3) lie on the sheet, (..., 2), mm: the sinusoidal projection, strip by strip."""
    x, y, z = direction.unbind(-1)
    longitude, latitude = torch.atan2(y, x), torch.asin(z.clamp(-1, 1))
    strip = ((longitude + math.pi) * gores.count / (2 * math.pi)).floor()
    middle = (strip + 0.5) * (2 * math.pi / gores.count) - math.pi
    across = middle + (longitude - middle) * latitude.cos()
    return 0.5 * gores.diameter_mm * torch.stack([across, latitude], -1)


def test_lengths_of_the_strips_are_true():  # oracle
    gores, D = Gores(count=12, diameter_mm=40.0), 40.0
    assert gores.size_mm == pytest.approx((math.pi * D, math.pi * D / 2))
    outline = np.concatenate(gores.outline_mm())
    assert np.ptp(outline, axis=0) == pytest.approx(gores.size_mm)
    # The parallel of 60 degrees is half as long as the equator.
    widths = [np.ptp(one[np.abs(one[:, 1] - D * math.pi / 6) < 0.3, 0]) for one in gores.outline_mm()]
    assert sum(widths) == pytest.approx(math.pi * D / 2, rel=0.02)


@pytest.mark.parametrize("filled", [True, False])
def test_the_printed_strips_show_the_paint_of_the_sphere_at_true_size(filled):
    gores, texture = Gores(count=6, diameter_mm=30.0), patterned_texture("blobs", 25.0, 1, 256)
    figure = gores_figure(texture, gores, filled=filled)
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(254)  # 10 pixels a mm
    canvas.draw()
    picture = np.asarray(canvas.buffer_rgba())[..., :3].astype(float).mean(-1)
    width, height = gores.sheet_mm
    assert picture.shape == (pytest.approx(10 * height, abs=1), pytest.approx(10 * width, abs=1))
    direction = torch.nn.functional.normalize(
        torch.randn(3000, 3, generator=torch.Generator().manual_seed(2)).double(), dim=-1
    )
    place = place_mm(gores, direction).numpy()
    # From the middle of the sheet, which is that of the strips; rows run downwards.
    column, row = 10 * (place[:, 0] + width / 2) - 0.5, 10 * (height / 2 - place[:, 1]) - 0.5
    printed = picture[row.round().astype(int), column.round().astype(int)] / 255
    paint = sample_texture(texture.double(), direction).numpy()
    if filled:
        agree = (printed > 0.5) == (paint > 0.5)
        assert agree.mean() > 0.98  # all but the borders and the dashed lines
        flipped = sample_texture(texture.flip(-1).double(), direction).numpy()
        assert ((printed > 0.5) == (flipped > 0.5)).mean() < 0.8
    else:
        near = np.abs(paint - 0.5) < 0.1
        assert printed[near].mean() < printed[~near].mean() - 0.3


@pytest.mark.parametrize(
    ("count", "diameter", "got"), [(3, 40.0, "got 3"), (12, 0.0, "got 0 mm"), (12, math.nan, "nan")]
)
def test_strips_that_cannot_be_cut_are_refused(count, diameter, got):
    with pytest.raises(PaintError, match=got):
        Gores(count=count, diameter_mm=diameter)


def test_the_page_of_text_names_the_lengths_to_measure():
    assert "must be 125.7 mm long and a strip 62.8 mm high" in instructions(Gores(count=12, diameter_mm=40.0))


def run(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "sphereorient.cli", *arguments], capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_the_command_judges_makes_and_prints(tmp_path):
    made = tmp_path / "made"
    quick = ["--views", "12", "--diameter-px", "24", "--quiet"]
    strips = ["--gores", "8", "--diameter-mm", "18"]
    done = run("texture", "design", "--make", "--tries", "3", "--kinds", "blobs", "-o", str(made), *quick, *strips)
    assert done.returncode == 0, done.stderr
    assert {path.name for path in made.iterdir()} == {
        *(
            "texture.png",
            "judgement.json",
            "design.png",
            "gores.pdf",
            "gores.svg",
            "stencil.pdf",
            "stencil.svg",
            "gores.txt",
        )
    }
    width, height = Gores(count=8, diameter_mm=18.0).sheet_mm
    found = re.search(r'<svg[^>]*width="([\d.]+)pt" height="([\d.]+)pt"', (made / "gores.svg").read_text())
    assert [float(each) for each in found.groups()] == pytest.approx([72 * width / 25.4, 72 * height / 25.4], rel=1e-4)
    judged = run("texture", "design", str(made / "texture.png"), "-o", str(tmp_path / "judged"), "--json", *quick)
    assert judged.returncode == 0, judged.stderr
    # 8 bit are as good as the map itself.
    before, after = json.loads((made / "judgement.json").read_text()), json.loads(judged.stdout)
    assert after["bound_deg"]["max"] == pytest.approx(before["bound_deg"]["max"], rel=0.01)
    assert load_texture(made / "texture.png").shape == (512, 1024)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "neither"),
        (["map.png", "--make"], "got both"),
        (["missing.png"], "missing.png"),
        (["--make", "--gores", "12"], "--gores alone"),
        (["--make", "--kinds", "stripes"], "'stripes'"),
    ],
)
def test_bad_input_gets_one_line(arguments, expected, tmp_path, monkeypatch, capsys):
    command = ["sphereorient", "texture", "design", *arguments, "--out", str(tmp_path / "out"), "--quiet"]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == 2
    message = capsys.readouterr().err
    assert expected in message
    assert message.count("\n") == 1


@pytest.mark.slow  # judges 18 maps
def test_the_figure_of_the_page_is_drawn_by_its_script(tmp_path):
    out = tmp_path / "paint-design.png"
    subprocess.run([sys.executable, REPO / "scripts" / "figure_paint_design.py", "--out", out], check=True)
    drawn, committed = (cv2.imread(str(path)) for path in (out, REPO / "docs" / "paint-design.png"))
    assert drawn.shape == committed.shape
    assert abs(drawn.astype(float) - committed).mean() < 10
