"""The section ``cell`` of an object's configuration file, every figure with what it is."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from attentionvote.simulation.cell import CellSettings
from attentionvote.simulation.sensor_models import SENSOR_MODELS


def cell_text(cell: CellSettings | None) -> str:
    """The lines of the section, metres but for the noise."""
    if cell is None:
        return "# Sensor, distance and bin of a cell; null = the benchmark's, scaled with D.\ncell: null\n"
    camera, walls, measures = cell.camera, cell.bin.walls, cell.measures
    model = SENSOR_MODELS.get(cell.sensor)
    if model is None:
        source, reach = "  # A camera of yours, from its file.", ""
    else:
        source = textwrap.fill(f"{model.title}: {model.sheet}.", 118, initial_indent="  # ", subsequent_indent="  # ")
        reach = f"\n  # The sensor measures from {model.near:g} to {model.far:g} m."
    noise = "  measures: null\n"
    if measures is not None:
        noise = f"""  measures:
    preset: {measures.preset}
    # Standard deviation along the ray at 0.65 m, mm; grows with the square of the distance.
    axial_sigma_mm: {measures.axial_sigma_mm!r}
    # From camera to projector or second camera, metres, and pixels over which noise is alike.
    baseline: {measures.baseline!r}
    noise_pixels: {measures.noise_pixels!r}
    # Lengths are those of one device: nothing scales with the distance.
    scaled: {str(measures.scaled).lower()}
"""
    area = "null" if cell.area is None else _list(cell.area)
    return f"""# What training, evaluation, gates and view are simulated with; a word on the command line wins, e.g.
# simulation.camera.distance=0.9. null = the benchmark's protocol, whose lengths scale with D.
cell:
{source}
  sensor: {cell.sensor}
  # From the camera to a point a third up the bin's axis, metres; varies by the share below.{reach}
  distance: {cell.distance!r}
  distance_jitter: {cell.distance_jitter!r}
  # Pixels.
  camera: {{width: {camera.width}, height: {camera.height}, fx: {camera.fx!r}, fy: {camera.fy!r}, cx: {camera.cx!r}, \
cy: {camera.cy!r}}}
  # What the sensor measures; null = conf/data and conf/evaluation say it.
{noise}  bin:
    # Inner length, width, height at the floor, metres; every side varies by the share below.
    size: {_list(cell.bin.size)}
    jitter: {cell.bin.jitter!r}
    # Metres: of walls and floor; how far the rim stands out, and its height; of the upright corners inside; and the
    # degrees by which the walls lean outward.
    walls: {{thickness: {walls.thickness!r}, rim: {walls.rim!r}, rim_height: {walls.rim_height!r}, \
radius: {walls.radius!r}, draft_degrees: {walls.draft_degrees!r}}}
  # Length and width of the piece of the floor that parts fall over, metres, so that they make a heap; null = all of it.
  area: {area}
  # Most volume of the convex pieces that fall, a multiple of the part's; null = as they come.
  hull_volume: {"null" if cell.hull_volume is None else repr(cell.hull_volume)}
"""


def _list(numbers: Sequence[float]) -> str:
    return f"[{', '.join(repr(float(number)) for number in numbers)}]"
