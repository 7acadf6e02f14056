"""Certainty of `init`'s outline of a fixed ball, partly hidden in a holder."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from conftest import SHARED
from typer.testing import CliRunner

from sphereorient import so3
from sphereorient.cli import app
from sphereorient.experiment import load_experiment
from sphereorient.preflight.first_look import FirstLook, look_at, with_circle
from sphereorient.sphere import orthographic_view

SIZE, CIRCLE = (160, 170), (84.0, 74.0, 41.0)  # H, W; u, v, radius, px
NEAR = pytest.approx(CIRCLE, abs=1.2)


def film(path: Path, hidden: float, rim: float = 1.25, animal: bool = False, wall: bool = False) -> Path:
    """A rotating ball, in a holder that hides this share of its height and has a bright rim of a larger radius;
    `animal`: it moves on the ball; `wall`: something beside it flickers.
    """
    random, (u, v, radius) = np.random.default_rng(1), CIRCLE
    paint = cv2.resize((random.random((8, 16)) > 0.5).astype(np.float32), (256, 128), interpolation=cv2.INTER_CUBIC)
    texture = torch.from_numpy(np.where(paint > 0.5, 0.9, 0.2).astype(np.float32))
    view, turn = orthographic_view(81), random.normal((0.15, 0.05, 0.0), 0.1, (60, 3))
    row, column = np.mgrid[: SIZE[0], : SIZE[1]]
    top = v + radius * (1 - 2 * hidden) - 0.15 * radius * np.sqrt(np.clip(1 - ((column - u) / rim / radius) ** 2, 0, 1))
    holder = (row > top) & (np.abs(column - u) < rim * radius) & (hidden > 0)
    edge = holder & (row < top + 4)
    pictures = []
    for R in so3.exp(torch.from_numpy(np.cumsum(turn, axis=0))):
        picture = np.full(SIZE, 30.0, np.float32)
        box = picture[34:115, 44:125]
        box[view.inside.numpy()] = 230 * view.render(texture, R.float()).numpy()[view.inside.numpy()]
        picture[holder], picture[edge] = 60, 240
        if animal:
            picture[(np.abs(column - u - 8) < 10) & (np.abs(row - v + 0.9 * radius) < 8)] = random.uniform(20, 90)
        if wall:
            picture[4:30, 4:-4] += random.uniform(0, 60, (26, SIZE[1] - 8))
        picture = cv2.GaussianBlur(picture, (0, 0), 0.8) + random.normal(0, 2, SIZE)
        pictures.append(picture.clip(0, 255).astype(np.uint8))
    np.save(path, np.array(pictures))
    return path


def seen(path: Path) -> FirstLook:
    (look,) = look_at([path])
    return look


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [0.0, 0.2, 0.4])
def test_an_outline_that_every_part_of_the_movie_shows_is_sure(tmp_path, hidden):
    look = seen(film(tmp_path / "ball.npy", hidden, animal=True))
    assert look.outline is not None
    assert look.outline.circle == NEAR
    assert not look.doubtful
    assert (look.found, look.looked) == (5, 5)
    assert look.apart_px < 0.5
    assert "5 of 5 parts" in look.words()


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [0.0, 0.3, 0.5, 0.6])
@pytest.mark.parametrize("rim", [1.1, 1.4])
def test_an_outline_is_right_or_doubtful_or_none(tmp_path, hidden, rim):
    look = seen(film(tmp_path / "ball.npy", hidden, rim, animal=True, wall=True))
    right = look.outline is not None and look.outline.circle == NEAR
    assert right or look.doubtful or look.outline is None, look.words()
    assert look.outline is None or look.stays, "a ball that stays"


def test_text_figure_and_files_name_one_outline(tmp_path):
    movie, out = film(tmp_path / "ball.npy", 0.45, rim=1.0, wall=True), tmp_path / "experiment.yaml"
    more = ["--vfov", "30", "--set", "frame_rate=100", "--set", "sphere.diameter=null"]
    printed = CliRunner().invoke(app, ["init", str(movie), "--out", str(out), *more]).output
    look = seen(movie)
    assert look.doubtful
    assert look.outline is not None
    assert f"ball of {2 * look.outline.radius_px:.1f} px" in printed
    assert look.diameter_px == pytest.approx(2 * look.outline.radius_px)
    assert "DOUBTFUL" in printed
    assert f"sphereorient mark {out}" in printed
    assert "write in experiment.yaml: circles" in printed, "without it the ball is not found"
    out.write_text(out.read_text().replace("#circles", "circles"))
    assert load_experiment(out).circles["cam1"] == pytest.approx(look.outline.circle, abs=0.06)


def test_a_given_circle_agrees_or_its_difference_is_reported_and_the_picture_counts(tmp_path):
    look = seen(film(tmp_path / "ball.npy", 0.2))
    u, v, radius = CIRCLE
    right, wrong = with_circle(look, (u, v + 1, radius - 1)), with_circle(look, (u, v - 12, 0.67 * radius))
    assert not right.doubtful
    assert "agrees" in right.words()
    assert wrong.doubtful
    assert wrong.differs
    assert "54.9 px about (84.0, 62.0), differs" in wrong.words()
    for one in (right, wrong):
        assert one.outline is not None
        assert one.outline.circle == NEAR


def test_a_given_circle_stands_where_the_movie_shows_none(tmp_path):
    for hidden in (0.5, 1.0):
        look = with_circle(seen(film(tmp_path / "ball.npy", hidden)), CIRCLE)
        assert look.outline is not None
        assert look.outline.circle == CIRCLE
        assert look.diameter_px == pytest.approx(2 * CIRCLE[2])
        assert math.isclose(look.outline.radius_px, CIRCLE[2])


@pytest.mark.slow  # the outlines above are doubtful too
@pytest.mark.shared
def test_the_ball_of_a_fly_stays_and_its_outline_is_doubtful():
    look = seen(SHARED / "real" / "fictrac" / "sample.mp4")
    assert look.stays
    assert look.doubtful
    assert look.outline is not None
    assert look.outline.circle == pytest.approx((108.8, 181.0, 46.0), abs=2.5)  # known to 2 px
