"""What `make part` finds out about the shape of a part beyond its surface: symmetry, near symmetries, mirror image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attentionvote.cad.mesh_file import largest_vertex_distance
from attentionvote.cad.near_symmetry import Twin, mirror_image, near_symmetries
from attentionvote.cad.symmetry_detection import UNSEEN, SymmetryFinding, detect_symmetry, hidden_symmetry
from attentionvote.cad.symmetry_groups import describe
from attentionvote.geometry import pose

Array = NDArray[np.float64]

SAME_HAND = 0.001  # of the diameter: a mirror image this near is the part itself


@dataclass(frozen=True)
class PartReport:
    """The symmetry found, and what is near it.

    Attributes:
        finding: the proper symmetry and the part frame.
        hidden: the larger group whose differences a sensor could overlook, None without one.
        near_symmetric: plain values of the turns that nearly leave the surface in place, part frame, metres.
        mirror: the same of the mirror image: overlap and largest distance.
    """

    finding: SymmetryFinding
    hidden: SymmetryFinding | None
    near_symmetric: list[dict[str, Any]]
    mirror: dict[str, float]

    @property
    def hidden_lines(self) -> list[str]:
        """Lines for people about the larger group, and how to choose it; none without one."""
        if self.hidden is None:
            return []
        return [
            f"A sensor that cannot see {self.hidden.residual * 1e3:.3f} mm (a thread, an engraved mark) sees",
            f"{describe(self.hidden.symmetry)}: if yours cannot, make the part again with "
            f'ARGS="tolerance={UNSEEN} force=true".',
        ]

    @property
    def lines(self) -> list[str]:
        """What is worth telling the part's owner, a line each."""
        finding = self.finding
        lines = [f"symmetry {describe(finding.symmetry)}, residual {finding.residual * 1e3:.3f} mm"]
        if self.hidden:
            lines.append(" ".join(self.hidden_lines))
        lines += [
            f"nearly symmetric: turned by {twin['quaternion']} the part is {twin['overlap']:.0%} alike"
            for twin in self.near_symmetric
        ]
        if not self.is_mirror_symmetric:
            lines.append(f"the part's mirror image is {self.mirror_line}")
        return lines

    @property
    def facts(self) -> dict[str, Any]:
        """The same as plain values, metres."""
        finding, hidden = self.finding, self.hidden
        return {
            "symmetry_residual": finding.residual,
            "symmetry_tolerance": finding.tolerance,
            "runner_up": finding.runner_up,
            "runner_up_residual": finding.runner_up_residual if finding.runner_up_residual < 1e9 else None,
            "hidden_symmetry": describe(hidden.symmetry) if hidden else None,
            "hidden_symmetry_residual": hidden.residual if hidden else None,
            "near_symmetric": self.near_symmetric,
            "mirror_image": self.mirror,
            "moved": finding.moved,
            "part_from_file": finding.part_from_file.round(9),
        }

    @property
    def mirror_line(self) -> str:
        """One phrase for people: whether a left part and a right part are one."""
        if self.is_mirror_symmetric:
            return "the part itself, left and right ones are one"
        return f"another part, {self.mirror['overlap']:.0%} alike; left ones and right ones in one bin are two parts"

    @property
    def is_mirror_symmetric(self) -> bool:
        """Whether the mirror image is the part itself."""
        return self.mirror["largest"] <= SAME_HAND * self.finding.diameter


def examine(vertices: Array, faces: NDArray[np.int64], tolerance: float) -> PartReport:
    """The report on a surface.

    Args:
        vertices: ``(V, 3)`` metres, the file's frame.
        faces: ``(F, 3)`` closed surface.
        tolerance: of the symmetry, a share of the diameter.

    Raises:
        ValueError: as ``detect_symmetry``.
    """
    finding = detect_symmetry(vertices, faces, tolerance)
    hidden = hidden_symmetry(vertices, faces, finding)
    in_part_frame = pose.apply(finding.part_from_file, vertices)
    diameter = largest_vertex_distance(vertices)
    twins = near_symmetries(in_part_frame, faces, finding.symmetry, diameter)
    mirror = mirror_image(in_part_frame, faces, diameter)
    return PartReport(
        finding, hidden, [_plain(twin) for twin in twins],
        {"overlap": round(mirror.overlap, 3), "largest": round(mirror.largest, 6)},
    )  # fmt: skip


def _plain(twin: Twin) -> dict[str, Any]:
    quaternion = pose.canonical_quaternion(pose.quaternion_from_matrix(twin.rotation))
    return {
        "quaternion": [round(float(v), 6) + 0.0 for v in quaternion],
        "translation": [round(float(v), 7) + 0.0 for v in twin.translation],
        "overlap": round(twin.overlap, 3),
        "largest": round(twin.largest, 6),
    }
