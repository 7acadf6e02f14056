"""All errors that sphereorient raises on purpose; and reasons and flags of a track's frames, which are no errors.

Every message is worded by `refusal`: what was checked, what was expected, what came, what to do.
"""

from enum import IntFlag, StrEnum
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor


class SphereOrientError(Exception):
    """Base of all errors that a user can mend; the command line prints it as one line."""


class ShapeError(SphereOrientError, ValueError):
    """A tensor has the wrong shape, type or values for the function."""


class CameraError(SphereOrientError):
    """Camera parameters are missing, impossible, or do not belong to the picture."""


class MovieError(SphereOrientError):
    """A movie is missing, unreadable, empty, or does not match another one."""


class TextureError(SphereOrientError):
    """A texture map is missing, unreadable or not 2:1."""


class PaintError(SphereOrientError):
    """No texture map can be learnt from the movies."""


class ExperimentError(SphereOrientError):
    """An experiment file is missing, malformed or inconsistent."""


class SettingsError(SphereOrientError, ValueError):
    """A setting is unknown, or its value is impossible."""


class TrackError(SphereOrientError):
    """A file is not a track, or of an unreadable version."""


class CheckpointError(SphereOrientError):
    """A file is not a trained proposer, of an unreadable version, or for another sphere."""


class BenchError(SphereOrientError):
    """Results of a benchmark are missing, damaged, or of another version or plan."""


class OutputError(SphereOrientError):
    """A result cannot be written."""


class Reason(StrEnum):
    """Why a camera has no orientation in a frame; `OK` if it has one."""

    OK = "ok"
    NOT_FOUND = "not_found"
    OUTLINE = "outline"
    DARK = "dark"
    SATURATED = "saturated"
    REPEATED = "repeated"
    RUNAWAY = "runaway"
    LOW_SCORE = "low_score"
    UNSEEN = "unseen"  # it shows unseen paint
    AMBIGUOUS = "ambiguous"
    CONTRADICTS = "contradicts"  # its line of sight misses the other camera's sphere
    SECOND_BALL = "second_ball"  # the same in a movie with two balls: it may show the other one
    HIDDEN = "hidden"  # another sphere covers it
    UNDECODABLE = "undecodable"
    MISSING = "missing"


class Flag(IntFlag):
    """Special properties of a frame: bits of the dataset `flags`."""

    POSITION_INTERPOLATED = 1
    POSITION_OUTLIER_REPLACED = 2
    ONE_CAMERA = 4
    REPAIRED_FROM_OTHER_CAMERA = 8
    AMBIGUOUS = 16
    DOUBTFUL_FIT = 32
    RECOVERED = 64
    SPIKE = 128
    EXTRAPOLATED = 256
    CONTRADICTION = 512
    IDENTITY = 1024  # the sphere may be another one, see the dataset `identity`


def refusal(name: str, *, expected: str, got: str, do: str) -> str:
    """Return a refusal as one line; `name` is the object with its file, `do` the remedy, without full stop."""
    return f"{name}: expected {expected}, got {got}; {do}."


def error_words(error: Exception) -> str:
    """Return the error of a library or the system as one line of at most 200 characters."""
    text = str(getattr(error, "strerror", None) or error)
    return f"'{text.splitlines()[0][:200]}'" if text else type(error).__name__


def tensor_of(name: str, values: Any) -> "Tensor":
    """Return a tensor, or an array or numbers as one; refuse anything else (ShapeError)."""
    import torch  # takes a second, not needed for `sphereorient --help`

    try:
        return torch.as_tensor(values)
    except (TypeError, ValueError, RuntimeError) as error:
        got, do = type(values).__name__, "pass a NumPy array or a tensor; `load_texture` reads the file of a map"
        raise ShapeError(refusal(name, expected="numbers", got=got, do=do)) from error


def check_finite(name: str, tensor: "Tensor") -> None:
    """Refuse a tensor with NaN or infinite values (ShapeError)."""
    if unknown := int((~tensor.isfinite()).sum()):
        do = "leave these frames out, or fill the pixels with the background"
        got = f"{unknown} of {tensor.numel()} NaN or infinite"
        raise ShapeError(refusal(name, expected="finite grey levels", got=got, do=do))


def check_tail(name: str, tensor: "Tensor", *tail: int) -> None:
    """Refuse a tensor whose last axes are not `tail`, after any leading shape (ShapeError)."""
    if tuple(tensor.shape[-len(tail) :]) != tail:
        expected = ", ".join(["...", *map(str, tail)])
        raise ShapeError(
            refusal(name, expected=f"shape ({expected})", got=str(tuple(tensor.shape)), do="put these axes last")
        )
