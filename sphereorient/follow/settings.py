from pydantic import BaseModel, Field


class RefineSettings(BaseModel, frozen=True, extra="forbid"):
    """How poses are fitted to pictures (method precise)."""

    background_frames: int = Field(
        32, ge=1, description="evenly spread frames whose mean is the background; fewer than paper's: starts sooner"
    )
    appearance_frames: int = Field(
        16, ge=1, description="evenly spread frames for the estimate of blur, light and noise"
    )
    blur_px: float | None = Field(
        None, gt=0.2, description="standard deviation of optics, pixel and exposure together, px; null learns it"
    )
    learn_paint: bool = Field(
        True, description="find and do not use paint that differs from the map (wear, dirt on the ball)"
    )
    candidates: int = Field(4, ge=1, description="fitted proposals of each camera in a search without history")
    chunk_frames: int = Field(
        64, ge=2, description="frames between full searches; chunks begin at its multiples, each independent"
    )
    chunks: int = Field(
        4, ge=1, description="chunks followed side by side, one batch; more suit a GPU; memory holds all frames"
    )
