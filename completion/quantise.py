"""Int8 versions of the exported networks, for ONNX Runtime: static quantisation with ranges seen on sample frames.

completer = quantised_completer("selection_small", frames)      # a few DepthFrames like those to come

Convolutions take uint8 and int8 per output channel; the last one, which says depth, stays float32. What it costs in
accuracy depends on network and frames: measure it before use (`python -m benchmarks.completion`).
"""

from __future__ import annotations

import logging
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

from numpy.typing import NDArray
from torch import Tensor, nn

from completion.backends import EXPORTABLE, Convolutions, export_onnx, onnxruntime_session
from completion.checkpoints import load_checkpoint
from completion.infer import NetworkCompleter
from completion.models import ModelSpec
from completion.models.selection import Selection
from completion.types import DepthFrame


def quantised_completer(path_or_name: str | Path, frames: Sequence[DepthFrame]) -> NetworkCompleter:
    """The completer of a weights file or bundled name with int8 convolutions.

    frames  sample frames; the ranges of all values inside the network are taken from them
    ValueError without frames or for a network that cannot be exported, ImportError without the extra `onnx`.
    """
    model, card = load_checkpoint(path_or_name)
    convolutions = quantised_convolutions(model, card.model, frames)
    return NetworkCompleter(model, card.model, decoding=card.decoding, convolutions=convolutions)


def quantised_convolutions(model: nn.Module, spec: ModelSpec, frames: Sequence[DepthFrame]) -> Convolutions:
    """`NetworkCompleter.convolutions` of a network in int8; see `quantised_completer`."""
    for package in ("onnx", "onnxruntime"):
        if find_spec(package) is None:
            raise ImportError(f"int8 needs {package}: pip install 'auglidar[onnx]'")
    if spec.architecture not in EXPORTABLE:
        raise ValueError(f"int8: expected one of {', '.join(EXPORTABLE)}, got {spec.architecture}")
    if not frames:
        raise ValueError("int8: expected sample frames to take ranges from, got none")
    return onnxruntime_session(quantised_graph(export_onnx(model), network_inputs(model, spec, frames)))


def network_inputs(model: nn.Module, spec: ModelSpec, frames: Sequence[DepthFrame]) -> list[tuple[Tensor, ...]]:
    """What the exported part of a network is given for each frame."""
    seen: list[tuple[Tensor, ...]] = []

    def record(*inputs: Tensor) -> Tensor:
        seen.append(tuple(item.detach().clone() for item in inputs))
        if isinstance(model, Selection):
            return model.network.at_half(*inputs)
        output: Tensor = model(*inputs)[0]
        return output

    decoding = {"twin": "fused", "mixture": "median"}.get(spec.output, spec.output)
    completer = NetworkCompleter(model, spec, decoding=decoding, convolutions=record)
    for frame in frames:
        completer.complete(frame.sparse, frame.image, frame.K)
    return seen


def quantised_graph(graph: bytes, samples: Sequence[Sequence[Tensor]]) -> bytes:
    """An ONNX graph with its convolutions in int8 (QDQ form); ranges from `samples`, one tuple of inputs each."""
    import onnx
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    names = [given.name for given in onnx.load_model_from_string(graph).graph.input]

    class Samples(CalibrationDataReader):
        def __init__(self) -> None:
            self.rows: Iterator[dict[str, NDArray]] = iter(
                [{name: item.contiguous().numpy() for name, item in zip(names, sample)} for sample in samples]
            )

        def get_next(self) -> dict[str, NDArray] | None:
            return next(self.rows, None)

    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.getLogger().setLevel(max(logging.getLogger().level, logging.WARNING))
        plain, prepared, done = (Path(folder) / f"{name}.onnx" for name in ("plain", "prepared", "int8"))
        plain.write_bytes(graph)
        quant_pre_process(str(plain), str(prepared), skip_symbolic_shape=True)
        convolutions = [node.name for node in onnx.load(str(prepared)).graph.node if "Conv" in node.op_type]
        quantize_static(
            str(prepared),
            str(done),
            Samples(),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            # Without VNNI two products of 8 x 8 bits are added in 16: 7-bit weights cannot overflow there.
            reduce_range=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            nodes_to_exclude=convolutions[-1:],
        )
        return done.read_bytes()
