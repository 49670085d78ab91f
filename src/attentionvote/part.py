"""A part: what the network looks for. Name, surface, diameter, symmetry, and its metric. And a set of them in one bin.

The diameter is a constant of the part's configuration, because benchmarks define it differently
(largest vertex distance, centroid sphere, bounding sphere); it is derived only for new parts.

Whoever works on "what lies in the bin" takes ``Parts``: a part is a set of itself (``parts``), and answers for lengths,
name and digest as a set does.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry.symmetry import Symmetry


def surface_moments(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> tuple[float, NDArray, NDArray]:
    """Area (m^2), centroid ``(3,)`` and covariance ``(3, 3)`` of a triangle surface, exact integrals."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    total = float(area.sum())
    centroid = (area[:, None] * (a + b + c) / 3).sum(0) / total
    a, b, c = a - centroid, b - centroid, c - centroid
    s = a + b + c
    # Integral of x x^T over a triangle = area / 12 * (a a^T + b b^T + c c^T + s s^T).
    second = sum(np.einsum("f,fi,fj->ij", area / 12, p, p) for p in (a, b, c, s))
    return total, centroid, np.asarray(second) / total


def uniform_points(
    triangles: NDArray[np.float64], count: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points ``(count, 3)`` uniform on triangles ``(F, 3, 3)``, and the triangle ``(count,)`` of each."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    index = rng.choice(len(area), size=count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a[index] + u * (b[index] - a[index]) + v * (c[index] - a[index]), index


@dataclass(frozen=True, eq=False)
class Part:
    """A rigid part.

    Args:
        name: stem of its configuration file.
        vertices: ``(V, 3)`` metres, part frame.
        faces: ``(F, 3)`` vertex indices, outward orientation.
        diameter: D in metres, the unit of every threshold.
        symmetry: proper symmetry in the part frame.
        title: one line for people.

    Raises:
        ValueError: with one sentence, when the surface or the diameter is impossible.
    """

    name: str
    vertices: NDArray[np.float64] = field(repr=False)
    faces: NDArray[np.int64] = field(repr=False)
    diameter: float
    symmetry: Symmetry = field(default_factory=Symmetry)
    title: str = ""

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        faces = np.ascontiguousarray(self.faces, dtype=np.int64)
        if vertices.ndim != 2 or vertices.shape[-1] != 3 or len(vertices) < 4:
            raise ValueError(f"{self.name}: vertices must be (V, 3) with V >= 4, got shape {vertices.shape}")
        if faces.ndim != 2 or faces.shape[-1] != 3 or len(faces) < 4:
            raise ValueError(f"{self.name}: faces must be (F, 3) with F >= 4, got shape {faces.shape}")
        if not np.isfinite(vertices).all():
            bad = int((~np.isfinite(vertices)).sum())
            raise ValueError(f"{self.name}: vertices must be finite, got {bad} NaN or inf")
        low, high = faces.min(), faces.max()
        if low < 0 or high >= len(vertices):
            raise ValueError(f"{self.name}: faces must index {len(vertices)} vertices, got {low}..{high}")
        a, b, c = (vertices[faces[:, i]] for i in range(3))
        if not np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() > 0:
            raise ValueError(f"{self.name}: the surface must have an area, got only triangles of area 0")
        if not (np.isfinite(self.diameter) and self.diameter > 0):
            raise ValueError(f"{self.name}: diameter must be positive metres, got {self.diameter}")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)

    @property
    def parts(self) -> tuple[Part, ...]:
        """What may lie in the bin: this part."""
        return (self,)

    @cached_property
    def box(self) -> NDArray[np.float64]:
        """``(2, 3)`` lowest and highest corner in the part frame, metres."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @cached_property
    def covariance_root(self) -> NDArray[np.float64]:
        """Lambda ``(3, 3)`` in metres: matrix root of the surface covariance (Bregier et al. 2017)."""
        values, vectors = np.linalg.eigh(surface_moments(self.vertices, self.faces)[2])
        return (vectors * np.sqrt(np.clip(values, 0, None))) @ vectors.T

    @cached_property
    def digest(self) -> str:
        """Sha256 of what the part is: surface (to 1 nm), diameter and symmetry, not its name."""
        h = hashlib.sha256()
        h.update(np.round(self.vertices * 1e9).astype(np.int64).tobytes())
        h.update(self.faces.tobytes())
        h.update(repr((round(self.diameter * 1e9), self.symmetry)).encode())
        return h.hexdigest()

    def surface_points(self, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """``(count, 3)`` points uniform on the surface, part frame, metres."""
        return uniform_points(self.vertices[self.faces], count, rng)[0]


@dataclass(frozen=True, eq=False)
class PartSet:
    """Several parts that lie in one bin and that one network looks for (paper section 4.1, Table 6).

    The classes of the network are the parts in their order. A set of one part has that part's digest: scenes, clouds
    and models of both are the same.

    Args:
        name: stem of the set's configuration file.
        parts: the parts, in the order of the classes.
        title: one line for people.

    Raises:
        ValueError: with one sentence, without a part, or when two could not be told apart.
    """

    name: str
    parts: tuple[Part, ...]
    title: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "parts", tuple(self.parts))
        if not self.parts:
            raise ValueError(f"{self.name}: a set must have at least one part, got none")
        for i, part in enumerate(self.parts):
            for other in self.parts[:i]:
                if part.name == other.name:
                    raise ValueError(
                        f"{self.name}: the parts of a set must have names of their own, got {part.name} twice"
                    )
                if part.digest == other.digest:
                    raise ValueError(f"{self.name}: the parts of a set must differ, but {other.name} is {part.name}")

    @property
    def diameter(self) -> float:
        """D of the largest part in metres: the lengths of network and bin are shares of it."""
        return max(part.diameter for part in self.parts)

    @cached_property
    def box(self) -> NDArray[np.float64]:
        """``(2, 3)`` corners in metres of the box that holds every part in its own frame."""
        boxes = np.stack([part.box for part in self.parts])
        return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])

    @cached_property
    def digest(self) -> str:
        """Sha256 of what the parts are, in their order; neither the set's name nor theirs."""
        if len(self.parts) == 1:
            return self.parts[0].digest
        return hashlib.sha256("".join(part.digest for part in self.parts).encode()).hexdigest()


Parts = Part | PartSet  # what lies in a bin


def only_part(parts: Parts, verb: str) -> Part:
    """The part of an object that describes one.

    Raises:
        ValueError: when it describes several.
    """
    if len(parts.parts) > 1:
        names = ", ".join(part.name for part in parts.parts)
        raise ValueError(
            f"object must be one part for {verb}, got {parts.name} with the parts {names}: choose one of them "
            "(docs/several-parts.md says what works for several)"
        )
    return parts.parts[0]
