"""Figures of a proposer's training: right proposals are marked, curves are those of the rows."""

import pytest
import torch
from matplotlib.colors import to_hex

from sphereorient.learn.metrics import Example
from sphereorient.report.learning import RIGHT, WRONG, examples_figure, learning_curve_figure
from sphereorient.report.plots.style import write_figure

ROWS = [
    {"step": 0.0, "validation_nll": 8.0, "validation_recall_1": 0.0, "validation_recall_5": 0.1},
    {"step": 50.0, "train_nll": 6.0, "train_recall_1": 0.3, "validation_nll": 5.0, "validation_recall_1": 0.5,
     "validation_recall_5": 0.7},
    {"step": 100.0, "train_nll": 4.0, "train_recall_1": 0.8, "validation_nll": 5.5, "validation_recall_1": 0.4,
     "validation_recall_5": 0.75},
]  # fmt: skip


def example(probability: list[float], off_deg: list[float], names: tuple[str, ...] = ("dirt",)) -> Example:
    view = torch.rand(16, 16, generator=torch.Generator().manual_seed(1))
    view[0, 0] = torch.nan
    return Example(
        degradations=names,
        disk=255 * view.nan_to_num(),
        true_view=view,
        proposed_view=view.expand(len(probability), 16, 16),
        probability=torch.tensor(probability),
        off_deg=torch.tensor(off_deg),
    )


def test_right_proposals_are_green_with_a_tick_and_wrong_ones_are_red_without():
    figure = examples_figure([example([0.7, 0.2, 0.06], [170.0, 4.2, 10.5])])
    panels = figure.axes[2:]
    assert [panel.get_title() for panel in panels] == ["70 %, 170°", "20 %, 4.2° ✓", "6 %, 10°"]
    colours = [to_hex(panel.spines["left"].get_edgecolor()).upper() for panel in panels]
    assert colours == [WRONG.upper(), RIGHT.upper(), WRONG.upper()]


def test_proposals_without_probability_are_left_out_and_degradations_named():
    figure = examples_figure(
        [example([0.99, 0.001], [1.0, 90.0], ("paint_wear", "dirt")), example([1.0, 0.0], [2.0, 9.0], ())]
    )
    assert [len(axes.images) for axes in figure.axes] == [1, 1, 1, 0, 1, 1, 1, 0]
    assert figure.axes[0].get_xlabel() == "paint wear\ndirt"
    assert figure.axes[4].get_xlabel() == "nothing"


def test_curves_are_those_of_the_rows_where_they_have_a_value():
    figure = learning_curve_figure(ROWS, 50)
    left, right = figure.axes
    lines = {line.get_label(): line.get_xydata().tolist() for axes in (left, right) for line in axes.lines}
    assert lines["validation"] == [[0, 8], [50, 5], [100, 5.5]]
    assert lines["training"] == [[50, 6], [100, 4]]
    assert lines["validation, first"] == [[0, 0], [50, 0.5], [100, 0.4]]
    assert lines["validation, first five"] == [[0, 0.1], [50, 0.7], [100, 0.75]]
    assert lines["training, first"] == [[50, 0.3], [100, 0.8]]
    assert lines["weights kept"] == [[50, 0], [50, 1]]


@pytest.mark.parametrize("draw", [lambda: learning_curve_figure(ROWS, 50), lambda: learning_curve_figure(ROWS[:1], 0),
                                  lambda: examples_figure([example([1.0], [1.0])])])  # fmt: skip
def test_the_same_figure_gives_the_same_bytes(tmp_path, draw):
    for name in ("a.png", "b.png"):
        write_figure(draw(), tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
