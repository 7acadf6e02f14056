"""Compiled code beside its definition in Python: found where it was built for this machine, and of this version."""

import ctypes
import os
import re
from functools import cache
from pathlib import Path

import torch

WITHOUT = "SPHEREORIENT_NO_COMPILED"  # an environment variable: where it is set, nothing compiled is used

NUMBERS = {"int64_t": ctypes.c_int64, "float": ctypes.c_float, "double": ctypes.c_double}


@cache
def record(source: Path, name: str) -> type[ctypes.Structure]:
    """Return a record of a C source (without suffix): numbers, pointers and other records, as declared there."""
    text = re.sub(r"/\*.*?\*/", "", source.with_suffix(".c").read_text(encoding="utf-8"), flags=re.DOTALL)
    declared = re.findall(rf"typedef struct {{([^}}]*)}} {name};", text)[0]
    fields = [
        (part.strip(" *"), ctypes.c_void_p if "*" in part else NUMBERS.get(kind) or record(source, kind))
        for kind, parts in re.findall(r"(?:const )?(\w+) ([^;]+);", declared)
        for part in parts.split(",")
    ]
    return type(name, (ctypes.Structure,), {"_fields_": fields})


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
