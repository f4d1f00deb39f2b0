"""What rounding leaves behind in overlaps of boxes, for the CPU kernel and its torch twin alike."""

from __future__ import annotations

# Boxes that do not meet leave sums that cancel to a few times 1e-16 of their size; an overlap this small is none.
RESIDUE = 1.6e-14
