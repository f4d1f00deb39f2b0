"""Which executor computes a network: torch, kernels of our own, or an export in ONNX Runtime or OpenVINO.

Exports are kept in the user's cache folder ($XDG_CACHE_HOME/auglidar, ~/.cache/auglidar) under a hash of all that
shapes them (`export_key`); any image size fits one file. Deleting them is always safe.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor, nn

from auglidar_base.atomic import write_bytes
from completion.checkpoints import Card
from completion.cpu.hourglass import hourglass_forward
from completion.cpu.propagation import nlspn_forward
from completion.cpu.ring_coefficients import WinogradCoefficients
from completion.cpu.selection import FusedSelection, WinogradSelection
from completion.executors import Executor, NetworkExecutor, finest_of
from completion.models import ModelSpec
from completion.models.hourglass import Hourglasses
from completion.models.nlspn import NLSPN
from completion.models.ring_coefficients import RingCoefficients
from completion.models.selection import INPUTS, Selection

BACKENDS = ("torch", "numba", "onnxruntime", "openvino", "auto")
# Pure convolutions; the others encode depth or are too large to be worth it.
EXPORTABLE = ("selection", "twise", "msg_chn")
OWN_KERNELS = (*EXPORTABLE, "ring_coefficients", "nlspn")
OPSET = 17
# Those whose versions an export depends on: who writes the graph, and who reads it.
EXPORTERS = ("torch", "onnx", "onnxruntime", "openvino")

# The inputs of an exported graph -> its output.
Session = Callable[[Sequence[Tensor]], Tensor]


class _Part(nn.Module):
    """What is exported: a selection network between its pixel shuffles, or the finest output of any other network."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, *inputs: Tensor) -> Tensor:
        if isinstance(self.model, Selection):
            return self.model.network.at_half(*inputs)
        output: Tensor = self.model(*inputs)[0]
        return output


def torch_executor(model: nn.Module, spec: ModelSpec, device: str | torch.device, decoding: str) -> Executor:
    """Torch on one device; what surrounds the convolutions of a selection network on the CPU is fused.

    The network is moved to the device and set to `eval`. ValueError for a decoding that it does not offer.
    """
    place = torch.device(device)
    moved = model.to(device=place, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]
    if isinstance(moved, Selection) and place.type == "cpu":
        return FusedSelection(moved, spec, decoding, moved.network.at_half)
    return NetworkExecutor(finest_of(moved), spec, decoding, place)


def kernel_executor(model: nn.Module, spec: ModelSpec, decoding: str) -> Executor:
    """Our kernels (`completion.cpu`), with the network's weights and torch's threads at the time of this call."""
    if isinstance(model, Selection):
        return WinogradSelection(model, spec, decoding)
    if isinstance(model, RingCoefficients):
        return WinogradCoefficients(model, spec, decoding)
    if isinstance(model, NLSPN):
        moved = model.to(memory_format=torch.channels_last).eval()  # type: ignore[call-overload]
        return NetworkExecutor(nlspn_forward(moved), spec, decoding)
    assert isinstance(model, Hourglasses), type(model)
    return NetworkExecutor(hourglass_forward(model), spec, decoding)


def session_executor(model: nn.Module, spec: ModelSpec, decoding: str, session: Session) -> Executor:
    """An export of the network in another runtime."""
    if isinstance(model, Selection):
        return FusedSelection(model, spec, decoding, lambda features: session((features,)), planes=True)
    return NetworkExecutor(lambda sparse, rgb: session((sparse, rgb)), spec, decoding)


def choose_executor(model: nn.Module, card: Card, device: str, backend: str) -> Executor:
    """The executor of a network.

    backend  one of BACKENDS; "auto" is "numba", the fastest, for the networks it can run, else torch

    ValueError for a network or device that `backend` cannot run, ImportError when its packages are missing.
    """
    can = OWN_KERNELS if backend in ("numba", "auto") else EXPORTABLE
    fits = card.model.architecture in can and torch.device(device).type == "cpu"
    if backend == "auto":
        backend = "numba" if fits else "torch"
    if backend == "torch":
        return torch_executor(model, card.model, device, card.decoding)
    if not fits:
        raise ValueError(
            f"backend {backend!r} runs {', '.join(can)} on the CPU, not {card.model.architecture} on {device}; "
            "use backend 'torch'"
        )
    if backend == "numba":
        return kernel_executor(model, card.model, card.decoding)
    for package in ("onnx", "onnxruntime") if backend == "onnxruntime" else ("onnx", "openvino"):
        if find_spec(package) is None:
            extra = "onnx" if backend == "onnxruntime" else "onnx,openvino"
            raise ImportError(f"backend {backend!r} needs {package}: pip install 'auglidar[{extra}]'")
    start = onnxruntime_session if backend == "onnxruntime" else openvino_session
    return session_executor(model, card.model, card.decoding, start(exported(model, card)))


def cache_folder() -> Path:
    """Where exports are kept."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "auglidar"


def export_key(card: Card) -> str:
    """Hash of everything that shapes an export: network with arguments, weights, decoding, our code, and versions.

    Weights alone do not tell: TWISE with average and with maximum pooling have the same tensors.
    """
    versions = {package: _version(package) for package in EXPORTERS}
    shaping = [asdict(card.model), card.decoding, card.sha256, _source_hash(), OPSET, versions]
    return hashlib.sha256(json.dumps(shaping, sort_keys=True, default=str).encode()).hexdigest()[:32]


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


@cache
def _source_hash() -> str:
    """Of the networks' code and this file, so that a changed forward pass is exported anew."""
    here = Path(__file__).resolve()
    files = [here, *sorted((here.parent / "models").glob("*.py"))]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def exported(model: nn.Module, card: Card) -> bytes:
    """The ONNX graph of a network's convolutions, from the cache when this network was exported before."""
    path = cache_folder() / f"{card.model.architecture}-{export_key(card)}.onnx"
    if card.sha256 and path.is_file():
        return path.read_bytes()
    graph = export_onnx(model)
    if card.sha256:
        try:
            write_bytes(path, graph)
        except OSError as error:
            warnings.warn(f"{path}: the exported network is not kept: {error}", RuntimeWarning, stacklevel=2)
    return graph


def export_onnx(model: nn.Module) -> bytes:
    """ONNX graph for any batch and image size: an `executors.Forward`, or `at_half` of a selection network."""
    channels = (4 * INPUTS,) if isinstance(model, Selection) else (1, 3)
    inputs = tuple(torch.rand(1, count, 64, 96) for count in channels)
    names = [f"input{number}" for number in range(len(inputs))]
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        # The exporter that needs no further package is called legacy; shape checks of the networks are not traced.
        warnings.simplefilter("ignore")
        path = Path(folder) / "network.onnx"
        torch.onnx.export(
            _Part(model).eval(),
            inputs,
            path,
            input_names=names,
            output_names=["output"],
            opset_version=OPSET,
            dynamic_axes={name: {0: "batch", 2: "height", 3: "width"} for name in (*names, "output")},
            dynamo=False,
        )
        return path.read_bytes()


def onnxruntime_session(graph: bytes) -> Session:
    """ONNX Runtime with as many threads as torch; inputs and output as the graph has them."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    names = [given.name for given in session.get_inputs()]

    def run(inputs: Sequence[Tensor]) -> Tensor:
        return torch.from_numpy(session.run(None, {name: x.contiguous().numpy() for name, x in zip(names, inputs)})[0])

    return run


def openvino_session(graph: bytes) -> Session:
    """OpenVINO with as many threads as torch; inputs and output as the graph has them."""
    import openvino

    core = openvino.Core()
    options = {"INFERENCE_NUM_THREADS": torch.get_num_threads(), "INFERENCE_PRECISION_HINT": "f32"}
    compiled = core.compile_model(core.read_model(graph), "CPU", options)

    def run(inputs: Sequence[Tensor]) -> Tensor:
        return torch.from_numpy(compiled([x.contiguous().numpy() for x in inputs])[0].copy())

    return run
