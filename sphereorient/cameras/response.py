"""The response of a camera: the light of each grey level."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

NODES = 1 << 12  # of the piecewise linear table for 16 bit pictures and means of pictures


@dataclass(frozen=True)
class Response:
    """Light as a function of the grey level, both as shares of full scale: a power, the sRGB curve, or a table."""

    gamma: float = 1.0  # light = grey ** gamma
    srgb: bool = False
    table: tuple[tuple[float, float], ...] = ()  # (grey, light), both increasing, from (0, 0) to (1, 1)

    @property
    def linear(self) -> bool:
        """Whether grey levels are proportional to the light."""
        return self == LINEAR

    def light(self, grey: NDArray[Any], full_scale: float) -> NDArray[np.float32]:
        """Return the light of grey levels (...), in grey levels of a linear camera with the same full scale."""
        if self.linear:
            return np.asarray(grey, np.float32)
        if grey.dtype == np.uint8:
            return np.asarray(_light(self, full_scale, 255.0, 256).take(grey))
        known = _light(self, full_scale, full_scale, NODES)
        return np.asarray(np.interp(grey, np.linspace(0.0, full_scale, NODES), known), np.float32)

    def __str__(self) -> str:
        """Return the response as written in experiment.yaml."""
        if self.table:
            return f"a table of {len(self.table)} levels"
        return "srgb" if self.srgb else "linear" if self.linear else f"gamma {self.gamma:.3g}"


LINEAR, SRGB = Response(), Response(srgb=True)


@lru_cache(maxsize=16)
def _light(response: Response, full_scale: float, brightest: float, count: int) -> NDArray[np.float32]:
    """Return the light of `count` grey levels from 0 to the brightest."""
    grey = np.linspace(0.0, brightest / full_scale, count)
    if response.table:
        light = np.interp(grey, *np.array(response.table).T)
    elif response.srgb:  # IEC 61966-2-1
        light = np.where(grey <= 0.04045, grey / 12.92, ((grey + 0.055) / 1.055) ** 2.4)
    else:
        light = grey**response.gamma
    return np.asarray(full_scale * light, np.float32)
