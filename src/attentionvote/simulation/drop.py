"""Parts dropped one after another into a bin, by rigid-body physics (MuJoCo).

Bin frame: origin in the middle of the floor, z up. Every settled pile of a drop cycle is a scene; the
piles of one cycle resemble each other, so data is split by cycle. Settings and guards are measured choices:
with them parts rest 0.2-0.3 % of D inside each other, other solvers and 10 line-search steps make piles explode.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from attentionvote.geometry.pose import apply, matrix_from_quaternion, random_quaternion, transform
from attentionvote.part import Part, Parts
from attentionvote.simulation.decomposition import Hulls
from attentionvote.simulation.mass import Mass, mass_properties

# The bin of the IPA-like protocol, for slender parts of 143 mm.
REFERENCE_DIAMETER = 0.143
REFERENCE_BIN = (0.360, 0.280, 0.160)
# Heaps of bulky parts reach the rim when the parts' convex hulls take about half of the bin's volume.
_LARGEST_FILL = 0.45
_SMALL_DIAMETER = 0.040  # below it, time step and contact time constant are halved


@dataclass(frozen=True)
class BinSettings:
    """The bin.

    Args:
        size: inner length, width and height in metres; None scales 360 x 280 x 160 mm, see
            :meth:`scaling_diameter`.
        jitter: every side is multiplied by a factor uniform in ``1 - jitter .. 1 + jitter``, once per cycle.
    """

    size: tuple[float, float, float] | None = None
    jitter: float = 0.15

    def __post_init__(self) -> None:
        if self.size is not None:
            object.__setattr__(self, "size", tuple(float(s) for s in self.size))
            if len(self.size) != 3 or min(self.size) <= 0:
                raise ValueError(f"bin size must be three positive lengths in metres, got {list(self.size)}")
        if not 0 <= self.jitter <= 0.5:
            raise ValueError(f"bin jitter must lie in 0..0.5, got {self.jitter}")

    def scaling_diameter(self, parts: Parts, count: int) -> float:
        """The diameter in metres, relative to 143 mm, that bin and camera distance scale with.

        It is D of the largest part, or more for bulky parts, of which ``count`` would not fit into a bin scaled with D;
        with a given bin size, the diameter that belongs to its length.
        """
        if self.size is not None:
            return self.size[0] / REFERENCE_BIN[0] * REFERENCE_DIAMETER
        volume = np.mean([ConvexHull(part.vertices).volume for part in parts.parts])
        fill = count * volume / np.prod(REFERENCE_BIN)
        return max(parts.diameter, float(REFERENCE_DIAMETER * (fill / _LARGEST_FILL) ** (1 / 3)))

    def sample(self, diameter: float, rng: np.random.Generator) -> NDArray[np.float64]:
        """``(3,)`` inner size in metres for one cycle, ``diameter`` from :meth:`scaling_diameter`."""
        size = np.array(self.size or np.array(REFERENCE_BIN) * diameter / REFERENCE_DIAMETER)
        return size * rng.uniform(1 - self.jitter, 1 + self.jitter, size=3)


@dataclass(frozen=True)
class DropSettings:
    """Physics of the drops.

    Args:
        timestep: seconds; 0.004 is the default, 0.008 with ``contact_time=0.02`` is "fast" (0.4 % D penetration).
        contact_time: time constant of a contact in seconds (MuJoCo's ``solref[0]``).
        friction: range of the sliding friction coefficient, drawn once per cycle.
        hull_threshold: concavity threshold of the convex decomposition.
        hull_vertices: most vertices of one convex piece.
        speed: downward speed at release, m/s.
        timeout: a drop that has not settled after so many seconds is judged as it is.
    """

    timestep: float = 0.004
    contact_time: float = 0.01
    friction: tuple[float, float] = (0.2, 0.6)
    hull_threshold: float = 0.1
    hull_vertices: int = 64
    speed: float = 0.5
    timeout: float = 1.5

    def __post_init__(self) -> None:
        object.__setattr__(self, "friction", tuple(float(f) for f in self.friction))
        if not 1e-4 <= self.timestep <= 0.01:
            raise ValueError(f"drop timestep must lie in 0.0001..0.01 seconds, got {self.timestep}")
        if self.contact_time < 2 * self.timestep:
            raise ValueError(
                f"drop contact_time must be at least two time steps ({2 * self.timestep:g} s), got {self.contact_time}"
            )
        if len(self.friction) != 2 or not 0 < self.friction[0] <= self.friction[1] <= 2:
            raise ValueError(f"drop friction must be a range within 0..2, got {list(self.friction)}")
        if not 0 <= self.speed <= 5:
            raise ValueError(f"drop speed must lie in 0..5 m/s, got {self.speed}")
        if not 0.25 < self.timeout <= 30:
            raise ValueError(f"drop timeout must lie in 0.25..30 seconds, got {self.timeout}")


@dataclass(frozen=True, eq=False)
class Pile:
    """A settled pile: ``bin_from_part`` ``(k, 4, 4)`` of the first k parts, and the fastest part's speed in m/s."""

    bin_from_part: NDArray[np.float64]
    speed: float


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
) -> Iterator[Pile]:
    """Drop parts in sequence and yield every pile that came to rest.

    The bin's walls go on invisibly above the rim, as infinite planes: nothing falls out or tunnels through.
    A pile that still moves (> 5 cm/s) after the timeout is left out. The cycle ends early when a part rests above the
    rim (the bin is full), left the bin, or any value is not finite.

    Args:
        solids: the parts; their true surfaces give mass and inertia.
        part_ids: ``(count,)`` which of them each drop is.
        bin_size: ``(3,)`` inner length, width, height in metres.
        friction: sliding friction coefficient of every surface.
        settings: physics settings.
        rng: decides places and orientations.

    Yields:
        One :class:`Pile` per accepted drop; its number of parts tells which drop it was.
    """
    count = len(part_ids)
    masses = [mass_properties(solid.part) for solid in solids]
    model = _build_model(solids, masses, part_ids, bin_size, friction, settings)
    data = mujoco.MjData(model)
    vertices = [np.concatenate(solid.hulls) for solid in solids]
    half = np.asarray(bin_size[:2]) / 2
    pile_top = 0.0
    for k, kind in enumerate(part_ids):
        height = pile_top + 0.3 * solids[kind].part.diameter
        _release(model, data, k, vertices[kind], half, height, settings.speed, rng)
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
            own = bin_from_part[part_ids[: k + 1] == i]
            if not len(own):
                continue
            centres = apply(own, centre[None])[:, 0]
            outside = np.abs(centres[:, :2]) > half
            if outside.any() or (centres[:, 2] < 0).any() or (centres[:, 2] > bin_size[2]).any():
                return
            pile_top = max(pile_top, float(apply(own, vertices[i])[..., 2].max()))
        if speed <= 0.05:
            yield Pile(bin_from_part, speed)


def _release(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    k: int,
    vertices: NDArray[np.float64],
    half: NDArray[np.float64],
    height: float,
    speed: float,
    rng: np.random.Generator,
) -> None:
    """Take part ``k`` from its parking place to a random pose whose lowest point is at ``height``."""
    quaternion = random_quaternion(rng)
    turned = vertices @ matrix_from_quaternion(quaternion).T
    low, high = turned.min(axis=0), turned.max(axis=0)
    # Between the walls with its whole extent, in the middle where it is too long for that.
    first, last = -half - low[:2], half - high[:2]
    middle = (first + last) / 2
    place = rng.uniform(np.minimum(first, middle), np.maximum(last, middle))
    data.qpos[7 * k : 7 * k + 7] = [*place, height - low[2], *quaternion]
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


def _build_model(
    solids: Sequence[Solid],
    masses: Sequence[Mass],
    part_ids: NDArray[np.int32],
    bin_size: NDArray[np.float64],
    friction: float,
    settings: DropSettings,
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
    x, y = bin_size[0] / 2, bin_size[1] / 2
    root = np.sqrt(0.5)
    planes: list[tuple[list[float], list[float]]] = [  # position, quaternion that turns z to the inward normal
        ([0, 0, 0], [1, 0, 0, 0]),
        ([-x, 0, 0], [root, 0, root, 0]),
        ([x, 0, 0], [root, 0, -root, 0]),
        ([0, -y, 0], [root, -root, 0, 0]),
        ([0, y, 0], [root, root, 0, 0]),
    ]
    for position, quaternion in planes:
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE, pos=position, quat=quaternion, size=[0, 0, 1], **surface
        )
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
