"""Cameras: one file per model; projection, lines of sight, triangulation."""

from sphereorient.cameras.camera import Camera, Rays
from sphereorient.cameras.covariance import ParameterCovariance
from sphereorient.cameras.io.cameras_yaml import load_cameras, load_covariance, save_cameras
from sphereorient.cameras.pinhole import PinholeCamera
from sphereorient.cameras.port import Port, PortCamera
from sphereorient.cameras.sight import R_cam_view, triangulate
from sphereorient.cameras.tsai import TsaiCamera

__all__ = [
    "Camera",
    "ParameterCovariance",
    "PinholeCamera",
    "Port",
    "PortCamera",
    "R_cam_view",
    "Rays",
    "TsaiCamera",
    "load_cameras",
    "load_covariance",
    "save_cameras",
    "triangulate",
]
