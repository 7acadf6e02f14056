"""Print the errors of a track against the exact truth of a synthetic experiment: `sphereorient score` as a script.

    sphereorient track synthetic_data/excerpt/experiment.yaml --out track.h5
    scripts/evaluate_track.py track.h5 synthetic_data/excerpt/truth.h5

Prints the errors of orientation, position and rates over the valid frames. --help lists the options.
"""

from __future__ import annotations

import sys

from sphereorient.cli import main

if __name__ == "__main__":
    sys.argv[:1] = ["sphereorient", "score"]
    main()
