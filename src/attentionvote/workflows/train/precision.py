"""What ``trainer.precision=auto`` means for a device, known before torch is imported."""

from __future__ import annotations

from importlib.metadata import version

from attentionvote.execution.hardware import gpu_generation
from attentionvote.training.settings import TrainerSettings

CPU_PRECISION = "32-true"
GPU_PRECISION = "bf16-mixed"
_BF16_GENERATION = 8  # Ampere: before it bfloat16 is emulated


def resolved_precision(trainer: TrainerSettings, gpu: bool | None = None) -> str:
    """The precision that a training has: ``auto`` is bfloat16 on a GPU that is good at it, else 32 bits.

    Args:
        trainer: precision and accelerator.
        gpu: whether the machine that trains has such a GPU; None: it is this one.
    """
    if trainer.precision != "auto":
        return trainer.precision
    if trainer.accelerator not in ("auto", "gpu", "cuda"):
        return CPU_PRECISION
    if gpu is None:
        gpu = not version("torch").endswith("+cpu") and (gpu_generation() or 0) >= _BF16_GENERATION
    return GPU_PRECISION if gpu else CPU_PRECISION


def device_type(accelerator: str) -> str:
    """Type of the device that Lightning trains on, as torch names it."""
    import torch

    if accelerator != "auto":
        return {"gpu": "cuda"}.get(accelerator, accelerator)
    if torch.cuda.is_available():
        return "cuda"
    return "mps" if torch.backends.mps.is_available() else "cpu"


def check_precision(setting: str, precision: str, device: str) -> None:
    """Whether a training is where its precision belongs.

    Args:
        setting: ``trainer.precision``.
        precision: what it was resolved to.
        device: type of the one that trains, as torch names it.

    Raises:
        ValueError: with one sentence: half precision on a CPU, which Lightning would replace without a word; or a GPU
            that torch cannot use after all.
    """
    if setting == "auto" and precision == GPU_PRECISION and device == "cpu":
        raise ValueError(
            f"trainer.precision=auto means {precision} with the GPU of this machine, but torch uses the CPU: mend the "
            f"driver, or set trainer.accelerator=cpu"
        )
    if precision == "16-mixed" and device == "cpu":
        raise ValueError(
            "trainer.precision=16-mixed must be trained on a GPU, got the CPU, which knows 16 bits as bf16-mixed: set "
            "that, or 32-true"
        )
