import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from torch import Tensor

from sphereorient.cameras.checks import camera_error
from sphereorient.cameras.model import CentralCamera, Key
from sphereorient.errors import CameraError, refusal


@dataclass(frozen=True, kw_only=True, eq=False)
class PinholeCamera(CentralCamera):
    """Perspective without distortion and with square pixels."""

    f_px: Tensor  # (), focal length, px

    MODEL: ClassVar[str] = "pinhole"
    KEYS: ClassVar[tuple[Key, ...]] = (
        Key("f_px", "f_px", optional=True, positive=True),
        Key("centre", "centre_px", ("centre_u", "centre_v"), optional=True),
    )
    ALSO: ClassVar[tuple[str, ...]] = ("vfov_deg",)

    @classmethod
    def completed(cls, values: dict[str, Any]) -> dict[str, Any]:
        """Return the keys with f_px from vfov_deg (one of both, else CameraError), and a default centre."""
        f_px, vfov_deg = values["f_px"], values["vfov_deg"]
        if (f_px is None) == (vfov_deg is None):
            got, do = "none" if f_px is None else "both", "write one of the two"
            raise CameraError(refusal("vfov_deg, f_px", expected="exactly one", got=got, do=do))
        values = super().completed(values)
        return values if vfov_deg is None else values | {"f_px": focal_of_field(values["image_size"][1], vfov_deg)}

    @classmethod
    def ideal_lens(cls, f_px: float, pitch_mm: Sequence[float]) -> dict[str, Any]:
        """Return the fields of a lens; refuse pixels that are not square."""
        if pitch_mm[0] != pitch_mm[1]:
            got, do = f"pixel_pitch {pitch_mm[0]:g}, {pitch_mm[1]:g}", "choose model: tsai or brown"
            raise CameraError(refusal("model: pinhole", expected="square pixels", got=got, do=do))
        return {"f_px": f_px}

    @property
    def focal_px(self) -> Tensor:
        """(2,), pixels per unit of slope."""
        return self.f_px.expand(2)


def focal_of_field(height_px: int, vfov_deg: float) -> float:
    """Return the focal length, px, for a vertical field of `vfov_deg`, 0 to 180 degrees (else CameraError)."""
    if not 0.0 < vfov_deg < 180.0:
        raise camera_error("vfov_deg", "an angle between 0 and 180", f"{vfov_deg:g}", "correct the camera")
    return 0.5 * height_px / math.tan(math.radians(vfov_deg) / 2)
