"""The cameras of this machine. Drivers may hang or crash: this file runs as a program, in one process per kind."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any


def _opencv(cv2: Any) -> Iterator[str]:
    for number in range(8):  # Linux lists each camera twice
        capture = cv2.VideoCapture(number)
        if capture.isOpened():
            width, height = (round(capture.get(one)) for one in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
            yield f"camera:{number} ({width} x {height} px)"
        capture.release()


def _genicam(core: Any) -> Iterator[str]:
    for folder in filter(None, os.environ.get("GENICAM_GENTL64_PATH", "").split(os.pathsep)):
        for producer in sorted(Path(folder).glob("*.cti")):
            with core.Harvester() as harvester:
                harvester.add_file(str(producer))
                harvester.update()
                for one in harvester.device_info_list:
                    yield f"genicam:{producer}#{one.serial_number} ({one.model})"


def _pylon(pylon: Any) -> Iterator[str]:
    for one in pylon.TlFactory.GetInstance().EnumerateDevices():
        yield f"pylon:{one.GetSerialNumber()} ({one.GetModelName()})"


def _vimba(vmbpy: Any) -> Iterator[str]:
    with vmbpy.VmbSystem.get_instance() as system:
        for one in system.get_all_cameras():
            yield f"vimba:{one.get_id()} ({one.get_model()})"


# By kind: the module of its driver, and the function that lists its cameras.
KINDS: Mapping[str, tuple[str, Callable[[Any], Iterator[str]]]] = {
    "opencv": ("cv2", _opencv),
    "genicam": ("harvesters.core", _genicam),
    "pylon": ("pypylon.pylon", _pylon),
    "vimba": ("vmbpy", _vimba),
}


def cameras_here(limit_s: float = 10.0) -> dict[str, list[str] | str]:
    """Return the cameras of each kind whose package is installed, or as text why there are none."""
    kinds = [kind for kind, (module, _) in KINDS.items() if find_spec(module.partition(".")[0]) is not None]
    with ThreadPoolExecutor() as pool:
        return dict(zip(kinds, pool.map(partial(_asked, limit_s=limit_s), kinds), strict=True))


def _asked(kind: str, limit_s: float) -> list[str] | str:
    command = [sys.executable, "-P", __file__, kind]  # -P: modules beside this file must not hide others
    try:
        ended = subprocess.run(command, capture_output=True, errors="replace", timeout=limit_s)
    except subprocess.TimeoutExpired:
        return f"no answer within {limit_s:g} s"
    if ended.returncode:
        return "the driver fails: " + (ended.stderr.strip().splitlines() or [f"status {ended.returncode}"])[-1][:200]
    return ended.stdout.splitlines()


if __name__ == "__main__":
    module, cameras = KINDS[sys.argv[1]]
    print(*cameras(import_module(module)), sep="\n", end="")  # noqa: T201
