"""What is fuzzed: readers of users' files, samples of good files, and the errors a reader may end with."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from hypothesis import strategies as st

from pipeline.base.errors import DataError, UsageError
from tests.fuzz.child import ReaderProcess, read_infos, read_npy_file, read_npz_file, read_torch_file
from tests.fuzz.mutations import mutated, opcodes, png_files, zipped


@dataclass(frozen=True)
class Target:
    """A reader.

    files    strategy of file contents
    read     reads the file written at a path; returns whether it was taken
    refused  the errors that are one clear line to the user; every other one is a find
    suffix   of the file
    """

    files: Callable[[], st.SearchStrategy[bytes]]
    read: Callable[[Path], object]
    refused: type[Exception]
    suffix: str


@cache
def scratch() -> TemporaryDirectory[str]:
    """The folder of the files of this process; in memory where there is such a place."""
    return TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None)


def try_file(name: str, data: bytes) -> bool:
    """Reads `data` with a target: True when it is taken, False when it is refused; another error is a find."""
    target = TARGETS[name]
    path = Path(scratch().name) / f"{name}{target.suffix}"
    path.write_bytes(data)
    try:
        target.read(path)
    except target.refused:
        return False
    return True


# --- samples


def _label_samples() -> tuple[bytes, ...]:
    line = b"Car 0.00 0 -1.58 587.01 173.33 614.12 200.12 1.65 1.67 3.64 -0.65 1.71 46.70 -1.59\n"
    return line * 2, line.replace(b"Car", b"DontCare"), b""


def _calibration_samples() -> tuple[bytes, ...]:
    from pipeline.geometry.calibration import format_calibration
    from tests.pipeline.tiny_kitti import CALIBRATION

    text = format_calibration(CALIBRATION).encode()
    return text, text.replace(b"Tr_velo_to_cam", b"Tr").replace(b"R0_rect", b"R_x"), text.replace(b":", b"")


def _velodyne_samples() -> tuple[bytes, ...]:
    return (np.linspace(-50, 50, 64, dtype="<f4").tobytes(),)


def _depth_samples() -> tuple[bytes, ...]:
    from pipeline.data.depth_png import png_bytes

    ramp = np.arange(600).reshape(20, 30)
    return png_bytes(ramp.astype(np.uint16)), png_bytes(ramp.astype(np.uint8))


def _cloud_samples(kind: str) -> tuple[bytes, ...]:
    from pipeline.data.cloud_files import Cloud, pcd_bytes, ply_bytes

    cloud = Cloud(np.arange(24, dtype=np.float32).reshape(6, 4), ("x", "y", "z", "intensity"))
    return (ply_bytes(cloud) if kind == "ply" else pcd_bytes(cloud),)


def _config_samples() -> tuple[bytes, ...]:
    from pipeline.run_folder.config import built_in_folder

    return tuple(path.read_bytes() for path in sorted(built_in_folder().glob("*.yaml")))


@cache
def _ledger_samples() -> tuple[bytes, ...]:
    from pipeline.runner.jobs import Failure, Outcome, Task
    from pipeline.runner.ledger import Ledger

    path = Path(scratch().name) / "good.sqlite"
    ledger = Ledger(path)
    for index in range(3):
        ledger.record(Outcome(Task("augment", f"{index:06d}")), "key")
    task = Task("augment", "000003")
    ledger.record(Outcome(task, failure=Failure("augment", task.frame, "data", "f", "e", "found")), "")
    ledger.close()
    return (path.read_bytes(),)


@cache
def _weights_samples() -> tuple[bytes, ...]:
    import torch
    from safetensors.torch import save

    return (save({"a": torch.ones(2, 3), "b": torch.zeros(4, dtype=torch.int64)}, {"run": "{}"}),)


@cache
def _checkpoint_samples() -> tuple[bytes, ...]:
    """Card, a zero byte, weights: one file for two, so that both are changed."""
    from completion.checkpoints import Card, save_checkpoint
    from completion.models import build_model, default_spec

    spec = default_spec("selection", width=8)
    path = save_checkpoint(Path(scratch().name) / "good", build_model(spec), Card(spec))
    return (path.with_suffix(".json").read_bytes() + b"\0" + path.read_bytes(),)


# --- readers


def _read_label(path: Path) -> object:
    from detection.kitti_format import boxes_of, format_line
    from pipeline.data.kitti_object import read_labels

    objects = read_labels(path)
    return boxes_of(objects), [format_line(item) for item in objects]


def _read_calibration(path: Path) -> object:
    from pipeline.geometry.calibration import read_calibration

    calibration = read_calibration(path)
    with np.errstate(all="raise"):
        return calibration.velo_to_cam(np.ones((2, 3))), calibration.cam_to_velo(np.ones((2, 3)))


def _read_velodyne(path: Path) -> object:
    from pipeline.data.kitti_object import read_velodyne

    return read_velodyne(path)


def _read_depth(path: Path) -> object:
    from pipeline.data.depth_png import read_depth_png

    return read_depth_png(path)


def _read_cloud(path: Path) -> object:
    from pipeline.data.cloud_files import read_points

    return read_points(path)


def _read_config(path: Path) -> object:
    from pipeline.run_folder.config import load_config

    return load_config(path)


def _read_ledger(path: Path) -> object:
    from pipeline.runner.jobs import Outcome, Task
    from pipeline.runner.ledger import Ledger, all_failures

    for leftover in path.parent.glob(f"{path.name}-*"):  # SQLite's journal of the file before
        leftover.unlink()
    ledger = Ledger(path)
    try:
        found = [ledger.row("augment", f"{index:06d}") for index in range(4)]
        ledger.record(Outcome(Task("augment", "000002")), "new")
        return found, ledger.mean_seconds("augment"), all_failures([path])
    finally:
        ledger.close()


def _read_checkpoint(path: Path) -> object:
    from completion.checkpoints import load_checkpoint

    card, _, weights = path.read_bytes().partition(b"\0")
    stated = hashlib.sha256(_checkpoint_samples()[0].partition(b"\0")[2]).hexdigest().encode()
    # A damaged file is refused by its hash; with the right hash in the card the reader itself is tried.
    card = card.replace(stated, hashlib.sha256(weights).hexdigest().encode())
    path.with_suffix(".safetensors").write_bytes(weights)
    path.with_suffix(".json").write_bytes(card)
    return load_checkpoint(path.with_suffix(".safetensors"))


def _read_safetensors(path: Path) -> object:
    from detection.checkpoints import load_tensors

    return load_tensors(path)


@cache
def _pickle_samples() -> tuple[bytes, ...]:
    """Infos and results in every protocol, and arrays that lie."""
    from tests.auglidar_base.forged_pickles import FORGED, forged

    boxes = {"name": np.array(["Car", "Van"]), "bbox": np.ones((2, 4), np.float32), "score": np.float32([0.5, 1])}
    frame = {"frame_id": "000001", **boxes, "extra": [np.zeros((0, 7)), np.str_("x"), np.array(["a", None], object)]}
    good = tuple(pickle.dumps([frame, {**frame, "n": 3}], protocol=protocol) for protocol in range(6))
    return good + tuple(forged(name) for name in FORGED)


@cache
def _npz_samples() -> tuple[bytes, ...]:
    from pipeline.run_folder.frame_outputs import npz_bytes

    surface = np.arange(48, dtype=np.uint16).reshape(6, 8)
    return (npz_bytes({"foreground": surface, "sigma": surface.astype(np.uint8)}),)


def _npy_samples() -> tuple[bytes, ...]:
    found = []
    for array in (np.arange(24, dtype="<f4").reshape(6, 4), np.asfortranarray(np.ones((3, 5), ">f8"))):
        stream = io.BytesIO()
        np.save(stream, array)
        found.append(stream.getvalue())
    return tuple(found)


@cache
def _torch_samples() -> tuple[bytes, ...]:
    """A checkpoint as a zip and in the form of before 2020."""
    import torch

    state = {"a.weight": torch.ones(2, 3), "b": torch.zeros(4, dtype=torch.int64), "epoch": 3}
    found = []
    for new in (True, False):
        stream = io.BytesIO()
        torch.save(state, stream, _use_new_zipfile_serialization=new)
        found.append(stream.getvalue())
    return tuple(found)


def _entries(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _zips(samples: Callable[[], tuple[bytes, ...]]) -> st.SearchStrategy[bytes]:
    """Damage in the files and, behind right checksums, in what the zips among them hold."""
    return mutated(samples()) | zipped(tuple(_entries(data) for data in samples() if data.startswith(b"PK")))


@cache
def _child(reader: Callable[[Path], None]) -> ReaderProcess:
    return ReaderProcess(reader)


def _changed(samples: Callable[[], tuple[bytes, ...]]) -> Callable[[], st.SearchStrategy[bytes]]:
    return lambda: mutated(samples())


def card_with(place: tuple[str, ...], value: object) -> bytes:
    """The good checkpoint with one value of its card replaced."""
    card, _, weights = _checkpoint_samples()[0].partition(b"\0")
    changed = json.loads(card)
    section = changed
    for name in place[:-1]:
        section = section[name]
    section[place[-1]] = value
    return json.dumps(changed).encode() + b"\0" + weights


def _card_and_weights() -> st.SearchStrategy[bytes]:
    """Bytes changed anywhere, or one value of the card replaced by any JSON."""
    (sample,) = _checkpoint_samples()
    fields = json.loads(sample.partition(b"\0")[0])
    values = st.recursive(
        st.none() | st.booleans() | st.integers(-2, 10**6) | st.floats() | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
        max_leaves=4,
    )
    names = [(name,) for name in fields] + [("model", name) for name in fields["model"]]
    names += [("model", "arguments", name) for name in fields["model"]["arguments"]]
    return mutated((sample,)) | st.builds(card_with, st.sampled_from(names), values)


TARGETS: dict[str, Target] = {
    "label": Target(_changed(_label_samples), _read_label, DataError, ".txt"),
    "calibration": Target(_changed(_calibration_samples), _read_calibration, DataError, ".txt"),
    "velodyne": Target(_changed(_velodyne_samples), _read_velodyne, DataError, ".bin"),
    "depth_png": Target(lambda: mutated(_depth_samples()) | png_files(), _read_depth, DataError, ".png"),
    "ply": Target(lambda: mutated(_cloud_samples("ply")), _read_cloud, DataError, ".ply"),
    "pcd": Target(lambda: mutated(_cloud_samples("pcd")), _read_cloud, DataError, ".pcd"),
    "config": Target(_changed(_config_samples), _read_config, UsageError, ".yaml"),
    "ledger": Target(_changed(_ledger_samples), _read_ledger, UsageError, ".sqlite"),
    "checkpoint": Target(_card_and_weights, _read_checkpoint, ValueError, ".both"),
    "pickle": Target(
        lambda: mutated(_pickle_samples()) | opcodes(), lambda path: _child(read_infos).read(path), DataError, ".pkl"
    ),
    "npz": Target(lambda: _zips(_npz_samples), lambda path: _child(read_npz_file).read(path), DataError, ".npz"),
    "npy": Target(_changed(_npy_samples), lambda path: _child(read_npy_file).read(path), DataError, ".npy"),
    "torch_pickle": Target(
        lambda: _zips(_torch_samples), lambda path: _child(read_torch_file).read(path), DataError, ".pth"
    ),
    "safetensors": Target(_changed(_weights_samples), _read_safetensors, ValueError, ".safetensors"),
}
