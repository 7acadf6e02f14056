"""Figures of a proposer's training: learning curve and examples."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from sphereorient.learn.metrics import WITHIN_DEG, Example
from sphereorient.report.plots.style import ALL, GREY, SECOND, SHADE, WIDTH_IN, X, in_style, new_figure, note

RIGHT, WRONG = "#1A7F37", "#B42318"  # borders of proposals; titles also have a tick
SIDE_IN = 1.12  # of a picture of the sheet
UNLIKELY = 0.005  # proposals with a lower probability are not shown


@in_style
def learning_curve_figure(rows: Sequence[Mapping[str, float]], best_step: int) -> Figure:
    """Draw loss and recall against the steps, from the rows of metrics.csv; `best_step`: that of the kept weights."""
    figure = new_figure(WIDTH_IN, 2.7)
    left, right = figure.subplots(1, 2)
    _curve(left, rows, "train_nll", "training", {**SECOND.drawn, "marker": "x"})
    _curve(left, rows, "validation_nll", "validation", {**ALL.drawn, "marker": "o"})
    left.set_ylabel("loss (nats)")
    _curve(right, rows, "train_recall_1", "training, first", {**SECOND.drawn, "marker": "x"})
    _curve(right, rows, "validation_recall_1", "validation, first", {**ALL.drawn, "marker": "o"})
    _curve(right, rows, "validation_recall_5", "validation, first five", {**X.drawn, "marker": "s"})
    right.set(ylabel=f"right within {WITHIN_DEG:g}°", ylim=(-0.02, 1.02))
    for axes, corner in ((left, "upper right"), (right, "lower right")):
        axes.axvline(best_step, color=GREY, linewidth=0.8, linestyle=":", label="weights kept")
        axes.set_xlabel("steps")
        axes.legend(loc=corner, frameon=True, framealpha=0.9, edgecolor="none")
    note(
        figure,
        "Validation: pictures of spheres that are not in the training data. The loss does not reach 0: right answers "
        "are spread over the grid. The training loss is the mean of an epoch, while the weights change.",
    )
    return figure


def _curve(axes: Axes, rows: Sequence[Mapping[str, float]], key: str, label: str, look: dict[str, Any]) -> None:
    there = [(row["step"], row[key]) for row in rows if key in row]
    steps, values = np.array(there, np.float64).reshape(-1, 2).T
    # A marker per row, fewer if there are many.
    axes.plot(steps, values, label=label, markevery=max(len(steps) // 12, 1), **look)


@in_style
def examples_figure(examples: Sequence[Example]) -> Figure:
    """Draw a row for each example: picture, true view, proposed views with probability and angle to the truth."""
    shown = max(len(example.probability) for example in examples)
    figure = new_figure(SIDE_IN * (shown + 2) + 0.4, (SIDE_IN + 0.34) * len(examples) + 0.5)
    panels = figure.subplots(len(examples), shown + 2, squeeze=False)
    for row, example in zip(panels, examples, strict=True):
        for axes in row:
            axes.set(xticks=[], yticks=[])
            axes.grid(visible=False)
            axes.set_frame_on(False)
        row[0].imshow(example.disk.numpy(), cmap="gray", vmin=0, vmax=255)
        names = "\n".join(name.replace("_", " ") for name in example.degradations) or "nothing"
        row[0].set_xlabel(names, fontsize=5.5, labelpad=2)
        _paint(row[1], example.true_view)
        for k, axes in enumerate(row[2:]):
            _proposal(axes, example, k)
    panels[0, 0].set_title("picture", fontsize=7)
    panels[0, 1].set_title("true view", fontsize=7)
    note(
        figure,
        f"Above proposals: probability and angle to the truth; framed green with a tick if it is below "
        f"{WITHIN_DEG:g}°, else red. Below pictures: their degradations. Candidates of less than "
        f"{100 * UNLIKELY:g} % are left out.",
    )
    return figure


def _proposal(axes: Axes, example: Example, k: int) -> None:
    probability, off_deg = float(example.probability[k]), float(example.off_deg[k])
    if probability < UNLIKELY:
        axes.set_axis_off()
        return
    right = off_deg <= WITHIN_DEG
    _paint(axes, example.proposed_view[k])
    for side in axes.spines.values():
        side.set(visible=True, color=RIGHT if right else WRONG, linewidth=1.6)
    tick = " ✓" if right else ""
    degrees = f"{off_deg:.1f}" if off_deg < 10 else f"{off_deg:.0f}"
    axes.set_title(f"{100 * probability:.0f} %, {degrees}°{tick}", fontsize=7, color=RIGHT if right else WRONG, pad=3)


def _paint(axes: Axes, view: Tensor) -> None:
    """Show a view, grey outside the sphere to separate white paint from the page."""
    axes.set_facecolor(SHADE)
    axes.patch.set_visible(True)
    axes.set_frame_on(True)
    for side in axes.spines.values():
        side.set_visible(False)
    axes.imshow(np.ma.masked_invalid(view.numpy()), cmap="gray", vmin=0, vmax=1)
