"""Sections of settings that several verbs share: where results are tracked, where jobs run, evaluation sets."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any

from attentionvote.execution.run import EXECUTORS
from attentionvote.setting import Identity, Setting
from attentionvote.simulation.sensor import Sensor

WORKERS = Setting("Processes; null = one per core.", low=1, high=1024)
SEED = Setting("Of everything random.", low=0, high=2**32 - 1)
TRUSTED_KEY = Setting(
    "Public key that must have signed the bundle; null = signing.pub in ATTENTIONVOTE_KEYS, else in "
    "~/.config/attentionvote."
)
EXECUTOR = Setting(
    "Where jobs run: local (this machine), ray or slurm (settings: cluster).",
    choices=EXECUTORS,
    identity=Identity.NEVER,
)


def no_password(instead: str) -> Any:
    """A check of an address: ``instead`` says where its password belongs."""

    def problem(address: str) -> str:
        from attentionvote.tracking.store import has_password, shown

        if not has_password(address):
            return ""
        return f"must not hold a password, because settings are kept with every run; got {shown(address)!r}: {instead}"

    return problem


STORE = Setting(
    "MLflow store; null = MLFLOW_TRACKING_URI, else a local SQLite file under outputs/.",
    problem=no_password("set MLFLOW_TRACKING_URI or PGPASSWORD"),
)


@dataclass(frozen=True)
class Store:
    """Where runs and the registry are."""

    store: Annotated[str | None, STORE]


@dataclass(frozen=True)
class Tracking:
    """How a training is tracked."""

    store: Annotated[str | None, STORE]
    system_interval: Annotated[
        float, Setting("Seconds between samples of processor, memory and GPU; 0 = none.", low=0, high=86_400)
    ]
    parent: Annotated[str | None, Setting("Run of MLflow that this one is shown below; grids and sweeps set it.")]


@dataclass(frozen=True)
class Slurm:
    """What a job of SLURM asks for."""

    folder: Annotated[str, Setting("Where jobs and their outcomes lie while they run; all machines must see it.")]
    system: Annotated[
        str, Setting("slurm, or local: processes of this machine, to rehearse.", choices=("slurm", "local"))
    ]
    minutes: Annotated[int, Setting("Limit of one element of the job array.", low=1, high=1_000_000)]
    memory_gb: Annotated[float | None, Setting("Limit; null = the partition's default.", above=0, high=100_000)]
    partition: Annotated[str | None, Setting("null = the default.")]
    account: Annotated[str | None, Setting("null = the default.")]


@dataclass(frozen=True)
class Cluster:
    """The group ``cluster``: of executor=ray and executor=slurm."""

    address: Annotated[
        str | None,
        Setting("Ray: null starts a cluster on this machine, auto joins this machine's, host:6379 another."),
    ]
    gpus: Annotated[float, Setting("GPUs a job takes.", low=0, high=1024)]
    slurm: Slurm


@dataclass(frozen=True)
class EvaluationSettings:
    """The group ``evaluation``: the frozen scenes, and the sensor that sees them."""

    split: Annotated[
        str,
        Setting("Of the scenes: no training, validation or test has seen them.", choices=("evaluation", "benchmark")),
    ]
    cycles: Annotated[int, Setting("Drop cycles, the unit of the intervals.", low=1, high=10_000)]
    keep_every: Annotated[
        int,
        Setting("A cycle keeps every so-many-th of drop_counts, each begins one later.", low=1, high=200),
    ]
    sensor: Sensor
    density: Annotated[int, Setting("Most points of a cloud.", low=3, high=10_000_000)]
    threads: Annotated[int, Setting("Of an estimate, as the cell will have.", low=1, high=1024)]
    peak_threshold: Annotated[float | None, Setting("Heat that a peak needs; null = the training's.", low=0, high=1000)]
    dataset: Annotated[
        str | None, Setting("Folder of somebody else's data to measure on instead; null = the generated set.")
    ]
    frozen: Annotated[dict[str, str], Setting("Digests of the scenes by part, where they are recorded.")] = field(
        default_factory=dict
    )
