"""Learn the settings of the second-order path from synthetic movies; compare them with the defaults on other movies.

    scripts/learn_path.py [--frames 240] [--movies 24] [--steps 120] [--honest] [--out learnt.yaml]

No pictures: true orientations with noise among false candidates, with likelihoods that overlap. The likelihoods are
three times too large (in nats) and the orientations' sigmas 1.7 times too small, as in fits that neglect the
correlation of neighbouring pixels; with --honest both are right. Learning descends the gradient, through the soft path,
of the mean negative log probability of the truth, over whole movies. Prints Markdown; --out writes the learnt settings
to a file that `sphereorient track --settings` reads.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import yaml
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble import PathLayer, PathSettings
from sphereorient.assemble.second_order_cost import PARAMETERS
from sphereorient.learn.metrics import reliability
from sphereorient.synth.motion import random_motion

RATE_HZ = 600.0
FALSE = 4  # false candidates beside the true one
SIGMA_DEG, APART = 0.5, 1.5  # of the orientations; sigmas between the scores of right and wrong
LOSS_BEGINS, LOSS_LASTS, EMPTY, STANDS = 0.03, 0.6, 0.01, 0.7
HELD_OUT = 10_000  # first seed of the movies that are not learnt from
DEFAULT = PathSettings(acceleration_rad_s2=math.radians(0.5) * RATE_HZ**2)  # START_DEG's middle


@dataclass(frozen=True, kw_only=True)
class Claims:
    """Ratios of the stated to the right nats and sigmas."""

    nats: float = 3.0
    sigma: float = 1 / 1.7


@dataclass(frozen=True, kw_only=True, eq=False)
class Labelled:
    """Movies with the index of the true candidate."""

    frames: dict[str, Tensor]  # arguments of PathLayer
    place: Tensor  # (B, N) int64, of C candidates; C where none is right, also in empty frames


@dataclass(frozen=True, kw_only=True, eq=False)
class PathResult:
    """Result of a path for some movies."""

    choice: Tensor  # (B, N), C: none
    confidence: Tensor  # (B, N), of the choice
    nll: Tensor  # (B, N), of the truth, nats; NaN in empty frames


def true_orientations(seed: int, frames: int, rng: torch.Generator) -> Tensor:
    """Return a smooth motion, slow to fast (0.5 to 6 degrees a frame), (N, 3, 3)."""
    share = torch.rand(2, generator=rng).tolist()
    omega_rms, omega_s = 5.0 * 12.0 ** share[0], 0.02 * 5.0 ** share[1]
    motion = random_motion(0.3, 0.05, omega_rms, omega_s, 40.0, seed)
    return motion.at(torch.arange(frames, dtype=torch.float64) / RATE_HZ).R_lab_body


def standing(frames: int, rng: torch.Generator) -> Tensor:
    """Return a false candidate that is constant for some tens of frames, (N, 3, 3)."""
    run = (torch.rand(frames, generator=rng) < 1 / 40).long().cumsum(0)
    return so3.random_rotations(int(run[-1]) + 1, generator=rng, dtype=torch.float64)[run]


def noisy(R: Tensor, sigma_rad: Tensor, rng: torch.Generator) -> Tensor:
    return so3.exp(sigma_rad[..., None] * torch.randn(*R.shape[:-1], generator=rng, dtype=torch.float64)) @ R


def draw(seed: int, frames: int, claims: Claims) -> Labelled:
    """Draw one movie, (1, N) frames."""
    rng = torch.Generator().manual_seed(seed)
    width = FALSE + 1
    every = so3.random_rotations((frames, width), generator=rng, dtype=torch.float64)
    every[:, 1] = torch.where(torch.rand(frames, 1, 1, generator=rng) < STANDS, standing(frames, rng), every[:, 1])
    missing = torch.zeros(frames, dtype=torch.bool)
    for k in range(1, frames):  # a chain: losses come in bursts
        missing[k] = float(torch.rand((), generator=rng)) < (LOSS_LASTS if missing[k - 1] else LOSS_BEGINS)
    every[:, 0] = torch.where(missing[:, None, None], every[:, 0], true_orientations(seed, frames, rng))
    sigma = math.radians(SIGMA_DEG) * torch.exp(0.3 * torch.randn(frames, width, generator=rng, dtype=torch.float64))
    score = torch.randn(frames, width, generator=rng, dtype=torch.float64) + APART
    score[:, 0] -= torch.where(missing, 0.0, APART)
    order = torch.rand(frames, width, generator=rng).argsort(-1)
    there = torch.rand(frames, 1, generator=rng) >= EMPTY
    row = torch.arange(frames)[:, None]
    place = torch.where(missing | ~there[:, 0], width, (order == 0).long().argmax(-1))
    nll = claims.nats * APART * score
    parts = {
        "R_lab_body": noisy(every, sigma, rng)[row, order][None],
        "score": -(nll - nll.amin(-1, keepdim=True))[row, order][None],
        "variance_rad2": (claims.sigma * sigma)[row, order].square()[None],
        "mask": there.expand(frames, width)[None],
        "time_s": (torch.arange(frames, dtype=torch.float64) / RATE_HZ)[None],
    }
    return Labelled(frames=parts, place=place[None])


def movies(first_seed: int, count: int, frames: int, claims: Claims) -> Labelled:
    """Draw some movies as one batch."""
    each = [draw(first_seed + k, frames, claims) for k in range(count)]
    parts = {name: torch.cat([x.frames[name] for x in each]) for name in each[0].frames}
    return Labelled(frames=parts, place=torch.cat([x.place for x in each]))


def true_nll(marginals: Tensor, known: Labelled) -> Tensor:
    """Return the negative log probability of the truth, (B, N), nats; NaN in empty frames."""
    probability = marginals.gather(-1, known.place[..., None])[..., 0]
    return torch.where(known.frames["mask"].any(-1), -probability.clamp_min(1e-12).log(), torch.nan)


def learn(known: Labelled, begin: PathSettings, steps: int) -> PathSettings:
    """Learn the parameters of the layer by Adam."""
    model = PathLayer(2, soft=1.0, settings=begin)
    optimizer = torch.optim.Adam(model.parameters(), lr=0.1)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        optimizer.zero_grad()
        loss = true_nll(model(**known.frames).marginals, known).nanmean()
        loss.backward()
        optimizer.step()
        schedule.step()
    learnt = model.settings
    assert isinstance(learnt, PathSettings)
    return learnt


def path_result(settings: PathSettings, known: Labelled) -> PathResult:
    """Return the result of the path that `track` uses."""
    path, width = PathLayer(2, settings=settings)(**known.frames), known.frames["mask"].shape[-1]
    choice = torch.where(path.choice < 0, width, path.choice)
    marginals = torch.cat([path.posterior, (1 - path.posterior.sum(-1, keepdim=True)).clamp_min(0)], -1)
    confidence = marginals.gather(-1, choice[..., None])[..., 0]
    return PathResult(choice=choice, confidence=confidence, nll=true_nll(marginals, known))


def wrong_share(result: PathResult, known: Labelled) -> Tensor:
    """Return each movie's share of frames with candidates whose choice is wrong, (B,)."""
    there = known.frames["mask"].any(-1)
    return ((result.choice != known.place) & there).sum(-1) / there.sum(-1)


def row(name: str, result: PathResult, known: Labelled) -> str:
    there, width = known.frames["mask"].any(-1), known.frames["mask"].shape[-1]
    seen = there & (known.place < width)
    wrong = wrong_share(result, known)
    false = ((result.choice != known.place) & (result.choice < width) & there).sum() / there.sum()
    lost = ((result.choice == width) & seen).sum() / seen.sum()
    chosen = there & (result.choice < width)
    curve = reliability(result.confidence[chosen].numpy(), (result.choice == known.place)[chosen].numpy())
    scatter = float(wrong.std()) / math.sqrt(len(wrong))
    return (
        f"| {name} | {100 * float(wrong.mean()):.2f} ± {100 * scatter:.2f} | {100 * float(false):.2f} |"
        f" {100 * float(lost):.2f} | {float(result.nll.nanmean()):.4f} | {curve.error:.4f} ({curve.chance:.4f}) |"
    )


def compared(after: PathResult, before: PathResult, known: Labelled) -> str:
    change = (wrong_share(before, known) - wrong_share(after, known)).numpy()
    nats = (before.nll - after.nll).nanmean(-1).numpy()
    parts = []
    for what, x, scale, unit in (("wrong frames", change, 100, " %"), ("negative log-likelihood", nats, 1, " nats")):
        mean, scatter = scale * np.mean(x), scale * np.std(x, ddof=1) / math.sqrt(len(x))
        parts.append(
            f"{what} {mean:.3f} ± {scatter:.3f}{unit} less ({np.sum(x > 0)} movies better, {np.sum(x < 0)} worse)"
        )
    return "; ".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=240)
    parser.add_argument("--movies", type=int, default=24)
    parser.add_argument("--steps", type=int, default=120)
    parser.add_argument("--honest", action="store_true")
    parser.add_argument("--out", type=Path, help="settings file to write the learnt settings to")
    arguments = parser.parse_args()
    claims, count = Claims(nats=1.0, sigma=1.0) if arguments.honest else Claims(), arguments.movies
    known, other = (movies(*which, arguments.frames, claims) for which in ((0, count), (HELD_OUT, 2 * count)))
    begun = time.perf_counter()
    learnt = learn(known, DEFAULT, arguments.steps)
    spent = time.perf_counter() - begun
    print(f"{count} movies of {arguments.frames} frames, {arguments.steps} steps, {spent:.0f} s\n")
    if arguments.out:
        arguments.out.write_text(yaml.safe_dump({"path": learnt.model_dump()}))
    print("| setting | default | learnt |\n|---|---|---|")
    for name in PARAMETERS:
        print(f"| {name} | {getattr(DEFAULT, name):.4g} | {getattr(learnt, name):.4g} |")
    print(f"\n{2 * count} other movies:\n")
    print("| path | wrong frames, % | false one taken, % | true one there and not taken, % | nats | ECE (chance) |")
    print("|---|---|---|---|---|---|")
    quiet = PathSettings(acceleration_rad_s2=learnt.acceleration_rad_s2)
    named = {"default": PathSettings(), "default, acceleration learnt": quiet, "learnt": learnt}
    results = {name: path_result(settings, other) for name, settings in named.items()}
    for name, each in results.items():
        print(row(name, each, other))
    print(f"\nLearnt against default: {compared(results['learnt'], results['default'], other)}.")


if __name__ == "__main__":
    main()
