"""Rotations in torch: the network's two output parametrisations and the way between them."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

_TINY = 1e-6


def matrix_from_quaternion(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions ``(w, x, y, z)`` of any length; the zero quaternion gives the identity-like
    limit of a tiny one, finite with finite gradient."""
    q = unit_quaternion(quaternion)
    w, x, y, z = q.unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    # nine of [...] -> [..., 3, 3]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def unit_quaternion(quaternion: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Quaternions scaled to length one."""
    return quaternion / (quaternion.square().sum(-1, keepdim=True) + _TINY**2).sqrt()


def matrix_from_six(six: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of two 3-vectors by Gram-Schmidt (Zhou et al. 2019): continuous, so easier to learn."""
    # [..., 6] -> two of [..., 3]
    a, b = six[..., :3], six[..., 3:]
    x = a / (a.square().sum(-1, keepdim=True) + _TINY).sqrt()
    b = b - (x * b).sum(-1, keepdim=True) * x
    y = b / (b.square().sum(-1, keepdim=True) + _TINY).sqrt()
    # three columns [..., 3] -> [..., 3, 3]
    return torch.stack([x, y, torch.linalg.cross(x, y, dim=-1)], dim=-1)


def quaternion_from_matrix(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions of rotation matrices (Shepperd: the formula with the largest divisor); w >= 0."""
    m = rotation
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    a, b, c = m[..., 2, 1], m[..., 0, 2], m[..., 1, 0]
    d, e, f = m[..., 1, 2], m[..., 2, 0], m[..., 0, 1]
    candidates = torch.stack(
        [
            torch.stack([1 + m00 + m11 + m22, a - d, b - e, c - f], dim=-1),
            torch.stack([a - d, 1 + m00 - m11 - m22, c + f, b + e], dim=-1),
            torch.stack([b - e, c + f, 1 - m00 + m11 - m22, a + d], dim=-1),
            torch.stack([c - f, b + e, a + d, 1 - m00 - m11 + m22], dim=-1),
        ],
        dim=-2,
    )
    largest = torch.diagonal(candidates, dim1=-2, dim2=-1).argmax(-1)
    # [..., 4, 4] -> [..., 4]: the row with the largest divisor
    q = torch.take_along_dim(candidates, largest[..., None, None], dim=-2)[..., 0, :]
    q = unit_quaternion(q)
    return torch.where(q[..., :1] < 0, -q, q)
