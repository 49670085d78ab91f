"""Many independent jobs: one call, on the cores of this machine, on a Ray cluster or on SLURM.

``run_all(task, jobs, executor, workers=...)`` yields (index, result) as the jobs end. Knows nothing of scenes, models
or parts; Ray and submitit are imported here only, and only when they are used.
"""

from attentionvote.execution.failures import WorkerDied
from attentionvote.execution.local_pool import LocalPool
from attentionvote.execution.ray_cluster import RayCluster
from attentionvote.execution.run import EXECUTORS, Executor, executor_named, run_all
from attentionvote.execution.slurm_array import SlurmArray

__all__ = [
    "EXECUTORS",
    "Executor",
    "LocalPool",
    "RayCluster",
    "SlurmArray",
    "WorkerDied",
    "executor_named",
    "run_all",
]
