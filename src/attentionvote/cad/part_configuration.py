"""The configuration file of a new part, every figure with its meaning."""

from __future__ import annotations

import json
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from attentionvote.cad.part_report import PartReport
    from attentionvote.part import Part

# What a symmetry of each kind needs to be said.
_KEYS: dict[str, tuple[str, ...]] = {
    "none": (),
    "cyclic": ("axis", "order"),
    "dihedral": ("axis", "order", "flip_axis"),
    "revolution": ("axis", "flip"),
    "group": ("quaternions",),
}


def configuration_text(part: Part, report: PartReport, mesh: Path, source: str) -> str:
    """The object's configuration file, every figure with what it is and how it was found."""
    from attentionvote.cad.symmetry_groups import describe

    d, finding = part.diameter, report.finding
    root = "; ".join(" ".join(f"{v + 0.0:.7f}" for v in row) for row in part.covariance_root.round(7))
    if finding.moved:
        rows = "\n".join("#   " + " ".join(f"{v:12.9f}" for v in row) for row in finding.part_from_file + 0.0)
        frame = (
            "# Part frame: NOT the file's. Origin at the surface centroid, z along the symmetry axis, or the long\n"
            f"# axis where there is none. part_from_file (metres) =\n{rows}\n"
        )
    else:
        frame = "# Part frame: the file's own.\n"
    if part.symmetry.kind == "none":
        verified = "no rotation leaves the surface in place"
    else:
        verified = (
            f"{describe(part.symmetry)}; every rotation checked leaves\n# the surface within "
            f"{finding.residual * 1e3:.4f} mm ({finding.residual / d:.4%} of D) of itself, beyond the height of\n"
            f"# its facets where it is curved (at most {finding.facet_height * 1e3:.3f} mm)"
        )
    rejected = "nothing else was near"
    if (away := finding.runner_up_residual) < 1e9:
        rejected = (
            f"the best hypothesis rejected is\n# {finding.runner_up} (axis in the file's frame), "
            f"which leaves it {away * 1e3:.3f} mm ({away / d:.2%} of D) away or more"
        )
    hidden = "".join(f"# {line}\n" for line in report.hidden_lines)
    symmetry = "\n".join(f"  {key}: {json.dumps(value)}" for key, value in symmetry_settings(part).items())
    made = "\n# ".join(wrap(f"{part.name}: made by `make part` from {source}.", 118))
    return f"""# {made}
{frame}# Surface: {len(part.faces)} triangles, watertight. Lambda, the root of the surface covariance, metres, its rows:
#   {root}
_target_: attentionvote.simulation.load_part
name: {part.name}
title: {json.dumps(part.title, ensure_ascii=False)}
mesh: {json.dumps(mesh.as_posix(), ensure_ascii=False)}
units: m
# Largest distance between two vertices, metres: the D of every threshold. Benchmarks may define it differently.
diameter: {d!r}
# Proper symmetry: {verified}
# (tolerance {finding.tolerance * 1e3:.3f} mm, both ways); {rejected}.
{hidden}symmetry:
{symmetry}
# Turns after which the part nearly looks like itself, the likeliest errors of a network: quaternion (w x y z) and
# translation in metres, share of the surface within 1 % of D of itself, largest distance in metres.
near_symmetric:{_listed(report)}
# The part's mirror image: {report.mirror_line}.
mirror_image: {json.dumps(report.mirror)}
# Scale settings in metres; null = derived from D by the documented rule.
base_radius: null
voxel_size: null
"""


def _listed(report: PartReport) -> str:
    if not report.near_symmetric:
        return " []"
    return "".join(f"\n  - {json.dumps(twin)}" for twin in report.near_symmetric)


def symmetry_settings(part: Part) -> dict[str, Any]:
    """The keys of ``symmetry:`` that a part's group needs."""
    symmetry = part.symmetry
    return {"kind": symmetry.kind} | {key: getattr(symmetry, key) for key in _KEYS[symmetry.kind]}
