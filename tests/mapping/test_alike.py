"""Maps of balls with the same paint are joined; maps of other balls stay."""

from types import SimpleNamespace

import pytest
import torch

from sphereorient import so3
from sphereorient.files.threads import silent
from sphereorient.mapping import LearntMap
from sphereorient.mapping.balls import corrected, shared_maps
from sphereorient.sphere.compare import turned_map
from sphereorient.sphere.texture import map_directions, random_texture
from sphereorient.synth import SynthSettings

pytestmark = pytest.mark.slow  # 15 s
ROWS, SIGMA = 64, 0.06
Q = so3.exp(torch.tensor([[0.4, -1.1, 0.7]], dtype=torch.float64))[
    0
]  # what the first shows at d, the other shows at Q d


def learnt(paint: torch.Tensor, seed: int) -> LearntMap:
    """A noisy map that does not show one pole, and the attitudes of three frames."""
    seen = map_directions(ROWS).reshape(ROWS, 2 * ROWS, 3)[..., 2] < 0.8
    noise = SIGMA * torch.randn(paint.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    rest = dict.fromkeys(LearntMap.__dataclass_fields__, SimpleNamespace())
    known = {
        "texture": torch.where(seen, paint + noise, torch.nan).float(),
        "seen": 5 * seen.long(),
        "sigma": torch.where(seen, SIGMA, torch.inf).float(),
        "R_lab_body": so3.random_rotations(3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64),
    }
    return LearntMap(**{**rest, **known})


@pytest.fixture(scope="module")
def maps():
    paints = [
        torch.nn.functional.avg_pool2d(random_texture(SynthSettings().texture, seed)[None].double(), 512 // ROWS)[0]
        for seed in (3, 4)
    ]
    turned = turned_map(paints[0], Q.mT)
    of = {"a": learnt(paints[0], 0), "b": learnt(paints[1], 1), "c": learnt(turned, 2)}
    return paints, of, shared_maps(of, silent)


def test_balls_of_one_paint_share_a_map_and_its_frame(maps):
    _, of, shared = maps
    assert [shared[name].first for name in "abc"] == ["a", "b", "a"]
    assert shared["a"].learnt.texture is shared["c"].learnt.texture
    assert shared["b"].learnt is of["b"]
    turn = shared["c"].learnt.R_lab_body @ (of["c"].R_lab_body @ Q).mT
    assert float(torch.rad2deg(so3.geodesic_distance(turn, torch.eye(3).double())).max()) < 0.5
    assert torch.equal(shared["a"].learnt.R_lab_body, of["a"].R_lab_body)


def test_the_map_that_they_share_shows_more_and_has_less_noise(maps):
    paints, of, shared = maps
    one, joined = of["a"], shared["a"].learnt
    assert int((joined.seen > 0).sum()) > int((one.seen > 0).sum())
    assert float((joined.texture.isfinite() & one.texture.isnan()).sum()) > 0
    both = (one.seen > 0) & (joined.seen == 10)
    error = [(part.texture.double() - paints[0])[both].std() for part in (one, joined)]
    assert float(error[1] / error[0]) < 0.9
    assert float(joined.sigma[both].median()) == pytest.approx(SIGMA / 2**0.5, rel=0.05)
    assert bool((joined.texture.isfinite() == (joined.seen > 0)).float().mean() > 0.99)


def test_paint_that_neither_the_old_map_nor_the_new_one_knows_stays_unknown():
    paint, height = random_texture("blobs", 3, ROWS).double(), map_directions(ROWS)[..., 2]
    new, _, share = corrected(learnt(paint, 1), torch.where(height > 0.9, torch.nan, paint).float())
    unknown = new.texture.isnan()
    assert bool(unknown[height > 0.95].all())
    assert not bool(unknown[height < 0.85].any())
    assert share == pytest.approx(0.05, abs=0.02)  # of the sphere, from 0.8 to 0.9
