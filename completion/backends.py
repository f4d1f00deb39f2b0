"""Who computes the convolutions on the CPU: torch, kernels of our own, or an export in ONNX Runtime or OpenVINO.

Exports are kept in the user's cache folder ($XDG_CACHE_HOME/auglidar, ~/.cache/auglidar) under the SHA-256 of their
weights; any image size fits one file. Deleting them is always safe.
"""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor, nn

from auglidar_base.atomic import write_bytes
from completion.checkpoints import Card
from completion.cpu import hourglass as hourglass_cpu
from completion.cpu.pixel_unet import PixelUNetKernels
from completion.models.hourglass import Hourglasses
from completion.models.ring_coefficients import RingCoefficients
from completion.models.selection import CANDIDATES, INPUTS, Selection

BACKENDS = ("torch", "numba", "onnxruntime", "openvino", "auto")
# Pure convolutions; the others encode depth or are too large to be worth it.
EXPORTABLE = ("selection", "twise", "msg_chn")
OWN_KERNELS = (*EXPORTABLE, "ring_coefficients")
OPSET = 17
# Part of the file names: raise it when the exported part of a network changes.
EXPORT_VERSION = 1

Convolutions = Callable[..., Tensor]


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


def other_than_torch(model: nn.Module, card: Card, device: str, backend: str) -> Convolutions | None:
    """The convolutions of a network for `infer.NetworkCompleter`, or None when torch is to compute them.

    backend  one of BACKENDS; "auto" is "numba", the fastest, for the networks it can run, else torch

    ValueError for a network or device that `backend` cannot run, ImportError when its packages are missing.
    """
    can = OWN_KERNELS if backend in ("numba", "auto") else EXPORTABLE
    fits = card.model.architecture in can and torch.device(device).type == "cpu"
    if backend == "auto":
        backend = "numba" if fits else "torch"
    if backend == "torch":
        return None
    if not fits:
        raise ValueError(
            f"backend {backend!r} runs {', '.join(can)} on the CPU, not {card.model.architecture} on {device}; "
            "use backend 'torch'"
        )
    if backend == "numba":
        return own_kernels(model)
    for package in ("onnx", "onnxruntime") if backend == "onnxruntime" else ("onnx", "openvino"):
        if find_spec(package) is None:
            extra = "onnx" if backend == "onnxruntime" else "onnx,openvino"
            raise ImportError(f"backend {backend!r} needs {package}: pip install 'auglidar[{extra}]'")
    graph = exported(model, card)
    return onnxruntime_session(graph) if backend == "onnxruntime" else openvino_session(graph)


def own_kernels(model: nn.Module) -> Convolutions:
    """Our Winograd convolutions (`models.winograd`) with as many threads as torch."""
    if isinstance(model, Selection):
        return PixelUNetKernels(model.network, outputs=2 * CANDIDATES)  # no read-out needs the scale
    if isinstance(model, RingCoefficients):
        return PixelUNetKernels(model.network)
    assert isinstance(model, Hourglasses), type(model)
    return hourglass_cpu.convolutions(model)


def cache_folder() -> Path:
    """Where exports are kept."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "auglidar"


def exported(model: nn.Module, card: Card) -> bytes:
    """The ONNX graph of a network's convolutions, from the cache when these weights were exported before."""
    path = cache_folder() / f"{card.model.architecture}-{card.sha256[:32]}-{EXPORT_VERSION}.onnx"
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
    """ONNX graph for any batch and image size; inputs and output as in `NetworkCompleter`."""
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


def onnxruntime_session(graph: bytes) -> Convolutions:
    """ONNX Runtime with as many threads as torch; inputs and output as the graph has them."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    names = [given.name for given in session.get_inputs()]

    def run(*inputs: Tensor) -> Tensor:
        return torch.from_numpy(session.run(None, {name: x.contiguous().numpy() for name, x in zip(names, inputs)})[0])

    return run


def openvino_session(graph: bytes) -> Convolutions:
    """OpenVINO with as many threads as torch; inputs and output as the graph has them."""
    import openvino

    core = openvino.Core()
    options = {"INFERENCE_NUM_THREADS": torch.get_num_threads(), "INFERENCE_PRECISION_HINT": "f32"}
    compiled = core.compile_model(core.read_model(graph), "CPU", options)

    def run(*inputs: Tensor) -> Tensor:
        return torch.from_numpy(compiled([x.contiguous().numpy() for x in inputs])[0].copy())

    return run
