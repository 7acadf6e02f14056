"""Build hooks of the package: compile its C sources where there is a compiler; the text that a package index shows."""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
import sysconfig
from itertools import product
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

NAMES = "so3.c", "sphere/texture_table.c", "pose/refine.c", "motion/kalman.c", "mapping/paint_cells.c"
SOURCES = [Path("sphereorient", name) for name in NAMES]
# Fused multiplication and addition would give other bits on other processors.
FLAGS = ["-std=c11", "-O3", "-fPIC", "-shared", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=off"]
X86 = {"avx2": ["-march=x86-64-v3"], "avx512": ["-march=x86-64-v4"]}
# Platform of a wheel, which WHEEL_FOR names, and its name in Zig, whose compiler (package ziglang) builds for all.
TARGETS = {
    "manylinux_2_17_x86_64": "x86_64-linux-gnu.2.17",
    "manylinux_2_17_aarch64": "aarch64-linux-gnu.2.17",
    "macosx_11_0_x86_64": "x86_64-macos.11.0",
    "macosx_11_0_arm64": "aarch64-macos.11.0",
    "win_amd64": "x86_64-windows-gnu",
    "win_arm64": "aarch64-windows-gnu",
}


class Compiled(BuildHookInterface):
    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        wanted = os.environ.get("WHEEL_FOR")
        compiler, on = [os.environ.get("CC", "cc")], platform.machine().lower()
        tag = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        if wanted:
            compiler, on = [sys.executable, "-m", "ziglang", "cc", "-s", "-target", TARGETS[wanted]], wanted
            tag = wanted
        kinds = {"default": [], **(X86 if on.endswith(("x86_64", "amd64")) else {})}
        for source, (kind, flags) in product(SOURCES, kinds.items()):
            target = source.with_name(f"{source.stem}.{kind}.compiled")
            flags = [flag.replace("x86-64-", "x86_64_") if wanted else flag for flag in flags]
            command = [*compiler, *FLAGS, *flags, str(source), "-o", str(target), "-lm"]
            try:
                subprocess.run(command, cwd=self.root, check=True, capture_output=True)
            except (OSError, subprocess.CalledProcessError) as error:
                if wanted:
                    raise
                print(f"{source} is not compiled for {kind} ({error}); slower code is used", file=sys.stderr)
                continue
            build_data["artifacts"].append(str(target))
            build_data["pure_python"] = False
            build_data["tag"] = f"py3-none-{tag}"


class Readme(MetadataHookInterface):
    """README.md without its pictures and links into the repository, which an index does not have."""

    def update(self, metadata: dict[str, Any]) -> None:
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        text = re.sub(r"(!\[[^\]]*\]\((?!https?:)[^)]*\)|<img [^>]*>)\n*", "", text)
        text = re.sub(r"\[([^\]]*)\]\((?!https?:)[^)]*\)", r"\1", text)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
