"""The processes of one training: which one this is, who speaks, and how Lightning is told.

Only ``torchrun`` (under SLURM: ``srun torchrun``) starts several; this program starts none, so that it works the same
on one machine, on many, and in a script. The first process (rank 0) does what must be done once: it locks the folder,
makes the data, tracks the run, writes the results and speaks.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from attentionvote.command.errors import ConfigurationError, sentence
from attentionvote.command.interruption import interruption
from attentionvote.execution.hardware import cores
from attentionvote.execution.job_process import TERMINATED, end_with_parent

FirstDoes = Callable[[str, Callable[[], Any]], Any]  # see ``attentionvote.training.processes``
_VARIABLES = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")


@dataclass(frozen=True)
class TrainingProcess:
    """Where this process stands among those of its training.

    Args:
        rank, processes: its number from 0, and how many there are.
        local_rank, local_processes: the same among those on its machine.
    """

    rank: int = 0
    processes: int = 1
    local_rank: int = 0
    local_processes: int = 1

    @classmethod
    def of(cls, environment: Mapping[str, str]) -> TrainingProcess:
        """What ``torchrun`` says in the environment; alone without it.

        Raises:
            ConfigurationError: when several processes were started by something else, or unevenly.
        """
        if environment.get("WORLD_SIZE", "1") in ("", "1"):
            return cls()
        missing = [name for name in (*_VARIABLES, "TORCHELASTIC_RUN_ID") if not environment.get(name)]
        if missing:
            raise ConfigurationError(
                f"several processes must be started by torchrun, but WORLD_SIZE is {environment['WORLD_SIZE']} and "
                f"{missing[0]} is not set: torchrun --standalone --nproc-per-node=N pipelines/train.py ..."
            )
        rank, processes, local_rank, local_processes = (int(environment[name]) for name in _VARIABLES)
        if processes % local_processes:
            raise ConfigurationError(
                f"every machine must start as many processes as the others, but {local_processes} on this one are no "
                f"equal share of {processes}: give each torchrun the same --nproc-per-node"
            )
        return cls(rank, processes, local_rank, local_processes)

    @property
    def name(self) -> str:
        """For sentences, counted from 1."""
        return f"process {self.rank + 1} of {self.processes}"

    @property
    def cores(self) -> int:
        """This process's share of the machine's."""
        return max(1, cores() // self.local_processes)

    def check(self, batch_size: int, scenes: Mapping[str, int]) -> None:
        """Whether what is shared can be shared.

        Args:
            batch_size: of the whole batch.
            scenes: number by split.

        Raises:
            ValueError: with one sentence.
        """
        n = self.processes
        if batch_size % n:
            nearest = max(1, round(batch_size / n)) * n
            raise ValueError(
                f"trainer.batch_size is shared by all processes and must be a multiple of their number, {n}; "
                f"got {batch_size}, {nearest} is the nearest"
            )
        for split in ("val", "test"):
            if scenes[split] < n:
                raise ValueError(f"processes must be at most the {scenes[split]} {split} scenes, got {n}")

    @contextmanager
    def joined(self, accelerator: str) -> Iterator[FirstDoes]:
        """Meet the others; yields what lets the first work alone while they wait."""
        if "TORCHELASTIC_RUN_ID" in os.environ:  # torchrun killed with -9 leaves no orphans that hold the folder
            end_with_parent()
        if self.processes == 1:
            yield lambda _, work: work()
            return
        # torch warns, from C++, that looking for unused parameters costs time where the first step has none.
        os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")
        import torch

        from attentionvote.training.processes import joined

        cuda = accelerator in ("auto", "gpu", "cuda") and torch.cuda.is_available()
        if cuda and torch.cuda.device_count() < self.local_processes:
            raise ConfigurationError(
                f"each process needs a GPU of its own, but there are {torch.cuda.device_count()} for "
                f"{self.local_processes} processes: lower --nproc-per-node, or set trainer.accelerator=cpu"
            )
        with joined(torch.device("cuda", self.local_rank) if cuda else torch.device("cpu")) as first_does:
            yield first_does

    def trainer_arguments(self) -> dict[str, Any]:
        """For ``lightning.Trainer``: one process a device, never started by Lightning."""
        if self.processes == 1:
            return {"devices": 1}
        from lightning.fabric.plugins.environments import TorchElasticEnvironment
        from lightning.pytorch.strategies import DDPStrategy

        os.environ.setdefault("OMP_NUM_THREADS", str(self.cores))  # else Lightning overrules trainer.threads
        # The warm-up trains the votes alone. Batch statistics are the same everywhere without a broadcast.
        strategy = DDPStrategy(
            cluster_environment=TorchElasticEnvironment(), find_unused_parameters=True, forward_sync_buffers=False
        )
        return {
            "devices": self.local_processes,
            "num_nodes": self.processes // self.local_processes,
            "strategy": strategy,
            "use_distributed_sampler": False,
        }


@contextmanager
def first_speaks(process: TrainingProcess) -> Iterator[None]:
    """Only the first process writes to stderr; another one only says, in one sentence, why it failed.

    That it ends because another one has ended is not said by the others, and by the first in words.

    Raises:
        ConnectionError: instead of what a backend says when another process is gone.
    """
    if process.rank:
        be_silent()
    try:
        yield
    except (KeyboardInterrupt, SystemExit) as error:
        # torchrun has ended this process after another one, or was told to end and says so itself.
        if process.processes > 1 and interruption(error) == TERMINATED:
            be_silent()
        raise
    except ConfigurationError as error:
        # The processes of one machine find the same; those of another one may find something else.
        if process.local_rank == 0:
            _say(process, error)
        raise
    except Exception as error:
        if process.processes == 1 or interruption(error) is not None:
            raise
        from attentionvote.training.processes import is_echo

        if is_echo(error):
            raise ConnectionError(
                "another process of this training has ended; run the same command to resume"
            ) from error
        _say(process, error)
        raise


def be_silent() -> None:
    """Neither logs nor messages of this process reach the terminal from now on."""
    sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - until the process ends
    logging.disable(logging.CRITICAL)


def _say(process: TrainingProcess, error: BaseException) -> None:
    if process.rank and sys.__stderr__ is not None:
        print(f"train: {process.name}: {sentence(error)}", file=sys.__stderr__, flush=True)


@contextmanager
def failing_at_once(environment: Mapping[str, str]) -> Iterator[None]:
    """Around everything: a process of several that fails leaves without waiting for what it began with the others.

    An operation that waits for another process would keep this one from ending, and this one the other.
    """
    try:
        yield
    except SystemExit as leaving:
        several = environment.get("WORLD_SIZE", "1") not in ("", "1")
        if several and isinstance(leaving.code, int) and leaving.code:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(leaving.code)
        raise


def refuse_grid(process: TrainingProcess, words: list[str]) -> None:
    """A grid under ``torchrun`` is refused: its jobs are trainings of one process each.

    Raises:
        ConfigurationError: when ``words`` ask for one.
    """
    if process.processes > 1 and {"-m", "--multirun"} & set(words):
        raise ConfigurationError(
            f"a grid (-m) must be run by one process, got {process.processes}: start one torchrun for each training"
        )
