import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Self

import numpy as np
from pydantic import BaseModel, Field, model_validator

from sphereorient.errors import SettingsError, refusal
from sphereorient.synth import write_degraded
from sphereorient.synth.degrade import OF_ONE_BALL
from sphereorient.synth.settings import SynthSettings
from sphereorient.synth.severities import DEGRADATIONS, LEVELS, degradation
from sphereorient.synth.write import CleanMovie, clean_movie

CLEAN, TOGETHER = "clean", "together"
SIDE_PX, VOLUME_MM = 480, 30.0  # of the pictures, and of a single ball's volume; small, for speed
OF_MOVIES = {"frames", "cameras", "balls", "paints", "volume_mm", "velocity_time"}  # settings of `synth`


class BenchSettings(BaseModel, frozen=True, extra="forbid"):
    """The list of scenes, part of the results, which are compared scene by scene."""

    degradations: tuple[str, ...] = Field(
        tuple(DEGRADATIONS), description="one at a time; names of docs/degradations.md"
    )
    levels: tuple[int, ...] = Field((1, 3, 5), description="severities, of 1 .. 5")
    seeds: tuple[int, ...] = Field((0, 1, 2), description="each gives another ball, motion and noise")
    together: int = Field(1, ge=0, description="scenes by level and seed with several degradations at once")
    at_once: int = Field(3, ge=2, description="number of these degradations, drawn by the seed")
    frames: int = Field(24, ge=12, description="of each movie")
    cameras: int = Field(2, ge=1, le=4, description="of each scene")
    balls: int = Field(1, ge=1, le=8, description="of each scene")
    paints: int = Field(8, ge=1, le=8, description="of several balls; fewer than balls: some look alike")
    volume_mm: float = Field(VOLUME_MM, gt=0, le=45, description="balls stay within about this distance of the origin")
    velocity_time: float = Field(0.12, gt=0, description="correlation time of the velocity, s; shorter: faster")

    @property
    def per_litre(self) -> float:
        """Number density of the balls in the sphere of radius `volume_mm`."""
        return self.balls / (4 / 3 * math.pi * self.volume_mm**3) * 1e6

    @model_validator(mode="after")
    def _known(self) -> Self:
        for name in self.degradations:
            degradation(name)
        for level in self.levels:
            if level not in LEVELS:
                expected, do = f"levels {LEVELS[0]} .. {LEVELS[-1]}", "choose among these"
                raise SettingsError(refusal("levels", expected=expected, got=str(level), do=do))
        if self.balls > 1 and (wrong := [name for name in self.degradations if name in OF_ONE_BALL]):
            expected, do = "degradations for several balls", "leave these out"
            raise SettingsError(refusal("degradations", expected=expected, got=", ".join(wrong), do=do))
        if not self.levels or not self.seeds:
            raise SettingsError(refusal("levels and seeds", expected="at least one", got="none", do="name some"))
        return self


FULL = BenchSettings(levels=LEVELS, seeds=(0, 1, 2), together=2, frames=60)


@dataclass(frozen=True, kw_only=True)
class BenchmarkScene:
    """An experiment with truth; made by `scenes_of`, rendered by `write_scene`."""

    kind: str  # a degradation's name, "clean", or "together"
    level: int  # 0 for clean
    seed: int
    number: int  # among those of the same kind, level and seed
    degradations: Mapping[str, int]  # level by name
    plan: BenchSettings = field(default_factory=BenchSettings)

    @property
    def name(self) -> str:
        """Name of the scene's folder."""
        return f"{self.kind}-{self.level}-{self.seed}-{self.number}"

    @property
    def base(self) -> SynthSettings:
        """Settings of the movie, before the degradations."""
        own = self.plan.model_dump(include=OF_MOVIES)
        return SynthSettings(name=self.name, image_size=(SIDE_PX, SIDE_PX), seed=self.seed, **own)


def scenes_of(settings: BenchSettings) -> list[BenchmarkScene]:
    """Return all scenes, clean ones first; the same settings give the same scenes."""
    return [
        BenchmarkScene(kind=kind, level=level, seed=seed, number=number, degradations=mixed, plan=settings)
        for seed in settings.seeds
        for kind, level, number, mixed in _of_seed(settings, seed)
    ]


def _of_seed(settings: BenchSettings, seed: int) -> Iterator[tuple[str, int, int, dict[str, int]]]:
    yield CLEAN, 0, 0, {}
    for name in settings.degradations:
        for level in settings.levels:
            yield name, level, 0, {name: level}
    count = min(settings.at_once, len(settings.degradations))
    for level in settings.levels:
        for number in range(settings.together if count > 1 else 0):
            rng = np.random.default_rng([20110, seed, level, number])  # of the random combinations
            drawn = sorted(rng.choice(len(settings.degradations), count, replace=False).tolist())
            yield TOGETHER, level, number, {settings.degradations[k]: level for k in drawn}


def write_scene(folder: Path, scene: BenchmarkScene) -> Path:
    """Render a scene into a folder, with truth.h5 (docs/data-format.md); return the path of experiment.yaml."""

    def clean(settings: SynthSettings, paint_wear: float) -> CleanMovie:
        return _rendered(settings.model_copy(update={"name": ""}), paint_wear)

    return write_degraded(folder, scene.base, scene.degradations, clean)


@lru_cache(maxsize=2)  # scenes of a seed share their motion: render it once
def _rendered(settings: SynthSettings, paint_wear: float) -> CleanMovie:
    return clean_movie(settings, paint_wear).kept()
