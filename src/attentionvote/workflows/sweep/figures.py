"""The figures of a sweep: optuna's own, interactive, on one page that needs no network."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

from optuna import Study, visualization

TARGET = "val/ap"
_PAGE = """<!DOCTYPE html>
<html><head><meta charset="utf-8"><title>{title}</title></head>
<body>{body}</body></html>
"""


def figures_page(study: Study, importances: bool) -> str:
    """History, curves of the trials, what matters most, slices and parallel coordinates, as HTML.

    Args:
        study: with at least one complete trial.
        importances: whether there are trials enough to tell what matters most.
    """
    from plotly import io

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # optuna's on figures that it calls experimental
        figures = list(_figures(study, importances))
    body = "".join(
        io.to_html(figure, full_html=False, include_plotlyjs="inline" if first else False, div_id=name)
        for first, (name, figure) in zip([True] + [False] * len(figures), figures, strict=False)
    )
    return _PAGE.format(title=study.study_name, body=body)


def _figures(study: Study, importances: bool) -> Iterator[tuple[str, Any]]:
    yield "history", visualization.plot_optimization_history(study, target_name=TARGET)
    yield "curves", visualization.plot_intermediate_values(study)
    if importances:
        yield "importances", visualization.plot_param_importances(study, target_name=TARGET)
    yield "slices", visualization.plot_slice(study, target_name=TARGET)
    yield "coordinates", visualization.plot_parallel_coordinate(study, target_name=TARGET)
