"""Cameras: their models, responses and files; projection, lines of sight, triangulation."""

from sphereorient.cameras.brown import TsaiCamera
from sphereorient.cameras.camera import (
    Camera,
    CoarserCamera,
    ParameterCovariance,
    R_cam_view,
    R_lab_view,
    Rays,
    centre_lab_mm,
    holds_disk,
    nearest_point,
    perspective_centre_lab_mm,
    sphere_disk_px,
    sphere_radius_px,
    triangulate,
    without_perspective,
)
from sphereorient.cameras.io.cameras_yaml import add_model, load_cameras, load_covariance, save_cameras
from sphereorient.cameras.model import PinholeCamera, field_of_focal
from sphereorient.cameras.port import Port, PortCamera, in_air
