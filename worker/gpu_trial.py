"""`python -m worker.gpu_trial`: computes something on the GPU, or says in a line why it cannot.

Started by `worker.gpu` in a process as contained as a stage's. Exit code 1 where it cannot, 3 where
PyTorch can and kernels of our own cannot be compiled: training is then some ten times slower.
"""

from __future__ import annotations

import ctypes
import os
import sys
import tempfile

CANNOT_COMPUTE, CANNOT_COMPILE = 1, 3


def driver_problem() -> str | None:
    """Why NVIDIA's driver does not start in this process; None where it does."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError as error:
        return f"the driver's library cannot be loaded: {error}"
    if status := int(driver.cuInit(0)):
        text = ctypes.c_char_p()
        driver.cuGetErrorString(status, ctypes.byref(text))
        return f"the driver does not start: CUDA error {status}, {(text.value or b'?').decode()}"
    return None


def torch_problem() -> str | None:
    """Why PyTorch cannot compute on the GPU; None where it can."""
    import torch  # takes seconds, and a driver that does not start needs none of it

    try:
        total = float(torch.ones(1000, device="cuda").sum())
    except (RuntimeError, AssertionError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        return f"PyTorch {torch.__version__} cannot compute on it: {reason}"
    return None if total == 1000.0 else f"PyTorch adds 1000 ones up to {total} on it"


def kernel_problem() -> str | None:
    """Why Triton cannot compile for the GPU; None where it can.

    It needs a C compiler with all that belongs to one, Python's headers, and NVIDIA's assembler,
    which it brings along. What it compiled for another trial, which may have been allowed more,
    does not count.
    """
    try:
        with tempfile.TemporaryDirectory() as empty:
            os.environ["TRITON_CACHE_DIR"] = empty  # before Triton is imported
            from pipelines.nerf.engines.gpu.parts.trial_kernel import doubled

            total = doubled(1000)
    except Exception as error:  # noqa: BLE001 -- of Triton, compilers, the driver: it is told
        reason = (str(error).splitlines() or [""])[0]
        return f"{type(error).__name__}: {reason}"
    return None if total == 2000.0 else f"1000 ones are {total} when doubled"


def main() -> None:
    """Try, and tell."""
    if problem := driver_problem() or torch_problem():
        print(problem)
        sys.exit(CANNOT_COMPUTE)
    if problem := kernel_problem():
        print(problem)
        sys.exit(CANNOT_COMPILE)


if __name__ == "__main__":
    main()
