"""The scenes of the benchmark: which there are, and how they are rendered."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sphereorient.evaluate.robustness.settings import BenchSettings
from sphereorient.synth.degrade_scene import write_degraded
from sphereorient.synth.settings import SynthSettings

CLEAN, TOGETHER = "clean", "together"
SIDE_PX, VOLUME_MM = 480, 30.0  # of the pictures, and of where the ball is: small, for speed
MIXED_SEED = 20110  # of the draws of what is together


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A movie of two cameras with truth; made by `scenes_of`, rendered by `write_scene`."""

    kind: str  # a degradation's name, "clean", or "together"
    level: int  # 0 for clean
    seed: int
    number: int  # among those of the same kind, level and seed
    degradations: Mapping[str, int]  # level by name
    frames: int

    @property
    def name(self) -> str:
        """Name of the scene's folder."""
        return f"{self.kind}-{self.level}-{self.seed}-{self.number}"


def scenes_of(settings: BenchSettings) -> list[Scene]:
    """Return all scenes, clean ones first; the same settings give the same scenes."""
    return [scene for seed in settings.seeds for scene in _of_seed(settings, seed)]


def _of_seed(settings: BenchSettings, seed: int) -> Iterator[Scene]:
    frames = settings.frames
    yield Scene(kind=CLEAN, level=0, seed=seed, number=0, degradations={}, frames=frames)
    for name in settings.degradations:
        for level in settings.levels:
            yield Scene(kind=name, level=level, seed=seed, number=0, degradations={name: level}, frames=frames)
    count = min(settings.at_once, len(settings.degradations))
    for level in settings.levels:
        for number in range(settings.together if count > 1 else 0):
            rng = np.random.default_rng([MIXED_SEED, seed, level, number])
            drawn = sorted(rng.choice(len(settings.degradations), count, replace=False).tolist())
            mixed = {settings.degradations[k]: level for k in drawn}
            yield Scene(kind=TOGETHER, level=level, seed=seed, number=number, degradations=mixed, frames=frames)


def write_scene(folder: Path, scene: Scene) -> Path:
    """Render a scene with its truth.

    Args:
        folder: made where it is missing.
        scene: of `scenes_of`.

    Returns:
        Path of experiment.yaml; truth.h5 lies beside it (docs/data-format.md).
    """
    base = SynthSettings(
        name=scene.name, frames=scene.frames, image_size=(SIDE_PX, SIDE_PX), volume_mm=VOLUME_MM, seed=scene.seed
    )
    return write_degraded(folder, base, scene.degradations)
