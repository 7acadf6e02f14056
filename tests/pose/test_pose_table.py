import torch

from sphereorient import so3
from sphereorient.pose.poses import POSE_PARTS, FittedPoses, Poses, exchanged, no_pose, pose_table, pose_tables
from sphereorient.trajectory import Reason

CAMERAS = 2
OK = (Reason.OK, Reason.OK)
TAILS = {"position_lab_mm": (3,), "R_lab_body": (3, 3), "covariance": (6, 6), "nll": (), "step": (6,)}
TAILS |= {"own_turn": (CAMERAS, 3), "own_covariance": (CAMERAS, 3, 3), "own_move": (CAMERAS, 3)}
TAILS |= dict.fromkeys(("own_sigma_mm", "limb_coverage", "excess", "score"), (CAMERAS,))


def poses(count: int, seed: int, reason: tuple[Reason, ...] = OK) -> Poses:
    """Poses of which every number is its own."""
    rng = torch.Generator().manual_seed(seed)
    parts = {name: torch.rand(count, *tail, generator=rng, dtype=torch.float64) for name, tail in TAILS.items()}
    parts["R_lab_body"] = so3.random_rotations(count, generator=rng)
    parts["nll"] = 100 * seed + parts["nll"].sort().values
    return Poses(**parts, use=torch.tensor([why == Reason.OK for why in reason]), reason=reason)


def test_the_parts_that_are_gathered_are_all_that_a_pose_has():
    assert set(POSE_PARTS) == set(TAILS)


def test_every_pose_keeps_its_frame_and_rank():
    frames = [poses(2, 1), no_pose(CAMERAS, (Reason.NOT_FOUND,) * 2), poses(3, 3), poses(1, 4)]
    table = pose_table(frames, CAMERAS)
    assert len(table) == 4
    assert table.mask.tolist() == [[True, True, False], [False] * 3, [True] * 3, [True, False, False]]
    for k, frame in enumerate(frames):
        for name in POSE_PARTS:
            part, expected = getattr(table, name), getattr(frame, name)
            assert part.shape == (4, 3, *TAILS[name])
            assert part.dtype == torch.float64
            if name != "nll":
                assert part[k, : len(frame)].equal(expected)


def test_nll_counts_from_the_best_of_its_frame():
    frames = [poses(2, 1), no_pose(CAMERAS, (Reason.NOT_FOUND,) * 2), poses(3, 3)]
    nll = pose_table(frames, CAMERAS).nll
    assert nll[:, 0].tolist() == [0.0, 0.0, 0.0]
    assert nll[0, :2].equal(frames[0].nll - frames[0].nll[0])
    assert nll[2].equal(frames[2].nll - frames[2].nll[0])


def test_places_not_in_use_hold_the_unit_rotation_and_zeros():
    table = pose_table([poses(1, 1), poses(3, 2)], CAMERAS)
    free = ~table.mask
    assert int(free.sum()) == 2
    assert table.R_lab_body[free].equal(torch.eye(3, dtype=torch.float64).expand(2, 3, 3))
    for name in set(POSE_PARTS) - {"R_lab_body", "nll"}:
        assert (getattr(table, name)[free] == 0).all()
    assert table.nll[free].isfinite().all()


def test_cameras_and_reasons_go_with_their_frames():
    lost = (Reason.NOT_FOUND, Reason.OUTLINE)
    frames = [poses(1, 1, (Reason.OK, Reason.OUTLINE)), no_pose(CAMERAS, lost), poses(1, 2)]
    table = pose_table(frames, CAMERAS)
    assert table.use.tolist() == [[True, False], [False, False], [True, True]]
    assert table.reason == ((Reason.OK, Reason.OUTLINE), lost, OK)


def test_frames_that_all_lack_a_pose_make_a_table_with_one_free_place():
    table = pose_table([no_pose(CAMERAS, (Reason.NOT_FOUND,) * 2)] * 3, CAMERAS)
    assert table.mask.shape == (3, 1)
    assert not table.mask.any()
    assert table.R_lab_body.shape == (3, 1, 3, 3)


def test_rows_are_the_chosen_places_and_nan_where_none_is_chosen():
    frames = [poses(2, 1), poses(3, 2), poses(1, 3), no_pose(CAMERAS, (Reason.NOT_FOUND,) * 2)]
    table = pose_table(frames, CAMERAS)
    rows = table.rows(torch.tensor([1, 2, -1, -1]))
    assert set(rows) == set(POSE_PARTS)
    for name, part in rows.items():
        assert part.shape == (4, *TAILS[name])
        if name != "nll":
            assert part[0].equal(getattr(frames[0], name)[1])
            assert part[1].equal(getattr(frames[1], name)[2])
        assert part[2:].isnan().all()
    # The table itself is as before.
    assert not table.R_lab_body.isnan().any()


def test_batches_of_several_balls_give_the_tables_of_all_their_frames():
    one, other = [poses(1, 1), poses(3, 2), poses(2, 3)], [poses(2, 4), poses(1, 5), poses(1, 6)]
    batches = [{"a": one[:1], "b": other[:1]}, {"a": one[1:], "b": other[1:]}]
    tables = pose_tables(batches, "ab", CAMERAS)
    for name, frames in (("a", one), ("b", other)):
        whole = pose_table(frames, CAMERAS)
        assert all(part.equal(whole.parts()[key]) for key, part in tables[name].parts().items())
        assert tables[name].mask.equal(whole.mask)
        assert tables[name].use.equal(whole.use)
        assert tables[name].reason == whole.reason


def test_exchanged_tables_are_those_of_exchanged_frames():
    blind = (Reason.OK, Reason.NOT_FOUND)
    one = [poses(1, 1), poses(3, 2), poses(2, 3)]
    other = [poses(2, 4, blind), poses(1, 5, blind), poses(1, 6, blind)]
    row = torch.tensor([[0, 1, 0], [1, 0, 1]])
    wanted = [pose_table(frames, CAMERAS) for frames in ([one[0], other[1], one[2]], [other[0], one[1], other[2]])]
    for found, whole in zip(
        exchanged([pose_table(one, CAMERAS), pose_table(other, CAMERAS)], row), wanted, strict=True
    ):
        most = whole.mask.shape[1]
        assert found.mask[:, :most].equal(whole.mask)
        assert not found.mask[:, most:].any()
        assert all(part[found.mask].equal(whole.parts()[key][whole.mask]) for key, part in found.parts().items())
        assert found.use.equal(whole.use)
        assert found.reason == whole.reason


def test_rows_of_fits_are_exchanged_also_none():
    fits = [FittedPoses(**poses(3, seed).parts()) for seed in (1, 2)]
    for rows in ([], [2, 0]):
        found = fits[0].with_rows(rows, fits[1].of(torch.arange(len(rows))))
        for name in POSE_PARTS:
            expected = getattr(fits[0], name).clone()
            for k, row in enumerate(rows):
                expected[row] = getattr(fits[1], name)[k]
            assert torch.equal(getattr(found, name), expected)
