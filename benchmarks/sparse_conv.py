"""Sparse 3D convolution against a dense conv3d and against spconv, on voxels laid out like a KITTI frame's.

    python -m benchmarks.sparse_conv                       one layer of each kind on a cropped grid, checked and timed
    python -m benchmarks.sparse_conv --voxels 16000 40000  the whole grid of SECOND (dense does not fit in memory there)
    python -m benchmarks.sparse_conv --backbone            all twelve layers of SECOND's sparse backbone

spconv is timed when it is installed; it is no dependency of the project.
"""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.record import measure_of, save
from benchmarks.timing import Comparison, compare, format_table
from detection.models.second import KITTI_VOXELS
from detection.models.voxel_backbone import SparseTensor, VoxelBackbone, mean_voxels
from detection.ops.sparse_conv import Sites, Triple, sparse_convolution
from detection.ops.voxelize import VoxelGrid

# A window of the KITTI grid whose zero-filled copy fits in memory.
CROP = VoxelGrid((5.0, -5.0, -3.0), (15.0, 5.0, 1.0), (0.05, 0.05, 0.1), 5, (40000, 40000))


def street_points(columns: int, seed: int = 0) -> Tensor:
    """(N, 4) returns of 64 beams x `columns` directions in a street: ground, two walls, and boxes beside the lane."""
    rng = np.random.default_rng(seed)
    elevation = np.radians(np.linspace(2.0, -24.8, 64))[:, None]
    azimuth = np.radians(np.linspace(-45, 45, columns))[None, :]
    ray = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth], -1
    ).reshape(-1, 3)
    # A ray exactly along an axis never meets the planes across it.
    ray = np.where(np.abs(ray) < 1e-9, 1e-9, ray)
    reach = np.minimum(np.where(ray[:, 2] < 0, -1.73 / np.minimum(ray[:, 2], -1e-9), 1e9), 10 / np.abs(ray[:, 1]))
    for x, y in zip(range(6, 70, 8), np.resize([4.0, -4.0, 5.0, -6.0], 8)):
        low, high = np.array([x, y - 0.8, -1.73]), np.array([x + 4.0, y + 0.8, -0.2])
        near, far = np.sort([low / ray, high / ray], axis=0)
        enter, leave = near.max(axis=1), far.min(axis=1)
        reach = np.where((enter < leave) & (enter > 0), np.minimum(reach, enter), reach)
    xyz = ray * (reach + 0.02 * rng.standard_normal(len(ray)))[:, None]
    xyz = xyz[(reach < 75) & (xyz[:, 2] < 1)]
    return torch.from_numpy(np.column_stack([xyz, rng.uniform(size=len(xyz))]).astype(np.float32))


def voxels_of(grid: VoxelGrid, wanted: int) -> SparseTensor:
    """`wanted` voxels of a street in a grid, from as many directions as it takes."""
    columns = 250
    while columns < 16000:
        found = mean_voxels([street_points(columns)], grid, wanted)
        if len(found.sites) == wanted:
            return found
        columns = int(columns * 1.2)
    raise SystemExit(f"cannot fill {wanted} voxels of this grid; ask for fewer")


def dense_layer(
    features: Tensor, sites: Sites, weight: Tensor, stride: Triple, padding: Triple
) -> Callable[[], Tensor]:
    """conv3d of the zero-filled grid, read where ours has outputs."""
    outputs = sites if stride == (1, 1, 1) else sites.strided((3, 3, 3), stride, padding)[0]
    _, z, y, x = outputs.coords.T
    dense = sites.to_dense(features).contiguous()
    kernel = weight.permute(0, 4, 1, 2, 3).contiguous()
    return lambda: F.conv3d(dense, kernel, stride=stride, padding=padding)[0, :, z, y, x].T


def our_layer(features: Tensor, sites: Sites, weight: Tensor, stride: Triple, padding: Triple) -> Callable[[], Tensor]:
    """Search of the pairs and the convolution: nothing is kept from one run to the next."""

    def run() -> Tensor:
        fresh = Sites(sites.coords, sites.shape, sites.batch)
        if stride == (1, 1, 1):
            return sparse_convolution(features, weight, fresh.submanifold((3, 3, 3)))
        return sparse_convolution(features, weight, fresh.strided((3, 3, 3), stride, padding)[1])

    return run


def spconv_layer(features: Tensor, sites: Sites, weight: Tensor, stride: Triple, padding: Triple) -> Callable[[], Any]:
    """spconv's own layer on the CPU; its output order differs, so results are compared by their sums only."""
    import spconv.pytorch as spconv

    kind = spconv.SubMConv3d if stride == (1, 1, 1) else spconv.SparseConv3d
    layer = kind(weight.shape[-1], weight.shape[0], 3, stride=stride, padding=padding, bias=False)
    layer.weight.data.copy_(weight)
    coords = sites.coords.int()

    def run() -> Any:
        return layer(spconv.SparseConvTensor(features, coords, list(sites.shape), sites.batch)).features

    return run


def layer_rows(grid: VoxelGrid, wanted: int, channels: int, with_dense: bool, repeats: int) -> list[Comparison]:
    """A submanifold and a strided layer with as many channels in as out."""
    start = voxels_of(grid, wanted)
    sites = start.sites
    torch.manual_seed(0)
    features, weight = torch.randn(len(sites), channels), torch.randn(channels, 3, 3, 3, channels) / channels
    rows = []
    for name, stride in (("submanifold", (1, 1, 1)), ("stride 2", (2, 2, 2))):
        layer = features, sites, weight, stride, (1, 1, 1)
        peers: dict[str, Callable[[], Any]] = {"conv3d": dense_layer(*layer)} if with_dense else {}
        if importlib.util.find_spec("spconv") is not None:
            peers["spconv"] = spconv_layer(*layer)
        title = f"{name}, {len(sites)} voxels, {channels} channels, grid {'x'.join(map(str, sites.shape))}"
        with torch.inference_mode():
            rows.append(compare(title, our_layer(*layer), peers, repeats, _agree))
    return rows


def _agree(ours: Tensor, theirs: Tensor) -> bool:
    if ours.shape != theirs.shape:
        return False
    same_rows = torch.allclose(ours, theirs, rtol=1e-3, atol=1e-4)
    return same_rows or torch.allclose(ours.double().sum(0), theirs.double().sum(0), rtol=1e-3, atol=1e-2)


def backbone_rows(wanted: int, repeats: int) -> list[Comparison]:
    """SECOND's sparse backbone without the 2D part: forward alone, and forward with backward."""
    start = voxels_of(KITTI_VOXELS, wanted)
    model = VoxelBackbone(4)

    def fresh() -> SparseTensor:
        return SparseTensor(start.features, Sites(start.sites.coords, start.sites.shape, 1))

    def forward() -> Tensor:
        with torch.inference_mode():
            return model.eval()(fresh()).bev

    def training() -> None:
        model.train()(fresh()).bev.square().mean().backward()

    title = f"VoxelBackBone8x, {len(start.sites)} voxels"
    return [
        compare(f"{title}, forward", forward, {}, repeats),
        compare(f"{title}, forward and backward", training, {}, repeats),
    ]


def main() -> None:
    """Times what the arguments ask for and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--voxels", type=int, nargs="*", help="sizes on the whole KITTI grid; default: a crop with dense"
    )
    parser.add_argument("--channels", type=int, nargs="*", default=[16])
    parser.add_argument("--backbone", action="store_true", help="SECOND's sparse backbone as a whole")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", help="write the figures to this file")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    rows: list[Comparison] = []
    for wanted in args.voxels or [16000]:
        if args.backbone:
            rows += backbone_rows(wanted, args.repeats)
            continue
        for channels in args.channels:
            grid = KITTI_VOXELS if args.voxels else CROP
            rows += layer_rows(grid, wanted, channels, not args.voxels, args.repeats)
    print(format_table(rows))
    save(args.json, [measure_of(row) for row in rows])


if __name__ == "__main__":
    main()
