"""What to do with the bodies of a file: unite those that touch, ask about those that stand apart."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from attentionvote.cad.bodies import body_of, gap, solids_of, united
from attentionvote.cad.healing import Changes, Whole, counted, settled

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

MOST_NAMED = 6


class Bodies(NamedTuple):
    """The bodies of a surface.

    Args:
        vertices: ``(V, 3)`` shares of D.
        faces: ``(F, 3)`` turned outward, in cavities inward.
        shell, solid, body: ``(F,)`` of each face.
        touching: ``(P, 2)`` pairs of solids that touch or overlap.
        sizes: of each body, in words.
    """

    vertices: Array
    faces: Ints
    shell: Ints
    solid: Ints
    body: Ints
    touching: Ints
    sizes: list[str]


def told_apart(whole: Whole, changes: Changes, diameter: float) -> Bodies:
    """The bodies of a closed surface in shares of D, ``diameter`` in metres; what is turned or left out is noted."""
    solids = solids_of(whole.vertices, whole.faces, whole.shell)
    is_kept = solids.solid >= 0
    if solids.empty:
        changes.note(f"left out {counted(solids.empty, 'surface that encloses', 'surfaces that enclose')} nothing")
        changes.removed.append(whole.vertices[whole.faces[~is_kept]])
    if solids.turned:
        changes.note(f"turned {counted(solids.turned, 'surface', 'surfaces')} outward")
    if solids.cavities:
        changes.note(f"kept {counted(solids.cavities, 'cavity', 'cavities')}")
    faces, solid = solids.faces[is_kept], solids.solid[is_kept]
    of_solid, touching = body_of(whole.vertices, faces, solid)
    body = of_solid[solid]
    sizes = [_size(whole.vertices, faces[body == k], diameter) for k in range(of_solid.max() + 1)]
    return Bodies(whole.vertices, faces, whole.shell[is_kept], solid, body, touching, sizes)


def as_one(whole: Whole, split: Bodies, changes: Changes) -> Whole:
    """All bodies as one surface, solids that touch or overlap united, so that no volume counts twice."""
    if not len(split.touching):
        return Whole(whole.vertices, split.faces, whole.source, split.shell)
    points, faces, twice = united(split.vertices, split.faces, split.solid)
    share = twice / max(_volume(points, faces), 1e-300)
    count = len(np.unique(split.touching))
    # Of solids that only touch the sum of volumes is the union's to the last digits.
    if share > 1e-6:
        changes.note(f"united {count} overlapping solids ({share:.1%} of the volume was there twice)")
    else:
        changes.note(f"united {count} touching solids")
    return settled(points, faces)


def _volume(vertices: Array, faces: Ints) -> float:
    return float(np.linalg.det(vertices[faces]).sum()) / 6


def _size(vertices: Array, faces: Ints, diameter: float) -> str:
    extent = np.ptp(vertices[np.unique(faces)], axis=0) * diameter * 1000
    return " x ".join(f"{e:.1f}" for e in extent) + " mm"


def listed(bodies: list[str]) -> str:
    """The bodies to choose from."""
    more = f" and {len(bodies) - MOST_NAMED} more" if len(bodies) > MOST_NAMED else ""
    what = "1 body" if len(bodies) == 1 else f"{len(bodies)} bodies"
    return f"{what}: " + ", ".join(f"BODY={i} ({b})" for i, b in enumerate(bodies[:MOST_NAMED], 1)) + more


def assembly_question(split: Bodies, diameter: float) -> str:
    """What to say of bodies that stand apart, to be put behind the file's name."""
    sizes, each = split.sizes, [split.faces[split.body == k] for k in range(min(len(split.sizes), MOST_NAMED))]
    away = min(gap(split.vertices, each[0], other) for other in each[1:]) * diameter * 1000
    names = [f"BODY={i} ({size})" for i, size in enumerate(sizes[:MOST_NAMED], 1)]
    if len(sizes) > MOST_NAMED:
        names.append(f"another up to BODY={len(sizes)}")
    alike = ""
    if len(sizes) == 2 and _are_alike(split.vertices, *each):
        alike = " of one size (copies, or mirror images)"
    return (
        f"holds {len(sizes)} bodies{alike} {away:.3g} mm apart: an assembly? {', '.join(names[:-1])} or {names[-1]} "
        "picks one, BODY=0 takes all as one part"
    )


def _are_alike(vertices: Array, one: Ints, other: Ints) -> bool:
    """Whether two bodies have the same volume and area."""
    measures = []
    for faces in (one, other):
        corners = vertices[faces] - vertices[faces].mean(axis=(0, 1))
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
        measures.append((float(np.linalg.det(corners).sum()) / 6, float(area)))
    return bool(np.allclose(measures[0], measures[1], rtol=1e-3))
