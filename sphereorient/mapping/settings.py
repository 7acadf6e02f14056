from pydantic import BaseModel, Field


class MapSettings(BaseModel, frozen=True, extra="forbid"):
    """How the texture map is learnt from the movies."""

    background_frames: int = Field(32, ge=1, description="spread frames whose mean is a moving ball's background")
    unordered: bool = Field(False, description="photographs in any order: compare all pairs, not only neighbours")
    disk_px: int = Field(48, ge=24, le=128, description="side of the disks that are compared without a map, px; even")
    detail: float = Field(0.06, gt=0, lt=0.5, description="finer detail is blurred in these disks, radii")
    window: float = Field(0.3, gt=0.1, lt=2, description="neighbourhood over which light is taken as uniform, radii")
    turn_max_deg: float = Field(30.0, gt=0, le=180, description="rotation between neighbours, at most; more for spin")
    baselines: tuple[int, ...] = Field((1, 2, 4, 8, 16), description="frames between the members of compared pairs")
    keyframe_deg: float = Field(12.0, gt=0, description="rotation from one keyframe of the loops to the next")
    loop_reach_deg: float = Field(24.0, gt=0, le=180, description="largest drift of loops; 180: all rotations, slowly")
    loop_pairs: int = Field(1500, ge=0, description="most pairs of keyframes that are tried for loops")
    score_min: float = Field(0.7, gt=0, lt=1, description="correlation above which two pictures show the same patch")
    frames_max: int = Field(400, ge=2, description="most frames, evenly spread, to fit the map to; the others follow")
    height: int | None = Field(None, ge=32, le=512, description="rows of the map; null: texels as large as pixels")
    pixels: int = Field(1600, ge=200, description="pixels of each disk from which the map is fitted, about")
    blur_px: float | None = Field(
        None, gt=0.2, description="standard deviation of optics, pixel and exposure together, px; null estimates it"
    )
    rounds: int = Field(40, ge=1, description="most iterations of orientations, light and map")
    arrived_deg: float = Field(0.01, gt=0, description="stop when an iteration moves orientations by less, degrees rms")
    turned_min_deg: float = Field(8.0, gt=0, description="refuse a movie in which the sphere rotates by less")
