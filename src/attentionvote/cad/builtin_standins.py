"""Stand-ins for the parts of the public Siléane and IPA datasets, designed for this project.

They have the size and the symmetry class of the dataset's part and are no copies of it: whoever has the
dataset uses its mesh instead. Millimetres; the catalogue (``cad.py``) centres and scales.
"""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from attentionvote.cad.builtin_shapes import Point, box, ring, turned


def brick() -> Manifold:
    """Hollow building block with two rows of four studs: C2 about z."""
    solid = box((-15.9, 15.9), (-7.9, 7.9), (0, 9.6)) - box((-14.4, 14.4), (-6.4, 6.4), (-1, 8.2))
    for x in (-12.0, -4.0, 4.0, 12.0):
        for y in (-4.0, 4.0):
            solid += Manifold.cylinder(1.8, 2.4, 2.4, 20).translate((x, y, 9.5))
    for x in (-8.0, 0.0, 8.0):
        post = Manifold.cylinder(8.3, 3.2, 3.2, 16) - Manifold.cylinder(8.0, 2.4, 2.4, 16)
        solid += post.translate((x, 0, 0))
    return solid


def gear() -> Manifold:
    """Gear blank with web and a hub on one side; no teeth: revolution about z, no flip."""
    half = [
        (14.0, 0.0),
        (26.0, 0.0),
        (26.0, 6.0),
        (46.0, 6.0),
        (46.0, 0.0),
        (57.0, 0.0),
        (59.5, 2.5),
        (59.5, 19.5),
        (57.0, 22.0),
        (46.0, 22.0),
        (46.0, 15.0),
        (27.0, 15.0),
        (25.0, 38.0),
        (23.0, 40.0),
        (14.0, 40.0),
    ]
    return turned(half)


def candlestick() -> Manifold:
    """Round foot, slender stem with a knob, cup with a socket: revolution about z, no flip."""
    profile = [
        (0.0, 0.0),
        (46.0, 0.0),
        (47.0, 3.0),
        (45.0, 7.0),
        (24.0, 14.0),
        (11.0, 26.0),
        (8.0, 48.0),
        (8.0, 78.0),
        *_bulge(8.0, 14.0, 78.0, 100.0),
        (8.0, 100.0),
        (8.5, 128.0),
        (15.0, 140.0),
        (30.0, 148.0),
        (30.0, 152.0),
        (16.0, 154.0),
        (16.0, 178.0),
        (11.5, 178.0),
        (11.5, 156.0),
        (0.0, 156.0),
    ]
    return turned(profile)


def pepper() -> Manifold:
    """Tall pepper mill, wide foot, waist and round head: revolution about z, no flip."""
    profile = [
        (0.0, 0.0),
        (33.0, 0.0),
        (34.0, 4.0),
        (34.0, 30.0),
        (29.0, 52.0),
        (21.0, 96.0),
        (18.0, 140.0),
        (20.0, 180.0),
        (26.0, 212.0),
        (27.0, 226.0),
        (23.0, 236.0),
        (23.0, 241.0),
        *_bulge(23.0, 31.0, 241.0, 300.0),
        (12.0, 308.0),
        (6.0, 311.0),
        *_bulge(6.0, 9.0, 311.0, 326.0),
        (4.0, 328.5),
        (0.0, 329.5),
    ]
    return turned(profile)


def ring_screw() -> Manifold:
    """Lifting eye: ring on a collar with a grooved shank: C2 about z (the shank)."""
    solid = ring(41.5, 12.5).translate((0, 0, 100))
    shank: list[Point] = [(0.0, 0.0), (12.0, 0.0), (14.0, 2.0)]
    for z in np.arange(3.0, 29.0, 7.0):
        # Grooves instead of a thread: a helix would leave no symmetry at all.
        shank += [(14.0, z), (12.0, z + 1.6), (12.0, z + 2.4), (14.0, z + 4.0)]
    shank += [(14.0, 34.0), (32.5, 34.0), (32.5, 42.0), (29.0, 45.0), (18.0, 50.0), (11.5, 60.0), (0.0, 60.0)]
    solid += turned(shank, 32)
    # The neck must not fill the eye.
    return solid - ring_hole()


def ring_hole() -> Manifold:
    """The free space of the eye, rounded like the ring's inner side."""
    hole = Manifold.cylinder(60, 29.5, 29.5, 48).rotate((90, 0, 0)).translate((0, 30, 100))
    return hole - ring(41.5, 12.5).translate((0, 0, 100))


def gear_shaft() -> Manifold:
    """Stepped shaft with a gear blank and a bearing collar off the middle: revolution about z, no flip."""
    profile = [
        (0.0, 0.0),
        (13.0, 0.0),
        (15.0, 2.0),
        (15.0, 62.0),
        (18.0, 62.0),
        (18.0, 150.0),
        (22.0, 154.0),
        (22.0, 214.0),
        (27.0, 214.0),
        (27.0, 232.0),
        (47.0, 232.0),
        (49.35, 235.0),
        (49.35, 272.0),
        (47.0, 275.0),
        (30.0, 275.0),
        (30.0, 296.0),
        (22.0, 296.0),
        (22.0, 352.0),
        (34.0, 352.0),
        (34.0, 366.0),
        (17.5, 366.0),
        (17.5, 433.8),
        (15.5, 435.8),
        (0.0, 435.8),
    ]
    return turned(profile, 48)


def _bulge(radius: float, peak: float, low: float, high: float, steps: int = 7) -> list[Point]:
    """Inner corners of a round swelling from ``radius`` to ``peak`` and back between two heights."""
    phase = np.linspace(0, np.pi, steps + 2)[1:-1]
    centre, half = (low + high) / 2, (high - low) / 2
    return [(float(radius + (peak - radius) * np.sin(p)), float(centre - half * np.cos(p))) for p in phase]
