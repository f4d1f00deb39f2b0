"""The two ways a request can go wrong, each with one clear line."""

from __future__ import annotations

from pathlib import Path


class DataError(ValueError):
    """A file or frame that cannot be used: what was expected, what came, and what to do."""

    def __init__(self, where: str | Path, expected: str, found: str, hint: str = "") -> None:
        self.where, self.expected, self.found, self.hint = str(where), expected, found, hint
        super().__init__(f"{where}: expected {expected}, got {found}" + (f"; {hint}" if hint else ""))

    def __reduce__(self) -> tuple[type[DataError], tuple[str, str, str, str]]:
        # Raised in worker processes: rebuilt from its parts on the other side.
        return type(self), (self.where, self.expected, self.found, self.hint)


class MissingPart(DataError):
    """A frame has no such part (no label, no image, ...): a fact about the data set rather than damage."""


class RenamedSettingWarning(FutureWarning):
    """A setting was given by a name it had in an earlier version; the name is still understood."""


class UsageError(Exception):
    """The request cannot be carried out (exit code 2): a wrong option, setting, folder or combination of them."""
