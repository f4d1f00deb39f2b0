"""The command line. Nothing heavy is imported here: `run_pipeline --help` answers at once."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import errno
import signal
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import BrokenExecutor
from typing import Any

from pipeline.base.disk import why_full
from pipeline.base.errors import DataError, RenamedSettingWarning, UsageError
from pipeline.base.streams import lost_output, patient_streams
from pipeline.runner.signals import Terminated, sigterm_as_interrupt
from pipeline.verbs import available_verbs, verb_module
from pipeline.verbs.parsers import STAGE_HELP, main_parser, verb_parser

# sysexits.h, EX_SOFTWARE: a fault of the program. 1 says that frames failed, and nothing else.
FAULT = 70


def program() -> int:
    """The console script; returns the exit code, also for a fault of the program, whose traceback is printed."""
    try:
        return main()
    except Exception:
        with patient_streams():
            traceback.print_exc()
        return FAULT


def main(argv: Sequence[str] | None = None) -> int:
    """Carries out the arguments; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    with patient_streams() as output:
        code = _answered(arguments)
        output.flush()
        lost = lost_output(output)
        if lost:
            print(f"run_pipeline: {lost}", file=sys.stderr)
    return code or (2 if lost else 0)


def _answered(arguments: list[str]) -> int:
    """The exit code; whatever the user can do something about is one line."""
    try:
        _check_names(arguments)
        with sigterm_as_interrupt(), _renamed_settings_in_a_line():
            return _dispatch(arguments)
    except (UsageError, DataError) as error:
        print(f"run_pipeline: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        what = why_full(error.filename) if error.errno == errno.ENOSPC else error.strerror or str(error)
        print(f"run_pipeline: {f'{error.filename}: ' if error.filename else ''}{what}", file=sys.stderr)
        return 2
    except BrokenExecutor:
        print("run_pipeline: a worker process was ended (out of memory? try fewer --workers)", file=sys.stderr)
        return 2
    except MemoryError:
        print("run_pipeline: there is not enough memory; try fewer --workers", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interrupt:
        print("run_pipeline: interrupted; the same command continues where it was", file=sys.stderr)
        return 128 + (signal.SIGTERM if isinstance(interrupt, Terminated) else signal.SIGINT)


def _check_names(arguments: Sequence[str]) -> None:
    """Refuses letters that cannot be told from their bytes here: a configuration could not name them either."""
    for argument in arguments:
        if any("\ud800" <= letter <= "\udfff" for letter in argument):
            encoding = sys.getfilesystemencoding()
            raise UsageError(
                f"{argument}: expected text in {encoding}; "
                + ("rename it" if encoding == "utf-8" else "set PYTHONUTF8=1 or LC_ALL=C.UTF-8")
            )


@contextlib.contextmanager
def _renamed_settings_in_a_line() -> Iterator[None]:
    """Each earlier name of a setting is told once, without the place in the program that found it."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", RenamedSettingWarning)
        show, told = warnings.showwarning, set[str]()

        def in_a_line(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
            if not issubclass(category, RenamedSettingWarning):
                show(message, category, *place, **more)
            elif str(message) not in told:
                told.add(str(message))
                print(f"run_pipeline: {message}", file=sys.stderr)

        warnings.showwarning = in_a_line
        yield


def _dispatch(arguments: list[str]) -> int:
    stage = _option(arguments, "--stage")
    verbs = available_verbs()
    if stage in verbs and not (stage == "evaluate" and _evaluates_a_run(arguments)):
        return _run_verb(stage, arguments, verbs[stage])
    if stage is not None and stage not in STAGE_HELP:
        known = [*STAGE_HELP, *verbs]
        close = difflib.get_close_matches(stage, known, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(dict.fromkeys(known))}"
        raise UsageError(f"unknown stage {stage!r}; {hint}")
    parser = main_parser(verbs)
    return _run_stages(parser.parse_args(arguments), arguments)


def _option(arguments: Sequence[str], name: str) -> str | None:
    """The value of `name VALUE` or `name=VALUE`, or None."""
    for index, argument in enumerate(arguments):
        if argument == name and index + 1 < len(arguments):
            return arguments[index + 1]
        if argument.startswith(f"{name}="):
            return argument.partition("=")[2]
    return None


def _evaluates_a_run(arguments: Sequence[str]) -> bool:
    """`--stage evaluate` means a run unless two folders are named or its help is asked for."""
    folders = any(argument.split("=")[0] in ("--labels", "--detections") for argument in arguments)
    asks_help = any(argument in ("-h", "--help") for argument in arguments)
    return not folders and not asks_help


def _run_verb(verb: str, arguments: Sequence[str], about: str) -> int:
    result: int = verb_module(verb).run(verb_parser(verb, about).parse_args(arguments))
    return result


def _run_stages(args: argparse.Namespace, arguments: Sequence[str]) -> int:
    import json
    from pathlib import Path

    from auglidar_base.atomic import write_text
    from pipeline.run import Request, carry_out

    overrides = list(args.overrides)
    # JSON strings are YAML strings: a folder called "1e3" or "yes" stays text.
    for key, value in (("data.root", args.data), ("data.frames", args.frames), ("augment.depth_from", args.depth_from)):
        if value is not None:
            overrides.append(f"{key}={json.dumps(value)}")
    if args.format is not None:
        overrides.append(f"report.format={args.format}")
    if args.workers is not None:
        overrides.append(f"run.workers={args.workers}")
    request = Request(
        stage=args.stage,
        config=args.config,
        out=args.out,
        overrides=tuple(overrides),
        shard=args.shard,
        engine=args.engine,
        dry_run=args.dry_run,
        verify=args.verify,
        command=("run_pipeline", *arguments),
    )
    if args.json is None:
        return carry_out(request)
    record: dict[str, Any] = {}
    with contextlib.redirect_stdout(sys.stderr if args.json == "-" else sys.stdout):
        code = carry_out(request, record)
    text = json.dumps({"exit_code": code, **record}, indent=1)
    if args.json == "-":
        print(text)
    else:
        write_text(Path(args.json), text + "\n")
    return code


if __name__ == "__main__":
    sys.exit(program())
