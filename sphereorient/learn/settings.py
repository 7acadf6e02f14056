from typing import Self

from pydantic import BaseModel, Field, model_validator

from sphereorient.errors import SettingsError, refusal
from sphereorient.sphere.texture import KINDS
from sphereorient.synth.disks import DISK_DEGRADATIONS, DiskSettings


class NetworkSettings(BaseModel, frozen=True, extra="forbid"):
    """Shape of the network; part of its checkpoints."""

    size_px: int = Field(40, ge=16, le=80, multiple_of=4, description="side of the disks, px")
    width: int = Field(32, ge=4, le=128, description="channels of the picture's network at half size")
    channels: int = Field(8, ge=1, le=64, description="features of a place, on the picture and on the map")
    hidden: int = Field(48, ge=4, le=256, description="units of the map's network")
    step_deg: float = Field(15.0, ge=6, le=30, description="step of the Lattman grid on which the density is given")
    nodes: int = Field(64, ge=16, le=96, description="cells of the map's features along each axis")


class PictureSettings(BaseModel, frozen=True, extra="forbid"):
    """The training pictures, new for each step."""

    disks: DiskSettings = Field(default_factory=lambda: DiskSettings(scale=0.55), description="how they are filmed")
    kinds: tuple[str, ...] = Field(tuple(KINDS), description="of paint")
    textures: int = Field(384, ge=1, description="random maps, each also in negative")
    texture: str | None = Field(None, description="path of one map: learn this ball alone (fine-tuning)")
    texture_rows: int = Field(128, ge=32, description="height of the maps, texels")
    degradations: tuple[str, ...] = Field(DISK_DEGRADATIONS, description="drawn from these")
    at_once: int = Field(3, ge=0, description="most degradations of a picture")
    hardest: float = Field(5.0, ge=1, le=5, description="highest level drawn; 1 .. 5")
    validation: int = Field(1024, ge=16, description="pictures of held-out maps")

    @model_validator(mode="after")
    def _known(self) -> Self:
        for name, known in (("kinds", set(KINDS)), ("degradations", set(DISK_DEGRADATIONS))):
            for one in getattr(self, name):
                if one not in known:
                    expected, do = ", ".join(sorted(known)), "choose among these"
                    raise SettingsError(refusal(f"pictures.{name}", expected=expected, got=repr(one)[:60], do=do))
        if not self.kinds:
            raise SettingsError(refusal("pictures.kinds", expected="at least one", got="none", do="name some"))
        return self


class TrainingSettings(BaseModel, frozen=True, extra="forbid"):
    """How a network is trained."""

    epochs: int = Field(200, ge=1, description="at most; each ends with a validation")
    steps: int = Field(150, ge=1, description="of an epoch")
    maps: int = Field(2, ge=1, description="maps in a step")
    groups: int = Field(8, ge=1, description="groups of pictures of each map, each with its own degradations")
    group: int = Field(16, ge=1, description="pictures in a group")
    learning_rate: float = Field(2e-3, gt=0, description="largest; rises over the first steps, then falls to zero")
    weight_decay: float = Field(1e-4, ge=0, description="of AdamW")
    spread_deg: float = Field(8.0, gt=0, description="spread of the right answer over the grid")
    patience: int = Field(20, ge=1, description="epochs without a better validation after which training ends")
    minutes: float | None = Field(80.0, gt=0, description="end after this time; null: no limit")
    seed: int = Field(0, ge=0, description="same seed, same network on the same machine")
    start: str | None = Field(None, description="path of a checkpoint with initial weights (fine-tuning)")


class ProposerSettings(BaseModel, frozen=True, extra="forbid"):
    """The settings of configs/train_proposer.yaml."""

    network: NetworkSettings = Field(default_factory=NetworkSettings, description="the network")
    pictures: PictureSettings = Field(default_factory=PictureSettings, description="what it learns from")
    training: TrainingSettings = Field(default_factory=TrainingSettings, description="how")

    @model_validator(mode="after")
    def _fitting(self) -> Self:
        size, filmed = self.network.size_px, self.pictures.disks.size_px
        if size != filmed:
            expected, do = f"network.size_px, {size}", "set both to the same"
            raise SettingsError(refusal("pictures.disks.size_px", expected=expected, got=str(filmed), do=do))
        return self
