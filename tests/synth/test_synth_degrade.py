"""Degradations of pictures: each has the size of its unit, and severity 0 changes nothing."""

import math
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from conftest import REPO, assert_close
from torch import Tensor

from sphereorient.errors import SettingsError, ShapeError
from sphereorient.synth.degrade import OPERATIONS, Disk, centre_error, degrade, gain_to_clip, lost_frames, radius_error
from sphereorient.synth.severities import DEGRADATIONS, severity

SIZE, RADIUS = 96, 30.0
NAMES = tuple(OPERATIONS)
LINEAR = [name for name in NAMES if name not in ("shot_noise", "saturation")]


def seeded(seed: int = 4) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def disk(lead: tuple[int, ...] = (), dtype: torch.dtype = torch.float32, radius: float = RADIUS) -> Disk:
    centre = torch.tensor([47.3, 45.8], dtype=dtype).expand(*lead, 2)
    return Disk(centre_px=centre, radius_px=torch.full(lead, radius, dtype=dtype))


def ball(dtype: torch.dtype = torch.float32, black: float = 30.0, white: float = 160.0) -> Tensor:
    """A ball with stripes, lit from the lower right, before a ground of 15, (SIZE, SIZE)."""
    u = torch.arange(SIZE, dtype=dtype)
    right, down = u - 47.3, u[:, None] - 45.8
    inside = (RADIUS - (right.square() + down.square()).sqrt() + 0.5).clamp(0, 1)
    paint = torch.where((right / 9 + down / 40).floor() % 2 == 0, white, black).to(dtype)
    light = (0.8 + 0.2 * u / SIZE) * (0.9 + 0.1 * u[:, None] / SIZE)
    return 15 + inside * (light * paint - 15)


def flat(level: float, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.full((SIZE, SIZE), level, dtype=dtype)


def only(name: str, value: float, picture: Tensor, seed: int = 4) -> Tensor:
    return degrade(picture, disk(dtype=picture.dtype), {name: value}, seeded(seed))


def test_every_degradation_gets_harder_from_nothing_on():
    for row in DEGRADATIONS.values():
        steps = row.values if row.nothing is None else (row.nothing, *row.values)
        change = np.diff(steps)
        assert (change > 0).all() or (row.name == "ball_size" and (change < 0).all()), row.name
        for value in row.values:
            row.check(value)


@pytest.mark.parametrize("level", [0, 6, -1, 2.5, "3", True, None], ids=repr)
def test_levels_out_of_range_are_refused(level):
    with pytest.raises(SettingsError, match="level of defocus"):
        severity("defocus", level)


def test_an_unknown_name_is_refused_with_the_nearest_one():
    for call in (lambda: severity("defocuss", 1), lambda: only("defocuss", 1.0, ball())):
        with pytest.raises(SettingsError, match="write 'defocus'") as refused:
            call()
        assert "\n" not in str(refused.value)


def test_degradations_that_do_not_act_on_pictures_are_refused_there():
    with pytest.raises(SettingsError, match="write_degraded"):
        only("spin", 5.0, ball())


@pytest.mark.parametrize(
    ("name", "value"),
    [("defocus", -1.0), ("uneven_light", 0.5), ("occlusion", 1.0), ("read_noise", math.nan), ("dirt", math.inf)],
)
def test_impossible_values_are_refused(name, value):
    with pytest.raises(SettingsError, match=f"degradation {name}"):
        only(name, value, ball())


def test_impossible_arguments_are_refused():
    for wrong in (torch.zeros(5), torch.zeros(5, 5, dtype=torch.uint8)):
        with pytest.raises(ShapeError, match="pass grey levels as floats"):
            degrade(wrong, disk(), {}, seeded())
    with pytest.raises(ShapeError, match="centre_px"):
        Disk(centre_px=torch.zeros(3), radius_px=torch.tensor(3.0))


@pytest.mark.slow
def test_the_page_is_that_of_the_table():
    run = [sys.executable, REPO / "scripts" / "figure_degradations.py", "--check"]
    subprocess.run(run, check=True)
    text = (REPO / "docs" / "degradations.md").read_text()
    for row in DEGRADATIONS.values():
        assert f"| `{row.name}` | {row.unit} |" in text
    assert (REPO / "docs" / "degradations.png").is_file()


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_the_identity_and_keeps_dtype(name, dtype):
    picture = ball(dtype)
    nothing = DEGRADATIONS[name].nothing
    assert nothing is not None
    # Also the operation itself, which `degrade` would not call.
    for got in (only(name, nothing, picture), OPERATIONS[name](picture, nothing, disk(dtype=dtype), seeded())):
        assert torch.equal(got, picture)
    assert only(name, severity(name, 3), picture).dtype == dtype


@pytest.mark.parametrize("name", NAMES)
def test_each_level_changes_the_picture_more_than_the_one_before(name):
    picture = ball()
    seeds = range(6)
    change = [
        np.mean([float((only(name, severity(name, k), picture, seed) - picture).abs().mean()) for seed in seeds])
        for k in (1, 2, 3, 4, 5)
    ]
    assert (np.diff([0.0, *change]) > 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_a_batch_is_the_stack_of_its_singles_drawn_in_order(name, batch):
    lead_disk, value = disk(batch), severity(name, 4)
    pictures = ball().expand(*batch, SIZE, SIZE) + torch.arange(math.prod(batch)).reshape(*batch, 1, 1)
    together = degrade(pictures, lead_disk, {name: value}, seeded())
    assert together.shape == pictures.shape
    rng = seeded()
    for got, picture in zip(together.reshape(-1, SIZE, SIZE), pictures.reshape(-1, SIZE, SIZE), strict=True):
        assert_close(got, degrade(picture, disk(), {name: value}, rng), atol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_the_same_seed_gives_the_same_bytes_and_the_input_stays(name):
    picture = ball()
    before = picture.clone()
    torch.manual_seed(1)
    first = only(name, severity(name, 4), picture)
    torch.manual_seed(2)  # torch's own generator does not matter
    assert torch.equal(only(name, severity(name, 4), picture), first)
    assert torch.equal(picture, before)
    random = name not in ("contrast_loss", "defocus", "saturation")
    assert torch.equal(only(name, severity(name, 4), picture, seed=5), first) != random


@pytest.mark.parametrize("name", NAMES)
def test_gradients_towards_the_picture_are_right(name):
    small = torch.rand(9, 8, generator=seeded(), dtype=torch.float64) * 200 + 5
    where = Disk(centre_px=torch.tensor([3.6, 4.2], dtype=torch.float64), radius_px=torch.tensor(3.3).double())
    small.requires_grad_()
    # Levels whose effect is seen on so small a picture.
    value = {"dirt": 2.0, "defocus": 1.0}.get(name, severity(name, 3))
    assert torch.autograd.gradcheck(lambda x: OPERATIONS[name](x, value, where, seeded()), (small,))


@pytest.mark.parametrize("name", ["uneven_light", "highlights", "background_clutter", "occlusion", "bubbles"])
def test_gradients_towards_the_ball_are_right(name):
    small = torch.rand(9, 8, generator=seeded(), dtype=torch.float64) * 200
    value = severity(name, 2)
    centre = torch.tensor([3.63, 4.21], dtype=torch.float64, requires_grad=True)
    radius = torch.tensor(3.3, dtype=torch.float64, requires_grad=True)

    def of_ball(centre: Tensor, radius: Tensor) -> Tensor:
        return OPERATIONS[name](small, value, Disk(centre_px=centre, radius_px=radius), seeded())

    assert torch.autograd.gradcheck(of_ball, (centre, radius))


def test_gradients_are_finite_where_the_light_is_none_and_at_the_very_centre():
    dark = torch.zeros(7, 7, requires_grad=True)
    centre = torch.tensor([3.0, 3.0], requires_grad=True)
    where = Disk(centre_px=centre, radius_px=torch.tensor(3.0))
    degrade(dark, where, {name: severity(name, 2) for name in NAMES}, seeded()).sum().backward()
    for part in (dark, centre):
        assert part.grad is not None
        assert torch.isfinite(part.grad).all()


def test_several_at_once_come_in_the_order_of_the_light():
    picture = ball()
    got = degrade(picture, disk(), {"read_noise": 6.0, "contrast_loss": 0.5, "occlusion": 0.3}, seeded())
    rng, expected = seeded(), picture
    for name, value in (("occlusion", 0.3), ("contrast_loss", 0.5), ("read_noise", 6.0)):
        expected = OPERATIONS[name](expected, value, disk(), rng)
    assert torch.equal(got, expected)


def test_noise_has_its_standard_deviation_at_each_grey_level():
    for level in (25.0, 100.0):
        many = flat(level, torch.float64).expand(8, SIZE, SIZE)  # 74,000 pixels: 0.3 % of sigma
        read = degrade(many, disk((8,)), {"read_noise": 7.0}, seeded()) - level
        noise = degrade(many, disk((8,)), {"shot_noise": 0.8}, seeded()) - level
        assert float(read.std()) == pytest.approx(7.0, rel=0.02)
        assert float(noise.std()) == pytest.approx(0.8 * math.sqrt(level), rel=0.02)
        assert abs(float(read.mean())) < 0.1
        neighbours = (read[..., 1:] * read[..., :-1]).mean() / read.var()
        assert abs(float(neighbours)) < 0.02


@pytest.mark.parametrize("sigma", [0.7, 3.0, 6.0])
def test_defocus_is_opencvs_gaussian(sigma):
    picture, size = ball(torch.float64), 2 * math.ceil(4 * sigma) + 1
    expected = cv2.GaussianBlur(picture.numpy(), (size, size), sigma, borderType=cv2.BORDER_REPLICATE)
    assert_close(only("defocus", sigma, picture), torch.from_numpy(expected), atol=1e-9)


def test_contrast_loss_leaves_its_share_of_every_difference():
    picture = ball()
    got = only("contrast_loss", 0.6, picture)
    assert float(got.max() - got.min()) == pytest.approx(0.4 * float(picture.max() - picture.min()), rel=1e-5)
    assert_close(only("contrast_loss", 0.6, flat(95.0)), flat(95.0))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_uneven_light_has_its_ratio_from_limb_to_limb_and_leaves_the_ground(seed):
    got = only("uneven_light", 4.0, flat(100.0), seed)
    v, u = np.mgrid[:SIZE, :SIZE]
    away = np.hypot(u - 47.3, v - 45.8)
    inside = got.numpy()[away < RADIUS - 0.5]
    assert inside.max() / inside.min() == pytest.approx(4.0, rel=0.05)  # the last pixel ends before the limb
    assert inside.max() == pytest.approx(100.0, rel=0.03)
    assert (got.numpy()[away > RADIUS + 0.5] == 100).all()
    # The gradient is smooth: the brightest and the darkest place lie opposite.
    grey = np.where(away < 29, got, np.nan)
    bright, dark = (np.array(np.unravel_index(f(grey), (SIZE, SIZE))) for f in (np.nanargmax, np.nanargmin))
    assert np.linalg.norm(bright - dark) > 1.8 * RADIUS


def test_uneven_light_dims_the_share_of_a_rim_pixel_that_the_ball_covers():
    where = disk(dtype=torch.float64)
    cover, ground = where.covered(flat(0.0, torch.float64)), torch.tensor(60.0, dtype=torch.float64)
    everywhere = replace(where, cover=torch.ones_like(cover))
    left = degrade(flat(1.0, torch.float64), everywhere, {"uneven_light": 4.0}, seeded())
    got = degrade(cover * 100 + (1 - cover) * ground, replace(where, behind=ground), {"uneven_light": 4.0}, seeded())
    assert ((cover > 0.1) & (cover < 0.9)).sum() > 100
    assert_close(got, cover * 100 * left + (1 - cover) * ground)


def test_highlights_have_their_peak_and_width_and_stay_on_the_ball():
    for seed in range(8):
        added = only("highlights", 120.0, ball(torch.float64), seed) - ball(torch.float64)
        assert 115 < float(added.max()) < 122  # the peak lies between pixels; the other lobe's foot
        v, u = np.mgrid[:SIZE, :SIZE]
        assert (added.numpy()[np.hypot(u - 47.3, v - 45.8) > RADIUS + 0.5] == 0).all()
        # Two Gaussians, each 2 pi sigma^2 times its peak, but for what the limb cuts off.
        assert float(added.sum()) / (120 * 2 * math.pi * (0.12 * RADIUS) ** 2) == pytest.approx(2.0, rel=0.05)


def test_clutter_has_its_standard_deviation_is_not_dark_and_stays_behind_the_ball():
    empty = Disk(centre_px=torch.zeros(2), radius_px=torch.tensor(5.0), cover=torch.zeros(SIZE, SIZE))
    added = degrade(flat(15.0), empty, {"background_clutter": 16.0}, seeded()) - 15
    assert float(added.std(correction=0)) == pytest.approx(16.0, rel=1e-3)
    assert float(added.min()) == pytest.approx(0, abs=1e-4)
    behind = only("background_clutter", 16.0, flat(15.0)) - 15
    v, u = np.mgrid[:SIZE, :SIZE]
    away = np.hypot(u - 47.3, v - 45.8)
    assert (behind.numpy()[away < RADIUS - 0.5] == 0).all()
    assert_close(behind[torch.from_numpy(away > RADIUS + 0.5)], added[torch.from_numpy(away > RADIUS + 0.5)])


@pytest.mark.parametrize("share", [0.05, 0.25, 0.6, 0.9])
def test_occlusion_hides_its_share_of_the_disk(share):
    for seed in range(3):
        got = only("occlusion", share, flat(200.0, torch.float64), seed)
        hidden = (200 - got) / (200 - 30)
        whole = disk(dtype=torch.float64).covered(got)
        assert float((hidden * whole).sum() / whole.sum()) == pytest.approx(share, abs=0.01)
        assert float(hidden.sum()) <= math.pi * RADIUS**2 * 1.01  # as large as the ball


def test_the_number_of_bubbles_before_the_disk_is_the_severity():
    white = torch.full((500, 500), 100.0)
    where = Disk(centre_px=torch.tensor([250.0, 250.0]), radius_px=torch.tensor(230.0))
    for count in (2, 5):
        dark = (degrade(white, where, {"bubbles": float(count)}, seeded(13)) != 100).numpy().astype(np.uint8)
        labels, _, stats, middles = cv2.connectedComponentsWithStats(dark)
        assert labels - 1 == count
        assert stats[1:, cv2.CC_STAT_WIDTH] == pytest.approx(2 * 0.12 * 230, abs=2)
        assert (np.linalg.norm(middles[1:] - 250, axis=1) < 230).all()


@pytest.mark.parametrize("radius", [2.0, 7.0])
def test_dirt_covers_the_area_of_its_radius(radius):
    many = flat(200.0).expand(40, SIZE, SIZE)
    got = degrade(many, disk((40,)), {"dirt": radius}, seeded())
    # Middles scattered at random: a place stays clean with the probability of no middle within the radius.
    expected = 1 - math.exp(-6e-4 * math.pi * radius**2)
    assert float((200 - got).mean()) / (200 - 12) == pytest.approx(expected, rel=0.08)
    border = torch.cat([got[:, 0], got[:, -1]])
    assert float((200 - border).mean()) / (200 - 12) == pytest.approx(expected, rel=0.3)  # none is missing there


@pytest.mark.parametrize("share", [0.05, 0.5, 0.98])
def test_saturation_clips_its_share_of_white_paint_and_black_paint_keeps_its_ratio(share):
    lit = ball(torch.float64)
    got = only("saturation", share, lit)
    inside = disk(dtype=torch.float64).covered(lit) > 0.99
    white = inside & (lit > 90)
    assert float((got > 255)[white].double().mean()) == pytest.approx(share, abs=0.002)
    assert float((got > 254.5)[white].double().mean()) == pytest.approx(share, abs=0.03)  # from 254.5 on
    gain = got / lit
    assert_close(gain, gain[0, 0].expand_as(gain))


def test_a_gain_never_darkens_and_needs_white_paint():
    grey = torch.tensor([[100.0, 200.0, 50.0, 250.0], [400.0, 300.0, 20.0, 10.0], [0.0, 0.0, 0.0, 0.0]])
    white = torch.tensor([[1, 1, 0, 1], [1, 1, 0, 0], [0, 0, 0, 0]]).bool()
    # A third of 100, 200, 250 is one pixel: the second brightest comes to 255.
    assert_close(gain_to_clip(grey, white, 1 / 3), torch.tensor([255 / 200, 1.0, 1.0]), atol=1e-6)


def test_the_number_of_lost_frames_is_the_severity_and_differs_by_movie():
    lost = lost_frames(torch.empty(3, 40), 0.15, seeded())
    assert (lost.sum(-1) == 6).all()
    assert not torch.equal(lost[0], lost[1])
    assert not lost_frames(torch.empty(40), 0.0, seeded()).any()
    assert int(lost_frames(torch.empty(24), 0.02, seeded()).sum()) == 1  # before: none


def test_a_wrong_disk_is_wrong_by_the_severity():
    true = disk((500,), torch.float64)
    off = centre_error(true, 2.0, seeded()).centre_px - true.centre_px
    assert_close(off.norm(dim=-1), torch.full((500,), 2.0, dtype=torch.float64))
    assert off.mean(0).norm() < 0.2  # in all directions
    assert_close(radius_error(true, 1.5).radius_px, true.radius_px + 1.5)
    assert torch.equal(radius_error(true, 1.5).centre_px, true.centre_px)
