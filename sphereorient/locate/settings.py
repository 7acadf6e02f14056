from pydantic import BaseModel, Field, JsonValue

OF_GAPS: dict[str, JsonValue] = {"methods": ["paper", "map"]}  # methods that interpolate along the movie of one camera


class LocateSettings(BaseModel, frozen=True, extra="forbid"):
    """How the sphere is found in a picture (paper section III A)."""

    background_frames: int = Field(
        100,
        ge=1,
        description="evenly spread frames whose mean is the background; more smear a passing sphere out better",
    )
    reduction: int = Field(
        2, ge=1, le=8, description="blobs are found on frames reduced by this whole factor; 2 is fastest per frame"
    )
    diameter_px: float | None = Field(
        None, gt=4, description="expected diameter, px; null takes it from the sphere's diameter and the camera"
    )
    diameter_tolerance: float = Field(
        0.4,
        gt=0,
        lt=1,
        description="accepted relative deviation from the expected diameter, by depth; half of it for several balls",
    )
    blob_candidates: int = Field(4, ge=1, description="round blobs whose variance and roundness are compared")
    noise_factor: float = Field(
        5.0,
        gt=0,
        description="a pixel belongs to the ball above this many standard deviations of the background's noise",
    )
    contrast_min: float = Field(
        8.0, gt=0, description="faintest ball: 90th percentile of the difference inside it, in 255ths of full scale"
    )
    saturated_share: float = Field(
        0.5, gt=0, le=1, description="share of saturated pixels in the ball from which it cannot be read"
    )
    edge_fraction: float = Field(
        0.2, gt=0, lt=1, description="least steepness of an edge of the outline, as a share of the ball's contrast"
    )
    edge_blur_px: float = Field(
        0.6, gt=0, description="Gaussian blur before edges are found, px; smooths the paint's grain; more moves corners"
    )
    edge_tolerance_px: float = Field(
        1.5, gt=0, description="largest distance of a supporting edge from the circle; texture edges lie farther inside"
    )
    coverage_min: float = Field(
        0.35, gt=0, lt=1, description="least share of the outline's directions with an edge; black paint hides some"
    )
    gap_frames_max: int = Field(
        4, ge=0, description="longest gap that is interpolated, frames; the paper: under 5", json_schema_extra=OF_GAPS
    )
    spline_knot_frames: int = Field(
        12,
        ge=2,
        description="knot spacing of the least-squares spline, frames; well below the shortest motion (20 ms)",
        json_schema_extra=OF_GAPS,
    )
    outlier_px: float = Field(
        1.0,
        gt=0,
        description="smallest deviation from the spline that can be an outlier, px",
        json_schema_extra=OF_GAPS,
    )
    outlier_factor: float = Field(
        6.0, gt=0, description="an outlier deviates by this many robust sigmas of its movie", json_schema_extra=OF_GAPS
    )
