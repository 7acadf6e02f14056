"""A network that predicts a density over SO(3), by correlating features of picture and rotated map; its modes."""

import math
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sphereorient import so3
from sphereorient.errors import Reason
from sphereorient.learn.settings import NetworkSettings
from sphereorient.search.candidates import BATCH, Candidates, Proposer, check_disks, distinct
from sphereorient.search.normalisation import rim_share
from sphereorient.sphere import orthographic_view, reduced_texture, sample_texture
from sphereorient.sphere.texture_table import octahedral_cells, octahedral_directions
from sphereorient.sphere.view import disk_offsets

SCALES = (0.06, 0.1, 0.16, 0.25, 0.4, 0.7)  # standard deviations of the map's blurs, rad
WINDOW = 0.3  # of the neighbourhood mean that is subtracted, radii
SEARCHED = 48  # likeliest grid points searched for modes
APART_DEG = 25.0  # a better mode suppresses nearer ones
AROUND_DEG = 22.0  # grid points of the mean at a mode
# Disks per batch, padded, as the last bits of a product depend on its number of rows.
CANDIDATES = 8
PROBABILITY_MIN = 1e-5  # of a candidate
DEFAULT_CHECKPOINT = Path(__file__).with_name("proposer.ckpt")


class PictureNetwork(nn.Module):
    """Features of a disk at half size, as independent of light and dirt as possible."""

    share: Tensor
    along: Tensor
    total: Tensor
    radius: Tensor

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        size, width = settings.size_px, settings.width
        share = rim_share(size)
        at = (torch.arange(size) + 0.5) * (2.0 / size)
        along = torch.exp(-0.5 * ((at[:, None] - at) / WINDOW).square())
        self.register_buffer("share", share, persistent=False)
        self.register_buffer("along", along, persistent=False)
        self.register_buffer("total", (along @ share @ along).clamp_min(1e-6), persistent=False)
        self.register_buffer("radius", disk_offsets(size).norm(dim=-1).float().clamp_max(1.2), persistent=False)
        self.first = nn.Sequential(_convolution(4, width // 2), _convolution(width // 2, width, stride=2))
        self.fine = nn.Sequential(Residual(width), Residual(width))
        wide = 2 * width
        self.coarse = nn.Sequential(_convolution(width, wide, stride=2), *(Residual(wide) for _ in range(3)))
        self.up = nn.Conv2d(wide, width, 1)
        self.last = nn.Sequential(Residual(width), nn.Conv2d(width, settings.channels, 1))
        for part in (self.first, self.fine, self.coarse, self.up, self.last):
            part.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # a quarter faster on a CPU

    def forward(self, disks: Tensor) -> Tensor:
        """Return features (F, C, S/2, S/2) of disks (F, S, S), grey levels of any scale."""
        share = self.share / self.share.sum()
        less = disks - (disks * share).sum((1, 2), keepdim=True)
        even = less / (less.square() * share).sum((1, 2), keepdim=True).sqrt().clamp_min(1e-6)
        about = self.along @ (even * self.share) @ self.along / self.total
        local = (even - about) * (self.share > 0)
        rim = self.radius.expand_as(even)
        # grey levels, those without the neighbourhood mean, radius and disk, (F, 4, S, S)
        seen = torch.stack([even.clamp(-4, 4), local.clamp(-3, 3), rim, (rim < 1).to(even)], dim=1)
        fine = self.fine(self.first(seen.contiguous(memory_format=torch.channels_last)))
        wide = F.interpolate(self.up(self.coarse(fine)), scale_factor=2, mode="bilinear", align_corners=False)
        found: Tensor = self.last(fine + wide)
        return found


class MapNetwork(nn.Module):
    """Features of the points of a map by their isotropic blurs, so that one evaluation serves all orientations."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        hidden = settings.hidden
        self.layers = nn.Sequential(
            nn.Linear(1 + len(SCALES), hidden), nn.GELU(), nn.Linear(hidden, hidden), nn.GELU(),
            nn.Linear(hidden, settings.channels),
        )  # fmt: skip

    def forward(self, blurs: Tensor) -> Tensor:
        """Return features (..., N, C) of the blurs (..., N, B) that `map_blurs` makes."""
        found: Tensor = self.layers(blurs)
        return found


class Correlator(nn.Module):
    """Density over SO(3) of a disk's orientation, given the texture map: logits on a Lattman grid."""

    grid: Tensor
    cells: Tensor
    place: Tensor

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.settings = settings
        self.picture, self.map = PictureNetwork(settings), MapNetwork(settings)
        self.gain = nn.Parameter(torch.tensor(0.0))
        half = settings.size_px // 2
        view = orthographic_view(half)
        board = torch.arange(half)
        white = ((board[:, None] + board) % 2 == 0) & view.inside
        normal = view.normal_view[white[view.inside]]
        self.register_buffer("place", torch.nonzero(white.reshape(-1))[:, 0], persistent=False)
        grid = so3.lattman_grid(math.radians(settings.step_deg)).float()
        self.register_buffer("grid", grid, persistent=False)
        x, y, z = (grid.mT @ normal.T).unbind(1)  # (K, P) each
        self.register_buffer("cells", octahedral_cells(x, y, z, settings.nodes).int(), persistent=False)

    def bank(self, blurs: Tensor) -> Tensor:
        """Return the map's features in all views of the grid, (K, P C), from blurs (N, B)."""
        features: Tensor = self.map(blurs)
        return features.index_select(0, self.cells.reshape(-1)).reshape(len(self.cells), -1)

    def seen(self, disks: Tensor) -> Tensor:
        """Return the features of disks (F, S, S) at the P compared points, (F, P C)."""
        found: Tensor = self.picture(disks).flatten(2)[..., self.place]  # (F, C, P)
        return found.mT.flatten(1)

    def logits(self, seen: Tensor, bank: Tensor) -> Tensor:
        """Return the log density on the grid, (F, K), up to a constant of each disk."""
        return seen @ bank.T * (self.gain.exp() / math.sqrt(bank.shape[1]))

    def forward(self, disks: Tensor, blurs: Tensor) -> Tensor:
        """Return logits (F, K) of disks (F, S, S) of one ball with blurs (N, B)."""
        return self.logits(self.seen(disks), self.bank(blurs))


class Residual(nn.Module):
    """Two convolutions, added to their input."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(_convolution(width, width), nn.Conv2d(width, width, 3, padding=1))

    def forward(self, x: Tensor) -> Tensor:
        """Return features of the same shape."""
        return F.gelu(x + self.layers(x))


def _convolution(into: int, out: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(into, out, 3, stride=stride, padding=1), nn.GELU())


def map_blurs(textures: Tensor, side: int) -> Tensor:
    """Return blurs (T, side^2, B) float32, in deviations, of maps (T, H, 2 H), 0 black .. 1 white, on an octahedron."""
    direction = octahedral_directions(side).float()
    # Solid angle of a cell of the octahedron.
    area = direction.abs().sum(-1).pow(3)
    paint = torch.stack([sample_texture(reduced_texture(each.float(), 0.8 * side), direction) for each in textures], -1)
    share = (area / area.sum())[:, None]
    paint = paint - (share * paint).sum(0)
    paint = paint / (share * paint.square()).sum(0).sqrt().clamp_min(1e-6)
    blurs = [paint]
    for scale in SCALES:
        # One kernel at a time, as all take half a gigabyte.
        kernel = torch.exp((direction @ direction.T - 1) / scale**2) * area
        blurs.append((kernel @ paint) / kernel.sum(1, keepdim=True))
    return torch.stack(blurs, -1).transpose(0, 1).contiguous()


class Modes(NamedTuple):
    """K candidates for each of F disks, likeliest first; made by `find_modes`."""

    R_view_body: Tensor  # (F, K, 3, 3) float32
    probability: Tensor  # (F, K), sum over the grid points around the mode; 0: no further mode


def find_modes(logits: Tensor, grid: Tensor, count: int, temperature: float = 1.0) -> Modes:
    """Find the `count` (K) likeliest modes of log densities (F, G), each up to a constant, on rotations (G, 3, 3). The
    temperature divides the logits for probabilities and order only; orientations are means of the density as learnt.
    """
    flat = grid.flatten(1)
    probability = logits.softmax(-1)
    point = logits.topk(min(SEARCHED, logits.shape[1]), dim=1).indices
    mode = distinct(grid[point], math.radians(APART_DEG))
    order = (~mode).int().argsort(dim=1, stable=True)[:, :count]
    chosen, exists = point.gather(1, order), mode.gather(1, order)
    near = flat[chosen] @ flat.T  # (F, K, G), trace of the relative rotation
    near = near.masked_fill(~exists[..., None], -2.0)
    own = (near == near.amax(1, keepdim=True)) & (near > 1 + 2 * math.cos(math.radians(AROUND_DEG)))
    share = own * probability[:, None]
    weight = (own * (logits / temperature).softmax(-1)[:, None]).sum(-1)
    mean = (share @ flat).reshape(*weight.shape, 3, 3) / share.sum(-1).clamp_min(1e-30)[..., None, None]
    view = torch.eye(3, dtype=grid.dtype, device=grid.device)
    R = so3.nearest_rotation(torch.where(exists[..., None, None], mean, view))
    weight = torch.where(exists, weight, 0.0)
    best = weight.argsort(dim=1, descending=True, stable=True)
    return Modes(R_view_body=R.gather(1, best[..., None, None].expand_as(R)), probability=weight.gather(1, best))


def smoothed_target(R: Tensor, grid: Tensor, spread_rad: float) -> Tensor:
    """Return true orientations (F, 3, 3) as Gaussian densities on the grid, (F, G), each with sum 1."""
    trace = R.flatten(1) @ grid.flatten(1).T
    # 3 - trace is the square of small angles.
    return ((trace - 3) / (2 * spread_rad**2)).softmax(-1)


def first_right(modes: Modes, R: Tensor, within_deg: float) -> Tensor:
    """Return the rank, (F,), 0 the likeliest, of the first mode near the true orientation (F, 3, 3); K: none."""
    trace = (modes.R_view_body * R[:, None]).sum((-2, -1))
    right = (trace > 1 + 2 * math.cos(math.radians(within_deg))) & (modes.probability > 0)
    count = right.shape[1]
    return torch.where(right, torch.arange(count, device=R.device), count).amin(1)


def score_of(probability: Tensor) -> Tensor:
    """Return probabilities on the scale of the paper's T: 1/2 for no information, 1 for certainty."""
    return 0.5 + 0.5 * probability


def probability_of(score: Tensor) -> Tensor:
    """Return the probabilities (0 .. 1) of scores: the inverse of `score_of`."""
    return 2.0 * score - 1.0


class LearnedProposer(Proposer):
    """Proposes modes of the density that a network predicts for a map (H, 2 H), 0 black .. 1 white.
    At most `CANDIDATES` for each disk; `temperature` divides the logits, for calibrated probabilities.
    """

    def __init__(self, correlator: Correlator, texture: Tensor, *, temperature: float = 1.0) -> None:
        super().__init__()
        self._network, self._temperature = correlator.eval(), temperature
        self.size_px = correlator.settings.size_px
        with torch.inference_mode():
            self._bank = correlator.bank(map_blurs(texture.float()[None], correlator.settings.nodes)[0])

    @torch.inference_mode()
    def propose(self, disks: Tensor, least: float | None = None) -> Candidates:
        """Propose orientations in the view frames of disks, with `score_of` their probability; `least` is of templates.
        A uniform disk has no proposals (`LOW_SCORE`); raise ShapeError for disks of another size.
        """
        check_disks(disks, self.size_px, self.size_px)
        filled = F.pad(disks.float(), (0, 0, 0, 0, 0, -len(disks) % BATCH))
        found = [Modes(torch.zeros(0, CANDIDATES, 3, 3), torch.zeros(0, CANDIDATES))]
        for batch in torch.split(filled, BATCH) if len(disks) else ():
            logits = self._network.logits(self._network.seen(batch), self._bank)
            found.append(find_modes(logits, self._network.grid, CANDIDATES, self._temperature))
        R_view_body, probability = (torch.cat(parts)[: len(disks)] for parts in zip(*found, strict=True))
        shown = (disks != disks[:, :1, :1]).flatten(1).any(1)  # not uniform
        there = (probability >= PROBABILITY_MIN) & shown[:, None]
        counts = there.sum(1)
        return Candidates(
            offset=F.pad(counts.cumsum(0), (1, 0)),
            R_view_body=so3.nearest_rotation(R_view_body[there].double()),
            score=score_of(probability[there].double()),
            reason=tuple(Reason.OK if count else Reason.LOW_SCORE for count in counts.tolist()),
        )
