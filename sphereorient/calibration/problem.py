"""What is to be fitted: cameras and plate poses on one side, points seen in pictures on the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.calibration.bias import disk_centre_shift
from sphereorient.calibration.slopes import slopes_along
from sphereorient.calibration.view import PlateView
from sphereorient.cameras.camera import Camera
from sphereorient.cameras.parameters import ROTATION, TRANSLATION, parameter_names, with_parameters
from sphereorient.cameras.port import PortCamera

POSE_PARTS = 6  # rotation (rad, lab) and translation (mm) of a plate pose
HELD = ("pixel_pitch_u", "pixel_pitch_v", "sx", "k3")  # scales that f holds already, and a term few lenses need


@dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """Cameras and the plate's P poses; made by the guess, improved by the fit."""

    cameras: Mapping[str, Camera]
    R_lab_plate: Tensor  # (P, 3, 3)
    T_lab_plate_mm: Tensor  # (P, 3)


@dataclass(frozen=True, kw_only=True, eq=False)
class Seen:
    """All points that one camera saw of the plate, n of them, whatever the picture."""

    pose: Tensor  # (n,) int64, row of the rig's poses
    points_plate_mm: Tensor  # (n, 3)
    diameter_mm: Tensor  # (n,), of the dot; 0 for corners
    uv_px: Tensor  # (n, 2), measured
    sigma_px: Tensor  # (n,)


def gathered(views: Mapping[int, PlateView]) -> Seen:
    """Join the views of one camera, by row of the rig's poses."""
    rows = sorted(views)

    def joined(name: str) -> Tensor:
        return torch.from_numpy(np.concatenate([getattr(views[row], name) for row in rows]))

    return Seen(
        pose=torch.cat([torch.full((len(views[row]),), row, dtype=torch.int64) for row in rows]),
        points_plate_mm=joined("points_plate_mm"),
        diameter_mm=joined("diameter_mm"),
        uv_px=joined("uv_px"),
        sigma_px=joined("sigma_px"),
    )


def fitted_parameters(camera: Camera, of_port: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the names of the parameters that a fit changes: the lens, the place, and of a port what is asked for."""
    inner = camera.camera if isinstance(camera, PortCamera) else camera
    return (*(name for name in parameter_names(inner) if name not in HELD), *of_port)


@dataclass(frozen=True, kw_only=True, eq=False)
class Problem:
    """Residuals and their slopes as functions of one vector: the cameras' changes, then those of the free poses."""

    rig: Rig
    seen: Mapping[str, Seen]
    names: Mapping[str, tuple[str, ...]]  # of each camera's fitted parameters
    fixed: frozenset[int]  # rows of poses that define the lab

    @property
    def free(self) -> list[int]:
        """Rows of the poses that are fitted: those that somebody sees and that do not define the lab."""
        rows = {row for seen in self.seen.values() for row in seen.pose.tolist()}
        return sorted(rows - self.fixed)

    @property
    def size(self) -> int:
        """Return the number of unknowns."""
        return sum(len(names) for names in self.names.values()) + POSE_PARTS * len(self.free)

    @property
    def labels(self) -> list[str]:
        """Names of the unknowns, such as cam1.f and pose 3, T_x."""
        of_cameras = [f"{camera}.{name}" for camera, names in self.names.items() for name in names]
        return [*of_cameras, *(f"pose {row}, {part}" for row in self.free for part in (*ROTATION, *TRANSLATION))]

    def applied(self, change: Tensor) -> Rig:
        """Return the rig with a vector of changes (size,) applied."""
        shares, poses = self._split(change)
        cameras = {
            name: with_parameters(camera, self.names[name], shares[name]) if self.names[name] else camera
            for name, camera in self.rig.cameras.items()
        }
        return Rig(
            cameras=cameras,
            R_lab_plate=so3.exp(poses[:, :3]) @ self.rig.R_lab_plate,
            T_lab_plate_mm=self.rig.T_lab_plate_mm + poses[:, 3:],
        )

    def shifts(self, rig: Rig) -> dict[str, Tensor]:
        """Return by how much each dot's centroid lies beside its centre, (n, 2) px of every camera."""
        return {
            name: torch.nan_to_num(
                disk_centre_shift(
                    rig.cameras[name],
                    rig.R_lab_plate[seen.pose],
                    rig.T_lab_plate_mm[seen.pose],
                    seen.points_plate_mm[:, None],
                    seen.diameter_mm[:, None],
                )[:, 0]
            )
            for name, seen in self.seen.items()
        }

    def residuals(self, change: Tensor, shifts: Mapping[str, Tensor]) -> Tensor:
        """Return measured less expected pixels over their sigmas, (2 n,), the cameras one after the other."""
        shares, poses = self._split(change)
        parts = []
        for name, seen in self.seen.items():
            missed = seen.uv_px - shifts[name] - self._expected(name, shares[name], poses)
            parts.append((missed / seen.sigma_px[:, None]).reshape(-1))
        return torch.cat(parts)

    def slopes(self, change: Tensor) -> Tensor:
        """Return the derivatives of the residuals (2 n, size), by differentiation of the cameras themselves.

        A point's picture depends on its own camera and its own pose: all poses are differentiated in one pass.
        """
        shares, poses = self._split(change)
        rows = 2 * sum(len(seen.pose) for seen in self.seen.values())
        out = change.new_zeros(rows, self.size)
        column = {row: k for k, row in enumerate(self.free)}
        begin, first_pose = 0, sum(len(names) for names in self.names.values())
        offset = 0
        for name, seen in self.seen.items():
            n = len(seen.pose)
            block = out[begin : begin + 2 * n].view(n, 2, self.size)
            weight = -1.0 / seen.sigma_px[:, None, None]
            units = torch.eye(len(self.names[name]), dtype=torch.float64)
            by_share = slopes_along(partial(self._by_share, name, poses), shares[name], units)
            block[:, :, offset : offset + len(units)] = weight * by_share
            place = torch.tensor([column.get(int(row), -1) for row in seen.pose])
            moving = torch.nonzero(place >= 0)[:, 0]
            units = torch.eye(POSE_PARTS, dtype=torch.float64)[:, None].expand(-1, len(poses), -1)
            by_pose = weight * slopes_along(partial(self._expected, name, shares[name]), poses, units)
            for part in range(POSE_PARTS):
                block[moving, :, first_pose + POSE_PARTS * place[moving] + part] = by_pose[moving, :, part]
            begin, offset = begin + 2 * n, offset + len(self.names[name])
        return out

    def _split(self, change: Tensor) -> tuple[dict[str, Tensor], Tensor]:
        """Cut a vector of changes into those of each camera and those of all poses (P, 6)."""
        lengths = [len(names) for names in self.names.values()]
        *shares, poses = torch.split(change, [*lengths, POSE_PARTS * len(self.free)])
        whole = change.new_zeros(len(self.rig.R_lab_plate), POSE_PARTS)
        whole[self.free] = poses.view(-1, POSE_PARTS)
        return dict(zip(self.names, shares, strict=True)), whole

    def _by_share(self, name: str, poses: Tensor, share: Tensor) -> Tensor:
        return self._expected(name, share, poses)

    def _expected(self, name: str, share: Tensor, poses: Tensor) -> Tensor:
        """Return where one camera shows its points, (n, 2) px."""
        seen, camera = self.seen[name], self.rig.cameras[name]
        if self.names[name]:
            camera = with_parameters(camera, self.names[name], share)
        R = (so3.exp(poses[:, :3]) @ self.rig.R_lab_plate)[seen.pose]
        T = (self.rig.T_lab_plate_mm + poses[:, 3:])[seen.pose]
        return camera.project((R @ seen.points_plate_mm[..., None])[..., 0] + T)
