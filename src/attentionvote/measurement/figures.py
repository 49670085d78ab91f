"""Figures of a measurement: average precision, working point, intervals, and the machine."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from attentionvote.measurement.models import Measurement
    from attentionvote.part import Parts


def figures_of(measured: Measurement, part: Parts) -> dict[str, Any]:
    """``figures`` of ``Measurement.figures``; ``intervals``, ``[low, high]``, none of one cycle; AP by threshold."""
    from attentionvote.evaluation import ap_by_threshold

    thresholds, ap = ap_by_threshold(measured.results, part)
    sure = {name: figure.interval() for name, figure in measured.left_out(part).items()}
    return {
        "working_point": measured.working_point,
        "figures": {name: round(value, 6) for name, value in measured.figures(part).items()},
        "intervals": {name: [round(i.low, 6), round(i.high, 6)] for name, i in sure.items()},
        "thresholds": [round(float(t), 6) for t in thresholds],
        "ap_by_threshold": [round(float(value), 6) for value in ap],
    }


def machine() -> str:
    """The processor, and how many cores of it there are."""
    from attentionvote.tracking import provenance

    hardware = provenance.hardware()
    return f"{hardware['cpu']}, {hardware['cores']} cores"
