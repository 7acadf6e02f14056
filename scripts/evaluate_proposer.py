"""Measure the recall of a trained proposer on balls that no training sees: `sphereorient evaluate` as a script.

    scripts/evaluate_proposer.py out/proposer/proposer.ckpt --pictures 240
    scripts/evaluate_proposer.py out/proposer/proposer.ckpt --config configs/train_proposer.yaml --json

Prints a line for each degradation, then recall and calibration on mixed pictures. --help lists the options.
"""

from __future__ import annotations

import sys

from sphereorient.cli import main

if __name__ == "__main__":
    sys.argv[:1] = ["sphereorient", "evaluate"]
    main()
