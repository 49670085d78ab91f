"""Figures of a run from plain numpy inputs: loss terms, precision-recall, average precision against the threshold.

Every function returns a ``matplotlib.figure.Figure`` 1600 pixels wide; no global state of pyplot is touched.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

# Okabe and Ito's colours: told apart by colour-blind readers, too.
PALETTE = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#000000")
DPI = 100
WIDTH_INCHES = 16.0


def new_figure(height_inches: float) -> Figure:
    """An empty figure, 1600 pixels wide, on its own Agg canvas."""
    figure = Figure(figsize=(WIDTH_INCHES, height_inches), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _polish(axes: Axes, title: str, x_label: str, y_label: str) -> None:
    axes.set_title(title, loc="left", fontsize=14, fontweight="bold")
    axes.set_xlabel(x_label, fontsize=12)
    axes.set_ylabel(y_label, fontsize=12)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="0.9", linewidth=0.8)
    axes.set_axisbelow(True)


def smoothed(values: ArrayLike, window: int) -> NDArray[np.float64]:
    """Running mean over the last ``window`` finite values, same length."""
    values = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(values)
    total = np.concatenate([[0.0], np.cumsum(np.where(finite, values, 0.0))])
    count = np.concatenate([[0], np.cumsum(finite)])
    end = np.arange(1, len(values) + 1)
    start = np.maximum(0, end - window)
    number = count[end] - count[start]
    return np.where(number > 0, (total[end] - total[start]) / np.maximum(number, 1), np.nan)


def loss_figure(terms: Mapping[str, tuple[Sequence[int], Sequence[float]]], x_label: str = "step") -> Figure:
    """Every loss term over the steps, in small panels with their own scale: raw pale, running mean strong.

    Args:
        terms: name -> (steps, values), for example from ``Run.metric_history``.
        x_label: what the first entries count.

    Raises:
        ValueError: there is no term.
    """
    if not terms:
        raise ValueError("a loss figure must have at least one term, got none")
    columns = min(4, len(terms))
    rows = -(-len(terms) // columns)
    figure = new_figure(0.4 + 3.6 * rows)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for index, (axes, (name, (steps, values))) in enumerate(zip(panels, terms.items(), strict=False)):
        colour = PALETTE[index % len(PALETTE)]
        axes.plot(steps, values, color=colour, alpha=0.25, linewidth=1)
        mean = smoothed(values, max(1, len(values) // 40))
        axes.plot(steps, mean, color=colour, linewidth=2)
        finite = np.asarray(values, dtype=np.float64)
        finite = finite[np.isfinite(finite)]
        if len(finite) and finite.min() > 0 and finite.max() > 30 * finite.min():
            axes.set_yscale("log")
        _polish(axes, name, x_label, "loss" if index % columns == 0 else "")
        if len(mean) and np.isfinite(mean[-1]):
            axes.set_title(f"{mean[-1]:.4g}", loc="right", fontsize=12, color=colour)
    for axes in panels[len(terms) :]:
        axes.set_visible(False)
    return figure


def precision_recall_figure(
    curves: Mapping[str, tuple[ArrayLike, ArrayLike]], average_precisions: Mapping[str, float] | None = None
) -> Figure:
    """Precision against recall.

    Args:
        curves: label (for example ``10 % D``) -> (recall, precision), both (R,) in [0, 1], by falling confidence.
        average_precisions: area by label, for the legend.
    """
    figure = new_figure(8.0)
    axes = figure.subplots()
    for level in (0.5, 0.7, 0.8, 0.9, 0.95):
        recall = np.linspace(level / (2 - level), 1, 100)
        axes.plot(recall, level * recall / (2 * recall - level), color="0.85", linewidth=0.9, linestyle="--")
        axes.annotate(f"F1 {level:g}", (1.002, level / (2 - level)), color="0.6", fontsize=9, annotation_clip=False)
    for index, (label, curve) in enumerate(curves.items()):
        recall, precision = (np.asarray(values, dtype=np.float64) for values in curve)
        area = (average_precisions or {}).get(label)
        text = label if area is None else f"{label}: AP {area:.3f}"
        axes.step(recall, precision, where="post", color=PALETTE[index % len(PALETTE)], linewidth=2.2, label=text)
        if len(recall):
            axes.plot(recall[-1], precision[-1], "o", color=PALETTE[index % len(PALETTE)], markersize=7)
    _polish(axes, "Precision against recall", "recall", "precision")
    axes.set_xlim(0, 1.05)
    axes.set_ylim(0, 1.02)
    if curves:
        axes.legend(loc="lower left", fontsize=12, frameon=False, title="dot: all results", alignment="left")
    return figure


def ap_threshold_figure(
    thresholds: ArrayLike, average_precisions: Mapping[str, ArrayLike], marks: Sequence[float] = (0.02, 0.05, 0.10)
) -> Figure:
    """Average precision against the distance at which a pose counts as correct.

    Args:
        thresholds: (T,) rising, in diameters.
        average_precisions: label -> (T,) in [0, 1].
        marks: thresholds whose value is written at the curve.
    """
    thresholds = np.asarray(thresholds, dtype=np.float64)
    figure = new_figure(7.0)
    axes = figure.subplots()
    for index, (label, values) in enumerate(average_precisions.items()):
        values = np.asarray(values, dtype=np.float64)
        colour = PALETTE[index % len(PALETTE)]
        axes.plot(100 * thresholds, values, color=colour, linewidth=2.2, label=label)
        for mark in marks:
            if len(thresholds) and thresholds[0] <= mark <= thresholds[-1]:
                value = float(np.interp(mark, thresholds, values))
                axes.plot(100 * mark, value, "o", color=colour, markersize=7)
                axes.annotate(
                    f"{value:.3f}", (100 * mark, value), (7, -14), textcoords="offset points", color=colour, fontsize=12
                )
    for mark in marks:
        axes.axvline(100 * mark, color="0.8", linewidth=0.9, linestyle="--", zorder=0)
    _polish(axes, "Average precision against distance threshold", "threshold, % of the diameter D", "average precision")
    axes.set_ylim(0, 1.02)
    axes.set_xlim(left=0)
    if average_precisions:
        axes.legend(loc="lower right", fontsize=12, frameon=False)
    return figure
