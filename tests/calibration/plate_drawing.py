"""Pictures of dot plates with known truth, drawn by supersampling through a camera without lens."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.calibration.targets import DotPlate
from sphereorient.cameras import PinholeCamera

SIZE = (480, 400)
PER_SIDE = 5  # samples per side of a pixel
PLATE = DotPlate(
    columns=11,
    rows=9,
    pitch_mm=8.0,
    dot_diameter_mm=3.2,
    fiducial_diameter_mm=5.0,
    fiducials=((0, 0), (3, 0), (0, 2)),
)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A plate before a camera that looks at it along -z of the plate where all angles are 0."""

    plate: DotPlate = PLATE
    tilt_deg: float = 0.0
    about_deg: float = 0.0  # direction, in the picture, of the axis of the tilt
    spin_deg: float = 0.0
    at_mm: tuple[float, float] = (0.0, 0.0)  # right and down of the optical axis
    distance_mm: float = 260.0
    f_px: float = 900.0

    @property
    def camera(self) -> PinholeCamera:
        middle = (torch.tensor(SIZE, dtype=torch.float64) - 1) / 2
        view = torch.eye(3, dtype=torch.float64)
        return PinholeCamera(
            image_size=SIZE, R_cam_lab=view, T_cam_lab_mm=torch.zeros(3), centre_px=middle, f_px=torch.tensor(self.f_px)
        )

    @property
    def R_lab_plate(self) -> Tensor:
        def about(axis: NDArray[np.float64], deg: float) -> NDArray[np.float64]:
            return cv2.Rodrigues(axis * math.radians(deg))[0]

        axis = np.array([math.cos(math.radians(self.about_deg)), math.sin(math.radians(self.about_deg)), 0.0])
        # x right, y up, z towards the camera; camera axes are x right, y down, z forward.
        facing = np.diag([1.0, -1.0, -1.0])
        return torch.from_numpy(about(axis, self.tilt_deg) @ about(np.array([0, 0, 1.0]), self.spin_deg) @ facing)

    @property
    def T_lab_plate(self) -> Tensor:
        return torch.tensor([*self.at_mm, self.distance_mm], dtype=torch.float64)

    def centres_px(self, index: NDArray[np.int64]) -> NDArray[np.float64]:
        points = torch.from_numpy(self.plate.points(index))
        return self.camera.project(points @ self.R_lab_plate.mT + self.T_lab_plate).numpy()

    def whole(self, clearance_px: float = 0.0) -> set[tuple[int, int]]:
        """The grid indices of dots whose rims lie in the picture, so far from its edge."""
        index = self.plate.indices
        angle = torch.arange(48) * (2 * math.pi / 48)
        circle = torch.stack([angle.cos(), angle.sin(), 0 * angle], dim=-1).double()
        radius = torch.from_numpy(self.plate.diameters(index))[:, None, None] / 2
        rim = torch.from_numpy(self.plate.points(index))[:, None] + radius * circle
        uv_px = self.camera.project(rim @ self.R_lab_plate.mT + self.T_lab_plate)
        low, high = -0.5 + clearance_px, torch.tensor(SIZE) - 0.5 - clearance_px
        inside = ((uv_px >= low) & (uv_px <= high)).all(-1).all(-1).numpy()
        return {(int(i), int(j)) for i, j in index[inside]}

    def picture(
        self,
        *,
        without: tuple[tuple[int, int], ...] = (),
        small: tuple[tuple[int, int], ...] = (),
        noise: float = 4.0,
        blur_px: float = 0.55,
        uneven: float = 0.0,
        seed: int = 0,
    ) -> NDArray[np.uint8]:
        """Draw: dots `without` are left out, `small` ones have the common size; light falls off by `uneven`."""
        albedo = self._albedo(set(without), set(small))
        light = 1 - uneven * np.linspace(0, 1, SIZE[0])[None, :] * np.linspace(0.3, 1, SIZE[1])[:, None]
        grey = cv2.GaussianBlur(albedo * light, (0, 0), blur_px) * 160 + 5
        noisy = grey + np.random.default_rng(seed).normal(0, 1, grey.shape) * noise * np.sqrt(grey / 160)
        return np.rint(noisy).clip(0, 255).astype(np.uint8)

    def _albedo(self, without: set[tuple[int, int]], small: set[tuple[int, int]]) -> NDArray[np.float64]:
        plate = self.plate
        steps = (np.arange(PER_SIDE) + 0.5) / PER_SIDE - 0.5
        u = (np.arange(SIZE[0])[:, None] + steps).ravel()
        v = (np.arange(SIZE[1])[:, None] + steps).ravel()
        middle = np.array(SIZE) / 2 - 0.5
        right, down = (u - middle[0]) / self.f_px, (v - middle[1])[:, None] / self.f_px
        R, T = self.R_lab_plate.numpy(), self.T_lab_plate.numpy()
        along = [right * R[0, k] + down * R[1, k] + R[2, k] for k in range(3)]  # components of the rays on the plate
        depth = (R[:, 2] @ T) / along[2]
        x, y = (along[k] * depth - R[:, k] @ T for k in (0, 1))
        i, j = np.rint(x / plate.pitch_mm), np.rint(y / plate.pitch_mm)
        width = np.zeros((plate.columns + 2, plate.rows + 2))  # with a border that holds no dots
        before = np.array(plate.first) - 1
        width[tuple((plate.indices - before).T)] = plate.diameters(plate.indices)
        for at in small:
            width[tuple(at - before)] = plate.dot_diameter_mm
        for at in without:
            width[tuple(at - before)] = 0
        column = np.clip(i - before[0], 0, plate.columns + 1).astype(int)
        row = np.clip(j - before[1], 0, plate.rows + 1).astype(int)
        away = np.hypot(x - i * plate.pitch_mm, y - j * plate.pitch_mm)
        dot = away < width[column, row] / 2
        half = (np.array([plate.columns, plate.rows]) + 0.5) * plate.pitch_mm / 2
        board = (np.abs(x) < half[0]) & (np.abs(y) < half[1])
        paint, ground = (0.03, 1.0) if plate.dark else (1.0, 0.1)
        albedo = np.where(board, np.where(dot, paint, ground), 0.01)
        return albedo.reshape(SIZE[1], PER_SIDE, SIZE[0], PER_SIDE).mean(axis=(1, 3))
