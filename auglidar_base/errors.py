"""Errors that all rooms share."""

from __future__ import annotations


class CheckpointError(ValueError):
    """A weights file that cannot be used: which file, what was expected, what came."""
