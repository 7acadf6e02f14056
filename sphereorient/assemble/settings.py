from pydantic import BaseModel, Field


class AssembleSettings(BaseModel, frozen=True, extra="forbid"):
    """How candidates of single frames become one history (the paper's assembly and its two cameras)."""

    quality_min: float = Field(0.5, ge=0, le=1, description="least quality T of a candidate; the paper's 0.5")
    gap_frames_max: int = Field(4, ge=0, description="longest gap inside a segment, frames; the paper: under 5")
    spike_window_frames: int = Field(41, ge=5, description="window of xi's median, frames: a few reversals of velocity")
    spike_factor: float = Field(6.0, gt=1, description="a spike is so many robust deviations (MAD) above xi's median")
    spike_min_deg: float = Field(15.0, gt=0, description="a smaller rotation is no spike, even of a sphere at rest")
    repair_deg: float = Field(30.0, gt=0, le=180, description="least difference of cameras for a repair; paper: 30")
    repair_margin: float = Field(0.02, ge=0, description="difference of mean T that decides a repair, else continuity")
    weight_window_frames: int = Field(
        51, ge=5, description="frames of the moving variance of xi, for the cameras' weights; 50 give its ratio to 28 %"
    )


class PathSettings(BaseModel, frozen=True, extra="forbid"):
    """How candidates of single frames become one history: the second-order path."""

    acceleration_rad_s2: float | None = Field(
        None, gt=0, description="scale of the angular acceleration per axis, rad/s^2; null estimates it from the movie"
    )
    tail: float = Field(4.0, gt=2, description="degrees of freedom of omega's change (Student-t); few: sudden changes")
    miss_probability: float = Field(
        0.01, gt=0, lt=1, description="probability that no candidate of a frame is right after a frame in which one was"
    )
    miss_again_probability: float = Field(
        0.5, gt=0, lt=1, description="probability that no candidate is right after a frame in which none was"
    )
    break_probability: float = Field(
        1.0e-5, gt=0, lt=1, description="probability that the motion breaks between two frames with an orientation"
    )
    stuck_probability: float = Field(
        0.3, gt=0, lt=0.5, description="probability that a false candidate repeats the previous one (glare, dirt)"
    )
    follow_probability: float = Field(
        2.0e-3, gt=0, lt=0.5, description="probability that a false candidate follows the motion (a symmetric map)"
    )
    evidence_doubt: float = Field(0.01, gt=0, lt=1, description="probability that the pictures show no right candidate")
    evidence_scale: float = Field(1.0, gt=0, description="factor on pictures' nats; below 1 if they are overconfident")
    sigma_scale: float = Field(
        1.0, gt=0, description="factor on the stated sigmas of orientations; above 1 if these are too small"
    )
    gap_frames_max: int = Field(16, ge=0, description="longest gap inside a segment, usual frame intervals")
    probability_min: float = Field(0.9, ge=0, le=1, description="a less probable orientation is flagged as ambiguous")
    spike_factor: float = Field(8.0, gt=1, description="least deviation of a spike from the motion, sigmas")
    spike_min_deg: float = Field(10.0, gt=0, description="least deviation of a spike from the motion's prediction")
