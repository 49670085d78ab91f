"""Built-in CAD of the paper's three industrial parts (its Table 6), designed for this project.

The paper publishes diameter and symmetry class of its parts, not their drawings; these are plausible
parts of the same size and the same class. Millimetres; the catalogue (``cad.py``) centres and scales.
"""

from __future__ import annotations

from manifold3d import CrossSection, Manifold

from attentionvote.cad.builtin_shapes import (
    box,
    cylinder,
    disc,
    filleted,
    lying_cylinder,
    plate,
    rectangle,
    turned,
    upright_plate,
)


def connecting_rod() -> Manifold:
    """Two equal eyes joined by a recessed web; C2 about z (the bores' direction), and nothing else.

    The eyes rise 9 mm above the web on the upper side only and the lower side is nearly flat, so that
    turning the rod over is no symmetry and can be told from the surface.
    """
    half = 50.0
    solid = Manifold()
    outline = CrossSection()
    for x in (-half, half):
        solid += cylinder(21, -9, 11, x) + cylinder(21, 11, 14, x, top=18)
        outline += disc(18.5, x)
        outline += CrossSection.batch_hull([disc(15, 0.9 * x), disc(10.5)])
    solid += plate(filleted(outline, 12), -9, 5)
    pocket = CrossSection.batch_hull([disc(5.5, -20), disc(5.5, 20)])
    groove = CrossSection.batch_hull([disc(3.5, -22), disc(3.5, 22)])
    solid -= plate(pocket, -1, 6)
    solid -= plate(groove, -10, -6.5)
    for x in (-half, half):
        bore = turned([(0, -10), (13.2, -10), (12, -8), (12, 11), (15, 14), (15, 15), (0, 15)], 48)
        solid -= bore.translate((x, 0, 0))
    return solid


def vertical_bearing_pedestal() -> Manifold:
    """Foot with four counterbored holes, tall bearing housing, gusset behind: no proper symmetry.

    The mirror plane x = 0 remains; a mirror image is no rigid pose.
    """
    height, radius = 112.0, 39.0
    foot = plate(rectangle(128, 88, 10), 0, 15)
    wall = CrossSection.batch_hull([disc(radius, 0, height), rectangle(92, 2).translate((0, 14))])
    solid = foot + upright_plate(wall, -15, 9)
    solid += lying_cylinder(radius, -27, 12, height) + lying_cylinder(radius - 3, -30, -27, height, top=radius)
    gusset = CrossSection([[(9, 12), (40, 12), (40, 20), (9, 84)]])
    # Drawn in (y, z), 14 mm wide along x.
    solid += Manifold.extrude(gusset, 14).rotate((90, 0, 0)).rotate((0, 0, 90)).translate((-7, 0, 0))
    solid -= lying_cylinder(22, -40, 40, height)
    solid -= lying_cylinder(29, -40, -18, height)
    solid -= upright_plate(CrossSection.batch_hull([disc(9, -17, 34), disc(9, 17, 34), disc(6, 0, 52)]), -20, -9)
    for x in (-50.0, 50.0):
        for y in (-30.0, 30.0):
            solid -= cylinder(5.5, -1, 20, x, y) + cylinder(9, 10, 20, x, y)
    # Grease hole in the crown, off the middle plane of the housing.
    return solid - cylinder(4, height, height + radius + 5, 0, -6)


def slider_bearing_pedestal() -> Manifold:
    """Split plain-bearing block: slotted foot, low housing with a bolted cap; C2 about z (vertical)."""
    height = 35.0
    foot = plate(rectangle(114, 44, 6), 0, 12)
    wall = CrossSection.batch_hull([disc(24, 0, height), rectangle(66, 2).translate((0, 11))])
    solid = foot + upright_plate(wall, -16, 16)
    solid += box((-34, 34), (-13, 13), (10, height + 6))
    solid += lying_cylinder(20, -20, 20, height)
    for x in (-28.0, 28.0):
        solid += Manifold.cylinder(6, 5.5, 5.5, 6).translate((x, 0, height + 6))
    # The joint between block and cap, as a shallow groove all around.
    joint = box((-60, 60), (-60, 60), (height - 0.75, height + 0.75))
    solid -= joint - box((-32.5, 32.5), (-11.5, 11.5), (0, 60)) - lying_cylinder(18.5, -60, 60, height)
    solid -= lying_cylinder(13, -40, 40, height)
    solid -= lying_cylinder(15, -21, -17, height, top=13) + lying_cylinder(13, 17, 21, height, top=15)
    for x in (-46.0, 46.0):
        slot = CrossSection.batch_hull([disc(4.5, x - 3), disc(4.5, x + 3)])
        solid -= plate(slot, -1, 13)
    return solid - cylinder(3, height, height + 30)
