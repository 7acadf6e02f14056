"""Settings of the robustness benchmark."""

from __future__ import annotations

from typing import Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from sphereorient.errors import SettingsError, refusal
from sphereorient.synth.severities import DEGRADATIONS, LEVELS, degradation


class BenchSettings(BaseModel):
    """Which scenes there are; two runs are compared scene by scene, so these stand in the results."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    degradations: tuple[str, ...] = Field(
        tuple(DEGRADATIONS), description="one at a time; names of docs/degradations.md"
    )
    levels: tuple[int, ...] = Field((1, 3, 5), description="severities, of 1 .. 5")
    seeds: tuple[int, ...] = Field((0,), description="each gives another ball, motion and noise")
    together: int = Field(1, ge=0, description="scenes by level and seed with several degradations at once")
    at_once: int = Field(3, ge=2, description="how many they have, drawn by the seed")
    frames: int = Field(24, ge=12, description="of each movie")

    @model_validator(mode="after")
    def _known(self) -> Self:
        for name in self.degradations:
            degradation(name)
        for level in self.levels:
            if level not in LEVELS:
                expected, do = f"levels {LEVELS[0]} .. {LEVELS[-1]}", "choose among these"
                raise SettingsError(refusal("levels", expected=expected, got=str(level), do=do))
        if not self.levels or not self.seeds:
            raise SettingsError(refusal("levels and seeds", expected="one at least", got="none", do="name some"))
        return self


FULL = BenchSettings(levels=LEVELS, seeds=(0, 1, 2), together=2, frames=60)
