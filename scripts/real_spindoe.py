"""Measure the spin of a real ball with dots from 22 photographs, beside the reference that comes with them.

    scripts/real_spindoe.py [FOLDER]

FOLDER (../shared/real/spindoe) holds test/*.png, ref_pattern.csv (one direction a line) and reference_orientations.csv.
The dots' size is measured in the pictures and nothing else is taken from the reference. Half a minute of one core.
"""

from __future__ import annotations

import argparse
import csv
import math
import resource
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import SphereOrientError
from sphereorient.tools.spin.disks import Photographs
from sphereorient.tools.spin.dots import DotTable
from sphereorient.tools.spin.spin import SpinEstimate, spin_of

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "real" / "spindoe"
WITHIN_DEG = 10.0
FILES = ("test", "ref_pattern.csv", "reference_orientations.csv")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=FOLDER)
    folder = parser.parse_args().folder
    missing = [name for name in FILES if not (folder / name).exists()]
    if missing:
        print(f"{folder}: the photographs are not here ({', '.join(missing)}); nothing to measure.", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    try:
        measure(folder)
    except SphereOrientError as error:
        print(f"real_spindoe: {error}", file=sys.stderr)
        return 2
    return 0


def measure(folder: Path) -> None:
    """Measure twice, the second time with the size of the dots that the first gave, and print the figures."""
    rows = list(csv.DictReader((folder / "reference_orientations.csv").open()))
    pictures = [cv2.imread(str(folder / "test" / row["file"]))[..., ::-1] for row in rows]
    time_s = torch.tensor([float(row["t_s"]) for row in rows], dtype=torch.float64)
    quat = [[float(row[f"constspin_q{axis}"]) for axis in "xyzw"] for row in rows]
    reference = torch.from_numpy(Rotation.from_quat(quat).as_matrix())
    table = DotTable(direction_body=torch.from_numpy(np.loadtxt(folder / "ref_pattern.csv", delimiter=",")))
    begin = time.process_time()
    photographs = Photographs(pictures=pictures, time_s=time_s)
    first = spin_of(photographs, table)
    table = table.measured(first.disks, first.R_view_body)
    found = spin_of(photographs, table)
    spent = time.process_time() - begin
    print(f"{len(pictures)} photographs, dots' radius {table.radius_deg:.1f} degrees (blur and motion in it)")
    alone = degrees(found.alone.R_view_body[found.alone.offset[:-1]], reference)
    print(f"each photograph alone within {WITHIN_DEG:g} degrees: {within(alone)}, median {alone.median():.1f}")
    spun = degrees(found.R_view_body, reference)
    print(f"near the even spin: {within(spun)}, median {spun.median():.1f}, largest {spun.max():.1f}")
    model = degrees(found.spins.R_view_body(time_s)[0], reference)
    print(f"the even spin itself: {within(model)}, median {model.median():.1f}, largest {model.max():.1f}")
    spins(found, reference_rate(reference, time_s))
    residual = torch.rad2deg(found.residual_rad)
    print("photographs' own attitudes off the spin, degrees: " + " ".join(f"{each:.1f}" for each in residual.tolist()))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(f"{spent:.0f} s of one core for two rounds, {peak:.0f} MB")


def spins(found: SpinEstimate, rate_reference: float) -> None:
    """Print each spin with its evidence, and that of the mirror image."""
    rates = found.spins.omega_view_rad_s.norm(dim=-1)
    for k, (omega, rate) in enumerate(zip(found.spins.omega_view_rad_s.tolist(), rates.tolist(), strict=True)):
        which = f"one of {found.ambiguous} that the times allow" if k < found.ambiguous else "less likely"
        off = f", {100 * (rate / rate_reference - 1):+.2f} % of the reference" if k == 0 else ""
        axes = ", ".join(f"{each:.1f}" for each in omega)
        sigma = float(found.spins.rate_sigma()[k])
        print(
            f"omega ({axes}) rad/s, |omega| {rate:.1f} +- {sigma:.1f} = {rate / (2 * math.pi):.1f} revolutions/s{off}: "
            f"{which}, evidence {float(found.spins.evidence[k]):.0f}"
        )
    print(f"mirrored table: evidence {found.mirrored_evidence:.0f}")


def reference_rate(reference: Tensor, time_s: Tensor) -> float:
    """Return |omega| of the reference's constant spin, from the rotation between photographs one step apart."""
    turn = so3.angle(reference[1:] @ reference[:-1].mT)
    gap = time_s.diff()
    near = gap < 1.5 * gap.min()
    return float((turn[near] / gap[near]).mean())


def degrees(found: Tensor, reference: Tensor) -> Tensor:
    return torch.rad2deg(so3.geodesic_distance(found, reference))


def within(off: Tensor) -> str:
    return f"{int((off < WITHIN_DEG).sum())} of {len(off)}"


if __name__ == "__main__":
    sys.exit(main())
