"""The path as a layer: its costs against a slow loop, the state for none, gradients, learning, and use in `track`."""

from __future__ import annotations

import doctest
import itertools
import math
from collections.abc import Mapping

import numpy as np
import pytest
import torch
import yaml
from assemble_examples import RATE_HZ, times, turning
from conftest import REPO, assert_close
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_t
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble import (
    AssembleSettings,
    Chosen,
    PathLayer,
    PathSettings,
    SoftPath,
    edge_costs,
    layer,
    shortest_path,
    soft_path,
)
from sphereorient.assemble.second_order_cost import PARAMETERS
from sphereorient.errors import SettingsError, ShapeError
from sphereorient.methods.settings import load_settings

SIGMA = math.radians(0.3)
SETTINGS = PathSettings(acceleration_rad_s2=math.radians(0.3) * RATE_HZ**2, break_probability=0.01)
Parts = dict[str, Tensor]


def changed(**values: float) -> PathSettings:
    return SETTINGS.model_copy(update=values)


def movie(R: Tensor, *others: Tensor, nll: Tensor | None = None, seed: int = 0) -> Parts:
    """The true candidate, in place 0, with noise, and others."""
    rng = torch.Generator().manual_seed(seed)
    noise = so3.exp(SIGMA * torch.randn(len(R), 3, generator=rng, dtype=torch.float64))
    every = torch.stack([noise @ R, *others], 1)
    shape = every.shape[:2]
    return {
        "R_lab_body": every,
        "score": torch.zeros(shape, dtype=torch.float64) if nll is None else -nll,
        "variance_rad2": torch.full(shape, SIGMA**2, dtype=torch.float64),
        "mask": torch.ones(shape, dtype=torch.bool),
        "time_s": times(len(R)),
    }


def soft(parts: Mapping[str, Tensor], settings: PathSettings = SETTINGS, temperature: float = 1.0) -> SoftPath:
    found = PathLayer(2, soft=temperature, settings=settings)(**parts)
    assert isinstance(found, SoftPath)
    return found


def choice(parts: Mapping[str, Tensor], settings: PathSettings = SETTINGS) -> Tensor:
    found = PathLayer(2, settings=settings)(**parts)
    assert isinstance(found, Chosen)
    return found.choice


def cheapest(parts: Mapping[str, Tensor], settings: PathSettings = SETTINGS) -> Tensor:
    """The cheapest path of the costs of the soft path: another algorithm and a coarser cost; -1 for none."""
    module, mask = PathLayer(2, soft=1.0, settings=settings), parts["mask"]
    costs = (parts[name] for name in ("R_lab_body", "score", "time_s", "variance_rad2", "mask"))
    edge, there, node, triple = module._second_order_costs(*costs)
    place = shortest_path(edge, there, node, triple).choice
    return torch.where(place == mask.shape[-1], -1, place)


def triples(settings: PathSettings, *parts: Tensor) -> Tensor:
    return layer.triple_costs(PathLayer(soft=1.0, settings=settings).cost(parts[0]), *parts)


def density(chord: float, spread: float, w: PathSettings) -> float:
    pdf = multivariate_t.pdf([chord, 0, 0], shape=spread * np.eye(3), df=w.tail)
    return float(8 * math.pi**2 * pdf) if spread < 1 else 1.0


def slow_cost(R: list[Rotation], variance: list[float], t: list[float], still: float, w: PathSettings) -> float:
    """Cost of three orientations in a row; `still`: ratio by which the third stands where one stood before."""
    span, dt = t[1] - t[0], t[2] - t[1]
    turn = (R[1] * R[0].inv()).as_rotvec()
    expected = Rotation.from_rotvec(turn * dt / span) * R[1]
    chord = 2 * math.sin((R[2] * expected.inv()).magnitude() / 2)
    drift = w.acceleration_rad_s2 * (span + dt) / 2 * dt
    r = dt / span
    spread = drift**2 + w.sigma_scale**2 * (variance[2] + (1 + r) ** 2 * variance[1] + r**2 * variance[0])
    follows = (1 - w.break_probability) * density(chord, spread, w) + w.break_probability
    stuck, follow = w.stuck_probability, w.follow_probability
    false = (1 - stuck - follow) + stuck * min(still, follows) + follow * follows
    return math.log(false) - math.log(follows)


def slow_still(
    R: list[Rotation], after: Rotation, variance: list[float], here: float, dt: float, w: PathSettings
) -> float:
    ratios = []
    for before, error in zip(R, variance, strict=True):
        chord = 2 * math.sin((after * before.inv()).magnitude() / 2)
        spread = (w.acceleration_rad_s2 * dt**2) ** 2 + 3 * w.sigma_scale**2 * (error + here)
        ratios.append(density(chord, spread, w))
    return max(ratios)


def test_costs_of_triples_agree_with_a_slow_loop_at_uneven_times_and_over_a_hole(rng):
    w = changed(sigma_scale=1.3, tail=3.0, break_probability=0.02, stuck_probability=0.2, follow_probability=0.05)
    R = so3.exp(0.2 * torch.randn(5, 2, 3, generator=rng, dtype=torch.float64))
    variance = SIGMA**2 * (1 + torch.rand(5, 2, generator=rng, dtype=torch.float64))
    time = torch.tensor([0.0, 1.0, 2.5, 3.0, 4.0], dtype=torch.float64) / RATE_HZ
    mask = torch.ones(5, 2, dtype=torch.bool)
    mask[2] = False
    got = triples(w, R, variance, time, mask).detach()
    turned = [[Rotation.from_matrix(each.numpy()) for each in frame] for frame in R]
    for a, b, c in ((0, 1, 3), (1, 3, 4)):
        for i, j, k in itertools.product(range(2), repeat=3):
            dt = float(time[c] - time[b])
            still = slow_still(turned[b], turned[c][k], variance[b].tolist(), float(variance[c, k]), dt, w)
            three = [turned[a][i], turned[b][j], turned[c][k]]
            errors = [float(variance[a, i]), float(variance[b, j]), float(variance[c, k])]
            expected = slow_cost(three, errors, [float(time[x]) for x in (a, b, c)], still, w)
            assert float(got[c - 2, i, j, k]) == pytest.approx(expected, abs=1e-7), (a, b, c, i, j, k)  # log's eps


def test_costs_do_not_depend_on_how_many_are_computed_at_once(rng, monkeypatch):
    R = so3.random_rotations((2, 7, 3), generator=rng)
    variance, time = torch.full((2, 7, 3), 1e-3, dtype=torch.float64), times(7).expand(2, 7)
    mask = torch.rand(2, 7, 3, generator=rng) < 0.8
    whole = triples(SETTINGS, R, variance, time, mask)
    monkeypatch.setattr(layer, "TRIPLES_AT_ONCE", 1)
    assert_close(triples(SETTINGS, R, variance, time, mask), whole)


@pytest.mark.parametrize("steps", [0, 1, 2])
def test_movies_too_short_for_a_triple_have_no_costs(steps):
    cost = triples(
        SETTINGS,
        torch.eye(3).expand(steps, 2, 3, 3),
        torch.ones(steps, 2),
        torch.arange(float(steps)),
        torch.ones(steps, 2) > 0,
    )
    assert cost.shape == (0, 2, 2, 2)


def test_costs_are_the_same_in_single_precision_where_errors_are_small(rng):
    every = movie(turning(20, 20.0), so3.random_rotations(20, generator=rng))
    R, variance, time, mask = (every[name] for name in ("R_lab_body", "variance_rad2", "time_s", "mask"))
    single = triples(SETTINGS, R.float(), variance.float(), time + 20_000.0, mask)
    assert single.dtype == torch.float32
    assert_close(single.double(), triples(SETTINGS, R, variance, time, mask), 2e-3)


def test_the_true_candidate_is_found_among_false_ones_that_stand_and_that_are_anywhere(rng):
    R = turning(60, 4.0)
    standing = so3.random_rotations((), generator=rng).expand(60, 3, 3)
    every = movie(R, standing, so3.random_rotations(60, generator=rng))
    assert choice(every).tolist() == cheapest(every).tolist() == [0] * 60
    marginals = soft(every).marginals
    assert marginals.shape == (60, 4)
    assert (marginals[:, 0] > 0.97).all()


def test_frames_in_which_no_candidate_is_right_get_none_and_empty_frames_nothing(rng):
    R = turning(60, 4.0)
    R[20] = so3.random_rotations((), generator=rng)
    every = movie(R)
    every["mask"][40:43] = False
    every["R_lab_body"][40:43] = torch.nan
    chosen = choice(every)
    assert chosen[20] == -1
    assert chosen[40:43].tolist() == [-1] * 3
    assert (chosen == 0).sum() == 56
    every["R_lab_body"][40:43] = torch.eye(3, dtype=torch.float64)
    assert torch.equal(cheapest(every), chosen)
    every["R_lab_body"][40:43] = torch.nan
    marginals = soft(every).marginals
    assert marginals[20, 1] > 0.9
    assert not marginals[40:43].any()
    assert marginals[43, 0] > 0.9  # the motion goes on after the gap


def test_the_pictures_likelihood_decides_between_twins(rng):
    R = turning(30, 4.0)
    nll = torch.stack([torch.full((30,), 0.5), torch.zeros(30)], 1).double()
    half = so3.exp(torch.tensor([0.0, 0.0, torch.pi], dtype=torch.float64))
    every = movie(R, R @ half, nll=nll)
    every["R_lab_body"][:, 1] = every["R_lab_body"][:, 0] @ half  # exactly as smooth
    assert choice(every).tolist() == cheapest(every).tolist() == [1] * 30
    assert soft(every).marginals[15, 1] > 0.99
    assert abs(float(soft(every, changed(evidence_scale=1e-3)).marginals[15, 1].detach()) - 0.5) < 0.02


def test_at_a_greater_temperature_less_is_sure(rng):
    every = movie(turning(30, 4.0), so3.random_rotations(30, generator=rng))
    sure = [float(soft(every, temperature=each).marginals[15, 0].detach()) for each in (1.0, 4.0, 16.0)]
    assert sure[0] > sure[1] > sure[2]


def random_parts(batch: tuple[int, ...], rng: torch.Generator) -> Parts:
    return {
        "R_lab_body": so3.random_rotations((*batch, 8, 2), generator=rng),
        "score": torch.rand(*batch, 8, 2, generator=rng, dtype=torch.float64),
        "variance_rad2": torch.full((*batch, 8, 2), SIGMA**2, dtype=torch.float64),
        "mask": torch.rand(*batch, 8, 2, generator=rng) < 0.7,
        "time_s": (torch.arange(8) + 0.3 * torch.rand(*batch, 8, generator=rng)).double() / RATE_HZ,
    }


@pytest.mark.parametrize("order", [1, 2])
def test_a_batch_is_the_stack_of_its_movies_and_arrays_of_numpy_are_accepted(order, batch, rng):
    parts = random_parts(batch, rng)
    module = PathLayer(order, soft=1.0, settings=SETTINGS if order == 2 else AssembleSettings(quality_min=0.2))
    together = module(**parts).marginals
    assert together.shape == (*batch, 8, order + 1)
    for at in itertools.product(*map(range, batch)):
        assert_close(together[at], module(**{name: part[at] for name, part in parts.items()}).marginals, 1e-10)
    assert_close(module(**{name: part.numpy() for name, part in parts.items()}).marginals, together, 0.0)
    single = module(**{name: part if name == "mask" else part.float() for name, part in parts.items()})
    assert single.marginals.dtype == torch.float32


def test_histories_of_a_batch_are_the_stack_of_those_of_its_movies(batch, rng):
    parts = random_parts(batch, rng)
    module = PathLayer(2, settings=PathSettings())
    assert list(module.parameters()) == []
    together = module(**parts)
    assert together.choice.shape == (*batch, 8)
    assert together.posterior.shape == (*batch, 8, 2)
    assert together.acceleration_rad_s2.shape == batch
    for at in itertools.product(*map(range, batch)):
        alone = module(**{name: part[at] for name, part in parts.items()})
        for name in Chosen.__dataclass_fields__:
            assert_close(getattr(together, name)[at], getattr(alone, name), 0.0)
    assert torch.equal(module(**{name: part.numpy() for name, part in parts.items()}).choice, together.choice)


def test_the_first_order_is_the_papers_path(rng):
    parts = random_parts((3,), rng)
    del parts["variance_rad2"]
    parts["mask"][:] = True  # without gaps its edges are those of the paper's assembly
    settings = AssembleSettings(quality_min=0.0)
    edges = edge_costs(parts["R_lab_body"], parts["score"], parts["time_s"])
    hard = PathLayer(1, settings=settings)(**parts)
    assert torch.equal(hard.choice, shortest_path(edges, parts["mask"]).choice)
    warm = PathLayer(1, soft=50.0, settings=settings)(**parts)
    assert_close(warm.marginals, soft_path(edges, parts["mask"], 50.0).marginals)
    parts["mask"][0, 3] = False
    keep = [0, 1, 2, 4, 5, 6, 7]
    without = {name: part[:, keep] for name, part in parts.items()}
    assert_close(PathLayer(1, settings=settings)(**parts).cost[0], PathLayer(1, settings=settings)(**without).cost[0])


def test_gradients_of_all_parameters_agree_with_differences(rng):
    nll = torch.rand(6, 2, generator=rng, dtype=torch.float64)
    every = movie(turning(6, 4.0), so3.random_rotations(6, generator=rng), nll=nll)
    every["mask"][3] = False
    module = PathLayer(2, soft=1.0, settings=SETTINGS)
    raw = tuple(module.get_parameter(name).detach().clone().requires_grad_() for name in PARAMETERS)

    def marginals(*values: Tensor) -> Tensor:
        found: SoftPath = torch.func.functional_call(module, dict(zip(PARAMETERS, values, strict=True)), (), every)
        return found.marginals

    assert torch.autograd.gradcheck(marginals, raw)
    slopes = torch.autograd.grad(marginals(*raw).square().sum(), raw)
    assert [name for name, slope in zip(PARAMETERS, slopes, strict=True) if slope == 0] == []


@pytest.mark.parametrize("order", [1, 2])
def test_gradients_to_candidates_and_scores_agree_with_differences(order, rng):
    delta = 0.3 * torch.randn(4, 2, 3, generator=rng, dtype=torch.float64)
    score = 0.5 + 0.4 * torch.rand(4, 2, generator=rng, dtype=torch.float64)
    module = PathLayer(order, soft=20.0 if order == 1 else 1.0, settings=SETTINGS if order == 2 else None)

    def marginals(delta: Tensor, score: Tensor) -> Tensor:
        variance = torch.full_like(score, 0.01)
        return module(so3.exp(delta), score, times(4), variance).marginals

    assert torch.autograd.gradcheck(marginals, (delta.requires_grad_(), score.requires_grad_()), atol=1e-4)


def test_gradients_to_the_candidates_are_finite_also_where_they_coincide():
    R = torch.eye(3, dtype=torch.float64).repeat(5, 2, 1, 1).requires_grad_()
    score = torch.zeros(5, 2, dtype=torch.float64, requires_grad=True)
    parts = {"R_lab_body": R, "score": score, "variance_rad2": torch.full((5, 2), 1e-4), "time_s": times(5)}
    soft(parts).marginals[:, 0].square().sum().backward()
    assert torch.isfinite(R.grad).all()
    assert torch.isfinite(score.grad).all()


def test_sigmas_that_were_claimed_too_small_are_learnt(rng):
    every = movie(turning(100, 4.0), so3.random_rotations(100, generator=rng))
    every["variance_rad2"] = every["variance_rad2"] / 9
    module = PathLayer(2, soft=1.0, settings=changed(acceleration_rad_s2=1.0, tail=30.0))  # all misfit is noise
    optimizer = torch.optim.Adam([module.get_parameter("sigma_scale")], lr=0.1)
    losses = []
    for _ in range(25):
        optimizer.zero_grad()
        loss = module(**every).marginals[:, 0].log().mean().neg()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0]
    assert module.settings.sigma_scale > 1.3


def test_learnt_settings_are_read_by_track_and_change_its_path(rng, tmp_path):
    # The likelihoods are four times too large in nats, so that a false candidate wins where it should not.
    R = turning(40, 4.0)
    nll = torch.zeros(40, 2, dtype=torch.float64)
    nll[10:30, 0] = 4 * 2.0
    twin = R @ so3.exp(torch.tensor([0.0, 0.0, torch.pi], dtype=torch.float64))
    nll[:10, 1] = nll[30:, 1] = 4 * 1.5
    anywhere = so3.random_rotations(40, generator=rng)
    every = movie(R, torch.where((torch.arange(40) % 2 == 0)[:, None, None], twin, anywhere), nll=nll)
    module = PathLayer(2, soft=1.0, settings=SETTINGS)
    with torch.no_grad():
        module.get_parameter("evidence_scale").fill_(math.log(0.25))
    (tmp_path / "learnt.yaml").write_text(yaml.safe_dump({"path": module.settings.model_dump()}))
    learnt = load_settings(tmp_path / "learnt.yaml").path
    assert learnt.evidence_scale == pytest.approx(0.25)
    before, after = (PathLayer(2, settings=each)(**every) for each in (SETTINGS, learnt))
    honest = PathLayer(2, settings=SETTINGS)(**{**every, "score": -nll / 4})
    assert_close(after.posterior, honest.posterior, 1e-9)
    assert (before.posterior - after.posterior).abs().max() > 0.01


def test_settings_come_back_as_they_went_in_and_impossible_ones_are_refused():
    assert PathLayer(settings=SETTINGS).settings == SETTINGS
    there = PathLayer(soft=1.0, settings=SETTINGS).settings
    for name in PathSettings.model_fields:
        assert getattr(there, name) == pytest.approx(getattr(SETTINGS, name), rel=1e-12)
    with pytest.raises(SettingsError, match="acceleration_rad_s2"):
        PathLayer(2, soft=1.0)
    with pytest.raises(SettingsError, match="AssembleSettings"):
        PathLayer(1, settings=SETTINGS)
    with pytest.raises(SettingsError, match="order: expected 1 or 2"):
        PathLayer(3)
    every = movie(turning(4))
    with pytest.raises(ShapeError, match="score: expected shape"):
        choice({**every, "score": torch.zeros(3, 1)})
    with pytest.raises(ShapeError, match="time_s: expected"):
        choice({**every, "time_s": times(3)})


def test_the_example_of_the_page_runs():
    failed, tried = doctest.testfile(str(REPO / "docs" / "assembly.md"), module_relative=False)
    assert tried >= 12
    assert failed == 0
