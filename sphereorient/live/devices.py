"""Cameras of makers and of OpenCV, set by experiment.yaml. A maker needs a function here, which opens a device by its
serial number, and a line in `MAKERS`; features have GenICam's names (SFNC).
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from queue import Empty, SimpleQueue
from threading import Event, Lock, Thread
from typing import Any

import cv2
import numpy as np

from sphereorient.errors import MovieError, error_words, refusal
from sphereorient.experiment.experiment import DeviceKeys
from sphereorient.experiment.recording import CameraStream
from sphereorient.files.picture import luma
from sphereorient.files.provenance import package
from sphereorient.live.feed import Arrival, Log
from sphereorient.live.instants import Instants, RawPicture
from sphereorient.movies import flipped_picture, flipped_shape

AGAIN_S = 1.0  # between attempts to open a camera
WAIT_S = 0.2  # limit of one call of a driver; without a trigger it is repeated
RELEASE_S = 10.0  # for drivers to release their cameras
BUFFERS = 16  # pictures buffered by a driver
OPENING = Lock()  # one camera at a time, as drivers scan for cameras
ALIKE = 0.02  # relative rounding of exposure and rate by a device; sizes are exact
OLDER = {"ExposureTime": "ExposureTimeAbs", "AcquisitionFrameRate": "AcquisitionFrameRateAbs"}  # of older GigE cameras
OPENCV = {
    "Width": cv2.CAP_PROP_FRAME_WIDTH,
    "Height": cv2.CAP_PROP_FRAME_HEIGHT,
    "AcquisitionFrameRate": cv2.CAP_PROP_FPS,
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Device:
    """An opened camera. All functions may raise errors of its driver."""

    get: Callable[[str], Any]  # the value of a feature
    set: Callable[[str, Any], object]
    shot: Callable[[], RawPicture | None]  # the next one; None: none within WAIT_S; EOFError: the end
    start: Callable[[], object] = lambda: None


Open = Callable[[str], AbstractContextManager[Device]]  # by serial number
Came = tuple[int, RawPicture | None] | None  # number of a camera, and what `LiveCamera.pictures` yields


@contextmanager
def _genicam(producer: str) -> Iterator[Open]:
    """GenICam cameras, through harvesters and the producer of their maker's driver."""
    driver = package("harvesters.core", "genicam", MovieError)
    with driver.Harvester() as harvester:
        harvester.add_file(producer, check_existence=True, check_validity=True)
        opened: list[str] = []

        @contextmanager
        def device(serial: str) -> Iterator[Device]:
            if not opened:
                harvester.update()  # closes open ones
            _check_seen(serial, [one.serial_number for one in harvester.device_info_list])
            with harvester.create({"serial_number": serial} if serial else 0) as camera:
                camera.num_buffers = max(BUFFERS, camera.min_num_buffers)
                nodes = camera.remote_device.node_map

                def shot() -> RawPicture | None:
                    try:
                        buffer = camera.fetch(timeout=WAIT_S)
                    except driver.TimeoutException:
                        return None
                    if buffer is None:  # incomplete; the counter shows it
                        return None
                    arrived_s = time.perf_counter()
                    with buffer:  # afterwards the driver reuses its memory
                        shown = buffer.payload.components[0]
                        picture = np.array(shown.data.reshape(shown.height, -1)[:, : shown.width])  # without padding
                        stamp_s = _known(lambda: buffer.timestamp / buffer.timestamp_frequency)
                        counter = _known(lambda: buffer.frame_id)
                    return RawPicture(picture=picture, arrived_s=arrived_s, stamp_s=stamp_s, counter=counter)

                opened.append(serial)
                try:
                    yield Device(
                        get=lambda name: getattr(nodes, name).value,
                        set=lambda name, value: setattr(getattr(nodes, name), "value", value),
                        shot=shot,
                        start=camera.start,
                    )
                finally:
                    opened.remove(serial)

        yield device


@contextmanager
def _pylon(serial: str) -> Iterator[Device]:
    """Basler's cameras, through pypylon."""
    driver = package("pypylon.pylon", "pylon", MovieError)
    factory = driver.TlFactory.GetInstance()
    seen = {one.GetSerialNumber(): one for one in factory.EnumerateDevices()}
    _check_seen(serial, list(seen))
    camera = driver.InstantCamera(factory.CreateDevice(seen[serial]))
    camera.Open()
    try:
        tick_s = _tick_s(lambda name: getattr(camera, name).Value)
        camera.MaxNumBuffer.Value = BUFFERS

        def shot() -> RawPicture | None:
            with camera.RetrieveResult(int(1e3 * WAIT_S), driver.TimeoutHandling_Return) as result:
                arrived_s = time.perf_counter()
                if not result.IsValid():
                    if camera.IsCameraDeviceRemoved():
                        raise OSError("it was removed")
                    return None
                picture = result.Array if result.GrabSucceeded() else None  # a copy
                stamp_s, counter = result.TimeStamp * tick_s or None, result.BlockID
            return RawPicture(picture=picture, arrived_s=arrived_s, stamp_s=stamp_s, counter=counter)

        yield Device(
            get=lambda name: getattr(camera, name).Value,
            set=lambda name, value: setattr(getattr(camera, name), "Value", value),
            shot=shot,
            start=lambda: camera.StartGrabbing(driver.GrabStrategy_OneByOne),
        )
    finally:
        camera.Close()


@contextmanager
def _vimba(serial: str) -> Iterator[Device]:
    """Allied Vision's cameras, through vmbpy."""
    driver = package("vmbpy", "vimba", MovieError)
    with driver.VmbSystem.get_instance() as system, ExitStack() as opened:
        _check_seen(serial, [one.get_id() for one in system.get_all_cameras()])
        camera = opened.enter_context(system.get_camera_by_id(serial))
        tick_s = _tick_s(lambda name: camera.get_feature_by_name(name).get())
        waiting: SimpleQueue[RawPicture] = SimpleQueue()

        def came(_camera: Any, _stream: Any, frame: Any) -> None:
            arrived_s, whole = time.perf_counter(), frame.get_status() == driver.FrameStatus.Complete
            picture = frame.as_numpy_ndarray()[..., 0].copy() if whole else None
            stamp_s, counter = (frame.get_timestamp() or 0) * tick_s or None, frame.get_id()
            waiting.put(RawPicture(picture=picture, arrived_s=arrived_s, stamp_s=stamp_s, counter=counter))
            camera.queue_frame(frame)

        def shot() -> RawPicture | None:
            with suppress(Empty):
                return waiting.get(timeout=WAIT_S)
            if serial not in [one.get_id() for one in system.get_all_cameras()]:
                raise OSError("it was removed")
            return None

        def start() -> None:
            camera.start_streaming(came, buffer_count=BUFFERS)
            opened.callback(camera.stop_streaming)

        yield Device(
            get=lambda name: camera.get_feature_by_name(name).get(),
            set=lambda name, value: camera.get_feature_by_name(name).set(value),
            shot=shot,
            start=start,
        )


@contextmanager
def _opencv(where: str) -> Iterator[Device]:
    """A camera of OpenCV, by number or address; pictures become grey, in their stored orientation."""
    capture = cv2.VideoCapture(int(where) if where.isdecimal() else where)
    try:
        if not capture.isOpened():
            do = "connect it, or choose another number"
            raise MovieError(refusal(f"camera:{where}", expected="a camera", got="none", do=do))
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # as movies are read

        def known(name: str) -> int:
            if name not in OPENCV:
                raise OSError("not through OpenCV")
            return OPENCV[name]

        def put(name: str, value: Any) -> None:
            if not capture.set(known(name), float(value)):
                raise OSError("not by this camera")

        def shot() -> RawPicture:
            there, picture = capture.read()
            if not there:
                raise EOFError
            grey = picture if picture.ndim == 2 else luma(*np.moveaxis(picture[..., ::-1], -1, 0))
            return RawPicture(picture=grey, arrived_s=time.perf_counter())

        yield Device(
            get=lambda name: "Mono8" if name == "PixelFormat" else capture.get(known(name)), set=put, shot=shot
        )
    finally:
        capture.release()


# By the name of a source; the functions hold a maker's driver; their argument is GenICam's producer.
MAKERS: Mapping[str, Callable[[str], AbstractContextManager[Open]]] = {
    "camera:": lambda _: nullcontext(_opencv),
    "genicam:": _genicam,
    "pylon:": lambda _: nullcontext(_pylon),
    "vimba:": lambda _: nullcontext(_vimba),
}


def _check_seen(serial: str, seen: Sequence[str]) -> None:
    if not seen or (serial and serial not in seen):
        got, do = ", ".join(seen) or "none", "connect it, or close the program that uses it"
        raise MovieError(refusal("--source", expected=f"a camera {serial}".rstrip(), got=got, do=do))


def _known(read: Callable[[], Any]) -> Any:
    """Return a value of a driver; None: it has none."""
    with suppress(Exception):
        return read() or None
    return None


def _tick_s(read: Callable[[str], Any]) -> float:
    """Return the unit of a device's time stamps, s: 1 ns, or that of older GigE cameras."""
    return 1 / float(_known(lambda: read("GevTimestampTickFrequency")) or 1e9)


def _features(keys: DeviceKeys, size: tuple[int, ...]) -> Iterator[tuple[str, Any]]:
    """Yield features and values to set, in an order that devices accept; "?": only if the device has the feature."""
    if keys.pixel_format:
        yield "PixelFormat", keys.pixel_format
    if keys.offset:
        yield from (("OffsetX?", 0), ("OffsetY?", 0))  # room for the size
    yield from zip(("Width", "Height"), size, strict=True)
    if keys.offset:
        yield from zip(("OffsetX", "OffsetY"), keys.offset, strict=True)
    if keys.exposure_ms:
        yield from (("ExposureAuto?", "Off"), ("ExposureMode?", "Timed"), ("ExposureTime", 1e3 * keys.exposure_ms))
    if keys.rate_hz:
        yield from (("AcquisitionFrameRateEnable?", True), ("AcquisitionFrameRate", keys.rate_hz))
    if keys.trigger == "none":
        yield "TriggerMode?", "Off"
    elif keys.trigger:
        yield from (("TriggerSelector?", "FrameStart"), ("TriggerSource", keys.trigger), ("TriggerMode", "On"))


def _refused(device: Device, name: str, value: Any) -> str:
    """Set a feature if its value differs; return as text what the device refuses."""
    try:
        if not _alike(device.get(name.rstrip("?")), value):
            device.set(name.rstrip("?"), value)
        taken = device.get(name.rstrip("?"))
        return "" if name[-1] == "?" or _alike(taken, value) else f"{name} {value} (it is {taken})"
    except Exception as error:  # errors differ between drivers
        if name in OLDER and _known(lambda: device.get(OLDER[name])) is not None:
            return _refused(device, OLDER[name], value)
        return "" if name[-1] == "?" else f"{name} {value} ({error_words(error)[:80]})"


def _alike(one: Any, other: Any) -> bool:
    if isinstance(other, float):
        return bool(abs(one - other) <= ALIKE * other)
    return bool(one == other) if isinstance(other, int) else str(one) == str(other)


@dataclass(frozen=True, kw_only=True, eq=False)
class LiveCamera:
    """A camera of an experiment, and the opener of its device."""

    name: str  # in messages
    open: Callable[[], AbstractContextManager[Device]]
    stream: CameraStream
    keys: DeviceKeys | None  # None: the device is not changed
    flip: str  # of `movies.flipped`
    log: Log | None  # gets faults, in one line; None: a movie, which ends

    def pictures(self, stopped: Event) -> Iterator[RawPicture | None]:
        """Yield pictures until `stopped`; None whenever the device is opened, as its clock restarts. After the first
        picture, a device that ends or fails is reopened each second. Raises MovieError: no camera, settings refused,
        or pictures of another size or type.
        """
        fault, seen = "", False
        while not stopped.is_set():
            found = f"{self.name}: pictures have stopped."
            try:
                with worded(self.name), suppress(EOFError), ExitStack() as opened:
                    with OPENING:
                        device = opened.enter_context(self.open())
                        self._set_up(device)
                        device.start()
                    yield None
                    while not stopped.is_set():
                        if (shot := device.shot()) is None:
                            continue
                        fitting = self._fitting(shot)
                        if fault and self.log is not None:
                            self.log(f"{self.name}: pictures arrive again.")
                        fault, seen = "", True
                        yield fitting
            except MovieError as error:
                if self.log is None or not seen:
                    raise
                found = str(error)
            if not seen and not stopped.is_set():
                do = "end other programs that use it, or choose another camera"
                raise MovieError(refusal(self.name, expected="pictures", got="none", do=do))
            if self.log is None or not seen:
                return
            if not fault and not stopped.is_set():
                self.log(f"{found} It is reopened each second.")
            fault = found
            stopped.wait(AGAIN_S)

    def _set_up(self, device: Device) -> None:
        name, size = self.stream.name, flipped_shape(self.stream.movie.frame_shape, self.flip)[::-1]
        wanted = _features(self.keys, size) if self.keys else ()
        if refused := ", ".join(filter(None, (_refused(device, feature, value) for feature, value in wanted))):
            do = f"correct camera: {name}: in experiment.yaml"
            raise MovieError(refusal(self.name, expected="a device that accepts its settings", got=refused, do=do))
        form = str(device.get("PixelFormat"))
        if not form.removeprefix("Mono").isdecimal():
            do = f"set its PixelFormat to Mono8 or Mono16, or add pixel_format under camera: {name}: in experiment.yaml"
            raise MovieError(refusal(self.name, expected="grey pictures", got=form, do=do))

    def _fitting(self, shot: RawPicture) -> RawPicture:
        """Return a picture in the movie's orientation. Raises MovieError: of another size or type."""
        if (picture := shot.picture) is None:
            return shot
        height, width = flipped_shape(self.stream.movie.frame_shape, self.flip)
        kind = self.stream.movie.dtype
        if (*picture.shape, picture.dtype) != (height, width, kind):
            got = f"{picture.shape[1]} x {picture.shape[0]} px {picture.dtype}"
            do = "set the camera to the size and depth of the movie that the experiment names"
            raise MovieError(refusal(self.name, expected=f"{width} x {height} px {kind}", got=got, do=do))
        return shot if self.flip == "none" else replace(shot, picture=flipped_picture(picture, self.flip))


@contextmanager
def worded(name: str) -> Iterator[None]:
    """Raise MovieError for any error of a driver."""
    try:
        yield
    except MovieError:
        raise
    except Exception as error:  # errors differ between drivers
        do = "check that the maker's viewer shows its pictures"
        raise MovieError(refusal(name, expected="a working camera", got=error_words(error), do=do)) from None


def device_frames(cameras: Sequence[LiveCamera], log: Log, stopped: Event) -> Iterator[Arrival]:
    """Yield the instants of cameras until `stopped` or a single camera ends. Raises as `LiveCamera`, `Instants`."""
    instants, waiting = Instants([one.stream.name for one in cameras], log), set(range(len(cameras)))
    triggered = any(one.keys is not None and one.keys.trigger not in (None, "none") for one in cameras)
    pictures: Iterator[Came] = ((0, shot) for shot in cameras[0].pictures(stopped))
    for came in pictures if len(cameras) == 1 else _side_by_side(cameras, stopped, lambda: instants.due_s):
        if came is not None and came[1] is not None:
            instants.take(came[0], came[1])
            triggered = False
        elif came is not None:
            instants.restart(came[0])
            waiting.discard(came[0])
            if triggered and not waiting:
                log("waiting for the first trigger.")
                triggered = False
        yield from instants.ready(time.perf_counter())


def _side_by_side(cameras: Sequence[LiveCamera], stopped: Event, due_s: Callable[[], float]) -> Iterator[Came]:
    """Yield the pictures of cameras, each read in a thread, as they come; None: one was due and none came."""
    waiting: SimpleQueue[Came | Exception] = SimpleQueue()

    def read(number: int) -> None:
        try:
            for shot in cameras[number].pictures(stopped):
                waiting.put((number, shot))
        except Exception as error:  # raised in the iterating thread
            waiting.put(error)

    threads = [Thread(target=read, args=(k,), name=one.name, daemon=True) for k, one in enumerate(cameras)]
    try:
        for thread in threads:
            thread.start()
        while not stopped.is_set():
            try:
                came = waiting.get(timeout=min(max(0.0, due_s() - time.perf_counter()), WAIT_S))
            except Empty:
                yield None
                continue
            if isinstance(came, Exception):
                raise came
            yield came
    finally:
        stopped.set()
        for thread in threads:
            thread.join(RELEASE_S)
