"""Compiled code beside its definition in Python: found where it was built for this machine, and of this version."""

import ctypes
import os
from functools import cache
from pathlib import Path

import torch

WITHOUT = "SPHEREORIENT_NO_COMPILED"  # an environment variable: where it is set, nothing compiled is used


@cache
def compiled(source: Path, record: type[ctypes.Structure]) -> ctypes.CDLL | None:
    """Return the code of a C source, (without suffix), for this processor; None: not built, or `WITHOUT` is set.
    `record` is the one that its functions take: code that knows another one is of another version.
    """
    if os.environ.get(WITHOUT):
        return None
    kinds = dict.fromkeys((torch.backends.cpu.get_cpu_capability().lower(), "default"))
    return next((code for kind in kinds if (code := built_for(source, record, kind)) is not None), None)


def built_for(source: Path, record: type[ctypes.Structure], kind: str) -> ctypes.CDLL | None:
    """Return the code built for a set of instructions (avx512, avx2, default), as `compiled`."""
    try:
        code = ctypes.CDLL(str(source.with_name(f"{source.name}.{kind}.compiled")))
        size = code[f"{source.name}_record"]
    except (OSError, AttributeError):  # not there, or for another machine
        return None
    size.restype = ctypes.c_int64
    return code if size() == ctypes.sizeof(record) else None
