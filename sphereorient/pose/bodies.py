"""Who computes a fit: compiled code where it was built, on the CPU; else torch, which defines it and has gradients."""

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor

from sphereorient.pose import compiled, fit, occluders, settle
from sphereorient.pose.camera_view import FrameDisks
from sphereorient.pose.model import SphereModel
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import FittedPoses, PoseStart


class Body(NamedTuple):
    """The functions of a fit; as those of `fit`, `occluders` and `settle`."""

    refine: Callable[[Pixels, PoseStart, SphereModel, int, float], FittedPoses]
    kept: Callable[[Pixels, PoseStart, SphereModel, float], Tensor]
    settle: Callable[[FrameDisks, PoseStart, SphereModel, int, float, bool], tuple[FittedPoses, Tensor]]


IN_TORCH = Body(fit.refine, occluders.kept, settle.settle)
COMPILED = Body(compiled.refine, compiled.kept, compiled.settle)


def body_of(begin: PoseStart) -> Body:
    """Return the body for fits that begin there."""
    X = begin.position_lab_mm
    able = compiled.library() is not None and X.device.type == "cpu" and not X.requires_grad
    return COMPILED if able else IN_TORCH
