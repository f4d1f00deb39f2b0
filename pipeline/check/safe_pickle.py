"""Info pickles of other projects, read without running what they ask for: containers, numbers and arrays only."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from auglidar_base.inert_pickle import RefusedError, loads
from pipeline.base.errors import DataError
from pipeline.data.images import read_bytes


def load_infos(path: Path) -> Any:
    """The contents of an info pickle. Raises DataError when it is damaged or asks for anything but data."""
    try:
        return loads(read_bytes(path, "an info pickle"))
    except RefusedError as error:
        raise DataError(path, "a pickle of lists, dicts, numbers and arrays", str(error)) from None
