"""GenICam cameras, through a module that stands for harvesters."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from sphereorient.errors import MovieError
from sphereorient.live.sources import genicam_pictures


class TimeoutException(Exception):
    pass


class Buffer:
    def __init__(self, log: list, content: np.ndarray, width: int, kind: str) -> None:
        self.log, self.memory = log, content.copy()
        component = SimpleNamespace(data=self.memory.reshape(-1), width=width, height=len(content), data_format=kind)
        self.payload = SimpleNamespace(components=[component])

    def __enter__(self):
        return self

    def __exit__(self, *fault) -> None:
        self.memory[:] = 0  # the driver writes the next picture there
        self.log.append("queued")


class Camera:
    def __init__(self, log: list, buffers: list) -> None:
        self.log, self.buffers = log, buffers

    def __enter__(self):
        return self

    def __exit__(self, *fault) -> None:
        self.log.append("destroyed")

    def start(self) -> None:
        self.log.append("started")

    def fetch(self, *, timeout: float) -> Buffer:
        assert timeout > 0
        thing = self.buffers.pop(0)
        if isinstance(thing, Exception):
            raise thing
        return Buffer(self.log, *thing)


class Harvester:
    log: list
    buffers: list
    device_info_list: list

    def __enter__(self):
        return self

    def __exit__(self, *fault) -> None:
        self.log.append("reset")

    def add_file(self, path: str, *, check_existence: bool, check_validity: bool) -> None:
        assert check_existence
        assert check_validity
        self.log.append(path)

    def update(self) -> None:
        self.log.append("updated")

    def create(self, key: object) -> Camera:
        self.log.append(key)
        return Camera(self.log, self.buffers)


@pytest.fixture
def harvester(monkeypatch):
    fake = type("Fake", (Harvester,), {"log": [], "buffers": [], "device_info_list": ["one"]})
    core = ModuleType("harvesters.core")
    core.Harvester, core.TimeoutException = fake, TimeoutException
    monkeypatch.setitem(sys.modules, "harvesters", ModuleType("harvesters"))
    monkeypatch.setitem(sys.modules, "harvesters.core", core)
    return fake


def test_pictures_are_copied_without_padding_and_a_camera_that_waits_is_asked_again(harvester):
    first, second = np.arange(12, dtype=np.uint8).reshape(3, 4), np.arange(6, dtype=np.uint16).reshape(2, 3)
    padded = np.hstack([first, np.full((3, 2), 99, np.uint8)])
    harvester.buffers += [TimeoutException(), (padded, 4, "Mono8"), TimeoutException(), (second, 3, "Mono16")]
    pictures = genicam_pictures("maker.cti")
    np.testing.assert_array_equal(next(pictures), first)
    np.testing.assert_array_equal(found := next(pictures), second)
    assert found.dtype == np.uint16
    pictures.close()
    assert harvester.log == ["maker.cti", "updated", 0, "started", "queued", "queued", "destroyed", "reset"]


def test_a_camera_is_chosen_by_its_serial_number(harvester):
    harvester.buffers.append((np.zeros((2, 2), np.uint8), 2, "Mono8"))
    next(genicam_pictures("maker.cti#4711"))
    assert {"serial_number": "4711"} in harvester.log


def test_what_is_wrong_is_told_in_one_line(harvester, monkeypatch):
    harvester.buffers += [(np.zeros((2, 2), np.uint8), 2, "BayerRG8"), RuntimeError("lost\nits cable")]
    with pytest.raises(MovieError, match="expected grey pictures, got BayerRG8"):
        next(genicam_pictures("maker.cti"))
    with pytest.raises(MovieError, match=r"got 'lost'; look"):
        next(genicam_pictures("maker.cti"))
    assert harvester.log[-2:] == ["destroyed", "reset"]
    harvester.device_info_list = []
    with pytest.raises(MovieError, match="expected a camera, got none"):
        next(genicam_pictures("maker.cti"))
    monkeypatch.setitem(sys.modules, "harvesters.core", None)
    with pytest.raises(MovieError, match=r"pip install 'sphereorient\[genicam\]'"):
        next(genicam_pictures("maker.cti"))
