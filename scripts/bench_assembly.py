"""Time the dynamic programming over candidates: shortest and soft path, first and second order.

    scripts/bench_assembly.py [--frames 15000] [--candidates 10] [--threads 2]

Wall seconds, best of three, in double precision: costs from orientations, the shortest path, the soft path (forward and
backward, all marginals), and the gradient of a loss on the marginals. Prints Markdown.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble import PathLayer, PathSettings, SoftPath, edge_costs, shortest_path, soft_path
from sphereorient.assemble.layer import triple_costs

REPETITIONS = 3
RATE_HZ = 600.0


def wall_s(work: Callable[[], object]) -> float:
    spent = []
    for _ in range(REPETITIONS):
        begin = time.perf_counter()
        work()
        spent.append(time.perf_counter() - begin)
    return min(spent)


def gradient_s(path: Callable[[Tensor], SoftPath], cost: Tensor) -> float:
    """Return the seconds of a gradient of some log marginals, through the soft path to the costs."""
    cost = cost.detach().requires_grad_()
    soft = path(cost)
    loss = soft.marginals[:, 0].clamp_min(1e-12).log().sum()
    return wall_s(lambda: torch.autograd.grad(loss, cost, retain_graph=True))


def rows(frames: int, width: int) -> dict[str, tuple[float, ...]]:
    """Return the seconds of costs, shortest path, soft path and gradient, for each order."""
    rng = torch.Generator().manual_seed(0)
    R = so3.random_rotations((frames, width), generator=rng, dtype=torch.float64)
    score = torch.rand(frames, width, generator=rng, dtype=torch.float64)
    time_s = torch.arange(frames, dtype=torch.float64) / RATE_HZ
    mask, variance = torch.ones(frames, width, dtype=torch.bool), torch.full_like(score, 1e-4)
    parameters = PathLayer(soft=1.0, settings=PathSettings(acceleration_rad_s2=1000.0)).requires_grad_(False).cost(R)

    def pairs() -> Tensor:
        return edge_costs(R, score, time_s)

    def triples() -> Tensor:
        return triple_costs(parameters, R, variance, time_s, mask)

    out = {}
    for name, costs, shortest, soft in (
        ("first", pairs, shortest_path, soft_path),
        (
            "second",
            triples,
            lambda cost, mask: shortest_path(None, mask, triple_cost=cost),
            lambda cost, mask: soft_path(None, mask, triple_cost=cost),
        ),
    ):
        cost = costs()
        out[name] = (
            wall_s(costs),
            wall_s(lambda cost=cost, shortest=shortest: shortest(cost, mask)),
            wall_s(lambda cost=cost, soft=soft: soft(cost, mask)),
            gradient_s(lambda cost, soft=soft: soft(cost, mask), cost),
        )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=15_000)
    parser.add_argument("--candidates", type=int, default=10)
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    print(f"{arguments.frames} frames x {arguments.candidates} candidates, {arguments.threads} threads, wall s\n")
    print("| order | costs | shortest path | soft path | sum of the three | gradient through the marginals |")
    print("|---|---|---|---|---|---|")
    for name, spent in rows(arguments.frames, arguments.candidates).items():
        costs, shortest, soft, gradient = spent
        print(
            f"| {name} | {costs:.2f} | {shortest:.2f} | {soft:.2f} | {costs + shortest + soft:.2f} | {gradient:.2f} |"
        )


if __name__ == "__main__":
    main()
