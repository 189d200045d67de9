"""Where a training computes: the graphics processor if there is one, else the processor."""

from __future__ import annotations

import os

import torch

from backend.core.faults import InputError
from backend.learning.job import DeviceName


def device_of(asked: DeviceName) -> torch.device:
    """Return the device that was ``asked`` for, ``auto`` the first graphics processor if any.

    Raises ``InputError`` for ``cuda`` where torch finds none.
    """
    found = torch.cuda.is_available()
    if asked == "cuda" and not found:
        raise InputError(
            "There is no graphics processor that torch can use here.",
            "device",
            "Train on --device cpu, or install its driver and a torch that is built for it.",
        )
    return torch.device("cuda" if found and asked != "cpu" else "cpu")


def name_of(device: torch.device) -> str:
    """Return what a card tells of the device."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type


def computes_bfloat16(device: torch.device) -> bool:
    """Whether an LSTM can be trained with bfloat16 products there.

    On a processor oneDNN wants AVX-512 for it.
    """
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported())
    return "AVX512" in torch.backends.cpu.get_cpu_capability()


def compute_alike(threads: int) -> None:
    """Let this process compute on so many threads, by algorithms that repeat their results.

    Call it before anything is computed on a graphics processor: its library of products repeats
    itself only with a workspace of a fixed size (cuBLAS manual, "Results reproducibility").
    """
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.set_num_threads(threads)
    # ``use_deterministic_algorithms`` would also load torch's compiler, to set an option of it.
    torch.set_deterministic_debug_mode("error")


def one_thread() -> None:
    """Let this process train and predict on one thread, the same on every machine."""
    compute_alike(1)
