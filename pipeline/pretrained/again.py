"""Puts the figures of another training beside those of bundled weights: how far a training of yours may be from them.

    python -m pipeline.pretrained.again completion RUN NAME --data HELD_OUT
    python -m pipeline.pretrained.again detection RUN NAME --data HELD_OUT --cloud L
    python -m pipeline.pretrained.again segmentation RUN NAME --data HELD_OUT

RUN is another training of what NAME was trained by. If NAME's own figures are from other frames, they are measured
anew.
"""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.base.errors import UsageError
from pipeline.pretrained import cards


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; see the module's text. Raises UsageError when there is no such name, or the run has no weights."""
    args = cards.parser_of("pipeline.pretrained.again", __doc__).parse_args(argv)
    bundled, held_out = cards.bundled_path(args.room, args.name), cards.held_out_of(args)
    if not bundled.is_file():
        raise UsageError(f"{bundled}: no bundled weights of this name; embed a first training (pipeline.pretrained)")
    source = cards.weights_of(args.room, args.run)
    card, other = cards.read_card(bundled), cards.read_card(source)
    known = card.get("held_out", {})
    if any(known.get(key) != value for key, value in held_out.which.items()):
        card |= {**cards.measured(args.room, bundled, held_out), "trained_again": []}
    repeat = {**cards.origin(other), "sha256": other["sha256"], "held_out": held_out.figures(args.room, source)}
    others = [each for each in card.get("trained_again", []) if each["sha256"] != repeat["sha256"]]
    card["trained_again"] = [*others, repeat]
    cards.write_card(bundled, card)
    print(bundled.with_suffix(".json"))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
