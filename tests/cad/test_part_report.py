"""What `make part` tells of a shape."""

from __future__ import annotations

import json

import numpy as np
import trimesh

from attentionvote.cad.builtin import builtin_surface
from attentionvote.cad.part_report import examine


def test_a_bolt_is_told_with_its_hidden_symmetry_and_its_twins() -> None:
    shaft = trimesh.creation.cylinder(0.004, 0.03, sections=64)
    head = trimesh.creation.cylinder(0.0065, 0.005, sections=6)
    head.apply_translation([0, 0, 0.0175])
    bolt = trimesh.boolean.union([shaft, head])
    report = examine(np.array(bolt.vertices), bolt.faces, 0.0003)
    assert (report.finding.symmetry.kind, report.finding.symmetry.order) == ("cyclic", 6)
    assert report.hidden is None
    assert report.near_symmetric[0]["overlap"] > 0.6  # the shaft, wherever the head's corners are
    assert report.is_mirror_symmetric
    assert report.lines[0].startswith("symmetry cyclic of order 6 about (0 0 1), residual 0.0")
    assert any(line.startswith("nearly symmetric: turned by [") for line in report.lines)
    json.dumps(report.facts, default=lambda value: value.tolist())


def test_a_groove_is_offered_in_words() -> None:
    bar = trimesh.creation.cylinder(0.01, 0.1, sections=64)
    groove = trimesh.creation.box(bounds=[[0.0098, -0.002, -0.03], [0.02, 0.002, 0.03]])
    part = trimesh.boolean.difference([bar, groove])
    report = examine(np.array(part.vertices), part.faces, 0.0003)
    told = " ".join(report.hidden_lines)
    assert told.startswith("A sensor that cannot see 0.199 mm")
    assert told.endswith('if yours cannot, make the part again with ARGS="tolerance=0.003 force=true".')
    assert report.facts["hidden_symmetry"] == "revolution about (0 0 1) with flip"


def test_left_and_right_parts_are_told() -> None:
    boxes = [[[0, 0, 0], [0.10, 0.02, 0.02]], [[0, 0, 0], [0.02, 0.07, 0.02]], [[0, 0, 0], [0.02, 0.02, 0.045]]]
    part = trimesh.boolean.union([trimesh.creation.box(bounds=b) for b in boxes])
    report = examine(np.array(part.vertices), part.faces, 0.0003)
    assert not report.is_mirror_symmetric
    assert "left ones and right ones in one bin are two parts" in report.lines[-1]


def test_a_rod_lists_the_half_turn_that_it_nearly_has() -> None:
    vertices, faces = builtin_surface("connecting_rod")
    report = examine(vertices, faces, 0.0003)
    assert [round(twin["overlap"], 1) for twin in report.near_symmetric] == [0.7]
