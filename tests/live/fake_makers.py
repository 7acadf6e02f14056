"""Modules that stand for harvesters, pypylon and vmbpy, with cameras that misbehave on request."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from threading import Event, Thread
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

TIMEOUT = None  # in a script: nothing comes
GONE = "gone"  # the camera is pulled out, until it is opened anew
Picture = tuple[np.ndarray | None, float, int]  # None: not whole; stamp, s; counter


class TimeoutException(Exception):
    pass


@dataclass
class Body:
    """A camera. `script`: the pictures of each opening; after the last one nothing comes."""

    serial: str
    script: list[Iterator[Any]] = field(default_factory=list)
    features: dict[str, Any] = field(default_factory=dict)
    limits: dict[str, Callable[[Any], bool]] = field(default_factory=dict)
    log: list[Any] = field(default_factory=list)
    seen: bool = True

    def get(self, name: str) -> Any:
        return self.features[name]

    def set(self, name: str, value: Any) -> None:
        if name not in self.features:
            raise RuntimeError(f"node {name} does not exist\nin file 'Node.cpp'")
        if not self.limits.get(name, lambda value: True)(value):
            raise RuntimeError(f"{value} is out of range")
        self.features[name] = value
        self.log.append((name, value))

    def open(self) -> None:
        self.log.append("opened")
        self.seen, self._things = True, self.script.pop(0) if self.script else iter(())

    def next(self, limit_s: float) -> Picture | None:
        """Return the next picture within a time; raise at a fault."""
        thing = next(self._things, TIMEOUT)
        if thing is TIMEOUT:
            time.sleep(min(limit_s, 0.002))
        if isinstance(thing, Exception):
            raise thing
        if isinstance(thing, str):
            self.seen = False
            return None
        return thing

    def close(self) -> None:
        self.log.append("closed")


def node_map(body: Body, value: str) -> Any:
    """Return an object with a node for each name, whose attribute `value` gets and sets."""

    class Node:
        def __init__(self, name: str) -> None:
            object.__setattr__(self, "name", name)

        def __getattr__(self, name: str) -> Any:
            assert name == value
            return body.get(self.name)

        def __setattr__(self, name: str, given: Any) -> None:
            assert name == value
            body.set(self.name, given)

    return type("Nodes", (), {"__getattr__": lambda self, name: Node(name)})()


class Reused:
    """The memory of a picture, which the driver overwrites."""

    def __init__(self, picture: np.ndarray) -> None:
        self.memory = np.hstack([picture, np.full((len(picture), 2), 99, picture.dtype)])

    def release(self) -> None:
        self.memory[:] = 0


def harvesters(bodies: list[Body]) -> dict[str, ModuleType]:
    class Buffer:
        def __init__(self, body: Body, picture: np.ndarray, stamp_s: float, counter: int) -> None:
            self.held, self.timestamp, self.timestamp_frequency = Reused(picture), round(stamp_s * 1e9), 10**9
            self.frame_id, memory = counter, self.held.memory
            part = SimpleNamespace(data=memory.reshape(-1), width=picture.shape[1], height=len(picture))
            self.payload = SimpleNamespace(components=[part])

        def __enter__(self) -> Buffer:
            return self

        def __exit__(self, *fault: object) -> None:
            self.held.release()

    class Acquirer:
        min_num_buffers, num_buffers = 3, 3

        def __init__(self, body: Body) -> None:
            self.body, self.remote_device = body, SimpleNamespace(node_map=node_map(body, "value"))
            body.open()

        def __enter__(self) -> Acquirer:
            return self

        def __exit__(self, *fault: object) -> None:
            self.body.close()

        def start(self) -> None:
            assert self.num_buffers > 3
            self.body.log.append("started")

        def fetch(self, *, timeout: float) -> Buffer | None:
            assert timeout > 0
            thing = self.body.next(timeout)
            if not self.body.seen:
                raise RuntimeError("it was removed\nfor good")
            if thing is None:
                raise TimeoutException
            return None if thing[0] is None else Buffer(self.body, *thing)

    class Harvester:
        users = 0

        def __enter__(self) -> Harvester:
            Harvester.users += 1
            assert Harvester.users == 1, "a producer is initialised once"
            return self

        def __exit__(self, *fault: object) -> None:
            Harvester.users -= 1

        def add_file(self, path: str, *, check_existence: bool, check_validity: bool) -> None:
            assert check_existence
            assert check_validity
            self.path = path

        def update(self) -> None:
            assert not any(body.log.count("opened") > body.log.count("closed") for body in bodies), "it closes these"
            self.device_info_list = [SimpleNamespace(serial_number=body.serial) for body in bodies]

        def create(self, key: Any) -> Acquirer:
            return Acquirer(next(b for b in bodies if key == 0 or b.serial == key["serial_number"]))

    core = ModuleType("harvesters.core")
    core.Harvester, core.TimeoutException = Harvester, TimeoutException
    return {"harvesters": ModuleType("harvesters"), "harvesters.core": core}


def pypylon(bodies: list[Body]) -> dict[str, ModuleType]:
    class Result:
        def __init__(self, thing: Picture | None) -> None:
            self.thing = thing
            if thing is not None:
                self.BlockID, self.TimeStamp = thing[2], round(thing[1] * 1e9)

        def __enter__(self) -> Result:
            return self

        def __exit__(self, *fault: object) -> None:
            self.thing = None

        def IsValid(self) -> bool:
            return self.thing is not None

        def GrabSucceeded(self) -> bool:
            return self.thing[0] is not None

        @property
        def Array(self) -> np.ndarray:
            return self.thing[0].copy()

    class InstantCamera:
        def __init__(self, body: Body) -> None:
            self.__dict__["body"] = body
            self.__dict__["MaxNumBuffer"] = SimpleNamespace(Value=10)

        def __getattr__(self, name: str) -> Any:
            return getattr(node_map(self.body, "Value"), name)

        def Open(self) -> None:
            self.body.open()

        def Close(self) -> None:
            self.body.close()

        def StartGrabbing(self, strategy: str) -> None:
            assert strategy == "one by one"
            self.body.log.append("started")

        def RetrieveResult(self, limit_ms: int, handling: str) -> Result:
            assert limit_ms > 0
            assert handling == "return"
            return Result(self.body.next(1e-3 * limit_ms))

        def IsCameraDeviceRemoved(self) -> bool:
            return not self.body.seen

    infos = [SimpleNamespace(GetSerialNumber=lambda body=body: body.serial, body=body) for body in bodies]
    factory = SimpleNamespace(EnumerateDevices=lambda: infos, CreateDevice=lambda info: info.body)
    pylon = ModuleType("pypylon.pylon")
    pylon.TlFactory = SimpleNamespace(GetInstance=lambda: factory)
    pylon.InstantCamera = InstantCamera
    pylon.GrabStrategy_OneByOne, pylon.TimeoutHandling_Return = "one by one", "return"
    return {"pypylon": ModuleType("pypylon"), "pypylon.pylon": pylon}


def vmbpy(bodies: list[Body]) -> dict[str, ModuleType]:
    class Frame:
        def __init__(self, picture: np.ndarray | None, stamp_s: float, counter: int) -> None:
            self.picture, self.stamp_s, self.counter = picture, stamp_s, counter
            self.held = None if picture is None else Reused(picture)

        def get_status(self) -> str:
            return "complete" if self.held else "incomplete"

        def as_numpy_ndarray(self) -> np.ndarray:
            return self.held.memory[:, : self.picture.shape[1], None]

        def get_timestamp(self) -> int:
            return round(self.stamp_s * 1e9)

        def get_id(self) -> int:
            return self.counter

    class Camera:
        def __init__(self, body: Body) -> None:
            self.body, self.stopped = body, Event()

        def get_id(self) -> str:
            return self.body.serial

        def __enter__(self) -> Camera:
            self.body.open()
            return self

        def __exit__(self, *fault: object) -> None:
            self.body.close()
            self.body.seen = True  # it is put in again

        def get_feature_by_name(self, name: str) -> Any:
            return SimpleNamespace(get=lambda: self.body.get(name), set=lambda value: self.body.set(name, value))

        def start_streaming(self, handler: Any, buffer_count: int) -> None:
            def run() -> None:
                while not self.stopped.is_set() and self.body.seen:
                    if (thing := self.body.next(0.002)) is not None:
                        handler(self, None, Frame(*thing))

            assert buffer_count > 5
            self.body.log.append("started")
            self.thread = Thread(target=run)
            self.thread.start()

        def queue_frame(self, frame: Frame) -> None:
            if frame.held:
                frame.held.release()

        def stop_streaming(self) -> None:
            self.stopped.set()
            self.thread.join()
            self.body.log.append("stopped")

    class System:
        def __enter__(self) -> System:
            return self

        def __exit__(self, *fault: object) -> None:
            pass

        def get_all_cameras(self) -> list[Camera]:
            return [Camera(body) for body in bodies if body.seen]

        def get_camera_by_id(self, serial: str) -> Camera:
            return Camera(next(body for body in bodies if body.serial == serial))

    module = ModuleType("vmbpy")
    module.VmbSystem = SimpleNamespace(get_instance=System)
    module.FrameStatus = SimpleNamespace(Complete="complete")
    return {"vmbpy": module}


MAKERS = {"genicam:maker.cti#": harvesters, "pylon:": pypylon, "vimba:": vmbpy}


def install(maker: str, bodies: list[Body], monkeypatch: Any) -> None:
    for name, module in MAKERS[maker](bodies).items():
        monkeypatch.setitem(sys.modules, name, module)
