"""Rows of ``make bench`` about points: farthest-point order, ball queries, normals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry import sampling, sampling_reference
from attentionvote.geometry.pointcloud import estimate_normals, estimate_normals_reference
from attentionvote.workflows.speed.contest import Contest, Unequal
from attentionvote.workflows.speed.material import Material
from attentionvote.workflows.speed.rows import CDIST, OPEN3D, QUICKFPS

if TYPE_CHECKING:
    from torch import Tensor

MOST_DEGREES = 0.01  # between normals of two estimators


def identical(fast: Any, others: Mapping[str, Any]) -> str:
    """Results are nested lists or tuples of arrays, all equal to the last bit.

    Raises:
        Unequal: when one is not.
    """
    for name, other in others.items():
        for a, b in zip(_arrays(fast), _arrays(other), strict=True):
            if not np.array_equal(a, b):
                share = float(np.mean(np.asarray(a) != np.asarray(b))) if np.shape(a) == np.shape(b) else 1.0
                raise Unequal(f"results must be identical to those of {name}, but {share:.2%} of the numbers differ")
    return "identical"


def _arrays(result: Any) -> list[Any]:
    if isinstance(result, (list, tuple)):
        return [array for item in result for array in _arrays(item)]
    return [result]


def farthest_points(material: Material) -> Contest:
    """The C operator beside numpy and, where it is installed, torch-quickfps."""
    model = material.trainings["full"]
    count = model.model.centers[0]
    cloud = material.sensed(model.data.points)
    references: dict[str, Callable[[], Any]] = {"numpy": lambda: sampling_reference.farthest_point_order(cloud, count)}
    absent: tuple[str, ...] = ()
    try:
        import torch
        import torch_quickfps  # type: ignore[import-not-found]
    except ImportError:
        absent = (QUICKFPS,)
    else:
        tensor = torch.from_numpy(cloud)
        references[QUICKFPS] = lambda: torch_quickfps.sample_idx(tensor, count, h=5, start_idx=0).numpy()

    def compare(fast: NDArray, others: Mapping[str, NDArray]) -> str:
        if not np.array_equal(sampling.farthest_point_order(cloud, count // 2), fast[: count // 2]):
            raise Unequal("half as many farthest points must be the first half of all, but they are others")
        return f"{identical(fast, others)}, prefixes too"

    size = f"{len(cloud):,} to {count:,} points"
    return Contest(lambda: sampling.farthest_point_order(cloud, count), references, compare, size, absent=absent)


def ball_queries(material: Material) -> Contest:
    """The C operator beside distances of all pairs in torch, of which the first k inside are kept."""
    import torch

    layout = material.network("full").layout
    cloud = material.sensed(material.trainings["full"].data.points)
    ordered = cloud[sampling.farthest_point_order(cloud, layout.centers[0])]
    below = [cloud, *(ordered[:size] for size in layout.centers)]
    levels = list(zip(below, layout.centers, layout.radii, layout.neighbors, strict=False))

    def fast() -> list[NDArray]:
        return [sampling.ball_query(p, ordered[:size], r, k)[0] for p, size, r, k in levels]

    def numpy() -> list[NDArray]:
        return [sampling_reference.ball_query(p, ordered[:size], r, k)[0] for p, size, r, k in levels]

    def cdist() -> list[NDArray]:
        tensors = [(torch.from_numpy(p), torch.from_numpy(ordered[:size]), r, k) for p, size, r, k in levels]
        return [cdist_query(*level).numpy() for level in tensors]

    size = f"{len(cloud):,} points, {' / '.join(f'{c:,} x {k}' for _, c, _, k in levels)}"
    return Contest(fast, {CDIST: cdist, "numpy": numpy}, identical, size)


def cdist_query(points: Tensor, centers: Tensor, radius: float, count: int) -> Tensor:
    """The first ``count`` points ``(P, 3)`` in each ball, ``(C, count)``, from distances of all pairs in torch."""
    import torch

    # By differences: the matrix product's rounding would move points across the edge.
    inside = torch.cdist(centers, points, compute_mode="donot_use_mm_for_euclid_dist") <= radius
    index = torch.arange(len(points), dtype=torch.int32).expand(len(centers), -1).masked_fill(~inside, len(points))
    index = torch.topk(index, count, largest=False, sorted=True)[0]
    return torch.where(index == len(points), index[:, :1], index).long()


def normals(material: Material) -> Contest:
    """The C code beside scipy's tree and LAPACK and, where it is installed, Open3D."""
    data = material.trainings["full"].data
    cloud, neighbors = material.sensed(data.points), data.normal_neighbors
    references: dict[str, Callable[[], Any]] = {"scipy": lambda: estimate_normals_reference(cloud, cloud, neighbors)}
    absent: tuple[str, ...] = ()
    try:
        import open3d
    except (ImportError, OSError):
        absent = (OPEN3D,)
    else:

        def with_open3d() -> NDArray:
            made = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(cloud))
            made.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(neighbors))
            made.orient_normals_towards_camera_location()
            return np.asarray(made.normals)

        references[OPEN3D] = with_open3d

    def compare(fast: NDArray, others: Mapping[str, NDArray]) -> str:
        return f"within {max(degrees_apart(fast, other, name) for name, other in others.items()):.4f} degrees"

    return Contest(
        lambda: estimate_normals(cloud, None, neighbors), references, compare, f"{len(cloud):,} points", absent=absent
    )


def degrees_apart(fast: NDArray, other: NDArray, name: str) -> float:
    """The largest angle between normals ``(P, 3)``.

    Raises:
        Unequal: when it is greater than ``MOST_DEGREES``, or one looks the other way.
    """
    a, b = fast.astype(np.float64), np.asarray(other, dtype=np.float64)
    angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1)))
    worst = float(angle.max(initial=0.0))
    if not worst <= MOST_DEGREES:
        raise Unequal(f"normals must lie within {MOST_DEGREES} degrees of those of {name}, got {worst:.3f}")
    return worst
