"""`--stage shell`: completion of options, stages and file names by the Tab key, for bash and zsh."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterable

SHELLS = ("bash", "zsh")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the verb."""
    parser.add_argument("shell", choices=SHELLS, help="prints a script for this shell")
    parser.epilog = 'example, in ~/.bashrc:\n  eval "$(run_pipeline --stage shell bash)"'


def run(args: argparse.Namespace) -> int:
    """Prints the script."""
    print(script(args.shell))
    return 0


def script(shell: str) -> str:
    """The script for `shell`; it holds every option of this version, so that a Tab does not start Python."""
    cases = "\n".join(
        f"    {stage}) words={shlex.quote(' '.join(words))} ;;" for stage, words in words_of_stages().items()
    )
    head = "autoload -Uz bashcompinit && bashcompinit\n" if shell == "zsh" else ""
    return head + _TEMPLATE.replace("@CASES@", cases).replace("@STAGES@", " ".join(stages()))


def stages() -> list[str]:
    """Everything that --stage takes."""
    from pipeline.verbs import available_verbs
    from pipeline.verbs.parsers import STAGE_HELP

    return list(dict.fromkeys((*STAGE_HELP, *available_verbs())))


def words_of_stages() -> dict[str, list[str]]:
    """stage -> its options; "*", last, stands for a stage without options of its own."""
    from pipeline.verbs import available_verbs
    from pipeline.verbs.parsers import main_parser, verb_parser

    verbs = available_verbs()
    own = {verb: _options(verb_parser(verb, about)) for verb, about in verbs.items()}
    # --stage evaluate is a stage of a run too, without --labels.
    common = _options(main_parser(verbs))
    own["evaluate"] = sorted({*own["evaluate"], *common})
    return {**own, "*": common}


def _options(parser: argparse.ArgumentParser) -> list[str]:
    actions: Iterable[argparse.Action] = parser._actions
    return sorted(option for action in actions for option in action.option_strings if option.startswith("--"))


_TEMPLATE = """\
_run_pipeline() {
  local current=${COMP_WORDS[COMP_CWORD]} before=${COMP_WORDS[COMP_CWORD-1]} stage='' words i
  for ((i = 1; i < COMP_CWORD; i++)); do
    [ "${COMP_WORDS[i]}" = --stage ] && stage=${COMP_WORDS[i+1]}
  done
  case $before in
    --stage) COMPREPLY=($(compgen -W '@STAGES@' -- "$current")); return ;;
  esac
  case $stage in
@CASES@
  esac
  COMPREPLY=()
  [[ $current == -* ]] && COMPREPLY=($(compgen -W "$words" -- "$current"))
}
complete -o default -F _run_pipeline run_pipeline"""
