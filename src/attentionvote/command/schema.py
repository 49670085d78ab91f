"""The range of every setting: one table, first matching pattern wins.

Types need no table: an override must have the type of the default it replaces
(``configuration.py``). Ranges hold for whatever the final value is, from a file or from the
command line. ``None`` (null) always passes: whether a setting may be null is its default's business.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from fnmatch import fnmatchcase
from typing import Any

_NOUNS: dict[type, str] = {int: "a whole number ", float: "a number ", str: "a text ", dict: "a section or null "}


@dataclass(frozen=True)
class Range:
    """What the values of the settings that match ``pattern`` may be.

    Args:
        pattern: of dotted keys, shell style.
        low, high: inclusive bounds of a number.
        above: exclusive bound of a number.
        options: the texts that are allowed.
        kind: ``int``, ``float``, ``str`` or ``dict``, for settings that may be null: null carries no type.
    """

    pattern: str
    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf
    options: tuple[str, ...] = ()
    kind: type | None = None

    def __str__(self) -> str:
        if self.options:
            return f"one of {', '.join(self.options)}"
        parts = []
        if self.above > -math.inf:
            parts.append(f"greater than {self.above:g}")
        if self.low > -math.inf:
            parts.append(f"at least {self.low:g}")
        if self.high < math.inf:
            parts.append(f"at most {self.high:g}")
        noun = "" if self.kind is None else _NOUNS[self.kind]
        return noun + " and ".join(parts) if parts else noun.strip() or "a finite number"

    def accepts(self, value: object) -> bool:
        """Whether ``value`` may stand here; null always may, texts are judged by options, numbers by bounds."""
        if value is None or isinstance(value, bool):
            return value is None or self.kind is None
        if self.kind is dict:
            return isinstance(value, dict)
        if isinstance(value, str):
            return self.kind in (None, str) and (not self.options or value in self.options)
        if not isinstance(value, (int, float)):
            return True
        if self.options or self.kind is str or (self.kind is int and isinstance(value, float)):
            return False
        return math.isfinite(value) and self.low <= value <= self.high and value > self.above


RANGES: tuple[Range, ...] = (
    Range("seed", low=0, high=2**32 - 1),
    Range("*.seed", low=0, high=2**32 - 1),
    Range("object.*diameter", above=0, high=10, kind=float),
    Range("object.*base_radius", above=0, high=10, kind=float),
    Range("object.*voxel_size", above=0, high=10, kind=float),
    Range("evaluation.split", options=("evaluation", "benchmark")),
    Range("evaluation.peak_threshold", low=0, kind=float),
    Range("*.dataset", kind=str),
    Range("data.held_out.*", above=0, high=0.4),
    Range("format", options=("ipa", "bop")),
    Range("objects", kind=str),
    Range("rows", kind=str),
    Range("rounds", low=1, high=1000),
    Range("batch.*", low=1, high=1024),
    Range("table.curve", kind=dict),
    Range("ppf.sampling", low=0.02, high=0.2),
    Range("ppf.reference_step", low=1, high=100),
    Range("ppf.hypotheses", low=1, high=10_000),
    Range("run", kind=str),
    Range("signing_keys", kind=str),
    Range("triton", kind=str),
    Range("voting_radius", above=0, high=10, kind=float),
    Range("peak_threshold", low=0, high=1000, kind=float),
    Range("trusted_key", kind=str),
    Range("champion_key", kind=str),
    Range("to", low=1, kind=int),
    Range("last", low=1),
    Range("poseutils", kind=str),
    Range("models", kind=str),
    Range("targets", kind=str),
    Range("suffix", kind=str),
    Range("frame", options=("toolbox", "object")),
    Range("occlusion", low=0, high=2),
    Range("threshold_scale", above=0, high=100),
    Range("result_limit", low=1, kind=int),
    Range("trials", low=1),
    Range("storage", kind=str),
    Range("save_as", kind=str),
    Range("heartbeat_s", low=1, high=3600),
    Range("sweep.sampler.random_trials", low=1),
    Range("sweep.pruner.kind", options=("median", "hyperband", "none")),
    Range("sweep.pruner.reduction", low=2, high=100),
    Range("sweep.pruner.least_*", low=1),
    Range("gates.floors.*", low=0, high=1, kind=float),
    Range("gates.margins.*", low=0, high=1, kind=float),
    Range("gates.provenance", options=("commit", "data", "config", "versions", "signature")),
    Range("gates.latency_p95_ms", above=0, high=600_000),
    Range("evaluation.cycles", low=1, high=10_000),
    Range("evaluation.density", low=3),
    Range("evaluation.threads", low=1, high=1024),
    Range("scenes", low=1, high=100_000),
    Range("golden", low=1, high=64),
    Range("tolerance", above=0, high=0.05),
    Range("*units", options=("m", "cm", "mm", "inch")),
    Range("*splits", options=("train", "val", "test")),
    Range("*split", options=("train", "val", "test")),
    Range("*sensor", options=("none", "gaussian", "phoxi")),
    Range("simulation.cycles.*", low=1),
    Range("simulation.drop_counts", low=1, high=1000),
    Range("simulation.bin.size", above=0, high=100, kind=float),
    Range("simulation.*jitter", low=0, high=0.9),
    Range("simulation.camera.distance", above=0, high=100, kind=float),
    Range("simulation.camera.camera.[wh]*", low=8, high=16384),
    Range("simulation.camera.camera.f[xy]", above=0),
    Range("simulation.camera.*_degrees", low=0, high=180),
    Range("simulation.camera.shift", low=0, high=1),
    Range("simulation.drop.timestep", above=0, high=0.05),
    Range("simulation.drop.contact_time", above=0, high=0.5),
    Range("simulation.drop.hull_threshold", above=0, high=1),
    Range("simulation.drop.hull_vertices", low=4, high=4096),
    Range("simulation.drop.speed", above=0, high=100),
    Range("simulation.drop.timeout", above=0),
    Range("simulation.visibility_stride", low=1, high=64),
    Range("*max_points", low=3),
    Range("data.workers", low=0, high=1024),  # 0 = in the training process
    Range("*sensor.preset", options=("none", "gaussian", "phoxi")),
    Range("data.density", low=3),
    Range("data.pool", low=3),
    Range("data.points", low=3),
    Range("data.normal_neighbors", low=3, high=1000),
    Range("data.augmentation.tilt", low=0, high=3.15),
    Range("*workers", low=1, high=1024, kind=int),
    Range("model.centers", low=1),
    Range("model.neighbors", low=1),
    Range("model*widths", low=1),
    Range("model.base_radius", above=0, high=10, kind=float),
    Range("model.voxel_size", above=0, high=10, kind=float),
    Range("model.voting_radius", above=0, high=10, kind=float),
    Range("model.test_voting_radius", above=0, high=10, kind=float),
    Range("model.proposal_source", options=("heatmap", "fps")),
    Range("model.fusion_kind", options=("aml", "amx", "pn")),
    Range("model.merge_fraction", above=0, high=10, kind=float),
    Range("model.*_fraction", above=0, high=10),
    Range("model.center_seed", options=("voxel", "mean")),
    Range("model.rotation", options=("quaternion", "six")),
    Range("model.confidence", options=("exponential", "quality")),
    Range("model.refinement", kind=dict),
    Range("model.refinement_steps", low=0, high=100),
    Range("model.*", low=1),
    Range("loss.settings.confidence", options=("exponential", "quality")),
    Range("loss.settings.rotation", options=("metric", "slerp", "minra", "nlerp")),
    Range("loss.settings.least_visible", low=0, high=1),
    Range("trainer.optimizer", options=("adam", "adamw")),
    Range("trainer.learning_rate", above=0, high=10),
    Range("trainer.schedule.shape", options=("step", "cosine", "constant")),
    Range("trainer.schedule.milestones", low=1),
    Range("trainer.schedule.decay", above=0, high=1),
    Range("trainer.schedule.vote_radius_factor", above=0, high=100),
    Range("trainer.average_decay", low=0, high=0.999999),
    Range("trainer.precision", options=("auto", "32-true", "bf16-mixed", "16-mixed", "64-true")),
    Range("trainer.accelerator", options=("auto", "cpu", "gpu", "cuda", "mps")),
    Range("trainer.threads", low=1, high=1024, kind=int),
    Range("trainer.validate_every", low=1),
    Range("trainer.log_every_steps", low=1),
    Range("tracking.store", kind=str),
    Range("executor", options=("local", "ray", "slurm")),
    Range("threads", low=1, high=1024, kind=int),
    Range("cluster.address", kind=str),
    Range("cluster.slurm.system", options=("slurm", "local")),
    Range("cluster.slurm.minutes", low=1),
    Range("cluster.slurm.memory_gb", above=0, kind=float),
    Range("cluster.slurm.partition", kind=str),
    Range("cluster.slurm.account", kind=str),
    Range("tracking.parent", kind=str),
    Range("resume", options=("auto", "never")),
    Range("*batch_size", low=1),
    Range("*.lr", above=0, high=10),
    Range("*epochs", low=1),
    # Everything else that is a number is a count, a length, a weight or a rate: never negative.
    Range("*", low=0),
)

# Settings that may be negative: coordinates, angles and offsets.
SIGNED: tuple[str, ...] = ("object.*symmetry.*", "*axis*", "*offset*")

# Settings that name a database or a server.
ADDRESSES = ("tracking.store", "storage")


def range_of(key: str) -> Range:
    """The range of a dotted key."""
    if any(fnmatchcase(key, pattern) for pattern in SIGNED):
        return Range(key)
    return next(r for r in RANGES if fnmatchcase(key, r.pattern))


def _scalars(value: Any) -> Iterator[Any]:
    """The items of a list of any depth; anything else is its own only item."""
    if isinstance(value, list):
        for item in value:
            yield from _scalars(item)
    else:
        yield value


def violation(key: str, value: Any) -> str:
    """One sentence when ``value`` (a scalar or a list of them) is out of range, else an empty string."""
    allowed = range_of(key)
    if key in ADDRESSES and isinstance(value, str):
        from attentionvote.tracking.store import has_password, shown

        if has_password(value):
            return (
                f"{key} must not hold a password, because settings are kept with every run; got {shown(value)!r}: "
                + ("set MLFLOW_TRACKING_URI or PGPASSWORD" if key == "tracking.store" else "set PGPASSWORD")
            )
    for item in _scalars(value):
        if not allowed.accepts(item):
            close = get_close_matches(str(item), allowed.options, n=1)
            return f"{key} must be {allowed}; got {item!r}" + (f", did you mean {close[0]!r}?" if close else "")
    return ""
