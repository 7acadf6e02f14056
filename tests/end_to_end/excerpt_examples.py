"""The bundled excerpt, whole or some of its frames."""

from __future__ import annotations

import shutil
from pathlib import Path

from conftest import REPO

EXCERPT = REPO / "synthetic_data" / "excerpt"


def shortened(folder: Path, first: int, last: int) -> Path:
    """Copy the excerpt to a new folder, its experiment limited to the frames first .. last - 1."""
    shutil.copytree(EXCERPT, folder)
    experiment = folder / "experiment.yaml"
    experiment.write_text(experiment.read_text() + f"frames: [{first}, {last}]\n")
    return experiment
