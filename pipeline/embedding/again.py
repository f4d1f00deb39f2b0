"""Puts the figures of another training beside those of embedded weights: how far a training of yours may be from them.

    python -m pipeline.embedding.again completion RUN NAME --data HELD_OUT
    python -m pipeline.embedding.again detection RUN NAME --data HELD_OUT --cloud L
    python -m pipeline.embedding.again segmentation RUN NAME --data HELD_OUT

RUN is another training of what NAME was trained by. If NAME's own figures are from other frames, they are measured
anew.
"""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.embedding.cards import (
    embedded_path,
    held_out_of,
    measured,
    origin,
    parser_of,
    read_card,
    weights_of,
    write_card,
)
from pipeline.errors import UsageError


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; see the module's text. Raises UsageError when there is no such name, or the run has no weights."""
    args = parser_of("pipeline.embedding.again", __doc__).parse_args(argv)
    embedded, held_out = embedded_path(args.room, args.name), held_out_of(args)
    if not embedded.is_file():
        raise UsageError(f"{embedded}: no embedded weights of this name; embed a first training (pipeline.embedding)")
    source = weights_of(args.room, args.run)
    card, other = read_card(embedded), read_card(source)
    known = card.get("held_out", {})
    if any(known.get(key) != value for key, value in held_out.which.items()):
        card |= {**measured(args.room, embedded, held_out), "trained_again": []}
    repeat = {**origin(other), "sha256": other["sha256"], "held_out": held_out.figures(args.room, source)}
    others = [each for each in card.get("trained_again", []) if each["sha256"] != repeat["sha256"]]
    card["trained_again"] = [*others, repeat]
    write_card(embedded, card)
    print(embedded.with_suffix(".json"))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
