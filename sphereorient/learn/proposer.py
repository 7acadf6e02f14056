"""The trained network as a proposer: the pipeline cannot tell it from the template search."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

from sphereorient import so3
from sphereorient.errors import ShapeError, refusal
from sphereorient.learn.density import tops_of
from sphereorient.learn.network import Correlator, map_blurs
from sphereorient.search.proposer import Proposals
from sphereorient.trajectory import Reason

# Disks at once. Fixed and filled up with empty disks: the last bits of products depend on how many rows there are, and
# so a disk's answer would depend on how many others came with it.
BATCH = 32
CANDIDATES = 8
PROBABILITY_MIN = 1e-5  # tops of less are none
DEFAULT_CHECKPOINT = Path(__file__).with_name("proposer.ckpt")


def score_of(probability: Tensor) -> Tensor:
    """Return probabilities on the scale of the paper's T: 1/2 for what says nothing, 1 for certainty."""
    return 0.5 + 0.5 * probability


def probability_of(score: Tensor) -> Tensor:
    """Return the probabilities (0 .. 1) of a network's scores."""
    return 2.0 * score - 1.0


class LearnedProposer:
    """Proposes the tops of the density over SO(3) that a trained network gives.

    Args:
        correlator: the network, in the state that was learnt.
        texture: (H, 2 H), the ball's map, 0 black .. 1 white.
        temperature: by which logits are divided for probabilities, fitted after training.
        candidates: at most so many of a disk.
    """

    def __init__(
        self, correlator: Correlator, texture: Tensor, *, temperature: float = 1.0, candidates: int = CANDIDATES
    ) -> None:
        self._network, self._candidates, self._temperature = correlator.eval(), candidates, temperature
        with torch.inference_mode():
            blurs = map_blurs(texture.float()[None], correlator.settings.nodes)[0]
            self._bank = correlator.bank(blurs)

    @property
    def size_px(self) -> int:
        """Side of the disks, px."""
        return self._network.settings.size_px

    @torch.inference_mode()
    def propose(self, disks: Tensor) -> Proposals:
        """Propose orientations.

        Args:
            disks: (F, S, S) float32, grey levels of any scale, cropped so that the outline touches the borders.

        Returns:
            Proposals in the disks' view frames; the score is `score_of` the probability that the ball points there. A
            disk without any light and dark has none (`LOW_SCORE`).

        Raises:
            ShapeError: the disks are of another size.
        """
        if disks.shape[1:] != (self.size_px, self.size_px):
            size = f"(F, {self.size_px}, {self.size_px})"
            raise ShapeError(refusal("disks", expected=size, got=str(tuple(disks.shape)), do="crop anew"))
        filled = F.pad(disks.float(), (0, 0, 0, 0, 0, -len(disks) % BATCH))
        parts = [self._of_batch(batch) for batch in torch.split(filled, BATCH)] if len(disks) else []
        R = torch.cat([R for R, _ in parts])[: len(disks)] if parts else torch.zeros(0, self._candidates, 3, 3)
        score = torch.cat([p for _, p in parts])[: len(disks)] if parts else torch.zeros(0, self._candidates)
        flat = disks.flatten(1)
        shown = (flat.amax(1) > flat.amin(1)) if len(disks) else torch.zeros(0, dtype=torch.bool)
        there = (score >= PROBABILITY_MIN) & shown[:, None]
        counts = there.sum(1)
        return Proposals(
            offset=F.pad(counts.cumsum(0), (1, 0)),
            R_view_body=so3.nearest_rotation(R[there].double()),
            score=score_of(score[there].double()),
            reason=tuple(Reason.OK if count else Reason.LOW_SCORE for count in counts.tolist()),
        )

    def _of_batch(self, disks: Tensor) -> tuple[Tensor, Tensor]:
        """Tops of one full batch: rotations (B, K, 3, 3) and probabilities (B, K)."""
        logits = self._network.logits(self._network.seen(disks), self._bank)
        tops = tops_of(logits, self._network.grid, self._candidates, self._temperature)
        return tops.R_view_body, tops.probability
