"""Every executor as it really is: processes, a Ray cluster on this machine, submitit's local jobs."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

from attentionvote.execution import Executor, LocalPool, RayCluster, SlurmArray


@pytest.fixture(scope="package")
def ray_cluster() -> Iterator[RayCluster]:
    """A cluster of two cores, started once; its token was in the environment, so that none is written at home."""
    import ray

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_AUTH_TOKEN", uuid.uuid4().hex)
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        ray.init(
            address="local",
            num_cpus=2,
            include_dashboard=False,
            log_to_driver=False,
            logging_level="error",
            object_store_memory=128 * 2**20,
        )
    try:
        yield RayCluster()
    finally:
        ray.shutdown()


@pytest.fixture(params=["local", "slurm", "ray"])
def executor(request: pytest.FixtureRequest, tmp_path: Path) -> Executor:
    """Each of the three."""
    if request.param == "local":
        return LocalPool()
    if request.param == "slurm":
        return SlurmArray(tmp_path / "slurm", system="local", poll_s=0.05)
    cluster: RayCluster = request.getfixturevalue("ray_cluster")
    return cluster
