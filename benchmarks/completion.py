"""Completion networks: plain eager torch beside every backend, operations, bytes and the machine's limit.

    python -m benchmarks.completion --threads 2

TWISE with 64 channels has no trained weights here: its last layers are fitted to closed-form streets (`street_twise`),
so that outputs are depths in metres. It and the bundled network are timed and scored on other streets with truth.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from benchmarks.pointcloud_frame import street_frame
from benchmarks.record import Measure, measure_of, save
from benchmarks.street_twise import cropped, given, street_twise
from benchmarks.targets import EAGER
from benchmarks.timing import Comparison, compare, format_table
from completion.backends import (
    Session,
    export_onnx,
    kernel_executor,
    onnxruntime_session,
    openvino_session,
    session_executor,
    torch_executor,
)
from completion.checkpoints import load_checkpoint
from completion.cpu.hourglass import hourglass_forward
from completion.executors import Executor, Forward, finest_of
from completion.infer import NetworkCompleter
from completion.models import ModelSpec, default_spec
from completion.types import DepthFrame

OWN = "ours (numba)"


def fastest(run: Callable[[], Any], repeats: int = 5) -> float:
    """Seconds of the fastest of some runs after a first one."""
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)


def machine_limits(size: int = 2048) -> dict[str, float]:
    """GFLOP/s of a large matrix product and of one large convolution, GB/s of a copy, with torch's threads."""
    a, b = torch.rand(size, size), torch.rand(size, size)
    product = 2e-9 * size**3 / fastest(lambda: a @ b)
    image = torch.rand(1, 64, 176, 608).to(memory_format=torch.channels_last)
    kernel = torch.rand(64, 64, 3, 3).to(memory_format=torch.channels_last)
    work = 2e-9 * 64 * 64 * 9 * 176 * 608
    convolution = work / fastest(lambda: torch.conv2d(image, kernel, padding=1))
    source, target = torch.rand(2**25), torch.empty(2**25)
    copy = 2 * 4e-9 * 2**25 / fastest(lambda: target.copy_(source))
    return {"product": product, "convolution": convolution, "copy": copy}


def work_of(model: nn.Module, *shapes: tuple[int, ...]) -> tuple[float, float, float]:
    """GFLOP of the convolutions of one pass; GB they read and write when nothing stays in a cache (float32); and GFLOP
    of the products that are left when 3x3 convolutions of stride 1 between many channels take a quarter."""
    total = [0.0, 0.0, 0.0]

    def count(layer: Any, given: tuple[Tensor, ...], output: Tensor) -> None:
        reach = given[0] if isinstance(layer, nn.ConvTranspose2d) else output
        per_place = layer.weight[0].numel() if isinstance(layer, nn.ConvTranspose2d) else layer.weight.numel()
        channels = layer.in_channels if isinstance(layer, nn.ConvTranspose2d) else 1
        work = 2e-9 * per_place * channels * reach.shape[0] * reach.shape[2] * reach.shape[3]
        few = min(layer.in_channels, layer.out_channels) <= 3
        winograd = isinstance(layer, nn.Conv2d) and layer.kernel_size == (3, 3) and layer.stride == (1, 1) and not few
        total[0] += work
        total[2] += work / 4 if winograd else work
        total[1] += 4e-9 * (given[0].numel() + output.numel() + layer.weight.numel())

    layers = [layer for layer in model.modules() if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d)]
    handles = [layer.register_forward_hook(count) for layer in layers]
    with torch.inference_mode():
        model(*(torch.rand(shape) for shape in shapes))
    for handle in handles:
        handle.remove()
    return total[0], total[1], total[2]


def streets(count: int, first: int = 0) -> list[DepthFrame]:
    """Closed-form streets of KITTI's size: LiDAR returns, a grey picture of the true depth, and the truth."""
    frames = []
    for seed in range(first, first + count):
        frame = street_frame(seed)
        calibration, truth = frame.calibration, frame.truth
        camera = frame.points[:, :3] @ calibration.T_cam_velo[:3, :3].T + calibration.T_cam_velo[:3, 3]
        pixels = camera @ calibration.P2[:, :3].T + calibration.P2[:, 3]
        u, v = (np.rint(pixels[:, axis] / pixels[:, 2]).astype(int) for axis in (0, 1))
        inside = (u >= 0) & (u < truth.shape[1]) & (v >= 0) & (v < truth.shape[0])
        sparse = np.zeros_like(truth)
        sparse[v[inside], u[inside]] = camera[inside, 2]
        shade = (255 * np.exp(-truth / 40)).astype(np.uint8)
        frames.append(DepthFrame(np.repeat(shade[:, :, None], 3, axis=2), sparse, truth, calibration.K))
    return frames


def sessions(graph: bytes) -> dict[str, Session]:
    """The installed runtimes that run exports."""
    found = {"ONNX Runtime": onnxruntime_session(graph)}
    if find_spec("openvino"):
        found["OpenVINO"] = openvino_session(graph)
    return found


def in_session(session: Session, sparse: Tensor, rgb: Tensor) -> Tensor:
    """An exported network as a `Forward`."""
    return session((sparse, rgb))


def within_1_mm(a: Tensor, b: Tensor) -> bool:
    """Whether no surface of two outputs of TWISE differs by more."""
    return 80e3 * float((a - b)[:, :2].abs().max()) < 1.0


def twise_measures(channels: int, size: tuple[int, int], repeats: int, limits: dict[str, float]) -> list[Measure]:
    """The large network: eager, other runtimes, what `backend="auto"` takes."""
    spec = default_spec("twise", channels=channels)
    rows, columns = min(size[0], 160), min(size[1], 400)
    seen = [cropped(one, rows, columns, 200 * left) for left, one in enumerate(streets(4, first=40))]
    model = street_twise(spec, seen)
    frames = [cropped(one, *size, left=10) for one in streets(2, first=1)]
    sparse, rgb = given(frames[0])
    work, traffic, products = work_of(model, tuple(sparse.shape), tuple(rgb.shape))
    ways: dict[str, Forward] = {EAGER: finest_of(model), OWN: hourglass_forward(model)}
    if find_spec("onnx") and find_spec("onnxruntime"):
        ways |= {name: partial(in_session, session) for name, session in sessions(export_onnx(model)).items()}
    last = copy.deepcopy(model).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    ways["torch, channels last"] = lambda depth, colour: last(
        depth, colour.contiguous(memory_format=torch.channels_last)
    )[0]
    runs: dict[str, Callable[[], Tensor]] = {name: partial(way, sparse, rgb) for name, way in ways.items()}
    with torch.inference_mode():
        reference = runs[EAGER]()
        for name, run in runs.items():
            apart = 80e3 * (run() - reference)[:, :2].abs()
            print(f"{name}: mean {float(apart.mean()):.3f} mm, at most {float(apart.max()):.3f} mm from eager")
        title = f"TWISE-{channels}, {size[0]}x{size[1]}"
        peers = {name: run for name, run in runs.items() if name != OWN}
        row = compare(f"{title}, fp32", runs[OWN], peers, repeats, within_1_mm)
        errors = {name: surface_mae(ways[name], frames) for name in (EAGER, OWN)}
    print(f"\n{format_table([row])}")
    costs = ", ".join(
        f"{name} {error:.1f} mm ({100 * (error / errors[EAGER] - 1):+.2f} %)" for name, error in errors.items()
    )
    print(f"MAE on {len(frames)} streets: {costs}")
    print(f"{title}: {roofline(row, work, traffic, products, limits)}\n")
    return [measure_of(row)]


def roofline(row: Comparison, work: float, traffic: float, products: float, limits: dict[str, float]) -> str:
    """How far ours is from the machine's limit, in words."""
    ours, eager = row.ours.median, next(peer.median for peer in row.peers if peer.label == EAGER)
    direct, least, copy_time = work / limits["product"], products / limits["product"], traffic / limits["copy"]
    return (
        f"{work:.1f} GFLOP, {traffic:.2f} GB of layer inputs and outputs ({copy_time:.2f} s at the speed of a copy). A "
        f"direct convolution at the rate of the matrix product takes {direct:.2f} s: none can be more than "
        f"{eager / direct:.1f} times faster than eager here. Winograd's leaves {products:.1f} GFLOP of products, "
        f"{least:.2f} s at that rate; all of ours takes {ours:.2f} s."
    )


def surface_mae(way: Forward, frames: list[DepthFrame]) -> float:
    """Mean absolute error in mm of the mean of both surfaces over all pixels with truth up to 80 m."""
    errors = []
    for frame in frames:
        assert frame.target is not None
        depth = 80 * way(*given(frame))[0, :2].mean(0).numpy()
        known = (frame.target > 0) & (frame.target < 80)
        errors.append(1e3 * float(np.abs(depth - frame.target)[known].mean()))
    return float(np.mean(errors))


def mae(completer: NetworkCompleter, frames: list[DepthFrame]) -> float:
    """Mean absolute error in mm over all pixels with truth up to 80 m."""
    errors = []
    for frame in frames:
        assert frame.target is not None
        depth = completer.complete(frame.sparse, frame.image).depth
        known = (frame.target > 0) & (frame.target < 80)
        errors.append(1e3 * float(np.abs(depth - frame.target)[known].mean()))
    return float(np.mean(errors))


def bundled_measures(name: str, repeats: int, limits: dict[str, float]) -> list[Measure]:
    """The bundled network on whole frames: torch, the automatic backend, exports."""
    model, card = load_checkpoint(name)
    spec: ModelSpec = card.model
    frames = streets(4, first=1)

    ways: dict[str, Executor] = {
        OWN: kernel_executor(model, spec, card.decoding),
        "torch, channels last": torch_executor(model, spec, "cpu", card.decoding),
    }
    if find_spec("onnx") and find_spec("onnxruntime"):
        for label, session in sessions(export_onnx(model)).items():
            ways[label] = session_executor(model, spec, card.decoding, session)
    completers = {label: NetworkCompleter(way) for label, way in ways.items()}
    one = frames[0]
    calls: dict[str, Callable[[], Any]] = {label: partial(depth_of, run, one) for label, run in completers.items()}
    ours = calls.pop(OWN)
    reference = calls["torch, channels last"]()
    row = compare("bundled completer, 375x1242", ours, calls, repeats, nearly_everywhere)
    print(format_table([row]))
    difference = 1e3 * np.abs(ours() - reference)
    print(
        f"ours beside torch: mean {difference.mean():.4f} mm, 99.9 % of pixels under "
        f"{np.quantile(difference, 0.999):.3f} mm, at most {difference.max():.1f} mm (another candidate chosen)"
    )
    errors = {label: mae(completers[label], frames) for label in ("torch, channels last", OWN)}
    exact_error = errors["torch, channels last"]
    costs = ", ".join(
        f"{label} {error:.1f} mm ({100 * (error / exact_error - 1):+.2f} %)" for label, error in errors.items()
    )
    print(f"MAE on {len(frames)} streets: {costs}")
    half = (one.size[0] + (-one.size[0] % 32)) // 2, (one.size[1] + (-one.size[1] % 32)) // 2
    network: Any = model
    work, _, products = work_of(_Half(network.network), (1, network.network.stem.in_channels, *half))
    direct, least = (1e3 * each / limits["product"] for each in (work, products))
    print(
        f"{name}: {work:.1f} GFLOP, {direct:.0f} ms at the rate of the matrix product; Winograd's convolutions leave "
        f"{products:.1f} GFLOP of products, {least:.0f} ms\n"
    )
    return [measure_of(row)]


def coefficient_measures(name: str, repeats: int) -> list[Measure]:
    """The bundled Depth Coefficients network on a whole frame: our pass and the tensor operations it repeats."""
    model, card = load_checkpoint(name)
    ways: dict[str, Executor] = {
        OWN: kernel_executor(model, card.model, card.decoding),
        "torch, channels last": torch_executor(model, card.model, "cpu", card.decoding),
    }
    runs = {label: NetworkCompleter(way) for label, way in ways.items()}
    frame = streets(1, first=1)[0]
    calls: dict[str, Callable[[], Any]] = {label: partial(depth_of, run, frame) for label, run in runs.items()}
    ours = calls.pop(OWN)
    row = compare("Depth Coefficients completer, 375x1242", ours, calls, repeats, nearly_everywhere)
    print(format_table([row]), "\n")
    return [measure_of(row)]


def depth_of(completer: NetworkCompleter, frame: DepthFrame) -> NDArray[np.float32]:
    """Completed depth."""
    return completer.complete(frame.sparse, frame.image).depth


def nearly_everywhere(a: NDArray[np.float32], b: NDArray[np.float32]) -> bool:
    """Equal to 1 mm but for one pixel in a thousand, where another candidate may win by a rounding."""
    return float(np.quantile(np.abs(a - b), 0.999)) < 1e-3


class _Half(nn.Module):
    def __init__(self, network: Any) -> None:
        super().__init__()
        self.network = network

    def forward(self, features: Tensor) -> Tensor:
        head: Tensor = self.network.at_half(features)
        return head


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="small sizes: whether it runs, not how fast")
    parser.add_argument("--network", default="selection_small", help="bundled network")
    parser.add_argument("--json")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    limits = machine_limits(256 if options.quick else 2048)
    print(
        f"{options.threads} threads: matrix product {limits['product']:.0f} GFLOP/s, one 64 to 64 channel convolution "
        f"{limits['convolution']:.0f} GFLOP/s, copy {limits['copy']:.1f} GB/s\n"
    )
    channels, size = (8, (96, 320)) if options.quick else (64, (352, 1216))
    measures = twise_measures(channels, size, options.repeats, limits)
    measures += bundled_measures(options.network, options.repeats if options.quick else 9, limits)
    measures += coefficient_measures("dc_small", options.repeats)
    save(options.json, measures)


if __name__ == "__main__":
    main()
