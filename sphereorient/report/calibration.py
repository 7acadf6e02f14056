"""The picture of a calibration: points found and expected, and the residuals."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from sphereorient.calibration import Calibrated, PictureReport
from sphereorient.report.plots.style import AXIS_COLOURS, in_style, new_figure, write_figure

SHOWN = 3  # pictures of each camera
EXPECTED, FOUND = AXIS_COLOURS[:2]
OUTLIER = "#CC79A7"


@in_style
def calibration_figure(result: Calibrated, path: Path) -> None:
    """Draw the pictures, read again, with points found and expected, and all residuals; into a PNG or PDF."""
    names = list(result.cameras)
    figure = new_figure(4.2 * (SHOWN + 2), 4.3 * len(names))
    axes = figure.subplots(len(names), SHOWN + 2, squeeze=False)
    for row, name in zip(axes, names, strict=True):
        used = [one for one in result.pictures if one.picture.camera == name and not one.reason]
        chosen = [used[int(k)] for k in np.linspace(0, len(used) - 1, min(SHOWN, len(used))).round()]
        for ax in row:
            ax.grid(visible=False)
        for ax, one in zip(row, chosen, strict=False):
            _draw_picture(ax, one)
        for ax in row[len(chosen) : SHOWN]:
            ax.set_axis_off()
        row[0].set_ylabel(name, fontsize=12)
        place = np.concatenate([np.zeros((0, 2)), *(one.view.uv_px[one.used] for one in used)])
        missed = np.concatenate([np.zeros((0, 2)), *(one.residual_px[one.used] for one in used)])
        _draw_residuals(row[SHOWN], place, missed, result.cameras[name].image_size)
        _draw_histogram(row[SHOWN + 1], missed, result.rms_px(name))
    write_figure(figure, path, dpi=110)


def _draw_picture(ax: Any, one: PictureReport) -> None:
    data = np.fromfile(one.picture.path, np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if picture is not None:  # a table of points has no picture
        ax.imshow(picture, cmap="gray")
    else:
        ax.set_aspect("equal")
        ax.invert_yaxis()
    found = one.view.uv_px
    expected = found - one.residual_px
    ax.plot(*expected.T, "+", ms=7, mew=0.9, color=EXPECTED, label="expected")
    ax.plot(*found.T, "o", ms=4, mfc="none", mew=0.8, color=FOUND, label="found")
    if not one.used.all():
        ax.plot(*found[~one.used].T, "x", ms=8, color=OUTLIER, label="left out")
    ax.set(xticks=[], yticks=[])
    ax.set_title(f"pose {one.pose}: {len(found)} points, rms {one.rms_px:.3f} px", fontsize=9)
    ax.legend(loc="lower right", frameon=True, framealpha=0.8)


def _draw_residuals(
    ax: Any, place: NDArray[np.float64], missed: NDArray[np.float64], image_size: tuple[int, int]
) -> None:
    usual = float(np.sqrt((missed**2).sum(1).mean())) if len(missed) else 1.0
    # The arrow of the usual length is a fortieth of the picture long.
    times = image_size[0] / 40 / max(usual, 1e-9)
    style = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.002, "color": EXPECTED, "alpha": 0.7}
    ax.quiver(*place.T, *(times * missed.T), **style)
    ax.set(xlim=(0, image_size[0]), ylim=(image_size[1], 0), aspect="equal", xlabel="u (px)", ylabel="v (px)")
    ax.set_title(f"found less expected, {times:.0f} times", fontsize=9)


def _draw_histogram(ax: Any, missed: NDArray[np.float64], rms_px: float) -> None:
    reach = 4 * max(rms_px, 1e-6) / np.sqrt(2)
    for part, colour, label in zip(missed.T, (FOUND, EXPECTED), ("u", "v"), strict=True):
        ax.hist(part, np.linspace(-reach, reach, 41), histtype="step", lw=1.5, color=colour, label=label)
    ax.set(xlabel="found less expected (px)", ylabel="points")
    ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.set_title(f"all pictures: rms {rms_px:.3f} px", fontsize=9)
    ax.legend()
