"""Compiled code for definitions in Python, used if built for this machine and version."""

import ctypes
import os
import re
from functools import cache
from pathlib import Path

import torch

from sphereorient.errors import refusal

WITHOUT = "SPHEREORIENT_NO_COMPILED"  # environment variable that disables compiled code

PACKAGE = Path(__file__).parents[1]
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
    """Return the code of a C source (without suffix) for this processor; None: not built, or `WITHOUT` is set. `record`
    is the argument of its functions: code with another record is of another version.
    """
    if os.environ.get(WITHOUT):
        return None
    return next((code for kind in _kinds() if (code := built_for(source, record, kind)) is not None), None)


def _kinds() -> list[str]:
    """Return the instruction sets of this processor for which code is built, best first."""
    return list(dict.fromkeys((torch.backends.cpu.get_cpu_capability().lower(), "default")))


def compiled_parts(folder: Path = PACKAGE) -> tuple[dict[str, str], list[str]]:
    """Return the instruction set of the used code for each C source in a folder, or that torch is used; and the code
    that does not load, a line each.
    """
    used, faults = {}, []
    for path in sorted(folder.rglob("*.c")):
        source, text = path.with_suffix(""), path.read_text(encoding="utf-8")
        (name,) = re.findall(r"_record\(void\) { return \(int64_t\)sizeof\((\w+)\)", text)
        there = [kind for kind in _kinds() if _file(source, kind).exists()]
        right = [kind for kind in there if built_for(source, record(source, name), kind)]
        for file in (_file(source, kind) for kind in there if kind not in right):
            got, do = "that of another version or machine", "run `make setup`, or install sphereorient again"
            faults.append(refusal(str(file), expected="code that loads", got=got, do=do))
        used[source.name] = "torch: slower" if os.environ.get(WITHOUT) or not right else right[0]
    return used, faults


def _file(source: Path, kind: str) -> Path:
    return source.with_name(f"{source.name}.{kind}.compiled")


def built_for(source: Path, record: type[ctypes.Structure], kind: str) -> ctypes.CDLL | None:
    """Return the code built for an instruction set (avx512, avx2, default), as `compiled`."""
    try:
        code = ctypes.CDLL(str(_file(source, kind)))
        size = code[f"{source.name}_record"]
    except (OSError, AttributeError):  # missing, or for another machine
        return None
    size.restype = ctypes.c_int64
    return code if size() == ctypes.sizeof(record) else None
