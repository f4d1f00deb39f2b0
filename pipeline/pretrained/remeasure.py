"""Measures bundled weights again and writes the figures onto their card, after the way of measuring has changed.

    python -m pipeline.pretrained.remeasure detection small_augmented --data HELD_OUT --cloud L_D_F \\
        --completer selection_small
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from pipeline.base.errors import UsageError
from pipeline.pretrained import cards


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; see the module's text."""
    parser = argparse.ArgumentParser(
        prog="python -m pipeline.pretrained.remeasure",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("room", choices=tuple(cards.ROOMS))
    parser.add_argument("name", help="name of the bundled weights")
    cards.add_held_out(parser)
    args = parser.parse_args(argv)
    weights = cards.bundled_path(args.room, args.name)
    if not weights.is_file():
        raise UsageError(f"{weights}: no bundled weights of this name")
    card = {key: value for key, value in cards.read_card(weights).items() if key != "score_threshold"}
    cards.write_card(weights, card | cards.measured(args.room, weights, cards.held_out_of(args)))
    print(weights.with_suffix(".json"))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
