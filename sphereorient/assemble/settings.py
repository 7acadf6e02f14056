"""Settings of the room assemble."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class AssembleSettings(BaseModel):
    """How candidates of single frames become one history (the paper's assembly and its two cameras)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    quality_min: float = Field(
        0.5, ge=0, le=1, description="candidates of lower T never enter the graph; the paper's 0.5"
    )
    gap_frames_max: int = Field(4, ge=0, description="longest hole inside a segment, frames; the paper: under 5")
    spike_window_frames: int = Field(
        41, ge=5, description="frames over which xi's usual size is taken (moving median): a few turns of the velocity"
    )
    spike_factor: float = Field(
        6.0,
        gt=1,
        description="a spike is this many robust deviations (1.48 MAD) above xi's moving median; noise stays below",
    )
    spike_min_deg: float = Field(
        15.0,
        gt=0,
        description="a smaller turn between frames is never a spike, however still the sphere stood; 5 fine steps",
    )
    repair_deg: float = Field(
        30.0,
        gt=0,
        le=180,
        description="cameras further apart than this are repaired, one from the other; the paper's 30",
    )
    repair_margin: float = Field(
        0.02,
        ge=0,
        description="mean T by which one camera must beat the other in a repair; below it, continuity decides",
    )
    weight_window_frames: int = Field(
        25, ge=5, description="frames of the moving variance of xi that weighs the cameras; the paper gives no number"
    )


class PathSettings(BaseModel):
    """How candidates of single frames become one history: the path with physics."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    acceleration_rad_s2: float | None = Field(
        None,
        gt=0,
        description="scale of the angular acceleration per axis, rad/s^2; null: learnt from the track itself",
    )
    tail: float = Field(
        4.0,
        gt=2,
        description="degrees of freedom of the Student-t of omega's change; small: sudden changes are less unlikely",
    )
    miss_probability: float = Field(
        0.01, gt=0, lt=1, description="that no candidate of a frame is right although one was in the frame before"
    )
    miss_again_probability: float = Field(
        0.5, gt=0, lt=1, description="that no candidate is right after a frame in which none was: misses come in bursts"
    )
    break_probability: float = Field(
        1.0e-5, gt=0, lt=1, description="that the motion does not go on from one frame with an orientation to the next"
    )
    stuck_probability: float = Field(
        0.3, gt=0, lt=0.5, description="that a false candidate stands where one stood in a frame before (glare, dirt)"
    )
    follow_probability: float = Field(
        2.0e-3,
        gt=0,
        lt=0.5,
        description="that a false candidate moves on like the sphere (the twin of a symmetric map)",
    )
    evidence_doubt: float = Field(
        0.01, gt=0, lt=1, description="that the pictures say nothing on which of a frame's candidates is right"
    )
    gap_frames_max: int = Field(
        16, ge=0, description="longest hole inside a segment, in usual frame intervals; beyond, a new segment begins"
    )
    probability_min: float = Field(
        0.9, ge=0, le=1, description="a chosen orientation that is less probable is flagged as ambiguous"
    )
    spike_factor: float = Field(
        8.0, gt=1, description="a turn this many standard deviations off what the motion predicts is a spike"
    )
    spike_min_deg: float = Field(
        10.0, gt=0, description="a turn less than this off the prediction is never a spike, however smooth the motion"
    )
