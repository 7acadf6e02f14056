"""Families of hostile texts: YAML files of all kinds, tables, calibration files of other programs."""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
import yaml
from camera_examples import load_opencv
from hostile_judge import Case, Load, Tally
from hostile_kinds import bombs, garbage, no_files, no_text, spoilt_bytes, spoilt_document
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy
from pydantic import BaseModel

from sphereorient.calibration.document import load_calibration, read_points
from sphereorient.cameras import load_cameras, load_covariance
from sphereorient.cameras.io.openptv import PtvPar, load_openptv, load_ptv_par
from sphereorient.experiment import load_experiment
from sphereorient.methods.settings import load_settings, read_model
from sphereorient.synth import SynthSettings

Generated = SearchStrategy[Case]


@dataclass(frozen=True)
class Family:
    """Inputs of one kind: the file's name, what loads it, written-out cases, and a strategy for more of them."""

    name: str
    file: str
    load: Load
    cases: Callable[[Path], list[Case]]
    more: Callable[[Path], Generated]
    beside: Callable[[Path], None] = lambda folder: None  # writes the files beside it
    many: int = 1  # times as many generated ones as usual

    def run(self, folder: Path, tally: Tally, examples: int, written_out: bool = True) -> Tally:
        """Judge the written-out cases and a number of generated ones, always the same."""
        folder.mkdir(parents=True, exist_ok=True)
        self.beside(folder)
        path = folder / self.file
        for case in self.cases(folder) if written_out else []:
            tally.judge(case, self.load, path)

        @settings(
            max_examples=self.many * examples,
            derandomize=True,
            database=None,
            deadline=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(self.more(folder))
        def judged(case: Case) -> None:
            tally.judge(case, self.load, path)

        if examples:
            judged()
        return tally


POINTS = torch.tensor([[0.0, 0, 0], [3, -2, 5], [-4, 1, 0.5]], dtype=torch.float64)
PINHOLE: dict[str, Any] = {
    "model": "pinhole",
    "image_size": [64, 48],
    "f_px": 80.0,
    "R": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    "T": [0.0, 0.0, 200.0],
}
OTHERS: dict[str, dict[str, Any]] = {
    "tsai": {"f": 45.0, "pixel_pitch": [0.02, 0.02], "sx": 1.0, "centre": [31.5, 23.5], "kappa1": 2.2e-4},
    "brown": {"fx": 80.0, "fy": 81.0, "cx": 31.5, "cy": 23.5, "k": [-0.1, 0.01, 0.0], "p": [1e-3, 1e-3]},
    "telecentric": {"scale": 0.23},
    "openptv": {
        "f": 45.0,
        "pixel_pitch": [0.02, 0.02],
        "centre": [31.5, 23.5],
        "k": [1e-5, 0.0, 0.0],
        "p": [0.0, 0.0],
        "scx": 1.0,
        "she": 0.001,
    },
    "pinhole": {"vfov_deg": 45.0, "centre": [31.0, 23.0]},
}
PORT = {"normal": [0.0, 0.0, -1.0], "offset": 100.0, "thickness": 12.0, "n_glass": 1.49, "n_fluid": 1.36}
PLATE = {"type": "dots", "columns": 13, "rows": 13, "pitch": 8.0, "dot_diameter": 3.2, "fiducial_diameter": 5.0}
PLATE |= {"fiducials": [[0, 0], [3, 0], [0, 2]], "dots": "dark"}
BOARD = {"columns": 8, "rows": 7, "pitch": 8.0}


def camera(model: str) -> dict[str, Any]:
    entry = {key: value for key, value in PINHOLE.items() if key != "f_px"}
    return entry | {"model": model} | OTHERS[model]


def cameras_documents() -> list[dict[str, Any]]:
    covariance = {"parameters": ["f_px", "T_x"], "matrix": [[1.0, 0.5], [0.5, 2.0]]}
    joint = {"parameters": ["cam1.f_px", "cam1.T_x"], "matrix": [[1.0, 0.5], [0.5, 2.0]]}
    schema = {"schema": "sphereorient-cameras/1"}
    each: list[dict[str, Any]] = [schema | {"cameras": {"cam1": camera(model)}} for model in OTHERS]
    return [
        *each,
        schema | {"cameras": {"cam1": PINHOLE | {"port": PORT, "covariance": covariance}}},
        schema | {"cameras": {"cam1": PINHOLE, "cam2": camera("tsai")}, "covariance": joint},
    ]


def experiment_documents() -> list[dict[str, Any]]:
    schema: dict[str, Any] = {"schema": "sphereorient-experiment/1"}
    whole = schema | {
        "name": "mixer",
        "frame_rate": 600.0,
        "exposure": 0.0004,
        "sphere": {"diameter": 18.0, "texture": "texture.png", "fixed": False},
        "masks": {"cam1": "mask.png"},
        "backgrounds": {"cam1": "empty.png"},
        "cameras": "cameras.yaml",
        "movies": {"cam1": "cam1.npy", "cam2": "cam2.npy"},
        "start": {"cam1": 1, "cam2": 0},
        "frames": [0, 240],
        "flow": {"viscosity": 8.0e-6, "dissipation": 1.7, "u_rms": 0.61, "integral_length": 0.03, "integral_time": 0.3},
    }
    short = schema | {
        "frame_rate": 30,
        "sphere": {"diameter": None},
        "cameras": "cameras.yaml",
        "movies": {"cam1": "cam1.npy"},
    }
    return [whole, short]


def calibration_documents() -> list[dict[str, Any]]:
    schema = {"schema": "sphereorient-calibration/1", "image_size": [650, 650], "pixel_pitch": [0.02, 0.02]}
    surveyed = {"pose": 0, "R_lab_plate": PINHOLE["R"], "T_lab_plate": [0.0, 0.0, 0.0]}
    pictures = [{"pose": 0, "cam1": "a.png", "cam2": "b.png"}, {"pose": 12, "cam1": "c.png"}]
    filmed = schema | {"plate": PLATE, "surveyed": surveyed, "pictures": pictures}
    targets: list[dict[str, Any]] = [
        {"type": "chessboard", **BOARD},
        {"type": "charuco", **BOARD, "marker": 6.0, "dictionary": "DICT_4X4_50", "legacy_pattern": False},
        {"type": "circles", **BOARD, "dot_diameter": 3.0, "asymmetric": True, "dots": "dark"},
    ]
    tables = schema | {"points": {"cam1": "points.csv"}, "model": "brown"}
    ports = {"ports": {"cam1": PORT}, "fit_ports": ["port_offset", "port_tilt_x"]}
    return [filmed | ports, tables, *(filmed | {"plate": target} for target in targets)]


def yaml_family(name: str, file: str, load: Load, documents: list[dict[str, Any]], beside: Any = None) -> Family:
    texts = [yaml.safe_dump(document, sort_keys=False).encode() for document in documents]

    def cases(folder: Path) -> list[Case]:
        return [*no_files(texts[0]), *no_text(texts[0]), *bombs(texts[0].decode())]

    def more(folder: Path) -> Generated:
        document = spoilt_document(documents)
        return st.one_of(document, document, document, spoilt_bytes(texts), garbage())

    return Family(name, file, load, cases, more, beside or (lambda folder: None))


def use_cameras(path: Path) -> None:
    """Load cameras, and let those that pass show points: an accepted camera must work."""
    cameras = load_cameras(path)
    load_covariance(path, cameras)
    for one in cameras.values():
        one.project(POINTS)
        one.rays(POINTS[:, :2])


def use_settings(load: Callable[[Path], BaseModel]) -> Load:
    """Load settings, and look for numbers that are none in those that pass."""

    def used(path: Path) -> None:
        _check_finite(load(path).model_dump())

    return used


def _check_finite(value: Any) -> None:
    for inner in value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else ():
        _check_finite(inner)
    assert not isinstance(value, float) or math.isfinite(value), "a number that is none was accepted"


def write_cameras(folder: Path) -> None:
    document = {"schema": "sphereorient-cameras/1", "cameras": {"cam1": PINHOLE, "cam2": PINHOLE}}
    (folder / "cameras.yaml").write_text(yaml.safe_dump(document))


TABLE = "x,y,z,u,v\n" + "".join(f"{k}.5,{2 * k},-{k},{10 * k}.25,{k}\n" for k in range(12))
CELLS = ["", "nan", "inf", "-inf", "1e400", "1,5", "abc", "1_0", "0x10", "\0", "é", '"', "\u2028"]
CELLS += ["x" * 3000, "9" * 5000]


def points_family() -> Family:
    valid = TABLE.encode()
    heads = ["", "x", "x,y,z,u", "a,b,c,d,e", "x,y,z,u,v,v", " x , y , z , u , v ", "x;y;z;u;v", ",,,,", "x\0,y,z,u,v"]

    def cases(folder: Path) -> list[Case]:
        texts = {f"cell {cell[:10]!r}": TABLE.replace("3.5", cell, 1) for cell in CELLS}
        texts |= {f"head {head!r}": TABLE.replace("x,y,z,u,v", head, 1) for head in heads}
        texts |= {
            "an open quote": TABLE.replace("3.5", '"3.5', 1),
            "a field without end": TABLE + '"' + "a" * 200_000,
            "rows too long": TABLE + "1,2,3,4,5,6,7\n",
            "rows too short": TABLE + "1,2\n",
            "only a head": "x,y,z,u,v\n",
            "many columns": ",".join(map(str, range(50_000))) + "\n" + "1," * 50_000 + "\n",
        }
        written = [Case(name, text.encode("utf-8", "surrogatepass")) for name, text in texts.items()]
        return [*no_files(valid), *no_text(valid), *written]

    def more(folder: Path) -> Generated:
        cell = st.tuples(st.integers(0, 11), st.one_of(st.sampled_from(CELLS), st.text(max_size=20)))
        spoilt = cell.map(lambda at: Case("cell", _with_cell(*at).encode("utf-8", "replace")))
        return st.one_of(spoilt_bytes([valid]), spoilt, garbage())

    return Family("points CSV", "points.csv", read_points, cases, more)


def _with_cell(row: int, cell: str) -> str:
    lines = TABLE.splitlines()
    lines[row + 1] = ",".join([cell, *lines[row + 1].split(",")[1:]])
    return "\n".join(lines)


OPENCV = {
    "yml": "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: !!opencv-matrix\n   rows: 3\n"
    "   cols: 3\n   dt: d\n   data: [ 700., 0., 331., 0., 715., 228.5, 0., 0., 1. ]\n"
    "distortion_coefficients: !!opencv-matrix\n   rows: 5\n   cols: 1\n   dt: d\n"
    "   data: [ -0.21, 0.12, 2.0e-03, -1.5e-03, -0.03 ]\nR: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
    "   data: [ 1., 0., 0., 0., 1., 0., 0., 0., 1. ]\nT: !!opencv-matrix\n   rows: 3\n   cols: 1\n   dt: d\n"
    "   data: [ 0., 0., 200. ]\n",
    "xml": '<?xml version="1.0"?>\n<opencv_storage>\n<image_width>640</image_width>\n<image_height>480</image_height>\n'
    '<camera_matrix type_id="opencv-matrix">\n  <rows>3</rows>\n  <cols>3</cols>\n  <dt>d</dt>\n  <data>\n'
    "    700. 0. 331. 0. 715. 228.5 0. 0. 1.</data></camera_matrix>\n"
    '<distortion_coefficients type_id="opencv-matrix">\n  <rows>5</rows>\n  <cols>1</cols>\n  <dt>d</dt>\n  <data>\n'
    "    -0.21 0.12 2.0e-03 -1.5e-03 -0.03</data></distortion_coefficients>\n</opencv_storage>\n",
    "json": '{\n"image_width": 640,\n"image_height": 480,\n"camera_matrix": {"type_id": "opencv-matrix", "rows": 3, '
    '"cols": 3, "dt": "d", "data": [ 700.0, 0.0, 331.0, 0.0, 715.0, 228.5, 0.0, 0.0, 1.0 ]},\n'
    '"distortion_coefficients": {"type_id": "opencv-matrix", "rows": 5, "cols": 1, "dt": "d", '
    '"data": [ -0.21, 0.12, 2.0e-03, -1.5e-03, -0.03 ]}\n}\n',
}
NUMBERS = ["0", "-1", "1e400", ".Nan", ".Inf", "-.Inf", "1e308", "abc", "", "2147483647", "99999999999999999999", "[1]"]
SHAPES = ["0", "-1", "1", "4", "100", "100000", "1000000000", "2147483647", "-2147483648", "99999999999", "1.5", "x"]


def opencv_family(suffix: str) -> Family:
    text = OPENCV[suffix]
    valid = text.encode()
    nested = {"yml": ("a: ", "["), "xml": ("", "<a>"), "json": ('"a": ', "[")}[suffix]

    def cases(folder: Path) -> list[Case]:
        texts = {f"{old} {new}": text.replace(old, new) for old, new in _opencv_changes(suffix)}
        head = text.replace("</opencv_storage>\n", "").replace("\n}\n", ",\n")
        texts |= {f"depth {n}": head + nested[0] + nested[1] * n for n in (100, 5000, 100_000)}
        texts["dashes"] = text + "a: " + "- " * 100_000
        texts["blocks"] = text + "".join(" " * k + "a:\n" for k in range(1200))
        texts["types"] = text.replace("dt: d", "dt: 1000000000d").replace("<dt>d<", "<dt>1000000000d<")
        entities = '<!DOCTYPE a [<!ENTITY a "lol">' + "".join(
            f'<!ENTITY {b} "{("&" + a + ";") * 10}">' for a, b in zip("abcdefgh", "bcdefghi", strict=True)
        )
        texts["entities"] = text.replace("<opencv_storage>", entities + "]>\n<opencv_storage>").replace("640", "&i;")
        written = [Case(name[:60], content.encode()) for name, content in texts.items()]
        return [*no_files(valid), *no_text(valid), *written]

    def more(folder: Path) -> Generated:
        number = st.tuples(st.sampled_from(_numbers_of(text)), st.sampled_from(NUMBERS + SHAPES))
        changed = number.map(lambda pair: Case(f"{pair[0]} {pair[1]}", text.replace(pair[0], pair[1], 1).encode()))
        return st.one_of(changed, spoilt_bytes([valid]), garbage())

    return Family(f"OpenCV {suffix}", f"cam.{suffix}", load_opencv, cases, more)


def _numbers_of(text: str) -> list[str]:
    plain = text.replace(",", " ").replace("<", " ").replace(">", " ").replace("]", " ").replace(":", " ")
    return sorted({word for word in plain.split() if word.strip("-").replace(".", "").replace("e", "").isdigit()})


def _opencv_changes(suffix: str) -> list[tuple[str, str]]:
    key = {"yml": "{}: {}", "json": '"{}": {}', "xml": "<{0}>{1}</{0}>"}[suffix]
    changes = []
    for name, old in (("rows", "3"), ("cols", "3"), ("rows", "5"), ("image_width", "640"), ("image_height", "480")):
        changes += [(key.format(name, old), key.format(name, new)) for new in [*SHAPES, *NUMBERS]]
    data = ["", "1", "[]", "'a b c'", "{a: 1}", "nan nan nan", "1 " * 10_000]
    return (
        changes
        + [("camera_matrix", "K1"), ("opencv-matrix", "opencv-nd-matrix"), ("opencv-matrix", "x")]
        + [("700.", new) for new in [*NUMBERS, *data]]
    )


ORI = (
    "105.2632 102.7458 403.8822\n-0.2383 0.2442 0.0552\n\n0.968 -0.053 0.241\n-0.003 0.973 0.229\n"
    "-0.247 -0.222 0.942\n\n-2.4742 3.2567\n100.0\n\n0.0001 0.00001 150.0\n"
)
ADDPAR = "-0.00001 0.00000002 0.0 0.00002 -0.00003 1.0 0.002\n"
PAR = "2\nimg/cam1.1\ncal/cam1.tif\nimg/cam2.1\ncal/cam2.tif\n1\n0\n1\n1280\n1024\n0.012\n0.011\n0\n1\n1.49\n1.33\n6\n"
TANK = PtvPar(image_size=(1280, 1024), pixel_pitch_mm=(0.012, 0.011), n_glass=1.49, n_fluid=1.33, thickness_mm=6.0)
WORDS = ["nan", "inf", "-inf", "1e400", "1e308", "-1e308", "1e-320", "0", "-1", "abc", "9" * 5000, "9" * 200, "\0", "é"]
WORDS += ["1_0"]


def load_ori(path: Path) -> None:
    load_openptv(path, TANK).project(POINTS)


def load_addpar(path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        load_openptv(path.with_name("good.ori"), TANK, path).project(POINTS)


def load_par(path: Path) -> None:
    load_openptv(path.with_name("good.ori"), load_ptv_par(path)).project(POINTS)


def openptv_family(suffix: str) -> Family:
    text, load = {"ori": (ORI, load_ori), "addpar": (ADDPAR, load_addpar), "par": (PAR, load_par)}[suffix]

    def with_word(at: int, word: str) -> Case:
        words = text.split()
        at %= len(words)
        return Case(f"word {at} {word[:10]}", "\n".join([*words[:at], word, *words[at + 1 :]]).encode())

    def cases(folder: Path) -> list[Case]:
        counts = ["-1", "0", "99999999999", "9" * 4000, "9" * 5000, "²", "٣", "1.0", "nan"]
        many = [Case("more", (text * 3).encode()), Case("a million words", b"1 " * 1_000_000)]
        return [*no_files(text.encode()), *no_text(text.encode()), *(with_word(0, word) for word in counts), *many]

    def more(folder: Path) -> Generated:
        word = st.tuples(st.integers(0, 20), st.one_of(st.sampled_from(WORDS), st.floats().map(repr)))
        changed = word.map(lambda pair: with_word(*pair))
        return st.one_of(changed, spoilt_bytes([text.encode()]), garbage())

    def beside(folder: Path) -> None:
        (folder / "good.ori").write_text(ORI)

    return Family(f"OpenPTV {suffix}", f"cam.{suffix}", load, cases, more, beside)


@functools.cache
def text_families() -> dict[str, Family]:
    """All families of texts by name."""
    settings_tree = load_settings().model_dump(mode="json")
    synth_tree = SynthSettings().model_dump(mode="json")
    families = [
        yaml_family("experiment.yaml", "experiment.yaml", load_experiment, experiment_documents(), write_cameras),
        yaml_family("cameras.yaml", "cameras.yaml", use_cameras, cameras_documents()),
        yaml_family("calibration.yaml", "calibration.yaml", load_calibration, calibration_documents()),
        yaml_family("settings", "settings.yaml", use_settings(load_settings), [settings_tree]),
        yaml_family("synth settings", "synth.yaml", use_settings(partial(read_model, SynthSettings)), [synth_tree]),
        points_family(),
        *(opencv_family(suffix) for suffix in OPENCV),
        *(openptv_family(suffix) for suffix in ("ori", "addpar", "par")),
    ]
    return {family.name: family for family in families}
