"""A scored run over three tiny frames."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.base.paths import RunFolder
from tests.pipeline.report.scored import write_run


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    """A run over three tiny frames whose detections are the labels themselves, found with score 1."""
    return write_run(tmp_path, "run", 1.0)
