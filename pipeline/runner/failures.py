"""failures.json: what could not be done, in words a person or a script can act on."""

from __future__ import annotations

import json
import shlex
from collections.abc import Collection, Sequence

from auglidar_base.atomic import write_text
from pipeline.base.paths import RunFolder
from pipeline.runner.jobs import Failure
from pipeline.runner.ledger import all_failures


def update_failures(
    run: RunFolder, command: Sequence[str], frames: Collection[str], stages: Collection[str]
) -> list[Failure]:
    """Writes failures.json from the ledgers of all shards, or removes it when nothing failed; returns the failures.

    command         the command line of this run: the same one tries the failed frames again and skips what is done
    frames, stages  that the run has today, over all shards: what failed elsewhere is no longer asked for
    """
    known, asked = set(frames), set(stages)
    failures = [item for item in all_failures(run.ledgers()) if item.frame in known and item.stage in asked]
    if not failures:
        run.failures.unlink(missing_ok=True)
        return []
    record = {
        "retry": shlex.join(command),
        "frames": sorted({failure.frame for failure in failures}),
        "failures": [failure.as_dict() for failure in failures],
    }
    write_text(run.failures, json.dumps(record, indent=1, ensure_ascii=False) + "\n")
    return failures
