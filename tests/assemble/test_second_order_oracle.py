"""The path with physics against all histories of short movies, one by one, and its probabilities against chance."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from assemble_examples import RATE_HZ, times, turned_deg, turning
from conftest import assert_close, slow
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_t
from second_order_examples import Hypotheses, physical_path, pooled

from sphereorient import so3
from sphereorient.assemble import PathSettings, beam


@dataclass
class Enumeration:
    """All histories of a movie by plain, slow recursion; names of settings and model as in the package."""

    hypotheses: Hypotheses
    time: list[float]
    s: PathSettings
    sums: dict[tuple[int, int], float] = field(default_factory=lambda: defaultdict(float))
    total: float = 0.0
    best: tuple[float, list[int]] = (-1.0, [])

    def __post_init__(self) -> None:
        h = self.hypotheses
        self.R = [[Rotation.from_matrix(R.numpy()) for R in frame] for frame in h.R_lab_body]
        self.variance = h.variance_rad2.tolist()
        self.there = [[int(k) for k in torch.nonzero(mask)] for mask in h.mask]
        self.frames = [f for f, there in enumerate(self.there) if there]
        self.usual = float(np.median(np.diff(self.time)))
        self.walk(0, None, [])

    def density(self, angle: float, variance: float) -> float:
        """Ratio to the uniform density."""
        shape = min(variance, 1.0) * np.eye(3)
        return 8 * math.pi**2 * float(multivariate_t.pdf([angle, 0, 0], shape=shape, df=self.s.tail))

    def picture(self, f: int, k: int) -> float:
        likelihood = [math.exp(-float(self.hypotheses.nll[f, j])) for j in self.there[f]]
        share = math.exp(-float(self.hypotheses.nll[f, k])) / sum(likelihood)
        return (1 - self.s.evidence_doubt) * share + self.s.evidence_doubt / len(likelihood)

    def still(self, f: int, k: int) -> float:
        ratios, place = [0.0], self.frames.index(f)
        for g in self.frames[max(place - 3, 0) : place]:
            dt = self.time[f] - self.time[g]
            for j in self.there[g]:
                angle = (self.R[f][k] * self.R[g][j].inv()).magnitude()
                spread = (self.s.acceleration_rad_s2 * dt**2) ** 2 + 3 * (self.variance[f][k] + self.variance[g][j])
                ratios.append(self.density(angle, spread))
        return max(ratios)

    def gain(self, f: int, k: int, ratio: float) -> float:
        """Right against false."""
        stuck, follow = self.s.stuck_probability, self.s.follow_probability
        false = (1 - stuck - follow) + stuck * min(self.still(f, k), ratio) + follow * ratio
        return self.picture(f, k) * ratio / false

    def onward(self, f: int, k: int, state: dict) -> list[tuple[float, np.ndarray]]:
        """Links from a state to a candidate: ratio of density and rotation; none where the motion is lost."""
        g, j, dt = state["frame"], state["candidate"], self.time[f] - self.time[state["frame"]]
        if dt > (self.s.gap_frames_max + 1.5) * self.usual:
            return []
        link = (self.R[f][k] * self.R[g][j].inv()).as_rotvec()
        angle, zones = np.linalg.norm(link), max(round(dt / self.usual), 1)
        turns = range(-(zones // 2), (zones - 1) // 2 + 1)
        around = {n: link * (1 + 2 * math.pi * n / angle) for n in turns}
        here, after, alpha = self.variance[g][j], self.variance[f][k], self.s.acceleration_rad_s2
        if state["turn"] is None:
            slow = self.density(angle, (alpha * dt**2) ** 2 + 3 * (here + after))
            return [(0.5 / zones + (0.5 * slow if n == 0 else 0.0), turn) for n, turn in around.items()]
        span, before = state["span"], state["variance_before"]
        expected = state["turn"] / span * dt
        known = (alpha * (span + dt) / 2 * dt) ** 2 + (1 + dt / span) ** 2 * here + (dt / span) ** 2 * before
        if known > 1.0:
            return []
        off = (self.R[f][k] * (Rotation.from_rotvec(expected) * self.R[g][j]).inv()).magnitude()
        nearest = min(around.values(), key=lambda turn: np.linalg.norm(turn - expected))
        return [(self.density(off, known + after), nearest)]

    def walk(self, place: int, state: dict | None, chosen: list[tuple[int, int]], weight: float = 1.0) -> None:
        if place == len(self.frames):
            self.total += weight
            for pair in chosen:
                self.sums[pair] += weight
            if weight > self.best[0]:
                self.best = (weight, list(chosen))
            return
        f = self.frames[place]
        last = chosen[-1][0] if chosen else None
        fresh = place == 0 or last == self.frames[place - 1]
        miss = self.s.miss_probability if fresh else self.s.miss_again_probability
        self.walk(place + 1, state, chosen, weight * miss)
        for k in self.there[f]:
            ways = self.onward(f, k, state) if state else []
            begin = {"frame": f, "candidate": k, "turn": None}
            breaks = self.s.break_probability if ways else 1.0
            self.walk(place + 1, begin, [*chosen, (f, k)], weight * (1 - miss) * breaks * self.gain(f, k, 1.0))
            for ratio, turn in ways:
                onward = begin | {
                    "turn": turn,
                    "span": self.time[f] - self.time[state["frame"]],
                    "variance_before": self.variance[state["frame"]][state["candidate"]],
                }
                step = (1 - miss) * (1 - self.s.break_probability) * self.gain(f, k, ratio)
                self.walk(place + 1, onward, [*chosen, (f, k)], weight * step)


def short_movie(seed: int) -> tuple[Hypotheses, torch.Tensor]:
    """Six frames at uneven times, one of them perhaps empty; candidates of all sorts near to and far from a motion."""
    rng = torch.Generator().manual_seed(seed)
    R = turning(6, float(3 + 10 * torch.rand((), generator=rng)))
    noise = 0.3 * torch.randn(6, 2, 3, generator=rng, dtype=torch.float64) * torch.tensor([[0.1], [3.0]])
    every = so3.exp(noise) @ R[:, None]
    every[4, 1] = turned_deg(every[3, 1], 0.1, 0.0, 0.0)  # as good as still
    mask = torch.tensor([[1, 1], [1, 0], [1, 1], [1, 1], [1, 1], [1, 0]]).bool()
    mask[seed % 6] = False
    size = 0.02 + 0.1 * torch.rand(6, 2, 1, generator=rng, dtype=torch.float64)
    hypotheses = Hypotheses(
        R_lab_body=every,
        nll=2 * torch.rand(6, 2, generator=rng, dtype=torch.float64),
        variance_rad2=size[..., 0] ** 2,
        mask=mask,
    )
    uneven = torch.tensor([0.0, 1.0, 2.0, 3.2, 4.0, 6.0], dtype=torch.float64) / RATE_HZ
    return hypotheses, uneven


@pytest.mark.parametrize("seed", [0, 3, *map(slow, (1, 2, 4, 5, 6, 7))])
def test_short_movies_agree_with_the_sum_over_all_histories_one_by_one(seed, monkeypatch):
    monkeypatch.setattr(beam, "BEAM_NATS", 1e9)
    hypotheses, time = short_movie(seed)
    settings = PathSettings(
        acceleration_rad_s2=0.05 * RATE_HZ**2, gap_frames_max=1, break_probability=0.02, miss_probability=0.1
    )
    path = physical_path(hypotheses, time, settings)
    oracle = Enumeration(hypotheses, time.tolist(), settings)
    posterior = torch.zeros(6, 2, dtype=torch.float64)
    for (f, k), weight in oracle.sums.items():
        posterior[f, k] = weight / oracle.total
    assert_close(path.posterior, posterior, 1e-9)
    assert float(posterior.max(1).values[path.present].min()) < 0.999  # a movie without a choice
    chosen = dict(oracle.best[1])
    assert path.choice.tolist() == [chosen.get(f, -1) for f in range(6)]


def test_probabilities_of_a_frame_and_of_none_make_one(rng):
    every = so3.random_rotations((80, 3), generator=rng)
    nll = torch.rand(80, 3, generator=rng, dtype=torch.float64)
    path = physical_path(pooled(*every.unbind(1), nll=nll), times(80), PathSettings())
    total = path.posterior.sum(1)
    assert (total <= 1 + 1e-9).all()
    assert (path.posterior >= 0).all()
    chosen = path.posterior[path.present].gather(1, path.choice[path.present, None])[:, 0]
    assert_close(path.probability[path.present], chosen)
    assert path.probability[~path.present].isnan().all()


def world(seed: int, frames: int, sigma: float, change: float, seen_share: float) -> tuple[Hypotheses, torch.Tensor]:
    """A movie drawn from the model: omega wanders, likelihoods are calibrated, the search fails in bursts.

    Returns:
        Hypotheses of three candidates a frame, and the place of the right one, -1 where there is none.
    """
    rng = torch.Generator().manual_seed(seed)
    turn = torch.tensor([0.08, 0.0, 0.05], dtype=torch.float64) + change * torch.randn(
        frames, 3, generator=rng, dtype=torch.float64
    ).cumsum(0)
    R = [torch.eye(3, dtype=torch.float64)]
    for each in turn[1:]:
        R.append(so3.exp(each) @ R[-1])
    every = so3.random_rotations((frames, 3), generator=rng)
    nll = 2 * torch.randn(frames, 3, generator=rng, dtype=torch.float64)
    nll = nll - nll.min(1, keepdim=True).values
    place = torch.multinomial(torch.softmax(-nll, 1), 1, generator=rng)[:, 0]
    missing = torch.zeros(frames, dtype=torch.bool)
    for k in range(1, frames):
        missing[k] = float(torch.rand((), generator=rng)) < (0.5 if missing[k - 1] else 1 - seen_share)
    noise = sigma * torch.randn(frames, 3, generator=rng, dtype=torch.float64)
    row = torch.nonzero(~missing)[:, 0]
    every[row, place[row]] = (so3.exp(noise) @ torch.stack(R))[row]
    hypotheses = Hypotheses(
        R_lab_body=every,
        nll=nll,
        variance_rad2=torch.full((frames, 3), sigma**2, dtype=torch.float64),
        mask=torch.ones(frames, 3, dtype=torch.bool),
    )
    return hypotheses, torch.where(missing, -1, place)


@pytest.mark.slow
@pytest.mark.parametrize("sigma_deg", [0.1, 12.0])
def test_frames_with_a_stated_probability_are_right_at_least_that_often(sigma_deg):
    probability, right = [], []
    for seed in range(3):
        settings = PathSettings(miss_probability=0.05)
        hypotheses, place = world(seed, 150, math.radians(sigma_deg), math.radians(1.0), 0.95)
        path = physical_path(hypotheses, times(150), settings)
        probability.append(path.probability[path.present])
        right.append((path.choice == place)[path.present])
    p, truth = torch.cat(probability), torch.cat(right).double()
    assert len(p) > 350
    for low, high in ((0.0, 0.6), (0.6, 0.9), (0.9, 1.01)):
        inside = (p >= low) & (p < high)
        if inside.sum() < 10:
            continue
        error = float((p * (1 - p))[inside].sum().sqrt() / inside.sum())
        assert float(truth[inside].mean()) >= float(p[inside].mean()) - 3 * error - 1e-3, (low, high)
    if sigma_deg > 1:
        assert ((p > 0.6) & (p < 0.9)).sum() >= 10  # motion and pictures leave some doubt
