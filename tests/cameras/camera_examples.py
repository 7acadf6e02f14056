"""Cameras that the tests of this room share."""

from __future__ import annotations

from pathlib import Path

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from sphereorient.cameras import Camera, PinholeCamera, Port, PortCamera, TsaiCamera
from sphereorient.cameras.brown import BrownCamera, OpenPTVCamera
from sphereorient.cameras.fisheye import FisheyeCamera
from sphereorient.cameras.io.opencv import load_camera_files
from sphereorient.cameras.model import TelecentricCamera

SIZE = (650, 480)
ROTVEC = (0.3, -0.2, 0.5)
T_MM = (4.0, -3.0, 520.0)


def f64(value: object) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)


def load_opencv(path: Path, image_size: tuple[int, int] | None = None) -> Camera:
    """Read a file of one camera."""
    (found,) = load_camera_files([path], image_size)
    return found.camera


def turned(rotvec: tuple[float, float, float] = ROTVEC) -> Tensor:
    return torch.from_numpy(Rotation.from_rotvec(rotvec).as_matrix())


def lens(**own: object) -> dict[str, object]:
    """Return the parameters that all cameras here share, and others."""
    return {
        "image_size": SIZE,
        "R_cam_lab": turned(),
        "T_cam_lab_mm": f64(T_MM),
        "centre_px": f64((331.0, 228.5)),
    } | own


def tsai(kappa1: float | Tensor = 2.2e-4, **changes: object) -> TsaiCamera:
    own = lens(f_mm=f64(45.0), pixel_pitch_mm=f64((0.02, 0.021)), sx=f64(1.03), kappa1=kappa1)
    return TsaiCamera(**(own | changes))


def pinhole(**changes: object) -> PinholeCamera:
    return PinholeCamera(**(lens(f_px=f64(700.0)) | changes))


def brown(**changes: object) -> BrownCamera:
    own = lens(f_px=f64((700.0, 715.0)), k=f64((-0.21, 0.12, -0.03)), p=f64((2e-3, -1.5e-3)))
    return BrownCamera(**(own | changes))


def fisheye(**changes: object) -> FisheyeCamera:
    return FisheyeCamera(**(lens(f_px=f64((700.0, 715.0)), k=f64((-0.02, 0.005, -0.004, 0.001))) | changes))


def telecentric(**changes: object) -> TelecentricCamera:
    return TelecentricCamera(**(lens(scale_mm_px=f64(0.23)) | changes))


def openptv(**changes: object) -> OpenPTVCamera:
    own = lens(f_mm=f64(18.0), pixel_pitch_mm=f64((0.02, 0.021)), scx=f64(1.003), she=f64(0.002))
    own |= {"k": f64((-4e-4, 6e-7, 1e-9)), "p": f64((1e-4, -2e-4))}
    return OpenPTVCamera(**(own | changes))


MODELS = {"tsai": tsai, "pinhole": pinhole, "brown": brown, "telecentric": telecentric, "openptv": openptv}
MODELS |= {"fisheye": fisheye}


def port(**changes: object) -> Port:
    """A wall 120 mm from the lab's origin, 6 degrees from square to the cameras above, in Plexiglas and sugar water."""
    tilt = torch.from_numpy(Rotation.from_rotvec((0.1, -0.04, 0.0)).as_matrix())
    parameters: dict[str, object] = {
        "normal": -(tilt @ turned()[2]),
        "offset_mm": 120.0,
        "thickness_mm": 12.0,
        "n_glass": 1.49,
        "n_fluid": 1.36,
    }
    return Port(**(parameters | changes))


def behind_port(camera: Camera, **changes: object) -> PortCamera:
    return PortCamera(camera=camera, port=port(**changes))


def level(kappa1: float) -> TsaiCamera:
    """A camera for numbers worked by hand: f = 10 mm, pixels of 1 mm, axis at pixel (20, 20)."""
    return TsaiCamera(
        image_size=(41, 41),
        R_cam_lab=torch.eye(3, dtype=torch.float64),
        T_cam_lab_mm=torch.zeros(3, dtype=torch.float64),
        centre_px=f64((20.0, 20.0)),
        f_mm=f64(10.0),
        pixel_pitch_mm=f64((1.0, 1.0)),
        sx=f64(1.0),
        kappa1=f64(kappa1),
    )


def whole_picture(size: tuple[int, int] = SIZE, steps: int = 9) -> Tensor:
    """Pixels over the whole picture, its corners (-0.5 .. W - 0.5) among them, (steps^2, 2)."""
    u = torch.linspace(-0.5, size[0] - 0.5, steps, dtype=torch.float64)
    v = torch.linspace(-0.5, size[1] - 0.5, steps, dtype=torch.float64)
    return torch.cartesian_prod(u, v)
