"""List of cameras: drivers that answer, hang, fail or end their program, as modules in their place."""

import os

import pytest

from sphereorient.live.seen import cameras_here

CV2 = """
CAP_PROP_FRAME_WIDTH, CAP_PROP_FRAME_HEIGHT = 3, 4
class VideoCapture:
    def __init__(self, number): self.number = number
    def isOpened(self): return self.number in (0, 2)
    def get(self, which): return {3: 640.0, 4: 480.0}[which]
    def release(self): print("", end="")
"""
HARVESTERS = """
from types import SimpleNamespace
class Harvester:
    def __enter__(self): return self
    def __exit__(self, *fault): pass
    def add_file(self, path): assert path.endswith("maker.cti")
    def update(self): self.device_info_list = [SimpleNamespace(serial_number=s, model="M") for s in ("11", "12")]
"""
PYLON = """
from types import SimpleNamespace
here = SimpleNamespace(GetSerialNumber=lambda: "21", GetModelName=lambda: "a2A")
TlFactory = SimpleNamespace(GetInstance=lambda: SimpleNamespace(EnumerateDevices=lambda: [here]))
"""
VIMBA = """
class VmbSystem:
    get_instance = classmethod(lambda cls: cls())
    opened = False
    def __enter__(self): self.opened = True; return self
    def __exit__(self, *fault): pass
    def get_all_cameras(self): assert self.opened; return [self]
    def get_id(self): return "DEV_1"
    def get_model(self): return "Alvium"
"""
PARTS = {"harvesters": "core.py", "pypylon": "pylon.py"}
HANGS = "import time\ntime.sleep(60)"
ENDS = "import os\nos.abort()"
FAILS = "raise RuntimeError('no transport layer')"


@pytest.fixture
def drivers(tmp_path, monkeypatch):
    """Install modules in place of drivers."""

    def install(**texts: str) -> None:
        for name, text in {"cv2": CV2, **texts}.items():
            (tmp_path / name).mkdir()
            (tmp_path / name / "__init__.py").touch()
            (tmp_path / name / PARTS.get(name, "__init__.py")).write_text(text)
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    return install


def test_cameras_are_listed_as_sources_name_them(drivers, tmp_path, monkeypatch):
    (tmp_path / "maker.cti").touch()
    monkeypatch.setenv("GENICAM_GENTL64_PATH", os.pathsep.join(["", str(tmp_path)]))
    drivers(harvesters=HARVESTERS, pypylon=PYLON, vmbpy=VIMBA)
    producer = tmp_path / "maker.cti"
    found = cameras_here()
    assert (found["pylon"], found["vimba"]) == (["pylon:21 (a2A)"], ["vimba:DEV_1 (Alvium)"])
    assert found["opencv"] == ["camera:0 (640 x 480 px)", "camera:2 (640 x 480 px)"]
    assert found["genicam"] == [f"genicam:{producer}#11 (M)", f"genicam:{producer}#12 (M)"]


def test_a_driver_that_hangs_or_ends_its_program_is_listed_beside_those_that_answer(drivers):
    drivers(pypylon=HANGS, vmbpy=ENDS)
    found = cameras_here(limit_s=1.5)
    assert found["pylon"] == "no answer within 1.5 s"
    assert found["vimba"].startswith("the driver fails: ")
    assert len(found["opencv"]) == 2


def test_a_driver_that_fails_is_reported_in_its_own_words(drivers):
    drivers(vmbpy=FAILS)
    assert cameras_here()["vimba"] == "the driver fails: RuntimeError: no transport layer"
