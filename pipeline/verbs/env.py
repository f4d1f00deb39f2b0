"""`--stage env`: what this installation runs on, to read before a long job or to paste into a report of a problem.

Nothing of what is reported on is imported: the report comes at once, and also where PyTorch or Open3D cannot be loaded.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from pipeline.base.versions import made_with
from pipeline.run_folder.weights import bundled_names
from pipeline.runner.processes import available_cores

# extra of this package -> modules it brings (pyproject.toml)
EXTRAS: dict[str, tuple[str, ...]] = {
    "onnx": ("onnx", "onnxruntime"),
    "openvino": ("openvino",),
    "ray": ("ray",),
    "hf": ("transformers",),
    "viewer": ("rerun", "mcap"),
    "tensorboard": ("tensorboard",),
    "parquet": ("pyarrow",),
    "nyu": ("h5py",),
    "docs": ("zensical",),
}
THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
LEAST_FREE_GB = 5.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.add_argument(
        "--out", type=Path, default=Path("."), metavar="DIR", help="folder whose disk is looked at (the current one)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.epilog = "example:\n  run_pipeline --stage env --json > environment.json"


def run(args: argparse.Namespace) -> int:
    """Prints the report; 0 also when something is worth a remark, since nothing was asked to be done."""
    found = environment(args.out)
    if args.json:
        print(json.dumps(found, indent=2))
    else:
        print(as_text(found))
    return 0


def environment(folder: Path) -> dict[str, Any]:
    """Everything the report says, as plain values: versions, cores, threads, memory, disk, GPU, extras, weights.

    folder  its disk is looked at; the nearest existing parent when it does not exist yet. Sizes in GB (1e9 bytes)
    """
    found: dict[str, Any] = {
        "versions": made_with(),
        "executable": sys.executable,
        "cores": available_cores(),
        "threads": _threads(),
        "memory_gb": _memory(),
        "disk": _disk(folder),
        "gpus": _gpus(),
        "extras": {name: all(importlib.util.find_spec(m) for m in modules) for name, modules in EXTRAS.items()},
        "weights": {room: bundled_names(room) for room in ("completion", "detection", "pipeline/semantics")},
    }
    return {**found, "remarks": remarks(found)}


def remarks(found: dict[str, Any]) -> list[str]:
    """What a user should know before a long run, one line each with what to do."""
    notes = []
    missing = [
        name for name, version in found["versions"].items() if version is None and name not in ("git", "auglidar")
    ]
    if missing:
        notes.append(f"packages without a version: {', '.join(missing)}; install this package with its dependencies")
    if found["disk"]["free_gb"] < LEAST_FREE_GB:
        place = f"{found['disk']['free_gb']:.1f} GB free at {found['disk']['folder']}"
        notes.append(f"{place}; ask a run what it needs with --dry-run, or choose another disk with --out")
    available = found["memory_gb"]["available"]
    if available is not None and available < 1.5 * found["cores"]:
        notes.append(f"{available:.1f} GB of memory free for {found['cores']} processes; give fewer --workers")
    torch = found["versions"].get("torch") or ""
    if found["gpus"] and torch.endswith("+cpu"):
        notes.append(f"PyTorch {torch} is the build for CPUs; training on the GPU needs a build with CUDA")
    if not found["weights"]["detection"]:
        notes.append("no detector is bundled; give one as detection.model, or stop at --stage augment")
    return notes


def _threads() -> dict[str, str | None]:
    return {name: os.environ.get(name) for name in THREAD_VARIABLES}


def _memory() -> dict[str, float | None]:
    """Total and available memory in GB, None where the system does not tell (it does on Linux)."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:
        return {"total": None, "available": None}
    sizes = {name: int(rest.split()[0]) * 1024 / 1e9 for name, _, rest in (line.partition(":") for line in lines)}
    return {"total": round(sizes["MemTotal"], 1), "available": round(sizes["MemAvailable"], 1)}


def _disk(folder: Path) -> dict[str, Any]:
    existing = next(path for path in (folder.resolve(), *folder.resolve().parents) if path.exists())
    usage = shutil.disk_usage(existing)
    return {
        "folder": str(existing),
        "free_gb": round(usage.free / 1e9, 1),
        "total_gb": round(usage.total / 1e9, 1),
        "writable": os.access(existing, os.W_OK),
    }


def _gpus() -> list[str]:
    """Names of NVIDIA's GPUs, as the driver's own tool lists them; empty without a driver."""
    try:
        command = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return []
    return [line.strip() for line in done.stdout.splitlines() if line.strip()]


def as_text(found: dict[str, Any]) -> str:
    """The report for a reader."""
    disk, memory = found["disk"], found["memory_gb"]
    set_threads = ", ".join(f"{name}={value}" for name, value in found["threads"].items() if value is not None)
    rows = [(name, version or "-") for name, version in found["versions"].items()]
    rows += [
        ("executable", found["executable"]),
        ("cores", str(found["cores"])),
        ("threads", set_threads),
        ("memory", f"{memory['available']} of {memory['total']} GB available"),
        ("disk", f"{disk['free_gb']} of {disk['total_gb']} GB free at {disk['folder']}"),
        ("GPU", ", ".join(found["gpus"]) or "none (none is needed)"),
        ("extras", ", ".join(name for name, there in found["extras"].items() if there) or "none"),
    ]
    rows += [(f"weights, {room}", ", ".join(names) or "none") for room, names in found["weights"].items()]
    width = max(len(name) for name, _ in rows)
    lines = [f"{name:<{width}}  {value}" for name, value in rows]
    return "\n".join([*lines, *(f"note: {remark}" for remark in found["remarks"])])
