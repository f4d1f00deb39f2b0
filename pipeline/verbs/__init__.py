"""Verbs: commands beside the stages, each a module with `add_arguments(parser)` and `run(args) -> exit code`."""

from __future__ import annotations

import importlib
import importlib.util
from types import ModuleType

# verb -> (module, what it does in half a line)
VERBS: dict[str, tuple[str, str]] = {
    "evaluate": ("pipeline.verbs.evaluate", "AP of any two folders of KITTI files (--labels, --detections)"),
    "experiment": ("pipeline.verbs.experiment", "tables and figures of the thesis"),
    "export": ("pipeline.verbs.export", "write clouds and labels for other detectors"),
    "import": ("pipeline.verbs.import_", "take weights or results from other programs"),
    "check": ("pipeline.verbs.check", "find what is wrong with a data set"),
    "pack": ("pipeline.verbs.pack", "results as a benchmark submission"),
    "bench": ("pipeline.verbs.bench", "measure speed and accuracy on this machine"),
    "env": ("pipeline.verbs.env", "versions, cores, memory, disk, GPU, extras, weights of this machine"),
    "shell": ("pipeline.verbs.shell", "Tab completion for bash and zsh"),
}


def available_verbs() -> dict[str, str]:
    """The verbs of this installation with what they do."""
    return {verb: about for verb, (module, about) in VERBS.items() if importlib.util.find_spec(module) is not None}


def verb_module(verb: str) -> ModuleType:
    """The module of an available verb."""
    return importlib.import_module(VERBS[verb][0])
