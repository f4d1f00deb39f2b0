"""Chapter 5 of the thesis: detection from noisy depth."""

from __future__ import annotations

from pipeline.experiments.tables import Table

TABLES: tuple[Table, ...] = ()
