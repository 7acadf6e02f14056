"""Fiducials of a plate, clicked in the browser where `calibrate` does not find them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.calibration.document import Photo, checked_clicks, load_calibration
from sphereorient.calibration.dots import Dots, find_dots
from sphereorient.calibration.lattice import index_dots
from sphereorient.calibration.plates import read_plate_picture
from sphereorient.calibration.targets import FIDUCIALS, DotPlate
from sphereorient.errors import CameraError
from sphereorient.files.page_server import Answer, Json
from sphereorient.files.picture import eight_bits
from sphereorient.preflight.mark import Marking, png


class FiducialMarking(Marking):
    """A calibration.yaml with pictures of a plate of dots."""

    page = "mark_fiducials.html"
    error = CameraError

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.document = load_calibration(self.path)
        if not isinstance(self.document.plate, DotPlate):
            expected, do = "pictures of a plate with fiducials, of type dots", "nothing needs to be clicked here"
            raise self.refused(str(self.path), expected, "other points", do)
        self.plate = self.document.plate
        self.clicked = {it: it.clicked_px for it in self.document.pictures}
        self.dots: dict[Photo, Dots] = {}

    def shown(self, steps: Sequence[str]) -> Answer:
        """Return the state, a picture, or its detected dots."""
        match steps:
            case ["state"]:
                return self.state()
            case ["picture", number] if number.isdecimal():
                return png(eight_bits(self._grey(self._picture(number))))
            case ["view", number] if number.isdecimal():
                picture = self._picture(number)
                return self.view(picture, self.clicked.get(picture))
        return super().shown(steps)

    def done(self, steps: Sequence[str], asked: Mapping[str, Any]) -> Json | None:
        """Try or save the clicked `points` of a picture."""
        match steps:
            case ["try" | "save" as what, number] if number.isdecimal():
                picture, points = self._picture(number), asked.get("points")
                return (
                    self.save(picture, points) if what == "save" else self.view(picture, self._checked(picture, points))
                )
        return None

    def state(self) -> Json:
        """Return the initial state of the page."""
        width, height = self.document.keys.image_size
        return {
            "file": str(self.path),
            "width": width,
            "height": height,
            "fiducials": dict(zip(FIDUCIALS, self.plate.fiducials, strict=True)),
            "pictures": [
                {"name": picture.path.name, "camera": picture.camera, "pose": self.document.poses[picture.row]}
                for picture in self.document.pictures
            ],
        }

    def view(self, picture: Photo, clicked: NDArray[np.float64] | None) -> Json:
        """Return dots, identified points and fiducials of a picture with clicked places, None or (2 or 3, 2) px, as
        JSON.
        """
        with self.lock:
            if picture not in self.dots:
                self.dots[picture] = find_dots(self._grey(picture), dark=self.plate.dark)
            dots = self.dots[picture]
        view = index_dots(dots, self.plate, picture.path.name, clicked)
        tied = view.state == "tied"
        at = [view.uv_px[tied & (view.index == mark).all(axis=1)] for mark in self.plate.fiducials]
        return {
            "tied": tied,
            "reason": view.reason,
            "dots": np.column_stack([dots.uv_px, np.sqrt(dots.area_px / np.pi)]).round(2).tolist(),
            "points": view.uv_px.round(2).tolist() if tied else [],
            "fiducials": [uv_px[0].round(2).tolist() if len(uv_px) else None for uv_px in at],
            "clicked": None if clicked is None else clicked.tolist(),
        }

    def save(self, picture: Photo, points: Any) -> Json:
        """Write clicked places into the file; return the view with them. Raises CameraError (impossible or insufficient
        places, or a file that cannot be changed safely), OutputError (the file cannot be written).
        """
        clicked = self._checked(picture, points).round(1)
        view = self.view(picture, clicked)
        if not view["tied"]:
            raise CameraError(view["reason"])
        pose, camera = self.document.poses[picture.row], picture.camera
        with self.lock:
            entries = self._entries()
            here = [k for k, entry in enumerate(entries) if entry.get("pose") == pose and camera in entry]
            by_hand = f"write clicked: {{{camera}: {clicked.tolist()}}} into the entry of pose {pose}"
            if len(here) != 1:
                expected = f"one entry with pose {pose} and {camera}"
                raise self.refused(f"{self.path}, pictures", expected, f"{len(here)}", by_hand)
            old = entries[here[0]].get("clicked") or {}
            self.write(["pictures", here[0], "clicked"], old | {camera: clicked.tolist()}, by_hand)
            self.clicked[picture] = clicked
        return view

    def _entries(self) -> list[Mapping[str, Any]]:
        content = self.read()  # the user may have changed it
        entries = content.get("pictures") if isinstance(content, dict) else None
        return [entry if isinstance(entry, dict) else {} for entry in entries] if isinstance(entries, list) else []

    def _grey(self, picture: Photo) -> NDArray[Any]:
        return read_plate_picture(picture.path, self.document.keys.image_size)

    def _checked(self, picture: Photo, points: Any) -> NDArray[np.float64]:
        return checked_clicks(points, self.document.keys.image_size, f"{picture.path.name}, clicked")

    def _picture(self, number: str) -> Photo:
        if (k := int(number[:9])) >= (count := len(self.document.pictures)):
            raise self.refused(f"picture {k}", f"0 .. {count - 1}", str(k), "choose another")
        return self.document.pictures[k]
