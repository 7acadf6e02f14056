"""Train a network that proposes orientations: `sphereorient train` as a script (docs/proposer.md).

    scripts/train_proposer.py configs/train_proposer.yaml --out out/proposer --set training.minutes=30

Writes proposer.ckpt, last.ckpt, metrics.csv, settings.yaml and two figures into --out. --help lists the options.
"""

from __future__ import annotations

import sys

from sphereorient.cli import main

if __name__ == "__main__":
    sys.argv[:1] = ["sphereorient", "train"]
    main()
