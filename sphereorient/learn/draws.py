"""Random numbers that depend on what they are for, and on nothing that was drawn before."""

from __future__ import annotations

import numpy as np
import torch


def generator_of(*numbers: int) -> torch.Generator:
    """Return a generator whose numbers depend on all of these, whole numbers from 0 up."""
    # torch's generator looks at 32 bits of its seed: sums of seed, epoch and step would meet again.
    # How many numbers there are comes first, or zeros at the end would not count.
    return torch.Generator().manual_seed(int(np.random.SeedSequence((len(numbers), *numbers)).generate_state(1)[0]))
