import pytest
import torch
from conftest import assert_close
from orient_examples import (
    KINDS,
    SIZE,
    attitudes,
    best_errors_deg,
    clean_disks,
    of_disk,
    search_of,
    texture_of,
)
from torch import nn

from sphereorient import so3
from sphereorient.errors import ShapeError
from sphereorient.search import OrientSettings, TemplateBank
from sphereorient.sphere import SphereRenderer, orthographic_view
from sphereorient.sphere.texture import map_directions
from sphereorient.sphere.view import disk_offsets
from sphereorient.trajectory import Reason


def noise(count: int, seed: int = 5) -> torch.Tensor:
    return 200 * torch.rand(count, SIZE, SIZE, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("kind", KINDS)
def test_the_best_proposal_lies_within_the_fine_grids_covering(kind):
    R_view_body = attitudes(30)
    found = search_of(kind).propose(clean_disks(kind, R_view_body))
    error = best_errors_deg(found, R_view_body)
    # The fine grid's covering radius is 0.704 x 3 = 2.1 degrees; the winner of T may be the point next to the nearest.
    assert error.max() < 4.0
    assert error.square().mean().sqrt() < 2.0
    assert found.score[found.offset[:-1]].min() > 0.88  # blurred borders of paint count in part
    # The transpose is no answer.
    assert so3.geodesic_distance(found.R_view_body[found.offset[:-1]].mT, R_view_body).rad2deg().median() > 20


def test_proposals_are_rotations_of_float64_best_score_first():
    found = search_of("dots").propose(clean_disks("dots", attitudes(30)))
    assert found.R_view_body.dtype == found.score.dtype == torch.float64
    assert_close(
        found.R_view_body @ found.R_view_body.mT, torch.eye(3, dtype=torch.float64).expand_as(found.R_view_body)
    )
    assert ((found.score >= 0.5) & (found.score <= 1)).all()
    assert found.offset[0] == 0
    assert found.offset[-1] == len(found.score) == len(found.R_view_body)
    for disk in range(30):
        assert (of_disk(found, disk)[1].diff() <= 0).all()
    assert found.reason == (Reason.OK,) * 30


@pytest.mark.slow
def test_a_finer_grid_answers_more_exactly():
    R_view_body = attitudes(8)
    disks = clean_disks("blobs", R_view_body, 64)
    coarse, fine = (
        best_errors_deg(
            TemplateBank(texture_of("blobs"), 64, OrientSettings(fine_step_deg=step)).propose(disks), R_view_body
        )
        for step in (6.0, 2.0)
    )
    assert fine.square().mean().sqrt() < 0.5 * coarse.square().mean().sqrt()
    assert fine.max() < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_it_distinguishes_a_mirrored_picture_and_a_mirrored_map_from_the_right_one(kind):
    disks = clean_disks(kind, attitudes(10))
    mirrored_search = TemplateBank(texture_of(kind).flip(1), SIZE, OrientSettings())

    def best_scores(search: TemplateBank, disks: torch.Tensor) -> torch.Tensor:
        found = search.propose(disks)
        none = torch.zeros(1, dtype=torch.float64)
        return torch.stack([torch.cat([of_disk(found, disk)[1], none])[0] for disk in range(len(disks))])

    right = best_scores(search_of(kind), disks)
    assert right.min() > 0.9
    assert (right - best_scores(search_of(kind), disks.flip(-1))).min() > 0.05
    assert (right - best_scores(mirrored_search, disks)).min() > 0.05
    # Two mirrors are none.
    assert (right - best_scores(mirrored_search, disks.flip(-1))).abs().max() < 0.05


# --- T, docs/errata.md A2


def test_T_of_the_perfect_picture_is_1_because_the_pixels_counted_are_divided_by():
    # Half white, half black, the border along the middle column of pixels: nothing in between.
    halves = torch.zeros(128, 256)
    halves[:, 128:] = 1.0  # east of longitude 0
    bank = TemplateBank(halves, SIZE, OrientSettings(coarse_step_deg=30))
    facing = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    paint = torch.ones(SIZE, SIZE)
    paint[:, : SIZE // 2] = -1
    T = bank.quality(torch.stack([paint, -paint, 0 * paint]), facing)
    # One column of pixels on either side of the border is blurred by the optics.
    assert_close(T, torch.tensor([1.0, 0.0, 0.5]), atol=0.025)
    assert_close(T[0] + T[1], torch.tensor(1.0), atol=1e-6)


def test_T_of_the_coarse_grid_is_greatest_for_a_template_least_for_its_negative_and_1_half_for_nothing():
    bank = search_of("blobs")
    picture = torch.sign(bank.renderer(bank.grid[777]) - 0.5)
    T = bank.score(torch.stack([picture, -picture, 0 * picture]))
    assert T.shape == (3, len(bank.grid))
    assert T[0].argmax() == 777
    assert T[0, 777] > 0.9
    assert T[1].argmin() == 777
    assert_close(T[0] + T[1], torch.ones(len(bank.grid)), atol=1e-6)
    assert (T[2] == 0.5).all()


def test_T_is_that_of_the_rendered_picture_pixel_by_pixel():
    bank, R = search_of("patches"), attitudes(3)
    disks = clean_disks("patches", R)
    paint, template = bank.paint(disks), 2 * bank.renderer(R) - 1
    counted = disk_offsets(SIZE).norm(dim=-1) <= OrientSettings().disk_share
    expected = [
        0.5
        + sum(float(i) * float(s) for i, s in zip(paint[k][counted], template[k][counted], strict=True))
        / 2
        / counted.sum()
        for k in range(3)
    ]
    assert_close(bank.quality(paint, R), torch.tensor(expected, dtype=torch.float64), atol=1e-6)


def test_T_of_each_candidate_is_the_renderers():
    bank, disks = search_of("dots"), clean_disks("dots", attitudes(4))
    found = bank.propose(disks)
    frame = torch.repeat_interleave(torch.arange(4), found.counts)
    assert_close(found.score, bank.quality(bank.paint(disks)[frame], found.R_view_body.float()).double(), atol=1e-6)


def test_gradients_of_T_by_orientation_paint_and_texture_agree_with_differences(rng):
    texture = nn.Parameter(0.2 + 0.6 * torch.rand(8, 16, generator=rng, dtype=torch.float64))
    bank = TemplateBank(texture, 16, OrientSettings(coarse_step_deg=30, renderer="kornia")).double()
    paint = torch.rand(16, 16, generator=rng, dtype=torch.float64).requires_grad_()
    turn = (0.7 * torch.randn(2, 3, generator=rng, dtype=torch.float64)).requires_grad_()

    def T(texture: torch.Tensor, paint: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(
            bank, {"renderer.texture": texture}, (paint, so3.exp(turn)), {"quality": True}
        )

    bank.forward = lambda paint, R, quality: bank.quality(paint, R)
    assert torch.autograd.gradcheck(T, (texture, paint, turn))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["blobs", "dots"])
def test_the_table_is_pinned_to_the_renderer(kind):
    size = 72
    settings, R = OrientSettings(score_min=0.0), attitudes(25)
    disks = clean_disks(kind, R, size) + 10 * torch.rand(25, size, size, generator=torch.Generator().manual_seed(5))
    table = TemplateBank(texture_of(kind), size, settings)
    kornia = TemplateBank(texture_of(kind), size, settings.model_copy(update={"renderer": "kornia"}))
    paint, about = table.paint(disks), so3.random_rotations(20, generator=torch.Generator().manual_seed(3)).float()
    T = [
        0.5 + bank._rendered(about, bank._real).float() @ paint[:, bank._real].T / (254 * bank._real.sum())
        for bank in (table, kornia)
    ]
    assert (T[0] - T[1]).abs().max() < 0.01
    assert (T[1].T - kornia.quality(paint[:, None], about)).abs().max() < 1e-3
    best = [bank.propose(disks) for bank in (table, kornia)]
    apart = so3.geodesic_distance(*(found.R_view_body[found.offset[:-1]] for found in best))
    assert (apart < 1e-6).float().mean() >= 0.99


def test_forward_keeps_the_leading_shape():
    disks = clean_disks("dots", attitudes(4))
    found = search_of("dots").propose(disks)
    shaped = search_of("dots")(disks.reshape(2, 2, SIZE, SIZE))
    T = shaped.score
    assert shaped.R_view_body.shape == (*T.shape, 3, 3)
    assert shaped.reason == found.reason
    assert T.shape[:2] == (2, 2)
    assert_close(T.flatten(0, 1)[:, 0], found.score[found.offset[:-1]])
    assert torch.equal(torch.isfinite(T).sum(-1).flatten(), found.counts)


def test_a_disk_without_a_candidate_has_a_reason_and_the_others_have_theirs():
    found = search_of("blobs")(torch.cat([clean_disks("blobs", attitudes(1)), noise(1)]))
    assert found.reason == (Reason.OK, Reason.RUNAWAY)
    assert bool(found.score[1].isnan().all())
    assert search_of("blobs")(torch.zeros(0, SIZE, SIZE)).reason == ()


# --- a map that is unseen in part


def unseen_cap(height: int, share: float = 0.36) -> torch.Tensor:
    """The texels of a cap about the south pole that covers a share of the sphere."""
    return map_directions(height)[..., 2] < 2 * share - 1


@pytest.mark.parametrize("kind", KINDS)
def test_renderings_of_a_map_that_is_unseen_in_part_are_found(kind):
    """9 of 20 got no candidate; now all that show half of their paint or more, and the others have a reason."""
    whole, R = texture_of(kind), attitudes(40)
    unseen = unseen_cap(len(whole))
    patchy = torch.where(unseen, torch.nan, whole)
    bank = TemplateBank(patchy, SIZE)
    shown = orthographic_view(SIZE).render((~unseen).float(), R.float())
    enough = shown[:, disk_offsets(SIZE).norm(dim=-1) <= 1].mean(-1) > 0.5
    assert 20 < int(enough.sum()) < 40
    own, ball = (bank(disks) for disks in (SphereRenderer(patchy, size_px=SIZE)(R.float()), clean_disks(kind, R)))
    for found in (own, ball):
        there = found.score[:, 0].isfinite()
        assert there.tolist() == [why is Reason.OK for why in found.reason]
        best = so3.geodesic_distance(found.R_view_body[:, 0], R).rad2deg()
        assert float(best[enough & there].max()) < 5.0
    assert bool(own.score[enough, 0].isfinite().all())


def test_T_of_known_paint_alone_is_1_of_the_right_picture_and_lower_for_the_same_share_of_fewer_pixels():
    whole, R = texture_of("patches"), attitudes(12)
    patchy = torch.where(unseen_cap(len(whole)), torch.nan, whole)
    bank = TemplateBank(patchy, SIZE, OrientSettings(coarse_step_deg=30))
    paint = torch.sign(SphereRenderer(whole, size_px=SIZE)(R.float()) - 0.5)
    T, all_seen = bank.quality(paint, R.float()), search_of("patches").quality(paint, R.float())
    assert float((T - all_seen).max()) < 0.02
    assert float(T.max()) > 0.85


# --- one disk, many disks


@pytest.mark.slow
def test_a_disks_answer_does_not_depend_on_which_others_come_with_it():
    search, R_view_body = search_of("blobs"), attitudes(35)  # more than one batch
    disks = clean_disks("blobs", R_view_body) + noise(35) / 20
    together = search.propose(disks)
    reversed_order = search.propose(disks.flip(0))
    three = search.propose(disks[[34, 2, 17]])
    assert together.reason == reversed_order.reason[::-1]
    for disk in range(35):
        for got, expected in zip(of_disk(reversed_order, 34 - disk), of_disk(together, disk), strict=True):
            assert torch.equal(got, expected)
    for place, disk in enumerate((34, 2, 17)):
        for got, expected in zip(of_disk(three, place), of_disk(together, disk), strict=True):
            assert torch.equal(got, expected)
    for disk in (0, 31, 32):
        for got, expected in zip(
            of_disk(search.propose(disks[disk : disk + 1]), 0), of_disk(together, disk), strict=True
        ):
            assert torch.equal(got, expected)


def test_no_disks_give_no_proposals():
    found = search_of("blobs").propose(torch.zeros(0, SIZE, SIZE))
    assert found.offset.tolist() == [0]
    assert found.R_view_body.shape == (0, 3, 3)
    assert found.reason == ()


def test_disks_of_another_size_are_refused_and_an_odd_size_is_rounded_up():
    with pytest.raises(ShapeError, match=r"disks: expected \(F, 48, 48\)"):
        search_of("blobs").propose(torch.zeros(2, SIZE + 2, SIZE + 2))
    search = TemplateBank(texture_of("blobs"), SIZE - 1, OrientSettings())
    assert search.size_px == SIZE
    R_view_body = attitudes(2)
    assert best_errors_deg(search.propose(clean_disks("blobs", R_view_body)), R_view_body).max() < 4


# --- pictures without the sphere


def test_noise_fits_everywhere_and_is_a_runaway():
    found = search_of("blobs").propose(noise(6))
    assert found.reason == (Reason.RUNAWAY,) * 6
    assert len(found.score) == 0
    assert found.offset.tolist() == [0] * 7


def test_a_disk_of_one_grey_is_a_runaway():
    assert search_of("blobs").propose(torch.full((1, SIZE, SIZE), 90.0)).reason == (Reason.RUNAWAY,)


def test_noise_does_not_change_its_neighbours():
    disks = clean_disks("blobs", attitudes(3))
    found = search_of("blobs").propose(torch.cat([disks[:1], noise(1), disks[1:]]))
    assert found.reason == (Reason.OK, Reason.RUNAWAY, Reason.OK, Reason.OK)
    assert best_errors_deg(search_of("blobs").propose(disks), attitudes(3)).max() < 4
    alone = search_of("blobs").propose(disks)
    assert torch.equal(found.R_view_body, alone.R_view_body)
    assert torch.equal(found.score, alone.score)


@pytest.mark.slow
def test_no_proposal_scores_below_score_min_and_those_above_stay():
    disks = clean_disks("dots", attitudes(30))
    all_of_them = search_of("dots").propose(disks)
    few = TemplateBank(texture_of("dots"), SIZE, OrientSettings(score_min=0.8)).propose(disks)
    assert (all_of_them.score < 0.8).any()
    assert (few.score >= 0.8).all()
    assert torch.equal(few.score, all_of_them.score[all_of_them.score >= 0.8])


def test_a_disk_whose_best_is_below_score_min_has_the_reason_low_score():
    search = TemplateBank(texture_of("blobs"), SIZE, OrientSettings(score_min=1.0))
    found = search.propose(clean_disks("blobs", attitudes(2)))
    assert found.reason == (Reason.LOW_SCORE,) * 2
    assert found.offset.tolist() == [0, 0, 0]


# --- groups


@pytest.mark.parametrize("group_deg", [30.0, 45.0])
def test_the_members_of_a_group_are_near_its_first_and_the_firsts_are_apart(group_deg):
    settings = OrientSettings(group_deg=group_deg, score_margin=0.2, groups_max=500)
    bank = TemplateBank(texture_of("dots"), SIZE, settings)
    T = bank.score(bank.paint(clean_disks("dots", attitudes(6))))
    group = bank.groups(T)
    assert torch.equal(group >= 0, T.amax(-1, keepdim=True) - 0.2 < T)
    assert (group.amax(-1) > 0).any()
    for own, quality in zip(group, T, strict=True):
        firsts = []
        for number in range(int(own.max()) + 1):
            members = torch.nonzero(own == number)[:, 0]
            first = members[quality[members].argmax()]
            assert so3.geodesic_distance(bank.grid[first], bank.grid[members]).rad2deg().max() <= group_deg + 0.01
            firsts.append(first)
        heads = torch.stack(firsts)
        assert (quality[heads].diff() <= 0).all()
        gap = so3.geodesic_distance(bank.grid[heads][:, None], bank.grid[heads]).rad2deg() + 360 * torch.eye(
            len(firsts)
        )
        assert gap.min() >= group_deg - 0.01


@pytest.mark.slow
def test_more_groups_than_allowed_are_a_runaway():
    disks = clean_disks("dots", attitudes(12))
    many = search_of("dots").propose(disks)
    assert (many.offset.diff() > 1).any()
    one = TemplateBank(texture_of("dots"), SIZE, OrientSettings(groups_max=1)).propose(disks)
    for disk in range(12):
        if many.offset.diff()[disk] > 1:
            assert one.reason[disk] == Reason.RUNAWAY
    assert Reason.OK in one.reason


@pytest.mark.slow
def test_two_groups_that_climb_to_one_place_give_one_proposal():
    settings = OrientSettings(group_deg=10.0, groups_max=500, score_margin=0.15)
    found = TemplateBank(texture_of("blobs"), SIZE, settings).propose(clean_disks("blobs", attitudes(2)))
    for disk in range(2):
        R, _ = of_disk(found, disk)
        gap = so3.geodesic_distance(R[:, None], R[None]).rad2deg() + 360 * torch.eye(len(R))
        assert gap.min() >= 2 * settings.fine_step_deg - 1e-6
