"""All tables and figures, by name."""

from __future__ import annotations

from pipeline.base.errors import UsageError
from pipeline.base.settings import nearest_name
from pipeline.experiments import (
    bundled,
    chapter_1,
    chapter_2_3,
    chapter_4,
    chapter_5,
    chapter_5_exact,
    chapter_5_figures,
)
from pipeline.experiments.tables import Table

TABLES: tuple[Table, ...] = (
    *chapter_1.TABLES,
    *chapter_2_3.TABLES,
    *chapter_4.TABLES,
    *chapter_5.TABLES,
    *chapter_5_exact.TABLES,
    *chapter_5_figures.TABLES,
    bundled.TABLE,
)
# Names of earlier versions, still taken.
FORMER_NAMES = {"embedded": "bundled"}


def find(kind: str, number: str) -> Table:
    """The table or figure of this number. UsageError that names the nearest one."""
    number = FORMER_NAMES.get(number, number)
    for table in TABLES:
        if (table.kind, table.number) == (kind, number):
            return table
    for table in TABLES:
        if table.number == number:
            raise UsageError(f"no experiment for {kind} {number}; did you mean --{table.kind} {number}?")
    known = [table.number for table in TABLES if table.kind == kind]
    raise UsageError(f"no experiment for {kind} {number}; {nearest_name(number, known)} (--list shows all)")
