from typing import Literal

from pydantic import BaseModel, Field


class OrientSettings(BaseModel, frozen=True, extra="forbid"):
    """How candidate orientations are found (paper sections III B and C)."""

    size_px: int | None = Field(None, ge=16, description="side of disks, px; null: the movie's median diameter")
    black_share: float = Field(0.30, gt=0, lt=1, description="least share of the disk that becomes black; paper: b")
    white_share: float = Field(0.30, gt=0, lt=1, description="least share of the disk that becomes white; paper: w")
    regions: tuple[float, float] = Field(
        (0.5, 0.3), description="sides of Otsu's moving regions, diameters: scale of changes of light, and of patches"
    )
    region_contrast_min: float = Field(
        0.3, ge=0, le=1, description="a region whose classes differ less shows one paint; it gets the global threshold"
    )
    disk_share: float = Field(1.0, gt=0.5, le=1, description="compared share of the radius; the paper: all")
    coarse_step_deg: float = Field(12.0, ge=4, le=30, description="step of the coarse Lattman grid; the paper's 12")
    score_margin: float = Field(
        0.1, gt=0, lt=0.5, description="possible orientations: T above the best less this; the paper's 0.1"
    )
    group_deg: float = Field(30.0, gt=0, lt=180, description="orientations nearer than this are a group; paper: 30-45")
    groups_max: int = Field(40, ge=1, description="a frame with more groups is a runaway, as noise fits everywhere")
    fine_step_deg: float = Field(3.0, gt=0.5, le=12, description="step of the fine grid; the paper's 3")
    fine_radius_deg: float = Field(
        12.0, gt=0, le=45, description="reach of the fine grid; the coarse grid's covering radius is 0.704 steps"
    )
    renderer: Literal["table", "kornia"] = Field(
        "table", description="source of the fine grid's templates: a table filled by the renderer, or the renderer"
    )
    score_min: float = Field(0.5, ge=0, le=1, description="least T of a candidate; the paper's 0.5")


class GreySearchSettings(BaseModel, frozen=True, extra="forbid"):
    """How orientations are searched by grey values (method precise)."""

    size_px: int = Field(40, ge=16, le=128, description="side of the disk's picture, px; 24 takes half the time of 40")
    distance_radii: float | None = Field(
        None, gt=1.5, description="of the camera from the ball, in its radii; null: too far for perspective"
    )
    step_deg: float = Field(12.0, ge=6, le=30, description="step of the bank's grid; 12: at most 14.5 to a template")
    detail: float = Field(0.1, gt=0, lt=0.5, description="finer detail is removed by blur in the bank, radii")
    window: float = Field(0.3, gt=0.1, lt=2, description="neighbourhood of even light, radii (standard deviation)")
    clip: float = Field(
        0.6, gt=0.1, description="differences beyond this many deviations are clipped: reflections, uneven light"
    )
    peak_deg: float = Field(20.0, gt=0, lt=90, description="least distance of the bank's peaks")
    peaks: int = Field(8, ge=1, le=32, description="best peaks, at which refinements start")
    rough_steps: int = Field(4, ge=1, description="steps of each refinement on coarse detail")
    finalists: int = Field(4, ge=1, description="refinements continued on the finest detail")
    fine_steps: int = Field(3, ge=1, description="steps on the finest detail")
    distinct_deg: float = Field(8.0, gt=0, lt=90, description="proposals nearer than this to a better one are the same")
    score_min: float = Field(0.45, ge=0, lt=1, description="least score of a proposal; smooth noise has 0.36")


class ProposeSettings(BaseModel, frozen=True, extra="forbid"):
    """Source of proposals: the template search, a trained network, or both (docs/proposer.md)."""

    checkpoint: str | None = Field(None, description="a network's file, `default`: the bundled; null: templates alone")
    when: Literal["always", "in_doubt"] = Field(
        "in_doubt",
        description="in_doubt: templates first, the network if they explain too little; always: the network alone",
    )
    sure: float = Field(0.75, ge=0, le=1, description="in_doubt: score of templates from which the network is not used")
