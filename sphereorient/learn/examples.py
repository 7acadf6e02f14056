"""Examples of what a network proposes, for people to look at."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.learn.checkpoint import Checkpoint, correlator_of
from sphereorient.learn.density import tops_of
from sphereorient.learn.draws import generator_of
from sphereorient.learn.pictures import VALIDATION_SEED, draw_values, film_with, make_balls
from sphereorient.learn.settings import PictureSettings
from sphereorient.sphere import orthographic_view, reduced_texture, sample_texture

STREAM = 7  # of random numbers, apart from those of training and validation


@dataclass(frozen=True, kw_only=True, eq=False)
class Example:
    """A picture, the truth and the first K proposals; made by `make_examples`, drawn by the report."""

    degradations: tuple[str, ...]
    disk: Tensor  # (S, S), grey levels
    true_view: Tensor  # (S, S), paint of the ball as it points, without light; NaN outside the outline
    proposed_view: Tensor  # (K, S, S), as it would look
    probability: Tensor  # (K,)
    off_deg: Tensor  # (K,), angle to the truth


def make_examples(checkpoint: Checkpoint, count: int, shown: int = 4, seed: int = 0) -> tuple[Example, ...]:
    """Film balls that training has not seen, as it films its own, and ask the network.

    Args:
        checkpoint: of the network; one that was fine-tuned is shown its own map.
        count: of examples, each of another map with degradations of its own, the first without any.
        shown: proposals of each, K.
        seed: of attitudes, light and degradations.
    """
    settings, network = checkpoint.settings.pictures, correlator_of(checkpoint)
    balls = make_balls(settings, network.settings.nodes, count=count, first_seed=VALIDATION_SEED)
    examples = []
    for k in range(count):
        rng = generator_of(seed, STREAM, k)
        R = so3.random_rotations(1, generator=rng).float()
        values = _some_values(settings, rng) if k else {}
        texture = balls.textures[k % len(balls.textures)]
        disk = film_with(texture, R, values, rng, settings)
        with torch.no_grad():
            logits = network(disk, balls.blurs[k % len(balls.blurs)])
            tops = tops_of(logits, network.grid, shown, checkpoint.temperature)
        proposed = tops.R_view_body[0]
        examples.append(
            Example(
                degradations=tuple(values),
                disk=disk[0],
                true_view=clean_views(texture, R, disk.shape[-1])[0],
                proposed_view=clean_views(texture, proposed, disk.shape[-1]),
                probability=tops.probability[0],
                off_deg=torch.rad2deg(so3.geodesic_distance(proposed.double(), R.double())),
            )
        )
    return tuple(examples)


def _some_values(settings: PictureSettings, rng: torch.Generator) -> dict[str, float]:
    """Draw degradations, one at least if there are any: pictures that nothing spoils look alike."""
    values = draw_values(settings, rng)
    while not values and settings.degradations and settings.at_once:
        values = draw_values(settings, rng)
    return values


def clean_views(texture: Tensor, R_view_body: Tensor, size_px: int) -> Tensor:
    """Draw the paint of a ball in attitudes (F, 3, 3), (F, S, S), NaN outside the outline."""
    view = orthographic_view(size_px)
    reduced = reduced_texture(texture, float(size_px))
    pictures = torch.full((len(R_view_body), size_px, size_px), torch.nan)
    pictures[:, view.inside] = sample_texture(reduced, view.normal_view.float() @ R_view_body)
    return pictures
