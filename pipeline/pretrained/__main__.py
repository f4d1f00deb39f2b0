"""From a training run to bundled weights: held-out figures go onto the card, files into the package.

    python -m pipeline.pretrained completion RUN NAME --data HELD_OUT --config CONFIG --limits TEXT
    python -m pipeline.pretrained detection RUN NAME --data HELD_OUT --cloud L --config CONFIG --limits TEXT
    python -m pipeline.pretrained segmentation RUN NAME --data HELD_OUT --config CONFIG --limits TEXT

HELD_OUT is a synthetic data set made with another seed than the training set (run_pipeline --stage synth). CONFIG is
what RUN was trained by; the card says how to train the network again with it.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from typing import Any

from pipeline.pretrained import cards
from pipeline.run_folder.config import Config, load_config
from pipeline.run_folder.resolved import synth_settings


def main(argv: Sequence[str] | None = None) -> int:
    """Command line; see the module's text."""
    parser = cards.parser_of("pipeline.pretrained", __doc__)
    parser.add_argument("--config", required=True, nargs="+", help="what RUN was trained by, and runs it began with")
    parser.add_argument("--limits", required=True, help="what the network is not good at, for its card")
    args = parser.parse_args(argv)
    source, target = cards.weights_of(args.room, args.run), cards.bundled_path(args.room, args.name)
    configs = [load_config(path) for path in args.config]
    card = cards.read_card(source)
    card |= {"name": args.name, "limits": args.limits, **cards.origin(card), **how_made(args.config, configs)}
    card |= cards.measured(args.room, source, cards.held_out_of(args))
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    cards.write_card(target, card)
    print(target)
    return 0


def how_made(paths: Sequence[str], configs: Sequence[Config]) -> dict[str, Any]:
    """The commands that train the network again, and the synthetic frames they make."""
    frames = {(settings.seed, settings.frames) for settings in map(synth_settings, configs)}
    return {
        "command": [f"run_pipeline --config {path} --stage train" for path in paths],
        "data": [f"{count} frames of the synthetic world, seed {seed}" for seed, count in sorted(frames)],
    }


if __name__ == "__main__":
    raise SystemExit(main())
