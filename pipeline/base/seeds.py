"""Seeds that depend on what is computed, never on when or where."""

from __future__ import annotations

import hashlib


def derive_seed(run_seed: int, frame_id: str, stage: str) -> int:
    """A seed in [0, 2**31) from the run's seed, the frame and the stage: the same for any number of workers."""
    text = f"{run_seed}\0{frame_id}\0{stage}".encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "little") % 2**31
