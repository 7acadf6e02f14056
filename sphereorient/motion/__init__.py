"""Velocities and accelerations on R^3 and SO(3)."""

from sphereorient.motion.estimate import ProcessNoise, ProcessPrior
from sphereorient.motion.kalman import Prior
from sphereorient.motion.measure import (
    RATE_UNITS,
    Motion,
    datasets_of,
    kabsch,
    measure_motion,
    omega_from_markers,
    omega_from_orientations,
    to_body,
)
from sphereorient.motion.path import rotvec_between
from sphereorient.motion.settings import MotionSettings, SmoothSettings
from sphereorient.motion.smooth import MeasuredPoses, Smoothed, in_middle, lasting_share, off_middle, smooth_motion
from sphereorient.motion.stencil import gaussian_derivative, gaussian_kernel
