"""Draw docs/paint-design.png and print its figures: effect of the patch size on bound and likeness.

    scripts/figure_paint_design.py [--out docs/paint-design.png]

One map of each kind and size, ball of 80 px, noise 5 % of the black-white step. A minute of one core.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from sphereorient.files.whole_file import writing
from sphereorient.report.plots.style import COMPONENTS, WIDTH_IN, in_style, new_figure, write_figure
from sphereorient.sphere import orthographic_view
from sphereorient.tools.design.judge import DesignSettings, Judgement, judge_texture
from sphereorient.tools.design.patterns import PATTERNS, facing, patterned_texture

REPO = Path(__file__).resolve().parents[1]
SIZES_DEG = (6.0, 9.0, 14.0, 22.0, 34.0, 50.0)
SHOWN_DEG = (6.0, 14.0, 34.0)
SETTINGS = DesignSettings(views=24)
HEIGHT, SEED, SIDE_PX = 512, 1, 120


@dataclass(frozen=True)
class Row:
    """One map and its judgement."""

    kind: str
    size_deg: float
    texture: Tensor
    judged: Judgement

    @property
    def bound_deg(self) -> tuple[float, float]:
        """Root of the mean square over the views, and the worst of them, degrees."""
        bound = torch.rad2deg(self.judged.bound_rad)
        return float(bound.square().mean().sqrt()), float(bound.max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=REPO / "docs" / "paint-design.png")
    out = parser.parse_args().out
    torch.set_num_threads(1)
    rows = [judged(kind, size) for kind in PATTERNS for size in SIZES_DEG]
    print("| paint | patches, degrees | brush | borders, radii | bound, degrees: rms (worst view) | most alike views |")
    print("|---|---|---|---|---|---|")
    for row in rows:
        rms, worst = row.bound_deg
        line = f"{row.kind} | {row.size_deg:g} | {row.judged.stroke_deg:.0f} | {row.judged.border:.0f}"
        print(f"| {line} | {rms:.3f} ({worst:.3f}) | {row.judged.alike:.2f} |")
    for kind in PATTERNS:
        own = [row for row in rows if row.kind == kind]
        slope = np.polyfit(
            [math.log(row.judged.border) for row in own], [math.log(row.bound_deg[0]) for row in own], 1
        )[0]
        gain = 1 - own[0].bound_deg[0] / own[-1].bound_deg[0]
        print(f"{kind}: bound ~ border length^{slope:.2f}; {100 * gain:.0f} % less from the coarsest to the finest")
    with writing(force=True):
        write_figure(figure(rows), out)


def judged(kind: str, size_deg: float) -> Row:
    texture = patterned_texture(kind, size_deg, SEED, HEIGHT)
    return Row(kind, size_deg, texture, judge_texture(texture, SETTINGS))


@in_style
def figure(rows: list[Row]) -> Figure:
    """Balls above; bound against the length of borders, and likeness against the size of patches below."""
    drawn = new_figure(WIDTH_IN, 4.1)
    above, below = drawn.subfigures(2, 1, height_ratios=[0.7, 1.3])
    balls(above, [row for row in rows if row.size_deg in SHOWN_DEG])
    left, right = below.subplots(1, 2)
    for look, kind in zip(COMPONENTS, PATTERNS, strict=True):
        own = [row for row in rows if row.kind == kind]
        border = [row.judged.border for row in own]
        style: dict[str, Any] = {**look.drawn, "marker": look.marker, "label": kind}
        left.plot(border, [row.bound_deg[0] for row in own], **style)
        left.plot(border, [row.bound_deg[1] for row in own], **{**style, "label": None, "alpha": 0.35})
        right.plot([row.size_deg for row in own], [row.judged.alike for row in own], **style)
    lengths = np.array([14.0, 120.0])
    left.plot(lengths, 0.19 / np.sqrt(lengths), color="black", linewidth=0.8, linestyle=":", label="length to the -1/2")
    ticks = {"xticks": [15, 30, 60, 120], "xticklabels": ["15", "30", "60", "120"]}
    left.set(xscale="log", yscale="log", xlabel="length of all borders (radii)", ylabel="best possible error (degrees)")
    left.set(**ticks, yticks=[0.02, 0.03, 0.05, 0.1], yticklabels=["0.02", "0.03", "0.05", "0.1"])
    left.minorticks_off()
    left.set_title("one view, 80 px, noise 5 %; pale: the worst view", fontsize=8)
    left.legend()
    right.set(xscale="log", xlabel="size of patches (degrees)", ylabel="similarity", ylim=(0, 1.02))
    right.set(xticks=SIZES_DEG, xticklabels=[f"{size:g}" for size in SIZES_DEG])
    right.minorticks_off()
    right.set_title("the two most alike of all views 20° apart", fontsize=8)
    return drawn


def balls(part: Any, rows: list[Row]) -> None:
    """One view of each map."""
    R = facing(torch.tensor([1.0, 0.3, 0.2]))
    for axes, row in zip(part.subplots(1, len(rows)), rows, strict=True):
        picture = orthographic_view(SIDE_PX).render(row.texture, R, 0.75)
        axes.imshow(picture.numpy(), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        axes.set_axis_off()
        axes.set_title(f"{row.kind}\n{row.size_deg:g}°", fontsize=7)


if __name__ == "__main__":
    main()
