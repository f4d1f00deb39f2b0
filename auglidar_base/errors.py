"""Errors that all rooms share."""

from __future__ import annotations


class CheckpointError(ValueError):
    """A weights file that cannot be used: which file, what was expected, what came."""


class SettingsError(ValueError):
    """A setting, or a combination of settings and data, that cannot be carried out: what was expected, what came.

    The command line shows it as one line; any other ValueError is a fault of the program and keeps its traceback.
    """
