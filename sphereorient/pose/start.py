"""Where fits of poses begin."""

from dataclasses import dataclass, replace

from torch import Tensor

from sphereorient.pose.neighbours import Neighbours


@dataclass(frozen=True, kw_only=True, eq=False)
class PoseStart:
    """Where the fit of B poses begins."""

    position_lab_mm: Tensor  # (B, 3)
    R_lab_body: Tensor  # (B, 3, 3)
    use: Tensor  # (B, C) bool, the cameras that see the sphere; a pose without any stays
    place_precision: Tensor | None = None  # (B, 3, 3), 1/mm^2, of `position_lab_mm` as known beforehand


@dataclass(frozen=True, kw_only=True, eq=False)
class NearStart(PoseStart):
    """Where the fit of B poses begins that are right to a few degrees and pixels."""

    place_precision: Tensor  # (B, 3, 3), 1/mm^2; counts where not all cameras see the sphere, and where it is held
    moved: Tensor  # (B, 6), turn (rad) and move (mm) while the shutter is open
    held: bool  # whether each step begins at the given position
    among: Neighbours | None = None  # None: no other sphere is in view

    def of(self, rows: Tensor) -> "NearStart":
        """Return some of the poses, by index."""
        parts = {name: part[rows] for name, part in vars(self).items() if isinstance(part, Tensor)}
        others = None if self.among is None else self.among.of(rows)
        return NearStart(**parts, held=self.held, among=others)

    def after(self, position_lab_mm: Tensor, R_lab_body: Tensor) -> "NearStart":
        """Return the start of a further fit, after one that ended there."""
        return replace(
            self, position_lab_mm=self.position_lab_mm if self.held else position_lab_mm, R_lab_body=R_lab_body
        )
