import math
from collections.abc import Sequence

import torch
from matplotlib.figure import Figure
from torch import Tensor

from sphereorient.report.plots.style import WIDTH_IN, in_style, new_figure
from sphereorient.sphere import orthographic_view, reduced_texture
from sphereorient.tools.spin.spin import SpinFound

COLUMNS = 6
MOST = 36  # photographs that are drawn, the first ones


@in_style
def spin_figure(found: SpinFound, texture: Tensor, time_s: Tensor, names: Sequence[str]) -> Figure:
    """Draw photographs and the map (H, 2 H) at the first spin's orientations, in order of the times (F,), s."""
    chosen = time_s.argsort()[:MOST].tolist()
    size, rows = found.disks.shape[-1], math.ceil(len(chosen) / COLUMNS)
    texture = reduced_texture(texture.float(), size)
    predicted = orthographic_view(size).render(texture, found.spins.R_view_body(time_s)[0].float(), math.nan)
    figure = new_figure(WIDTH_IN, 2.4 * rows + 0.4)
    axes = figure.subplots(2 * rows, COLUMNS, squeeze=False)
    for one in axes.flat:
        one.set_axis_off()
    inside = torch.isfinite(predicted[0])
    for place, k in enumerate(chosen):
        row, column = 2 * (place // COLUMNS), place % COLUMNS
        disk = torch.where(inside, found.disks[k], torch.nan)
        axes[row, column].imshow(disk.numpy(), cmap="gray", interpolation="nearest")
        axes[row + 1, column].imshow(predicted[k].numpy(), cmap="gray", vmin=0, vmax=1.2, interpolation="nearest")
        off = float(found.residual_rad[k])
        words = f"{math.degrees(off):.1f}° off" if math.isfinite(off) else "no attitude"
        axes[row, column].set_title(f"{names[k]}, {1e3 * float(time_s[k]):.1f} ms\n{words}", fontsize=6)
    return figure
