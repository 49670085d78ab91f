"""Mass and inertia of parts: those of the solid, and for a part of revolution the same on every processor."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from attentionvote.geometry.pose import rotation_about
from attentionvote.geometry.symmetry import Symmetry
from attentionvote.part import Part
from attentionvote.simulation.mass import inertia_of, mass_properties

RADIUS, HEIGHT = 0.02, 0.1


def cylinder(symmetry: Symmetry) -> Part:
    """A cylinder about z."""
    mesh = trimesh.creation.cylinder(RADIUS, HEIGHT, sections=256)
    return Part("cylinder", mesh.vertices, mesh.faces, 0.108, symmetry)


@pytest.mark.parametrize("symmetry", [Symmetry(), Symmetry("revolution", flip=True)])
def test_a_cylinder_has_the_mass_and_the_moments_of_the_textbook(symmetry: Symmetry) -> None:
    mass, centre, inertia = mass_properties(cylinder(symmetry))
    assert mass == pytest.approx(2700 * np.pi * RADIUS**2 * HEIGHT, rel=1e-3)
    np.testing.assert_allclose(centre, 0, atol=1e-12)
    across = mass * (3 * RADIUS**2 + HEIGHT**2) / 12
    np.testing.assert_allclose(inertia, np.diag([across, across, mass * RADIUS**2 / 2]), rtol=1e-3, atol=1e-12)


def test_an_open_surface_has_those_of_its_hull() -> None:
    mesh = trimesh.creation.box((0.1, 0.05, 0.02))
    part = Part("tray", mesh.vertices, mesh.faces[:-2], 0.12)
    assert mass_properties(part).mass == pytest.approx(2700 * 0.1 * 0.05 * 0.02)


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.6, 0.0, 0.8)])
def test_the_last_bits_of_sums_do_not_reach_the_physics_of_a_part_of_revolution(axis: tuple[float, ...]) -> None:
    """The two moments of a candlestick, as two processors sum them up, and noise off the diagonal."""
    symmetry = Symmetry("revolution", axis=axis)
    turn = np.eye(3)
    if axis != (0.0, 0.0, 1.0):
        normal = np.cross([0, 0, 1], axis)
        turn = rotation_about(normal, np.arccos(axis[2]))
    found = []
    for across, noise in ((1.9353692963313173e-03, 3e-21), (1.9353692963313177e-03, -7e-20)):
        inertia = np.diag([across, 1.9353692963313173e-03, 2.4359882399723233e-04])
        inertia[0, 1] = inertia[1, 0] = noise
        found.append(inertia_of(symmetry, turn @ inertia @ turn.T))
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_allclose(found[0], turn @ np.diag([1.93536930e-03, 1.93536930e-03, 2.43598824e-04]) @ turn.T,
                               rtol=1e-8, atol=1e-18)  # fmt: skip


def test_other_parts_keep_the_inertia_of_their_mesh() -> None:
    inertia = np.array([[3.0, 1e-17, 0], [1e-17, 2.0, 0], [0, 0, 1.0]])
    assert inertia_of(Symmetry("cyclic", order=2), inertia) is inertia
