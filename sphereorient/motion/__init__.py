"""Velocities and accelerations on R^3 and SO(3)."""

from sphereorient.motion.angular_velocity import kabsch, omega_from_markers, omega_from_orientations, to_body
from sphereorient.motion.estimate import ProcessNoise, ProcessPrior
from sphereorient.motion.matern import Prior
from sphereorient.motion.measure import RATE_UNITS, Motion, datasets_of, measure_motion
from sphereorient.motion.path import rotvec_between
from sphereorient.motion.settings import MotionSettings, SmoothSettings
from sphereorient.motion.smooth import MeasuredPoses, Smoothed, lasting_share, off_middle, smooth_motion
from sphereorient.motion.stencil import gaussian_derivative, gaussian_kernel
