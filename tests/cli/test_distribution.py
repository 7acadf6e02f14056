"""The wheel and the source distribution, used in an environment of their own."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest
from conftest import REPO

EXCERPT = REPO / "synthetic_data" / "excerpt"
EXTRAS = ("pandas", "pyarrow", "xarray", "distributed", "pynwb")


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a wheel that was built from the source distribution, and of that."""
    folder = tmp_path_factory.mktemp("dist")
    pip = [sys.executable, "-m", "pip"]
    build = "import sys; from hatchling.build import build_sdist; build_sdist(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build, str(folder)], check=True, cwd=REPO)
    (source,) = folder.glob("*.tar.gz")
    subprocess.run(
        [*pip, "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", str(folder), str(source)], check=True
    )
    return folder


@pytest.fixture(scope="module")
def python(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of an environment with the wheel, its requirements, and no extra."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False, symlinks=True)
    own = Path(sysconfig.get_path("purelib", vars={"base": str(folder)}))
    (wheel,) = built.glob("*.whl")
    pip = [sys.executable, "-m", "pip", "--python", str(folder / "bin" / "python")]
    subprocess.run([*pip, "install", "-q", "--no-deps", "--no-index", str(wheel)], check=True)
    # The wheel's requirements are installed already; the project's folder is not on this path.
    (own / "required.pth").write_text(sysconfig.get_path("purelib") + "\n")
    hidden = "".join(f"sys.modules[{name!r}] = None\n" for name in EXTRAS)
    (own / "sitecustomize.py").write_text(f"import sys\n{hidden}")
    return folder / "bin" / "python"


def run(python: Path, folder: Path, *words: object) -> str:
    command = [str(python), *map(str, words)]
    apart = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=500, env=apart)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow  # builds and installs
def test_the_wheel_tracks_reports_and_exports_without_an_extra(python, tmp_path):
    assert str(python.parents[1]) in run(python, tmp_path, "-c", "import sphereorient; print(sphereorient.__file__)")
    command, experiment = ("-m", "sphereorient.cli"), EXCERPT / "experiment.yaml"
    assert "Commands:" in run(python, tmp_path, *command, "--help")
    run(python, tmp_path, *command, "track", experiment, "--out", "track.h5", "-q")
    run(python, tmp_path, *command, "report", "track.h5", "--experiment", experiment, "--out", "report", "-q")
    run(python, tmp_path, *command, "export", "track.h5", "--to", "csv", "--out", "track.csv", "-q")
    assert (tmp_path / "report" / "index.html").is_file()
    assert (tmp_path / "track.csv").read_text().count("\n") > 40


@pytest.mark.slow
def test_wheel_and_source_distribution_hold_the_right_files(built):
    (wheel,), (source,) = built.glob("*.whl"), built.glob("*.tar.gz")
    names = zipfile.ZipFile(wheel).namelist()
    assert all(name.startswith("sphereorient") for name in names)  # no tests, no data
    for needed in ("sphereorient/pose/refine.c", "sphereorient/py.typed"):
        assert needed in names
    assert any(name.endswith("LICENSE") for name in names)
    (metadata,) = [name for name in names if name.endswith("/METADATA")]
    text = zipfile.ZipFile(wheel).read(metadata).decode()
    assert "text/markdown" in text
    assert "sphereorient track experiment.yaml" in text
    assert "](" not in text.replace("](http", ""), "a package index has no such files"
    with tarfile.open(source) as packed:
        inside = packed.getnames()
    for needed in ("scripts/build_compiled.py", "README.md", "LICENSE", "CITATION.cff"):
        assert any(name.endswith(needed) for name in inside), needed
    assert not any("/.venv/" in name or "/out/" in name for name in inside)
