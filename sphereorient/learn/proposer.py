from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

from sphereorient import so3
from sphereorient.learn.network import Correlator, find_modes, map_blurs
from sphereorient.search.candidates import Candidates, check_disks
from sphereorient.trajectory import Reason

# Disks at once, padded: the last bits of a product depend on its number of rows, a disk's result must not.
BATCH = 32
CANDIDATES = 8
PROBABILITY_MIN = 1e-5  # of a candidate
DEFAULT_CHECKPOINT = Path(__file__).with_name("proposer.ckpt")


def score_of(probability: Tensor) -> Tensor:
    """Return probabilities on the scale of the paper's T: 1/2 for no information, 1 for certainty."""
    return 0.5 + 0.5 * probability


def probability_of(score: Tensor) -> Tensor:
    """Return the probabilities (0 .. 1) of scores: the inverse of `score_of`."""
    return 2.0 * score - 1.0


class LearnedProposer:
    """Proposes modes of the density that a network predicts for a map (H, 2 H), 0 black .. 1 white.

    At most `CANDIDATES` for each disk; `temperature` divides the logits, for calibrated probabilities.
    """

    def __init__(self, correlator: Correlator, texture: Tensor, *, temperature: float = 1.0) -> None:
        self._network, self._temperature = correlator.eval(), temperature
        with torch.inference_mode():
            blurs = map_blurs(texture.float()[None], correlator.settings.nodes)[0]
            self._bank = correlator.bank(blurs)

    @property
    def size_px(self) -> int:
        """Side of the disks, px."""
        return self._network.settings.size_px

    @torch.inference_mode()
    def propose(self, disks: Tensor) -> Candidates:
        """Propose orientations in the view frames of disks, with `score_of` their probability.

        A uniform disk has no proposals (`LOW_SCORE`); raise ShapeError for disks of another size.
        """
        check_disks(disks, self.size_px, self.size_px)
        filled = F.pad(disks.float(), (0, 0, 0, 0, 0, -len(disks) % BATCH))
        R, score = [torch.zeros(0, CANDIDATES, 3, 3)], [torch.zeros(0, CANDIDATES)]
        for batch in torch.split(filled, BATCH) if len(disks) else ():
            logits = self._network.logits(self._network.seen(batch), self._bank)
            modes = find_modes(logits, self._network.grid, CANDIDATES, self._temperature)
            R.append(modes.R_view_body)
            score.append(modes.probability)
        R_view_body, probability = torch.cat(R)[: len(disks)], torch.cat(score)[: len(disks)]
        shown = (disks != disks[:, :1, :1]).flatten(1).any(1)  # not uniform
        there = (probability >= PROBABILITY_MIN) & shown[:, None]
        counts = there.sum(1)
        return Candidates(
            offset=F.pad(counts.cumsum(0), (1, 0)),
            R_view_body=so3.nearest_rotation(R_view_body[there].double()),
            score=score_of(probability[there].double()),
            reason=tuple(Reason.OK if count else Reason.LOW_SCORE for count in counts.tolist()),
        )
