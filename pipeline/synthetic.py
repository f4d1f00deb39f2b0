"""The synth stage: makes the synthetic data set of a run once, and again only when its settings or its code change."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from auglidar_base.atomic import write_text
from pipeline.base.errors import UsageError
from pipeline.base.progress import progress
from pipeline.base.settings import plain
from pipeline.run_folder.config import Config
from pipeline.run_folder.resolved import synth_settings
from pipeline.runner.keys import code_version
from pipeline.runner.processes import available_cores

MARKER = "synthetic.json"


def make_synthetic_data(config: Config, root: Path) -> bool:
    """Writes the data set below `root` unless it is there already; returns whether it was made.

    Raises UsageError when `root` holds something else: a folder that this stage did not make is never written into.
    """
    settings = synth_settings(config)
    wanted = {"settings": plain(settings), "code": code_version("pipeline/simulation")}
    marker = root / MARKER
    state = _read_marker(marker)
    if state == {**wanted, "complete": True}:
        return False
    if not state and root.is_dir() and any(root.iterdir()):
        raise UsageError(f"{root} holds files that the synth stage did not write; choose another folder with --data")
    if state:
        _remove_older(config, root)
    from pipeline.simulation.writers import write_dataset

    # Written first: after a kill the folder is known to be ours, and the next run makes it complete.
    write_text(marker, json.dumps({**wanted, "complete": False}, indent=1) + "\n")
    with progress("synth", settings.frames) as counter:
        write_dataset(root, settings, config.run.workers or available_cores(), lambda *_: counter.advance())
    write_text(marker, json.dumps({**wanted, "complete": True}, indent=1) + "\n")
    return True


def _remove_older(config: Config, root: Path) -> None:
    """Removes a data set of other settings from the run's own folder; one in a folder of the user's is left alone."""
    if config.data.root is not None:
        raise UsageError(
            f"{root} holds synthetic data of other settings: remove it, or choose another folder with --data"
        )
    shutil.rmtree(root)


def _read_marker(marker: Path) -> dict[str, object]:
    """The marker's contents, or {} when there is none or it is damaged."""
    try:
        state = json.loads(marker.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return state if isinstance(state, dict) else {}
