"""From a part and what the user says of their cell to one that can work: defaults as they exist in the world.

The bin is the smallest of the usual ones in which the part's piles have room, the sensor the smallest whose picture
holds that bin, the distance the one at which the bin fills the picture, within the sensor's range.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from attentionvote.part import Parts
from attentionvote.simulation.bin_walls import Walls
from attentionvote.simulation.camera_file import read_camera
from attentionvote.simulation.cell import CellBin, CellSettings, fitting_distance
from attentionvote.simulation.drop_settings import REFERENCE_BIN, REFERENCE_DIAMETER, BinSettings
from attentionvote.simulation.sensor_models import CUSTOM, SENSOR_MODELS

Size = tuple[float, float, float]

_TRAY = Walls(thickness=0.0015, rim=0.003, rim_height=0.003, radius=0.004, draft_degrees=2.0)
_CARRIER = Walls()
_LARGE = Walls(thickness=0.004, rim=0.015, rim_height=0.015, radius=0.020, draft_degrees=2.0)
_PALLET = Walls(thickness=0.020, rim=0.0, rim_height=0.010, radius=0.020, draft_degrees=0.0)
# Inner length, width, height in millimetres at the floor. Load carriers: VDA 4500, as remembered; their outsides are
# 300 x 200, 400 x 300 and 600 x 400 mm. Small-parts trays follow no standard.
BINS: tuple[tuple[str, tuple[int, int, int], Walls], ...] = (
    ("small-parts tray", (80, 60, 30), _TRAY),
    ("small-parts tray", (120, 90, 40), _TRAY),
    ("small-parts tray", (180, 130, 60), _TRAY),
    ("small load carrier KLT 3147", (243, 162, 129), _CARRIER),
    ("small load carrier KLT 4147", (346, 265, 109), _CARRIER),
    ("small load carrier KLT 4280", (346, 265, 242), _CARRIER),
    ("small load carrier KLT 6280", (544, 364, 242), _CARRIER),
    ("Euro container 800 x 600", (750, 550, 320), _LARGE),
    ("pallet box 1200 x 800", (1160, 760, 500), _PALLET),
)

_ROOM = 0.9  # of the protocol's floor and height, below which a bin is too small for the part's piles
_LEAST_PARTS = 6  # the smallest pile of conf/simulation
_STEP = 0.005  # distances are multiples of it, metres


class NoUsualCell(ValueError):
    """A part is too large for the bins and scanners that are usual."""


def parsed_bin(text: str) -> Size:
    """Inner length, width, height in metres of a text in millimetres, ``360x280x160``.

    Raises:
        ValueError: with one sentence, when it is none.
    """
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*[xX*]\s*(\d+(?:\.\d+)?)\s*[xX*]\s*(\d+(?:\.\d+)?)\s*", text)
    if found is None:
        raise ValueError(f"bin must be inner length x width x height in mm, e.g. 360x280x160; got {text!r}")
    length, width, height = (float(number) / 1000 for number in found.groups())
    for side in (length, width, height):
        if not 0.01 <= side <= 3:
            raise ValueError(f"bin must be millimetres, every side 10 to 3000, e.g. 360x280x160; got {text!r}")
    return length, width, height


def walls_for(size: Size) -> Walls:
    """Walls as the usual bin next in length has them; corners no rounder than an eighth of the shorter side."""
    walls = min(BINS, key=lambda entry: abs(np.log(entry[1][0] / 1000 / size[0])))[2]
    radius = min(walls.radius, min(size[:2]) / 8)
    return Walls(walls.thickness, walls.rim, min(walls.rim_height, size[2] / 4), round(radius, 4), walls.draft_degrees)


def default_bin(parts: Parts, count: int) -> Size:
    """The smallest usual bin with nine tenths of the room that the benchmark's protocol gives ``count`` parts.

    Raises:
        NoUsualCell: when there is none so large.
    """
    needed = _ROOM * _protocol_bin(parts, count)
    for _, size, _ in BINS:
        if (np.array(size) / 1000 >= needed).all():
            return tuple(side / 1000 for side in size)  # type: ignore[return-value]  # three
    length, width, height = needed * 1000 / _ROOM
    raise NoUsualCell(
        f"bin must be given for a part of {parts.diameter * 1000:.0f} mm, of which {count} fit no usual bin, e.g. "
        f"bin={length:.0f}x{width:.0f}x{height:.0f}"
    )


def drop_area(parts: Parts, size: Size, count: int) -> tuple[float, float] | None:
    """The piece of a bin's floor over which ``count`` parts make a heap as in the benchmark's protocol, metres; None
    where that is the whole floor. A thin layer of parts teaches nothing of piles, and hundreds of parts are dear."""
    protocol = _protocol_bin(parts, count)
    # In a lower bin the same heap needs more floor: the cycle ends at the rim.
    lower = max(1.0, float(protocol[2]) / size[2])
    heap = np.minimum(protocol[:2] * np.sqrt(lower), size[:2])
    if (heap >= _ROOM * np.array(size[:2])).all():
        return None
    length, width = heap.round(4)
    return float(length), float(width)


def choose_cell(
    parts: Parts,
    count: int,
    sensor: str | None = None,
    bin_text: str | None = None,
    distance_mm: float | None = None,
    camera_file: Path | None = None,
) -> CellSettings:
    """The cell that the user means, its defaults filled in.

    Args:
        parts: what lies in the bin.
        count: most parts in it.
        sensor: name of a model, ``custom`` with a camera file; None = by the bin.
        bin_text: inner size in mm, ``360x280x160``; None = by the part's size.
        distance_mm: from the camera to a point a third up the bin; None = by sensor and bin.
        camera_file: intrinsics, see ``read_camera``.

    Raises:
        ValueError: with one sentence, when they do not fit together.
        FileNotFoundError: when there is no camera file.
    """
    size = default_bin(parts, count) if not bin_text else parsed_bin(bin_text)
    _check_room(parts, size)
    walls = walls_for(size)
    wanted = None if distance_mm is None else distance_mm / 1000
    if camera_file is not None and sensor not in (None, CUSTOM):
        raise ValueError(f"sensor must be {CUSTOM} with camera={camera_file}, got {sensor}: leave one of them out")
    if camera_file is not None or sensor == CUSTOM:
        if camera_file is None:
            raise ValueError(f"camera must name a file with sensor={CUSTOM} (fx, fy, cx, cy, width, height); got none")
        name, camera, reach = CUSTOM, read_camera(camera_file), None
    else:
        name = sensor or _smallest_sensor(size, walls, wanted)
        if name not in SENSOR_MODELS:
            raise ValueError(f"sensor must be one of {', '.join([*SENSOR_MODELS, CUSTOM])}; got {name!r}")
        model = SENSOR_MODELS[name]
        camera, reach = model.camera, (model.near, model.far)
    least = fitting_distance(camera, size, walls)
    distance = _distance(name, size, wanted, least, reach)
    return CellSettings(
        name,
        distance,
        CellBin(size, walls),
        camera,
        None if name == CUSTOM else SENSOR_MODELS[name].sensor,
        area=drop_area(parts, size, count),
    )


def _protocol_bin(parts: Parts, count: int) -> np.ndarray:
    """``(3,)`` metres: the benchmark's bin of these parts."""
    return np.array(REFERENCE_BIN) * BinSettings().scaling_diameter(parts, count) / REFERENCE_DIAMETER


def _check_room(parts: Parts, size: Size) -> None:
    """Refuse a bin of which a part is longer than the diagonal, or that the fewest parts of a pile fill."""
    needed = _protocol_bin(parts, _LEAST_PARTS)
    # A part's centre must stay below the rim when it lies on another.
    low = 1.5 * float(np.ptp(parts.parts[0].box, axis=0).min())
    if size[2] < low:
        raise ValueError(
            f"bin must be high enough for parts that lie on each other, at least {np.ceil(low * 1000):.0f} mm, got "
            f"{size[2] * 1000:g}: take a higher one"
        )
    if np.prod(size) < np.prod(needed) * (_LEAST_PARTS / 30) or np.linalg.norm(size) < parts.diameter:
        length, width, height = np.ceil(needed * 100) * 10
        given = "x".join(f"{side * 1000:g}" for side in size)
        raise ValueError(
            f"bin must hold a heap of {_LEAST_PARTS} parts of {parts.diameter * 1000:.0f} mm, got {given}: take e.g. "
            f"bin={length:.0f}x{width:.0f}x{height:.0f}"
        )


def _smallest_sensor(size: Size, walls: Walls, wanted: float | None) -> str:
    """The first of the scanners that measures all of the bin, within its range and picture, at the wanted distance."""
    for name in ("phoxi_s", "phoxi_m", "phoxi_l"):
        model = SENSOR_MODELS[name]
        least = fitting_distance(model.camera, size, walls)
        nearest, farthest = _whole_bin(size, model.near, model.far, 0.0 if wanted else CellSettings.distance_jitter)
        if max(least, nearest) <= (wanted or farthest) <= farthest:
            return name
    given = "x".join(f"{side * 1000:g}" for side in size)
    at = "" if wanted is None else f" at distance={wanted * 1000:g}"
    raise ValueError(
        f"sensor must be given, because none of the usual scanners sees a bin of {given} mm{at}: leave distance out, "
        f"take another bin, or sensor={CUSTOM} with a camera file"
    )


def _distance(name: str, size: Size, wanted: float | None, least: float, reach: tuple[float, float] | None) -> float:
    given = "x".join(f"{side * 1000:g}" for side in size)
    near, far = reach or (0.05, 100.0)
    if least > far:
        raise ValueError(
            f"bin must be in the picture of {name}, which holds {given} mm from {least * 1000:.0f} mm on but measures "
            f"up to {far * 1000:.0f} mm only: {_others(size, name)}"
        )
    if wanted is None:
        # All of the bin in the sensor's range, from scene to scene, where its picture allows that.
        nearest, farthest = _whole_bin(size, near, far, CellSettings.distance_jitter)
        return round(float(np.ceil(max(least, min(nearest, farthest)) / _STEP - 1e-9)) * _STEP, 4)
    if not near <= wanted <= far:
        raise ValueError(
            f"distance must lie within {near * 1000:.0f}..{far * 1000:.0f} mm, the range of {name}, got "
            f"{wanted * 1000:g}: take {np.clip(wanted, max(near, least), far) * 1000:.0f}"
        )
    if wanted < least - 1e-9:
        raise ValueError(
            f"distance must be at least {np.ceil(least * 1000):.0f} mm, from where on the picture of {name} holds the "
            f"bin of {given} mm; got {wanted * 1000:g}"
        )
    return round(wanted, 6)


def _whole_bin(size: Size, near: float, far: float, jitter: float) -> tuple[float, float]:
    """Distances to a point a third up the bin between which all of it lies in a sensor's range, whatever the jitter."""
    return (near + size[2] * 2 / 3) / (1 - jitter), (far - size[2] / 3) / (1 + jitter)


def _others(size: Size, name: str) -> str:
    """Which models see a bin, the end of a sentence."""
    fit = [
        other for other, model in SENSOR_MODELS.items()
        if other != name and fitting_distance(model.camera, size, walls_for(size)) <= model.far
    ]  # fmt: skip
    return f"take {' or '.join(fit)}" if fit else "take a smaller bin, or a camera of your own"
