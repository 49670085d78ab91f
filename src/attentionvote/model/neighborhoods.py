"""Neighbourhoods of every level of the backbone, searched once a sample and outside the network's gradient.

One exact farthest-point pass orders the sample; every level's centres are a prefix of it. Loader workers call
``find_neighborhoods`` with the C operators; the network calls it itself only when it is given none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from attentionvote.geometry.sampling import level_neighbors, three_nearest


@dataclass(frozen=True)
class Layout:
    """Sizes of the four set-abstraction and two feature-propagation levels (paper section 3.5).

    Args:
        centers: number of centres of each set-abstraction level.
        neighbors: neighbours of a centre at each level.
        radii: ball radius of each level in metres; the paper's are r, 2r, 3r and 6r.
    """

    centers: tuple[int, ...]
    neighbors: tuple[int, ...]
    radii: tuple[float, ...]

    def __post_init__(self) -> None:
        if not len(self.centers) == len(self.neighbors) == len(self.radii) == 4:
            raise ValueError(
                "a layout must have four levels of centers, neighbors and radii, "
                f"got {len(self.centers)}, {len(self.neighbors)} and {len(self.radii)}"
            )
        if any(a <= b for a, b in zip(self.centers, self.centers[1:], strict=False)) or self.centers[-1] < 1:
            raise ValueError(f"centers must fall from level to level and stay positive, got {self.centers}")

    @property
    def seeds(self) -> int:
        """M, the number of seeds and votes: the centres of the second level."""
        return self.centers[1]


class Neighborhoods(NamedTuple):
    """Indices of one batch; ``batch`` is missing before collation.

    Attributes:
        order: ``(batch, S1)`` farthest-point order of the sample's points; level l's centres are its first S_l.
        neighbors: four tensors ``(batch, S_l, k_l)`` of indices into the points of the level below.
        nearest: two tensors ``(batch, T, 3)``: the three nearest of the coarser level, for levels 3 and 2.
        weights: two tensors ``(batch, T, 3)``: inverse-distance weights that sum to one.
    """

    order: Tensor
    neighbors: tuple[Tensor, ...]
    nearest: tuple[Tensor, ...]
    weights: tuple[Tensor, ...]

    @classmethod
    def stack(cls, samples: Sequence[Neighborhoods]) -> Neighborhoods:
        """One batch of the neighbourhoods of single samples."""
        return cls(
            torch.stack([s.order for s in samples]),
            *(
                tuple(torch.stack(level) for level in zip(*(getattr(s, name) for s in samples), strict=True))
                for name in ("neighbors", "nearest", "weights")
            ),
        )

    def to(self, device: torch.device | str, dtype: torch.dtype | None = None) -> Neighborhoods:
        """The same on another device; the weights in the precision of ``dtype`` where that is given."""
        at_once = waits_for_nothing(device)

        def index(values: Tensor) -> Tensor:
            return values.to(device, non_blocking=at_once).long()  # widened there, see ``narrow``

        return Neighborhoods(
            index(self.order),
            tuple(index(t) for t in self.neighbors),
            tuple(index(t) for t in self.nearest),
            tuple(t.to(device, dtype, non_blocking=at_once) for t in self.weights),
        )

    def narrow(self) -> Neighborhoods:
        """The same with indices of 32 bits, for the way to another device: what uses them wants 64."""
        return Neighborhoods(
            self.order.int(), tuple(t.int() for t in self.neighbors), tuple(t.int() for t in self.nearest), self.weights
        )


def waits_for_nothing(device: torch.device | str) -> bool:
    """Whether a copy to a device may go on while the program does: to a GPU, whose own order keeps it right."""
    return torch.device(device).type == "cuda"


def find_neighborhoods(points: NDArray[np.float32], layout: Layout) -> Neighborhoods:
    """Neighbourhoods of one sample.

    Args:
        points: ``(N, 3)`` metres in random order, N at least the first level's number of centres.
        layout: the levels.

    Raises:
        ValueError: when there are fewer points than centres, or any is not finite.
    """
    if len(points) < layout.centers[0]:
        raise ValueError(f"a sample must have at least {layout.centers[0]} points (first level), got {len(points)}")
    order, neighbors = level_neighbors(points, layout.centers, layout.neighbors, layout.radii)
    ordered, nearest, weights = points[order], [], []
    for coarse, fine in ((layout.centers[3], layout.centers[2]), (layout.centers[2], layout.centers[1])):
        index, distance = three_nearest(ordered[:coarse], ordered[:fine])
        weight = 1.0 / (distance.astype(np.float64) ** 2 + 1e-10)  # PointNet++; metres
        nearest.append(index)
        weights.append((weight / weight.sum(1, keepdims=True)).astype(np.float32))
    return Neighborhoods(
        torch.from_numpy(order),
        tuple(map(torch.from_numpy, neighbors)),
        tuple(map(torch.from_numpy, nearest)),
        tuple(map(torch.from_numpy, weights)),
    )


def find_batch(points: Tensor, layout: Layout) -> Neighborhoods:
    """Neighbourhoods of a batch of points ``(batch, N, 3)``, on the device and in the precision of the points."""
    samples = [find_neighborhoods(p, layout) for p in points.detach().float().cpu().numpy()]
    return Neighborhoods.stack(samples).to(points.device, points.dtype)
