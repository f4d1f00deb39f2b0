"""Completion networks: plain eager torch beside every backend, int8, operations, bytes and the machine's limit.

    python -m benchmarks.completion --threads 2

TWISE with 64 channels has no trained weights here: its weights are random, and differences are given as if its output
spread over 20 m (one standard deviation). The embedded network is timed and scored on closed-form streets with truth.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.pointcloud_frame import street_frame
from benchmarks.record import Measure, measure_of, save
from benchmarks.targets import EAGER
from benchmarks.timing import compare, format_table
from completion.backends import export_onnx, onnxruntime_session, openvino_session
from completion.checkpoints import load_checkpoint
from completion.infer import NetworkCompleter
from completion.models import ModelSpec, build_model, default_spec
from completion.quantise import quantised_convolutions
from completion.types import DepthFrame

SPREAD = 20.0  # metres


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


def work_of(model: nn.Module, *shapes: tuple[int, ...]) -> tuple[float, float]:
    """GFLOP of the convolutions of one pass, and GB they read and write when nothing stays in a cache (float32)."""
    total = [0.0, 0.0]

    def count(layer: Any, given: tuple[Tensor, ...], output: Tensor) -> None:
        reach = given[0] if isinstance(layer, nn.ConvTranspose2d) else output
        per_place = layer.weight[0].numel() if isinstance(layer, nn.ConvTranspose2d) else layer.weight.numel()
        channels = layer.in_channels if isinstance(layer, nn.ConvTranspose2d) else 1
        total[0] += 2e-9 * per_place * channels * reach.shape[0] * reach.shape[2] * reach.shape[3]
        total[1] += 4e-9 * (given[0].numel() + output.numel() + layer.weight.numel())

    layers = [layer for layer in model.modules() if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d)]
    handles = [layer.register_forward_hook(count) for layer in layers]
    with torch.inference_mode():
        model(*(torch.rand(shape) for shape in shapes))
    for handle in handles:
        handle.remove()
    return total[0], total[1]


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


def backends(graph: bytes) -> dict[str, Callable[..., Tensor]]:
    """The installed runtimes that run exports."""
    found = {"ONNX Runtime": onnxruntime_session(graph)}
    if find_spec("openvino"):
        found["OpenVINO"] = openvino_session(graph)
    return found


def twise_measures(channels: int, size: tuple[int, int], repeats: int, limits: dict[str, float]) -> list[Measure]:
    """The large network: eager against what `backend="auto"` takes, then int8."""
    torch.manual_seed(0)
    spec = default_spec("twise", channels=channels)
    model = build_model(spec).eval()
    sparse = torch.rand(1, 1, *size) * (torch.rand(1, 1, *size) < 0.05)
    rgb = torch.rand(1, 3, *size)
    work, traffic = work_of(model, tuple(sparse.shape), tuple(rgb.shape))
    graph = export_onnx(model)
    runs: dict[str, Callable[[], Tensor]] = {EAGER: lambda: model(sparse, rgb)[0]}
    runs |= {name: (lambda run=run: run(sparse, rgb)) for name, run in backends(graph).items()}
    last = build_model(spec).eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    last.load_state_dict(model.state_dict())
    images = sparse, rgb.contiguous(memory_format=torch.channels_last)
    runs["torch, channels last"] = lambda: last(*images)[0]
    calibration = [DepthFrame(np.zeros((96, 320, 3), np.uint8) + 90, sparse[0, 0, :96, :320].numpy() * 80)]
    quantised = quantised_convolutions(model, spec, calibration)
    with torch.inference_mode():
        reference = runs[EAGER]()
        scale = 1e3 * SPREAD / float(reference[:, :2].std())
        for name, run in runs.items():
            print(f"{name}: at most {scale * float((run() - reference)[:, :2].abs().max()):.3f} mm from eager")
        apart = scale * float((quantised(sparse, rgb) - reference)[:, :2].abs().mean())
        print(f"int8: {apart:.0f} mm from eager in the mean\n")
        ours = runs.pop("ONNX Runtime")
        title = f"TWISE-{channels}, {size[0]}x{size[1]}"

        def within_1_mm(a: Tensor, b: Tensor) -> bool:
            return scale * float((a - b)[:, :2].abs().max()) < 1.0

        rows = [
            compare(f"{title}, fp32", ours, runs, repeats, within_1_mm),
            compare(f"{title}, int8", lambda: quantised(sparse, rgb), {EAGER: runs[EAGER]}, min(repeats, 2)),
        ]
    print(format_table(rows))
    reached, eager = work / rows[0].ours.median, rows[0].peers[0].median
    share, at_peak = 100 * reached / limits["product"], work / limits["product"]
    print(
        f"{title}: {work:.1f} GFLOP, {traffic:.2f} GB of layer inputs and outputs ({traffic / limits['copy']:.2f} s "
        f"at the speed of a copy). Ours reaches {reached:.0f} GFLOP/s, {share:.0f} % of the matrix product. At that "
        f"peak the network takes {at_peak:.2f} s, {eager / at_peak:.1f} times faster than eager.\n"
    )
    return [measure_of(row) for row in rows]


def mae(completer: NetworkCompleter, frames: list[DepthFrame]) -> float:
    """Mean absolute error in mm over all pixels with truth up to 80 m."""
    errors = []
    for frame in frames:
        assert frame.target is not None
        depth = completer.complete(frame.sparse, frame.image).depth
        known = (frame.target > 0) & (frame.target < 80)
        errors.append(1e3 * float(np.abs(depth - frame.target)[known].mean()))
    return float(np.mean(errors))


def embedded_measures(name: str, repeats: int, limits: dict[str, float]) -> list[Measure]:
    """The embedded network on whole frames: torch, the automatic backend, int8."""
    model, card = load_checkpoint(name)
    spec: ModelSpec = card.model
    frames = streets(4, first=1)
    graph = export_onnx(model)

    def completer(convolutions: Callable[..., Tensor] | None) -> NetworkCompleter:
        return NetworkCompleter(model, spec, read_out=card.read_out, convolutions=convolutions)

    runs = {label: completer(run) for label, run in backends(graph).items()}
    runs["torch, channels last"] = completer(None)
    quantised = completer(quantised_convolutions(model, spec, streets(2, first=20)))
    one = frames[0]
    calls = {label: (lambda run=run: run.complete(one.sparse, one.image).depth) for label, run in runs.items()}
    calls["int8"] = lambda: quantised.complete(one.sparse, one.image).depth
    ours = calls.pop("ONNX Runtime")
    row = compare("embedded completer, 375x1242", ours, calls, repeats)
    print(format_table([row]))
    reference = runs["torch, channels last"].complete(one.sparse, one.image).depth
    difference = 1e3 * np.abs(ours() - reference)
    print(
        f"ONNX Runtime beside torch: mean {difference.mean():.4f} mm, 99.9 % of pixels under "
        f"{np.quantile(difference, 0.999):.3f} mm, at most {difference.max():.1f} mm (another candidate chosen)"
    )
    errors = [mae(one, frames) for one in (runs["ONNX Runtime"], quantised)]
    loss = 100 * (errors[1] / errors[0] - 1)
    print(f"MAE on {len(frames)} streets: fp32 {errors[0]:.1f} mm, int8 {errors[1]:.1f} mm ({loss:+.2f} %)")
    half = (one.size[0] + (-one.size[0] % 32)) // 2, (one.size[1] + (-one.size[1] % 32)) // 2
    network: Any = model
    work, _ = work_of(_Half(network.network), (1, network.network.stem.in_channels, *half))
    print(f"{name}: {work:.1f} GFLOP, {work / limits['product'] * 1e3:.0f} ms at the peak of the matrix product\n")
    return [measure_of(row), Measure("int8, loss of MAE", loss, "%")]


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
    parser.add_argument("--network", default="selection_small", help="embedded network")
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
    measures += embedded_measures(options.network, options.repeats if options.quick else 9, limits)
    save(options.json, measures)


if __name__ == "__main__":
    main()
