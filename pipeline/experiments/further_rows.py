"""Rows that a configuration adds to tables: another input, another detector, a method of one's own.

    rows:
      - {label: "my detector, L", like: "PointRCNN2, L", detector: "my_methods:Clusters"}

A row takes over the recipe of the row named by `like` (the first that is computed) and replaces what else is given.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from pipeline.base.errors import UsageError
from pipeline.base.settings import nearest_name
from pipeline.experiments.tables import Row, Table

# What a row of each kind may replace.
SETTINGS = {
    "detection": ("input", "test_input", "detector", "rows", "options"),
    "completion": ("completer", "options", "network", "loss", "gamma", "rows", "colour", "target", "scene"),
    "completer": ("completer", "options"),
    "selection": ("loss", "width", "start"),
    "cloud": ("input", "rows"),
}


@dataclass(frozen=True)
class FurtherRow:
    """One entry of `rows`.

    table     number of the table it goes into; "" for every table that was asked for
    like      label of the row whose recipe it takes over; "" for the first that is computed
    settings  what is replaced in the recipe
    where     the file, for messages
    """

    label: str
    settings: Mapping[str, Any]
    where: str
    table: str = ""
    like: str = ""

    def added_to(self, table: Table) -> Table:
        """The table with this row at its end. Raises UsageError for a row that the table cannot have."""
        here = f"{self.where}: rows: {self.label!r}"
        computed = {row.label: row for row in table.rows if row.recipe is not None}
        if not computed:
            raise UsageError(f"{here}: {table.heading} has no row that is computed")
        if self.like and self.like not in computed:
            raise UsageError(f"{here}: like: {nearest_name(self.like, computed)}, got {self.like!r}")
        if self.label in {row.label for row in table.rows}:
            raise UsageError(f"{here}: {table.heading} has a row of this label; choose another")
        base = computed[self.like] if self.like else next(iter(computed.values()))
        assert base.recipe is not None
        known = SETTINGS.get(base.recipe.kind, ())
        for key in self.settings:
            if key not in known:
                raise UsageError(f"{here}: unknown setting {key!r}; {nearest_name(key, known)}")
        recipe = base.recipe.with_settings(**self.settings)
        # A method of one's own has one read-out, which is that of no view.
        own = recipe.kind == "completion" and "completer" in self.settings
        return replace(table, rows=(*table.rows, Row(self.label, (), recipe, "" if own else base.view)))


def read_rows(given: Any, where: str) -> tuple[FurtherRow, ...]:
    """The entries of `rows` in a configuration. Raises UsageError for an entry without label."""
    if not isinstance(given, list):
        raise UsageError(f"{where}: rows: expected a list of rows, got {given!r}")
    found = []
    for entry in given:
        if not isinstance(entry, Mapping) or not isinstance(entry.get("label"), str):
            raise UsageError(f"{where}: rows: expected a label and settings, got {entry!r}")
        settings = {key: value for key, value in entry.items() if key not in ("label", "table", "like")}
        row = FurtherRow(entry["label"], settings, where, str(entry.get("table", "")), str(entry.get("like", "")))
        found.append(row)
    return tuple(found)


def with_rows(tables: Sequence[Table], rows: Sequence[FurtherRow]) -> tuple[Table, ...]:
    """The tables with the further rows. Raises UsageError for a row of a table that was not asked for."""
    numbers = [table.number for table in tables]
    for row in rows:
        if row.table and row.table not in numbers:
            raise UsageError(f"{row.where}: rows: {row.label!r}: table {row.table} is not asked for")
    made = []
    for table in tables:
        for row in rows:
            if row.table in ("", table.number):
                table = row.added_to(table)
        made.append(table)
    return tuple(made)
