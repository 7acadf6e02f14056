from typing import Literal, Self

from pydantic import BaseModel, Field, model_validator

from sphereorient.errors import SettingsError, refusal
from sphereorient.files.hdf5 import UNNAMED


class SynthSettings(BaseModel, frozen=True, extra="forbid"):
    """A synthetic experiment: motion, light, cameras and noise."""

    name: str = Field("synthetic", description="name of the experiment")
    frames: int = Field(120, ge=2, description="frames of each movie")
    frame_rate: float = Field(600.0, gt=0, description="Hz")
    exposure: float = Field(0.0004, ge=0, description="s; the picture is the mean over it")
    exposure_samples: int = Field(2, ge=1, description="averaged instants of the exposure")
    balls: int = Field(1, ge=1, le=8, description="number of balls; several are named a, b, ...")
    paints: int = Field(8, ge=1, le=8, description="different paints; fewer than balls: some look alike")
    diameter_mm: float = Field(18.0, gt=0, description="of the sphere")
    texture: Literal["blobs", "patches", "dots"] = Field("blobs", description="kind of the random paint")
    velocity_rms: float = Field(0.25, ge=0, description="m/s per component")
    omega_rms: float = Field(8.0, ge=0, description="rad/s per component; the paper's sphere: 7.8")
    velocity_time: float = Field(0.12, gt=0, description="correlation time of the velocity, s")
    omega_time: float = Field(0.03, gt=0, description="correlation time of the angular velocity, s")
    periodic: bool = Field(False, description="a periodic motion: whole turns about one axis in the movie")
    volume_mm: float = Field(45.0, gt=0, description="the centre stays within about this distance from the origin")
    cameras: int = Field(2, ge=1, le=4, description="number of cameras, at right angles; the fourth looks aslant")
    image_size: tuple[int, int] = Field((650, 650), description="width and height, px")
    distance_mm: float = Field(520.0, gt=0, description="of the cameras from the origin")
    diameter_px: float = Field(78.0, gt=8, description="of the sphere's picture at the origin")
    white: float = Field(170.0, gt=0, le=255, description="grey level of lit white paint")
    black: float = Field(20.0, ge=0, le=255, description="grey level of lit black paint")
    background: float = Field(15.0, ge=0, le=255, description="grey level behind the sphere")
    ambient: float = Field(0.5, ge=0, le=1, description="share of uniform light from all directions")
    read_noise: float = Field(1.5, ge=0, description="standard deviation of a dark pixel, grey levels")
    shot_noise: float = Field(0.3, ge=0, description="grey levels per root of grey level")
    blur_px: float = Field(0.55, ge=0, description="Gaussian blur of the optics, px")
    seed: int = Field(0, ge=0, description="same seed, same bytes")

    @property
    def worn(self) -> dict[str, int]:
        """Number of the paint of each ball, by its name."""
        names = "abcdefgh"[: self.balls] if self.balls > 1 else (UNNAMED,)
        return {name: k % self.paints for k, name in enumerate(names)}

    @model_validator(mode="after")
    def _exposed_within_a_frame(self) -> Self:
        longest = 1 / self.frame_rate
        if self.exposure > longest:
            expected, got = f"at most 1 / frame_rate, {longest:.4g} s", f"{self.exposure:g}"
            raise SettingsError(refusal("exposure", expected=expected, got=got, do="write it in seconds"))
        return self
