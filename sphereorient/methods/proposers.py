"""The choice of proposer: template search or trained network."""

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.cameras import Camera
from sphereorient.files.cache import cached
from sphereorient.follow.initialise import Initialiser
from sphereorient.methods.settings import Settings
from sphereorient.pose import Fitter, base_table
from sphereorient.pose.camera_view import defocus_radii
from sphereorient.search import FallbackProposer, GreySearch, Proposer, TemplateBank
from sphereorient.search.settings import GreySearchSettings, ProposeSettings
from sphereorient.sphere.texture_table import TextureTable

NEAR_RADII = 8.0  # for a farther ball, the bank's perspective errs by less than half a grid step
DEFAULT = "default"  # the bundled checkpoint
Search = TypeVar("Search", GreySearch, TemplateBank)


def precise_proposer(texture: Tensor, settings: Settings, blur: float = 0.0) -> Proposer:
    """Return the proposer of the precise method for a map (H, 2 H), 0 black .. 1 white, and a blur, radii (0: sharp).
    Raise CheckpointError if the checkpoint cannot be used with this map.
    """
    make = partial(GreySearch, texture, settings.search, blur)
    inputs = texture, settings.search.model_dump_json(), blur
    return _proposer(texture, settings.propose, lambda: _with_bank("bank", inputs, make))


def _with_bank(kind: str, inputs: Iterable[Tensor | str | float], make: Callable[..., Search]) -> Search:
    """Return a template search; its bank, whole numbers -127 .. 127, is cached between runs; `make` may be given it."""
    made: list[Search] = []

    def bank() -> dict[str, NDArray[Any]]:
        made.append(make())
        return {"bank": made[0].bank.to(torch.int8).numpy()}

    kept = cached(kind, inputs, bank)
    return made[0] if made else make(torch.from_numpy(kept["bank"]))


def finest_table(texture: Tensor, diameter_px: float, unseen: Tensor | None) -> TextureTable:
    """Return `base_table`, cached between runs."""
    inputs = texture, diameter_px, unseen
    return TextureTable.of(cached("table", inputs, lambda: base_table(texture, diameter_px, unseen).arrays()))


class BlurMatchedSearch:
    """Proposers by blur for a map (H, 2 H): one template bank for sharp pictures, others made on demand.
    `diameters_px`: expected diameter of the sphere, px, in each camera. The bank has the nearest camera's perspective.
    """

    def __init__(self, texture: Tensor, settings: Settings, diameters_px: Sequence[tuple[Camera, float]]) -> None:
        self.diameter_px = max(diameter_px for _, diameter_px in diameters_px)
        search = as_near(settings.search, diameters_px)
        self._texture, self._settings = texture, settings.model_copy(update={"search": search})
        self._made: dict[float, Proposer] = {}

    def of(self, blur_px: float) -> Proposer:
        """Return the proposer for pictures of a blur, px."""
        blur = defocus_radii(blur_px, self.diameter_px)
        if blur not in self._made:
            self._made[blur] = precise_proposer(self._texture, self._settings, blur)
        return self._made[blur]

    def start(self, fitter: Fitter, blur_px: float, **more: Any) -> Initialiser:
        """Return the initialiser for pictures of a blur, px; `more`: its other fields."""
        return Initialiser(
            fitter=fitter,
            proposers=dict.fromkeys((view.name for view in fitter.views), self.of(blur_px)),
            locating=self._settings.locate,
            candidates=self._settings.refine.candidates,
            **more,
        )


def as_near(settings: GreySearchSettings, diameters_px: Sequence[tuple[Camera, float]]) -> GreySearchSettings:
    """Return settings of a search whose bank has the perspective of the nearest of these cameras, each with the
    sphere's expected diameter, px; a given distance stays.
    """
    if settings.distance_radii is not None:
        return settings
    near = _distance_radii(*max(diameters_px, key=lambda pair: pair[1]))
    return settings.model_copy(update={"distance_radii": near})


def _distance_radii(camera: Camera, diameter_px: float) -> float | None:
    """Return the distance, radii, of a ball of this diameter at the centre of a picture; None without perspective."""
    middle = (torch.tensor(camera.image_size, dtype=torch.float64) - 1) / 2
    aside = torch.tensor([diameter_px / 2, 0.0], dtype=torch.float64)
    rim = camera.rays(torch.stack([middle - aside, middle + aside])).direction_lab
    half_rad = 0.5 * float(torch.linalg.cross(*rim).norm().clamp(max=1.0).asin())
    distance = 1 / max(math.sin(half_rad), 1e-9)
    return round(distance, 1) if distance < NEAR_RADII else None


def paper_proposer(texture: Tensor, size_px: int, settings: Settings) -> Proposer:
    """Return the proposer of the paper's method; templates are for disks of `size_px`."""
    make = partial(TemplateBank, texture, size_px, settings.orient)
    inputs = texture, size_px, settings.orient.model_dump_json()
    return _proposer(texture, settings.propose, lambda: _with_bank("templates", inputs, make))


def _proposer(texture: Tensor, settings: ProposeSettings, templates: Callable[[], Proposer]) -> Proposer:
    network = trained_network(texture, settings)
    if network is None:
        return templates()
    return network if settings.when == "always" else FallbackProposer(templates(), network, settings.sure)


def trained_network(texture: Tensor, settings: ProposeSettings) -> Proposer | None:
    """Return the network of a checkpoint; None if the settings name none."""
    if settings.checkpoint is None:
        return None
    # Late import: most runs use no network.
    from sphereorient.learn.checkpoint import check_texture, correlator_of, load_checkpoint
    from sphereorient.learn.network import LearnedProposer

    checkpoint = load_checkpoint(checkpoint_path(settings.checkpoint))
    check_texture(checkpoint, texture)
    return LearnedProposer(correlator_of(checkpoint), texture, temperature=checkpoint.temperature)


def checkpoint_path(named: str) -> Path:
    """Return the file of a checkpoint; `default` is the bundled one."""
    from sphereorient.learn.network import DEFAULT_CHECKPOINT

    return DEFAULT_CHECKPOINT if named == DEFAULT else Path(named)
