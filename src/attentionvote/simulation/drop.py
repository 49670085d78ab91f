"""Parts dropped one after another into a bin, by rigid-body physics (MuJoCo).

Bin frame: origin in the middle of the floor, z up. Every settled pile of a drop cycle is a scene; the
piles of one cycle resemble each other, so data is split by cycle. Settings and guards are measured choices:
with them parts rest 0.2-0.3 % of D inside each other, other solvers and 10 line-search steps make piles explode.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from attentionvote.geometry.pose import apply, matrix_from_quaternion, random_quaternion, transform
from attentionvote.part import Part
from attentionvote.simulation.bin_walls import Walls, wall_pieces
from attentionvote.simulation.decomposition import Hulls
from attentionvote.simulation.drop_settings import DropSettings
from attentionvote.simulation.mass import Mass, mass_properties

_SMALL_DIAMETER = 0.040  # below it, time step and contact time constant are halved


class Solid(NamedTuple):
    """A part as the physics sees it: ``hulls`` are its convex pieces (``decomposition.convex_hulls``)."""

    part: Part
    hulls: Hulls


def drop_parts(
    solids: Sequence[Solid],
    part_ids: NDArray[np.int32],
    bin_size: NDArray[np.float64],
    friction: float,
    settings: DropSettings,
    rng: np.random.Generator,
    drops: int | None = None,
    walls: Walls | None = None,
) -> Iterator[NDArray[np.float64]]:
    """Drop parts in sequence and yield every pile that came to rest.

    The bin's walls go on invisibly above the rim, as infinite planes: nothing falls out or tunnels through. Walls with
    a shape end at the rim, on which parts can lie; the planes stand where the rim ends outside.
    A pile that still moves (> 5 cm/s) after the timeout is left out. The cycle ends early when a part rests above the
    rim (the bin is full), left the bin, or any value is not finite.

    Args:
        solids: the parts; their true surfaces give mass and inertia.
        part_ids: ``(count,)`` which of them each drop is.
        bin_size: ``(3,)`` inner length, width, height in metres.
        friction: sliding friction coefficient of every surface.
        settings: physics settings.
        rng: decides places and orientations.
        drops: end after so many; None drops all. The piles are the same.
        walls: shape of the bin's walls; None are upright and meet squarely.

    Yields:
        ``bin_from_part`` ``(k, 4, 4)`` of the first k parts, once per accepted drop.
    """
    count = len(part_ids)
    masses = [mass_properties(solid.part) for solid in solids]
    model = _build_model(solids, masses, part_ids, bin_size, friction, settings, walls)
    data = mujoco.MjData(model)
    vertices = [np.concatenate(solid.hulls) for solid in solids]
    half = np.asarray(bin_size[:2]) / 2
    middle, reach = _drop_area(half, settings, rng)
    opening = half if walls is None else half + walls.lean(float(bin_size[2]))
    pile_top = 0.0
    for k, kind in enumerate(part_ids[:drops]):
        height = pile_top + 0.3 * solids[kind].part.diameter
        _release(model, data, k, vertices[kind], middle, reach, height, settings.speed, rng)
        speed = _settle(model, data, k + 1, settings)
        pose = data.qpos.reshape(count, 7)[: k + 1]
        if (
            not np.isfinite(speed)
            or not np.isfinite(pose).all()
            or data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number
        ):
            return
        bin_from_part = transform(matrix_from_quaternion(pose[:, 3:]), pose[:, :3])
        pile_top = 0.0
        for i, (_, centre, _) in enumerate(masses):
            poses_of_part = bin_from_part[part_ids[: k + 1] == i]
            if not len(poses_of_part):
                continue
            centres = apply(poses_of_part, centre[None])[:, 0]
            outside = np.abs(centres[:, :2]) > opening
            if outside.any() or (centres[:, 2] < 0).any() or (centres[:, 2] > bin_size[2]).any():
                return
            pile_top = max(pile_top, float(apply(poses_of_part, vertices[i])[..., 2].max()))
        if speed <= 0.05:
            yield bin_from_part


def _drop_area(
    half: NDArray[np.float64], settings: DropSettings, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Middle and half size, each ``(2,)`` metres, of the piece of the floor that parts fall over: somewhere in the bin,
    along its walls too."""
    if settings.area is None:
        return np.zeros(2), half
    reach = np.minimum(np.array(settings.area) / 2, half)
    return rng.uniform(-1, 1, size=2) * (half - reach), reach


def _release(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    k: int,
    vertices: NDArray[np.float64],
    middle: NDArray[np.float64],
    reach: NDArray[np.float64],
    height: float,
    speed: float,
    rng: np.random.Generator,
) -> None:
    """Take part ``k`` from its parking place to a random pose, its lowest point at ``height``, over the floor's piece
    with that middle and half size."""
    quaternion = random_quaternion(rng)
    turned = vertices @ matrix_from_quaternion(quaternion).T
    low, high = turned.min(axis=0), turned.max(axis=0)
    # Between the walls with its whole extent, in the middle where it is too long for that.
    first, last = -reach - low[:2], reach - high[:2]
    between = (first + last) / 2
    center = middle + rng.uniform(np.minimum(first, between), np.maximum(last, between))
    data.qpos[7 * k : 7 * k + 7] = [*center, height - low[2], *quaternion]
    data.qvel[6 * k : 6 * k + 6] = [0, 0, -speed, 0, 0, 0]
    model.body_gravcomp[k + 1] = 0.0  # body 0 is the world


def _settle(model: mujoco.MjModel, data: mujoco.MjData, dropped: int, settings: DropSettings) -> float:
    """Step until the dropped parts rest, at least 0.25 s and at most the timeout; the fastest part's speed in m/s."""
    start = data.time
    while True:
        mujoco.mj_step(model, data, nstep=10)
        velocity = data.qvel.reshape(-1, 6)[:dropped]
        linear, angular = np.linalg.norm(velocity.reshape(-1, 2, 3), axis=2).max(axis=0)
        elapsed = data.time - start
        resting = elapsed >= 0.25 and linear < 0.01 and angular < 0.2
        if resting or elapsed >= settings.timeout or not np.isfinite(linear):
            return float(linear)


def _planes(bin_size: NDArray[np.float64], walls: Walls | None) -> list[tuple[list[float], list[float]]]:
    """Floor and upright planes that end what a part can reach, the walls where they have no shape: a point of each, and
    the quaternion that turns z to its inward normal."""
    floor: tuple[list[float], list[float]] = ([0, 0, 0], [1, 0, 0, 0])
    if walls is not None:  # where the rim ends, upright
        bin_size = np.array([*walls.outer_size(bin_size), bin_size[2]])
    x, y, root = bin_size[0] / 2, bin_size[1] / 2, np.sqrt(0.5)
    return [
        floor,
        ([-x, 0, 0], [root, 0, root, 0]),
        ([x, 0, 0], [root, 0, -root, 0]),
        ([0, -y, 0], [root, -root, 0, 0]),
        ([0, y, 0], [root, root, 0, 0]),
    ]


def _build_model(
    solids: Sequence[Solid],
    masses: Sequence[Mass],
    part_ids: NDArray[np.int32],
    bin_size: NDArray[np.float64],
    friction: float,
    settings: DropSettings,
    walls: Walls | None = None,
) -> mujoco.MjModel:
    """A model with every part of the cycle, parked above the bin without weight until its drop."""
    diameters = [solid.part.diameter for solid in solids]
    scale = 0.5 if min(diameters) < _SMALL_DIAMETER else 1.0
    spec = mujoco.MjSpec()
    spec.memory = 256 << 20  # the contact arena; reserved, not touched, until it is needed
    option = spec.option
    option.timestep = settings.timestep * scale
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.iterations, option.tolerance, option.ls_iterations = 100, 1e-8, 50
    # A reset to the parking places must not pass for a pile.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    surface = {
        "solref": [settings.contact_time * scale, 1.0],
        "solimp": [0.95, 0.99, 0.001, 0.5, 2.0],
        "condim": 3,
        "friction": [friction, 0.005, 0.0001],
    }
    for position, quaternion in _planes(bin_size, walls):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE, pos=position, quat=quaternion, size=[0, 0, 1], **surface
        )
    for i, piece in enumerate([] if walls is None else wall_pieces(bin_size, walls)):
        spec.add_mesh(name=f"wall_{i}", uservert=piece.ravel(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"wall_{i}", **surface)
    for kind in np.unique(part_ids):
        for i, hull in enumerate(solids[kind].hulls):
            spec.add_mesh(
                name=f"hull_{kind}_{i}", uservert=hull.ravel(), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            )
    for k, kind in enumerate(part_ids):
        mass, centre, inertia = masses[kind]
        body = spec.worldbody.add_body(
            name=f"part_{k}",
            pos=[0, 0, 10.0 + 2 * max(diameters) * k],
            gravcomp=1.0,
            explicitinertial=True,
            mass=mass,
            ipos=centre,
            fullinertia=[inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2]],
        )
        body.add_freejoint()
        for i in range(len(solids[kind].hulls)):
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"hull_{kind}_{i}", **surface)
    return spec.compile()
