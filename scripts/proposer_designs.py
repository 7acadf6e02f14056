"""Compare designs of the learned proposer, each trained for the same CPU time on the same kind of pictures.

    scripts/proposer_designs.py [--minutes 10] [--designs correlator,descriptor,classifier]

correlator: features of the picture against features of the map, rotated with it (shipped).
descriptor: one vector per picture, from one network for pictures and clean views; the map's views are a bank.
classifier: logits on the grid directly from the picture; learns one ball and works for no other.

Prints recall within 10 degrees among the first and the first five, on the same mixed pictures (up to three
degradations, levels up to 5) of balls that training has not seen; for the classifier, of its own ball.
"""

from __future__ import annotations

import argparse
import math
import time

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sphereorient import so3
from sphereorient.learn.network import Correlator, PictureNetwork, find_modes, first_right, smoothed_target
from sphereorient.learn.pictures import VALIDATION_SEED, RandomTextures, TrainingBatch, draw_batch, make_textures
from sphereorient.learn.settings import NetworkSettings, PictureSettings
from sphereorient.sphere import orthographic_view, reduced_texture

GRID_STEP_DEG = 15.0
SPREAD_DEG = 8.0
RATE = 2e-3
VECTOR = 256  # numbers of a descriptor
SHARE = 600  # views of a map in one step of the descriptor's training
VIEW_LEVELS = 40.0, 170.0  # grey of black and white paint in clean views


class Design(nn.Module):
    """A density on a grid, given pictures of one ball."""

    def __init__(self) -> None:
        super().__init__()
        grid = so3.lattman_grid(math.radians(GRID_STEP_DEG)).float()
        self.register_buffer("grid", grid, persistent=False)

    def logits(self, disks: Tensor, texture: Tensor, blurs: Tensor, rotations: Tensor | None) -> Tensor:
        """Return logits (F, K) for all rotations of the grid, or some (K, 3, 3)."""
        raise NotImplementedError


class CorrelatorDesign(Design):
    """The shipped design."""

    def __init__(self) -> None:
        super().__init__()
        self.network = Correlator(NetworkSettings(step_deg=GRID_STEP_DEG))

    def logits(self, disks: Tensor, texture: Tensor, blurs: Tensor, rotations: Tensor | None) -> Tensor:
        found: Tensor = self.network(disks, blurs)
        return found


class Vector(nn.Module):
    """Network from a picture to one vector."""

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.picture = PictureNetwork(NetworkSettings())
        self.last = nn.Linear(8 * 20 * 20, outputs)

    def forward(self, disks: Tensor) -> Tensor:
        """Return (F, outputs)."""
        found: Tensor = self.last(self.picture(disks).flatten(1))
        return found


class DescriptorDesign(Design):
    """Compare vectors of pictures and of clean views of the map."""

    def __init__(self) -> None:
        super().__init__()
        self.vector = Vector(VECTOR)
        self.gain = nn.Parameter(torch.tensor(2.0))
        self.view = orthographic_view(40)

    def logits(self, disks: Tensor, texture: Tensor, blurs: Tensor, rotations: Tensor | None) -> Tensor:
        R = self.grid if rotations is None else rotations
        views = torch.cat([self.clean(texture, some) for some in torch.split(R, 256)])
        bank = F.normalize(self.vector(views), dim=1)
        return self.gain.exp() * F.normalize(self.vector(disks), dim=1) @ bank.T

    def clean(self, texture: Tensor, R: Tensor) -> Tensor:
        """Return views of the map under even light, (K, S, S)."""
        paint = self.view.paint(reduced_texture(texture, 40), R)
        black, white = VIEW_LEVELS
        return self.view.picture(black + (white - black) * paint, outside=black)


class ClassifierDesign(Design):
    """Logits directly from the picture."""

    def __init__(self) -> None:
        super().__init__()
        self.vector = Vector(len(self.grid))

    def logits(self, disks: Tensor, texture: Tensor, blurs: Tensor, rotations: Tensor | None) -> Tensor:
        found: Tensor = self.vector(disks)
        return found


DESIGNS = {"correlator": CorrelatorDesign, "descriptor": DescriptorDesign, "classifier": ClassifierDesign}


def main() -> None:
    """Train and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--designs", default=",".join(DESIGNS))
    options = parser.parse_args()
    torch.set_num_threads(1)
    settings = PictureSettings()
    nodes = NetworkSettings().nodes
    trained = make_textures(settings, nodes, count=144, first_seed=0)
    unseen = make_textures(settings, nodes, count=24, first_seed=VALIDATION_SEED)
    print("| design | parameters | steps of 256 pictures | recall, first | recall, first five | ms per picture |")
    print("|---|---|---|---|---|---|")
    for name in options.designs.split(","):
        torch.manual_seed(0)
        design = DESIGNS[name]()
        one = RandomTextures(textures=trained.textures[:1], blurs=trained.blurs[:1])
        own = PictureSettings(texture="one ball")  # no negatives
        chosen, kind = (one, own) if name == "classifier" else (trained, settings)
        steps = train(design, chosen, kind, 60 * options.minutes)
        first, five, seconds = judge(design, one if name == "classifier" else unseen, kind)
        count = sum(p.numel() for p in design.parameters())
        print(f"| {name} | {count:,} | {steps} | {first:.3f} | {five:.3f} | {1e3 * seconds:.2f} |", flush=True)


def train(design: Design, balls: RandomTextures, settings: PictureSettings, seconds: float) -> int:
    """Train for some CPU seconds, the making of pictures included; return the steps."""
    rng = torch.Generator().manual_seed(1)
    optimiser = torch.optim.AdamW(design.parameters(), lr=RATE, weight_decay=1e-4)
    begin, step = time.process_time(), 0
    while (spent := (time.process_time() - begin) / seconds) < 1:
        lesson = draw_batch(balls, settings, rng, (2, 8, 16))
        for group in optimiser.param_groups:
            group["lr"] = RATE * min(1, step / 100) * 0.5 * (1 + math.cos(math.pi * spent))
        loss = torch.stack([loss_of(design, balls, lesson, m, rng) for m in range(2)]).mean()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(design.parameters(), 1.0)
        optimiser.step()
        step += 1
    return step


def loss_of(design: Design, balls: RandomTextures, lesson: TrainingBatch, m: int, rng: torch.Generator) -> Tensor:
    """Return the cross entropy with the right rotations, spread over the grid."""
    some = None
    if isinstance(design, DescriptorDesign):  # a bank of all views takes ten times the time of the rest
        near = lesson.R_view_body[m]
        turn = so3.exp(0.1 * torch.randn((len(near), 3), generator=rng))
        others = so3.random_rotations(SHARE - len(near), generator=rng).float()
        some = torch.cat([turn @ near, others])
    logits = design.logits(lesson.disks[m], lesson.textures[m], lesson.blurs[m], some)
    grid = design.grid if some is None else some
    right = smoothed_target(lesson.R_view_body[m], grid, math.radians(SPREAD_DEG))
    return (torch.logsumexp(logits, 1) - (right * logits).sum(1)).mean()


@torch.inference_mode()
def judge(design: Design, balls: RandomTextures, settings: PictureSettings) -> tuple[float, float, float]:
    """Return recall of the first and the first five, and CPU seconds per picture without the map's part."""
    rng = torch.Generator().manual_seed(2)
    ranks, seconds, count = [], 0.0, 0
    for _ in range(12):
        lesson = draw_batch(balls, settings, rng, (1, 16, 8))
        logits = design.logits(lesson.disks[0], lesson.textures[0], lesson.blurs[0], None)
        ranks.append(first_right(find_modes(logits, design.grid, 8), lesson.R_view_body[0], 10.0))
        begin = time.process_time()
        find_modes(design.logits(lesson.disks[0], lesson.textures[0], lesson.blurs[0], design.grid[:1]), design.grid, 8)
        seconds += time.process_time() - begin
        count += len(lesson.disks[0])
    rank = torch.cat(ranks)
    return float((rank < 1).float().mean()), float((rank < 5).float().mean()), seconds / count


if __name__ == "__main__":
    main()
