"""A table or figure of the thesis as data: what its rows train and evaluate, what was printed, what is claimed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

LOWER, HIGHER = "lower", "higher"


@dataclass(frozen=True)
class Column:
    """A number that is compared.

    key     name in a run's result ("mae_mm"); a row's `view` is put before it ("fused/mae_mm")
    better  "lower", "higher" or "" (neither)
    digits  decimals when it is written
    """

    key: str
    title: str
    unit: str = ""
    better: str = LOWER
    digits: int = 1

    def __post_init__(self) -> None:
        if self.better not in (LOWER, HIGHER, ""):
            raise ValueError(f"better: expected 'lower', 'higher' or '', got {self.better!r}")

    @property
    def heading(self) -> str:
        """Title with its unit."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title


@dataclass(frozen=True)
class Recipe:
    """What has to be computed for a row.

    kind      a name in `runs.KINDS` ("completion", "detection", "analysis")
    settings  plain values (JSON); equal settings of different tables are computed once
    """

    kind: str
    settings: Mapping[str, Any] = field(default_factory=dict)

    def with_settings(self, **changes: Any) -> Recipe:
        """The same with some settings replaced."""
        return replace(self, settings={**self.settings, **changes})


@dataclass(frozen=True)
class Row:
    """A row of a table.

    printed  the thesis' values, one per column (None where it has none); () when it prints none at all
    recipe   None: the thesis quotes a network that we do not have; `reason` says so and the row is listed only
    view     which part of the run's result the row shows (a read-out, a region); "" for all
    """

    label: str
    printed: tuple[float | None, ...] = ()
    recipe: Recipe | None = None
    view: str = ""
    reason: str = ""

    def __post_init__(self) -> None:
        if self.recipe is None and not self.reason:
            raise ValueError(f"row {self.label!r}: expected a recipe, or the reason why there is none")


@dataclass(frozen=True)
class Claim:
    """Every row of `better` is better in `column` than every row of `worse`."""

    text: str
    column: str
    better: tuple[str, ...]
    worse: tuple[str, ...]


@dataclass(frozen=True)
class RankClaim:
    """Kendall's tau of `column` between two lists of rows: 1 when `same`, below 1 when not."""

    text: str
    column: str
    first: tuple[str, ...]
    second: tuple[str, ...]
    same: bool = True


@dataclass(frozen=True)
class Table:
    """A table or figure.

    number     "4.5"; kind: "table" or "figure"
    purpose    what it is for, in half a line
    misprints  numbers of the thesis that cannot be right, quoted beside the table
    notes      how our runs differ from the thesis'
    drawing    how its figure is drawn: a name in `figures.DRAWINGS`
    needs      what a run takes ("synthetic world or KITTI depth", ...)
    lidar_rows rows asked for (see `with_lidar_rows`), 0 when the table is as it stands
    """

    number: str
    kind: str
    title: str
    purpose: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    claims: tuple[Claim | RankClaim, ...] = ()
    misprints: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    drawing: str = "dots"
    needs: str = "synthetic world"
    lidar_rows: int = 0

    def __post_init__(self) -> None:
        if self.kind not in ("table", "figure"):
            raise ValueError(f"kind: expected 'table' or 'figure', got {self.kind!r}")
        labels = [row.label for row in self.rows]
        if len(set(labels)) != len(labels):
            raise ValueError(f"{self.name}: row labels must differ")
        for row in self.rows:
            if row.printed and len(row.printed) != len(self.columns):
                raise ValueError(f"{self.name}, {row.label}: expected {len(self.columns)} printed values")
        self._check_claims(set(labels), {column.key for column in self.columns})

    def _check_claims(self, labels: set[str], columns: set[str]) -> None:
        for claim in self.claims:
            named = (*claim.better, *claim.worse) if isinstance(claim, Claim) else (*claim.first, *claim.second)
            unknown = sorted(set(named) - labels) + sorted({claim.column} - columns)
            if unknown:
                raise ValueError(f"{self.name}: the claim {claim.text!r} names {', '.join(unknown)}, which it has not")

    @property
    def name(self) -> str:
        """ "table_4.5", "table_5.3_16_rows"; stem of the files written."""
        return f"{self.kind}_{self.number}" + (f"_{self.lidar_rows}_rows" if self.lidar_rows else "")

    @property
    def of_thesis(self) -> bool:
        """False for the tables that only this project has; those have names in place of numbers."""
        return self.number[0].isdigit()

    @property
    def heading(self) -> str:
        """ "Table 4.5"."""
        return f"{self.kind.capitalize()} {self.number}" + (
            f" at {self.lidar_rows} LiDAR rows" if self.lidar_rows else ""
        )

    def row(self, label: str) -> Row:
        """The row with this label. KeyError when there is none."""
        return {row.label: row for row in self.rows}[label]

    def column(self, key: str) -> Column:
        """The column with this key. KeyError when there is none."""
        return {column.key: column for column in self.columns}[key]

    def with_lidar_rows(self, rows: int) -> Table:
        """The table at `rows` LiDAR rows: the rows that have them where rows differ in it, all at `rows` otherwise."""
        ours = [row for row in self.rows if row.recipe is not None and "rows" in row.recipe.settings]
        numbers = {row.recipe.settings["rows"] for row in ours if row.recipe is not None}
        if not ours:
            return self
        changed = []
        for row in self.rows:
            if row.recipe is None or "rows" not in row.recipe.settings:
                changed.append(row)
            elif len(numbers) == 1:
                changed.append(replace(row, recipe=row.recipe.with_settings(rows=rows)))
            elif row.recipe.settings["rows"] == rows:
                changed.append(row)
        left = {row.label for row in changed}
        claims = tuple(claim for claim in self.claims if _labels(claim) <= left)
        return replace(self, rows=tuple(changed), claims=claims, lidar_rows=rows)


def _labels(claim: Claim | RankClaim) -> set[str]:
    named = (*claim.better, *claim.worse) if isinstance(claim, Claim) else (*claim.first, *claim.second)
    return set(named)
