"""Even spins: planted ones come back, also above half a turn per picture; aliases are given; handedness is certain."""

import csv
import math
from itertools import pairwise

import cv2
import numpy as np
import pytest
import torch
from conftest import SHARED
from spin_examples import dot_directions, photograph, spinning

from sphereorient import so3
from sphereorient.errors import PaintError
from sphereorient.search import GreySearchSettings
from sphereorient.tools.spin.disks import Photographs
from sphereorient.tools.spin.dots import DotTable
from sphereorient.tools.spin.fit import Spins, fit_spins, picture_candidates
from sphereorient.tools.spin.spin import SpinSettings, spin_of

STEP = 0.004
TURN = 2 * math.pi / STEP  # rad/s that pictures one step apart do not show
QUICK = GreySearchSettings(size_px=32, score_min=0.05, peaks=12, finalists=8)


def candidates(omega, time_s, *, wrong=2, scatter_deg=3.0, missing=(), seed=3):
    """Candidates of pictures: the right one among `wrong` ones of equal score; `missing` ones have no right one."""
    rng = torch.Generator().manual_seed(seed)
    count = len(time_s)
    true = spinning(omega, so3.random_rotations((), generator=rng), time_s)
    noise = math.radians(scatter_deg) / math.sqrt(3) * torch.randn(count, 3, generator=rng, dtype=torch.float64)
    R = so3.random_rotations((count, wrong + 1), generator=rng)
    right = [k for k in range(count) if k not in missing]
    R[right, torch.arange(count)[right] % (wrong + 1)] = (so3.exp(noise) @ true)[right]
    offset = torch.arange(count + 1) * (wrong + 1)
    return picture_candidates(time_s, offset, R.flatten(0, 1), torch.ones(count * (wrong + 1))), true


def turned(spins: Spins, true, time_s):
    """Largest angle, degrees, (K,), between spins and the truth at the pictures' times."""
    return torch.rad2deg(so3.geodesic_distance(spins.R_view_body(time_s), true).amax(-1))


@pytest.mark.slow
@pytest.mark.parametrize("turns", [0.07, 0.35, 0.49])
def test_a_planted_spin_comes_back_among_wrong_candidates_and_wrong_pictures(turns):
    omega = turns * TURN * torch.nn.functional.normalize(torch.tensor([0.2, 1.0, -0.4], dtype=torch.float64), dim=0)
    time_s = STEP * torch.tensor([0.0, 1, 2, 3, 5, 6, 7, 8, 9, 11, 12, 13, 14, 15], dtype=torch.float64)
    seen, true = candidates(omega, time_s, missing=(4, 7, 8))
    spins = fit_spins(seen, 0.5 * TURN)
    assert len(spins) == 1
    assert float(turned(spins, true, time_s)[0]) < 3
    rate, found = omega.norm(), spins.omega_view_rad_s[0]
    # Candidates scatter by 3 degrees: along 15 steps the rate is known to a degree or so, the axis to 2.
    assert float((found.norm() - rate).abs()) * 15 * STEP < math.radians(3.0)
    assert float(torch.acos(found @ omega / (found.norm() * rate))) < math.radians(2.0)
    assert float(spins.rate_sigma()[0]) < 0.01 * TURN


@pytest.mark.slow
def test_beyond_half_a_turn_per_picture_all_aliases_are_given_with_the_same_evidence():
    axis = torch.nn.functional.normalize(torch.tensor([0.5, -0.3, 0.8], dtype=torch.float64), dim=0)
    omega = 0.8 * TURN * axis  # looks like 0.2 turns backwards
    time_s = STEP * torch.arange(12, dtype=torch.float64)
    seen, true = candidates(omega, time_s)
    spins = fit_spins(seen, 2.0 * TURN)
    rates = sorted(float(one @ axis) / TURN for one in spins.omega_view_rad_s)
    assert rates == pytest.approx([-1.2, -0.2, 0.8, 1.8], abs=0.01)
    assert float(spins.evidence.max() - spins.evidence.min()) < 0.1
    assert float(turned(spins, true, time_s).max()) < 3


@pytest.mark.slow
def test_uneven_times_leave_one_spin():
    axis = torch.nn.functional.normalize(torch.tensor([0.5, -0.3, 0.8], dtype=torch.float64), dim=0)
    gaps = torch.tensor([1.0, 1.37, 1.11, 1.9, 1.23, 1.0, 1.61, 1.43, 1.29, 1.7, 1.17], dtype=torch.float64)
    time_s = STEP * torch.nn.functional.pad(gaps.cumsum(0), (1, 0))
    seen, _ = candidates(0.8 * TURN * axis, time_s)
    spins = fit_spins(seen, 2.0 * TURN)
    assert float((spins.omega_view_rad_s[0] / TURN - 0.8 * axis).norm()) < 0.02
    assert float(spins.evidence[0]) > float(spins.evidence[1:].max()) + 20


def test_the_order_of_the_pictures_and_the_origin_of_time_do_not_matter():
    omega = 0.3 * TURN * torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
    time_s = STEP * torch.arange(10, dtype=torch.float64)
    rng = torch.Generator().manual_seed(8)
    true = spinning(omega, so3.random_rotations((), generator=rng), time_s)
    order = torch.randperm(10, generator=rng)
    ones = torch.ones(10)
    a = fit_spins(picture_candidates(time_s, torch.arange(11), true, ones), 0.5 * TURN)
    b = fit_spins(picture_candidates(time_s[order] + 7.0, torch.arange(11), true[order], ones), 0.5 * TURN)
    torch.testing.assert_close(a.omega_view_rad_s, b.omega_view_rad_s, rtol=1e-6, atol=1e-3)


@pytest.mark.slow
def test_the_sigma_of_the_rate_is_the_scatter_over_many_draws():
    omega = 0.2 * TURN * torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
    time_s = STEP * torch.arange(10, dtype=torch.float64)
    found = [fit_spins(candidates(omega, time_s, scatter_deg=5.0, wrong=0, seed=s)[0], 0.5 * TURN) for s in range(24)]
    rates = torch.stack([spins.omega_view_rad_s[0].norm() for spins in found])
    stated = torch.stack([spins.rate_sigma()[0] for spins in found]).square().mean().sqrt()
    # 24 draws give their scatter to 15 %; the sigma itself is from 10 pictures.
    assert float(rates.std() / stated) == pytest.approx(1.0, abs=0.4)


def filmed(omega, time_s, *, strays=(), mirror=False):
    """Photographs of an even spin, and the attitudes; `strays` show the ball in any other attitude."""
    directions = dot_directions()
    R = spinning(omega, so3.random_rotations((), generator=torch.Generator().manual_seed(4)), time_s)
    shown = R.clone()
    shown[list(strays)] = so3.random_rotations(len(strays), generator=torch.Generator().manual_seed(5))
    table = DotTable(direction_body=directions, radius_deg=7.0)
    pictures = [photograph(one, directions, seed=k) for k, one in enumerate(shown)]
    return Photographs(pictures=pictures, time_s=time_s), R, table.mirrored() if mirror else table


@pytest.mark.slow  # two searches of 12 pictures, 10 s
def test_photographs_give_back_spin_attitudes_and_aliases_with_strays_between():
    axis = torch.nn.functional.normalize(torch.tensor([0.1, 0.9, -0.3], dtype=torch.float64), dim=0)
    omega, time_s = 0.65 * TURN * axis, STEP * torch.arange(12, dtype=torch.float64)
    photographs, R, table = filmed(omega, time_s, strays=(3, 8))
    found = spin_of(photographs, table, SpinSettings(omega_max_rad_s=TURN, search=QUICK))
    rates = [float(one @ axis) / TURN for one in found.spins.omega_view_rad_s]
    assert rates == pytest.approx([-0.35, 0.65], abs=0.005)  # the slower one leads, the other is given
    assert found.ambiguous == 2
    right = [k for k in range(12) if k not in (3, 8)]
    assert float(torch.rad2deg(so3.geodesic_distance(found.R_view_body, R))[right].max()) < 4
    assert set(torch.nonzero(found.evidence[0] < 0)[:, 0].tolist()) == {3, 8}
    alone = found.alone.R_view_body[found.alone.offset[:-1]]
    assert float(torch.rad2deg(so3.geodesic_distance(alone, R))[right].median()) < 3
    assert found.mirrored_evidence < 0.6 * float(found.spins.evidence.max())


@pytest.mark.slow
def test_a_mirrored_table_is_refused():
    omega = 0.3 * TURN * torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
    time_s = STEP * torch.arange(12, dtype=torch.float64)
    photographs, _, table = filmed(omega, time_s, mirror=True)
    with pytest.raises(PaintError, match="not its mirror image"):
        spin_of(photographs, table, SpinSettings(omega_max_rad_s=TURN, search=QUICK))


@pytest.mark.slow
def test_pictures_that_show_no_spin_are_refused():
    omega, time_s = torch.zeros(3, dtype=torch.float64), STEP * torch.arange(8, dtype=torch.float64)
    photographs, _, table = filmed(omega, time_s, strays=tuple(range(8)))
    with pytest.raises(PaintError, match="more than chance") as caught:
        spin_of(photographs, table, SpinSettings(omega_max_rad_s=TURN, search=QUICK))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("count", "times", "got"),
    [
        (2, [0.0, 1.0], "got 2"),
        (3, [0.0, 1.0], "3 times"),
        (3, [0.0, 1.0, 1.0], "one of them twice"),
        (3, [0.0, 1.0, math.nan], "no number"),
    ],
)
def test_times_that_do_not_fit_the_pictures_are_refused(count, times, got):
    pictures = [np.zeros((60, 60, 3), np.uint8)] * count
    with pytest.raises(PaintError, match=got):
        Photographs(pictures=pictures, time_s=torch.tensor(times))


@pytest.mark.slow
@pytest.mark.shared
def test_the_spin_of_a_real_ball_in_22_photographs():
    folder = SHARED / "real" / "spindoe"
    rows = list(csv.DictReader((folder / "reference_orientations.csv").open()))
    pictures = [cv2.imread(str(folder / "test" / row["file"]))[..., ::-1] for row in rows]
    time_s = torch.tensor([float(row["t_s"]) for row in rows], dtype=torch.float64)
    table = DotTable(direction_body=torch.from_numpy(np.loadtxt(folder / "ref_pattern.csv", delimiter=",")))
    found = spin_of(Photographs(pictures=pictures, time_s=time_s), table)
    reference = torch.tensor([102.2, 819.5, -116.6], dtype=torch.float64)
    rates = found.spins.omega_view_rad_s.norm(dim=-1)
    assert float(rates[0]) == pytest.approx(float(reference.norm()), rel=0.005)
    cosine = float(found.spins.omega_view_rad_s[0] @ reference / (rates[0] * reference.norm()))
    assert cosine > math.cos(math.radians(3))
    assert found.ambiguous == 2
    assert float(rates[1]) / (2 * math.pi) == pytest.approx(248.6, rel=0.005)
    assert found.mirrored_evidence < 0.5 * float(found.spins.evidence[0])
    quat = np.array([[float(row[f"constspin_q{axis}"]) for axis in "xyzw"] for row in rows])
    R = torch.from_numpy(np.stack([from_quaternion(one) for one in quat]))
    alone = torch.rad2deg(so3.geodesic_distance(found.alone.R_view_body[found.alone.offset[:-1]], R))
    assert int((alone < 10).sum()) >= 20
    assert float(torch.rad2deg(so3.geodesic_distance(found.R_view_body, R)).max()) < 10
    assert all(b > a for a, b in pairwise(time_s.tolist()))


def from_quaternion(xyzw):
    """The rotation of a quaternion, by the textbook."""
    x, y, z, w = xyzw / np.linalg.norm(xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
