"""Checkpoints: written ones are read, and any other file is refused in one line, nothing executed."""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
import pytest
import torch
from learn_examples import Writer, state_of, tiny, untrained

from sphereorient.errors import CheckpointError
from sphereorient.learn import checkpoint as module
from sphereorient.learn.checkpoint import (
    SCHEMA,
    Checkpoint,
    check_texture,
    correlator_of,
    load_checkpoint,
    save_checkpoint,
    texture_sha256,
)
from sphereorient.sphere import load_texture
from sphereorient.sphere.texture import random_texture

ABOUT = {"torch": "2.6", "steps": 100, "validation_ece": 0.02}


def example(**changes: Any) -> Checkpoint:
    whole = Checkpoint(settings=tiny(), state=state_of(untrained()), temperature=0.4, about=ABOUT)
    return whole.model_copy(update=changes)


def refused(path: Path) -> str:
    with pytest.raises(CheckpointError) as caught:
        load_checkpoint(path)
    text = str(caught.value)
    assert "\n" not in text
    assert text.endswith(".")
    assert len(text) < 400
    assert path.name in text
    return text


def tree_of(path: Path) -> dict[str, Any]:
    save_checkpoint(path, example())
    return torch.load(path, weights_only=True)


def test_what_is_written_is_read(tmp_path):
    path = tmp_path / "proposer.ckpt"
    written = example(texture_sha256="ab" * 32)
    save_checkpoint(path, written)
    read = load_checkpoint(path)
    assert (read.settings, read.temperature, read.texture_sha256) == (tiny(), 0.4, "ab" * 32)
    assert dict(read.about) == ABOUT
    assert read.state.keys() == written.state.keys()
    assert all(torch.equal(read.state[name], tensor) for name, tensor in written.state.items())
    assert [entry.name for entry in tmp_path.iterdir()] == ["proposer.ckpt"]


def test_the_same_checkpoint_gives_the_same_bytes(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        save_checkpoint(tmp_path / folder / "proposer.ckpt", example())
    assert (tmp_path / "a" / "proposer.ckpt").read_bytes() == (tmp_path / "b" / "proposer.ckpt").read_bytes()


def test_the_network_of_a_checkpoint_predicts_the_same_as_before(tmp_path, rng):
    save_checkpoint(tmp_path / "proposer.ckpt", example())
    network = correlator_of(load_checkpoint(tmp_path / "proposer.ckpt"))
    disks, blurs = 100 * torch.rand(2, 24, 24, generator=rng), torch.randn(32 * 32, 7, generator=rng)
    with torch.no_grad():
        assert torch.equal(network(disks, blurs), untrained()(disks, blurs))
    assert not network.training
    assert not any(parameter.requires_grad for parameter in network.parameters())


@pytest.mark.parametrize("form", ["torch", "pickle", "legacy", "in the weights"])
def test_code_in_a_file_is_not_executed(tmp_path, form):
    mark, path = tmp_path / "mark.txt", tmp_path / "evil.ckpt"
    if form == "pickle":
        path.write_bytes(pickle.dumps(Writer(mark)))
    elif form == "legacy":
        torch.save({"schema": SCHEMA, "state": Writer(mark)}, path, _use_new_zipfile_serialization=False)
    elif form == "in the weights":
        tree = tree_of(path)
        torch.save({**tree, "state": {**tree["state"], "gain": Writer(mark)}}, path)
    else:
        torch.save({"schema": SCHEMA, "state": Writer(mark)}, path)
    text = refused(path)
    assert not mark.exists()
    if form in ("torch", "in the weights"):
        assert "code" in text
        torch.load(path, weights_only=False)  # otherwise it would have done so
        assert mark.exists()


def archived_again(path: Path, left_out: int = 0, claimed: int = 0) -> None:
    """A checkpoint without its last entries, or whose last one claims so many bytes."""
    save_checkpoint(path, example())
    whole = zipfile.ZipFile(path)
    with zipfile.ZipFile(path.with_suffix(".other"), "w") as other:
        for entry in whole.infolist()[: len(whole.infolist()) - left_out]:
            other.writestr(entry, whole.read(entry))
        if claimed:
            other.filelist[-1].file_size = claimed
    path.with_suffix(".other").replace(path)


def half(path: Path) -> None:
    save_checkpoint(path, example())
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])


def flipped(path: Path) -> None:
    save_checkpoint(path, example())
    content = bytearray(path.read_bytes())
    start = content.index(b"data.pkl") + 80
    content[start : start + 200] = b"\x80" * 200
    path.write_bytes(bytes(content))


def without_weights(path: Path) -> None:
    archived_again(path, 8)


def packed(path: Path) -> None:
    """Few bytes that grow to a hundred million."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", b"\0" * 100_000_000)


def claims_much(path: Path) -> None:
    """One whose directory claims an entry larger than the file."""
    archived_again(path, claimed=2_000_000_000)


def other_archive(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "not this one")


def large(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(module.LARGEST_BYTES + 1)


FILES: dict[str, tuple[Callable[[Path], object], str]] = {
    "nothing": (lambda path: None, "got no such file"),
    "folder": (Path.mkdir, "got a folder"),
    "empty": (lambda path: path.write_bytes(b""), "another file"),
    "random bytes": (lambda path: path.write_bytes(np.random.default_rng(0).bytes(5000)), "another file"),
    "half": (half, "the beginning of one"),
    "flipped": (flipped, "expected a file of weights"),
    "without weights": (without_weights, "expected a file of weights"),
    "packed": (packed, "compressed"),
    "claims much": (claims_much, "claims more"),
    "other archive": (other_archive, "expected a file of weights"),
    "large": (large, "at most 64 MB"),
    "list": (lambda path: torch.save([1, 2], path), SCHEMA),
    "tensor": (lambda path: torch.save(torch.zeros(3), path), SCHEMA),
    "module": (lambda path: torch.save(untrained(), path), "code"),
    "bare state": (lambda path: torch.save(state_of(untrained()), path), SCHEMA),
}


@pytest.mark.parametrize("case", FILES)
def test_a_file_that_is_none_is_refused_in_one_line(tmp_path, case):
    make, words = FILES[case]
    make(tmp_path / "some.ckpt")
    assert words in refused(tmp_path / "some.ckpt")


def other_weight(value: Any) -> dict[str, Any]:
    return {"state": {**state_of(untrained()), "gain": value}}


def changed_network(**changes: Any) -> dict[str, Any]:
    tree = tiny().model_dump(mode="json")
    return {"settings": {**tree, "network": {**tree["network"], **changes}}}


LESS = {name: tensor for name, tensor in state_of(untrained()).items() if name != "gain"}
CHANGES: dict[str, tuple[dict[str, Any], str]] = {
    "later version": ({"schema": "sphereorient-proposer/2"}, "sphereorient-proposer/2"),
    "schema of many letters": ({"schema": "x" * 10_000}, "'xxx"),
    "key too many": ({"optimizer": 1}, "optimizer"),
    "weight missing": ({"state": LESS}, "gain"),
    "weight too many": ({"state": {**state_of(untrained()), "extra": torch.zeros(1)}}, "extra"),
    "shape": (other_weight(torch.zeros(2)), "shape (), got (2,)"),
    "dtype": (other_weight(torch.tensor(0.0, dtype=torch.float64)), "torch.float64"),
    "a number": (other_weight(0.0), "state.gain"),
    "nan": (other_weight(torch.tensor(float("nan"))), "gain: expected finite"),
    "sparse": (other_weight(torch.zeros(()).to_sparse()), "gain"),
    "another width": (changed_network(width=12), "expected shape"),
    "impossible width": (changed_network(width=10_000), "settings.network.width"),
    "unknown setting": (changed_network(depth=3), "settings, network"),
    "settings that contradict each other": (changed_network(size_px=32), "size_px"),
    "temperature of 0": ({"temperature": 0.0}, "temperature"),
    "temperature as text": ({"temperature": "1"}, "temperature"),
    "hash of another length": ({"texture_sha256": "ab"}, "texture_sha256"),
    "about a list": ({"about": [1]}, "about"),
    "about long": ({"about": {"a": "x" * 10_000}}, "about"),
}


@pytest.mark.parametrize("case", CHANGES)
def test_a_changed_checkpoint_is_refused_in_one_line(tmp_path, case):
    change, words = CHANGES[case]
    path = tmp_path / "changed.ckpt"
    torch.save({**tree_of(path), **change}, path)
    assert words in refused(path)


def test_a_checkpoint_that_would_be_refused_is_not_written(tmp_path):
    with pytest.raises(CheckpointError, match="finite"):
        save_checkpoint(tmp_path / "bad.ckpt", example(**other_weight(torch.tensor(float("nan")))))
    assert not list(tmp_path.iterdir())


def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch):
    path = tmp_path / "proposer.ckpt"
    save_checkpoint(path, example())
    before = path.read_bytes()

    def full(tree: Any, aside: IO[bytes]) -> None:
        aside.write(b"some")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.torch, "save", full)
    with pytest.raises(Exception, match="No space left"):
        save_checkpoint(path, example(temperature=1.0))
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["proposer.ckpt"]


def test_a_map_is_identified_by_its_grey_levels_in_any_file(tmp_path):
    grey = (255 * random_texture("dots", 2, 64)).round().to(torch.uint8).numpy()
    paths = [tmp_path / name for name in ("a.png", "b.tiff", "c.png")]
    cv2.imwrite(str(paths[0]), grey)
    cv2.imwrite(str(paths[1]), grey)
    cv2.imwrite(str(paths[2]), grey.astype(np.uint16) * 257)
    first, *others = (texture_sha256(load_texture(path)) for path in paths)
    assert others == [first, first]
    assert len(first) == 64


def test_another_map_than_that_of_the_fine_tuning_is_refused():
    texture = random_texture("dots", 2, 64)
    own = example(texture_sha256=texture_sha256(texture))
    check_texture(own, texture)
    other = texture.clone()
    other[10, 10] = 1 - other[10, 10]
    for wrong in (other, 1 - texture, texture.flip(1), texture[::2, ::2]):
        with pytest.raises(CheckpointError, match="fine-tuned") as caught:
            check_texture(own, wrong)
        assert "\n" not in str(caught.value)
    check_texture(example(), other)
