"""What a result was made with: written into every run's config.yaml."""

from __future__ import annotations

import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_PACKAGES = ("auglidar", "torch", "numpy", "numba", "scipy", "opencv-python-headless", "open3d")


def made_with() -> dict[str, str | None]:
    """Versions of Python, of the packages that decide a result, and the git commit of a checkout; None when unknown."""
    found: dict[str, str | None] = {"python": platform.python_version(), "platform": platform.platform()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = None
    found["git"] = git_commit()
    return found


def git_commit() -> str | None:
    """The commit of the checkout this program runs from ("-dirty" with local changes), or None when it is installed."""
    root = Path(__file__).resolve().parent.parent.parent
    if not (root / ".git").exists():
        return None
    try:
        command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None
