"""A request carried out: make or open the data, run the stages it needs, score, report, say how it went."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from auglidar_base.atomic import remove_leftovers, write_text
from pipeline.base.errors import UsageError
from pipeline.base.paths import RunFolder
from pipeline.base.settings import nearest_name
from pipeline.base.versions import made_with
from pipeline.data import Dataset
from pipeline.run_folder.config import Config, dump_config, load_config
from pipeline.run_folder.frames import data_root, has_points, open_frames
from pipeline.run_folder.preset import augment_settings
from pipeline.run_folder.resolved import resolved_config, synth_settings
from pipeline.runner.batch import Batch, StageSummary, open_batch, shard_of
from pipeline.runner.failures import update_failures
from pipeline.runner.jobs import Outcome, Task
from pipeline.runner.processes import available_cores
from pipeline.runner.signals import StopRequest, stop_on_signals
from pipeline.stages.order import FRAME_STAGES, STAGES, frame_stages_for
from pipeline.summary import print_dry_run, print_results, print_summary, run_record

DONE, SOME_FAILED, REFUSED = 0, 1, 2


@dataclass(frozen=True)
class Request:
    """What the command line asks for.

    stage      one of STAGES, or None for everything but training
    overrides  `key.sub=value` texts, applied after the file and the other options
    shard      (i, n), counted from 0
    verify     read every file again to tell whether it changed
    command    the command line, for messages and failures.json
    """

    stage: str | None = None
    config: str | None = None
    out: str | None = None
    overrides: tuple[str, ...] = ()
    shard: tuple[int, int] | None = None
    engine: str = "local"
    dry_run: bool = False
    verify: bool = False
    command: tuple[str, ...] = field(default=("run_pipeline",))


def carry_out(request: Request, record: dict[str, Any] | None = None) -> int:
    """Runs the stages of a request. Returns the exit code; raises UsageError when it cannot be carried out.

    record  is filled with what became of it, as plain values (`--json`)
    """
    record = {} if record is None else record
    out = Path(request.out) if request.out else default_out(request.config)
    config = resolved_config(load_config(config_source(request, out), request.overrides))
    run = RunFolder(out)
    stage = request.stage or "report"
    check_request(request, stage)
    if stage == "train":
        from pipeline.training.settings import with_training_settings

        config = with_training_settings(config)
    if "augment" in frame_stages_for(stage, config):
        augment_settings(config)  # a preset without its masks is refused before anything is written or promised
    record |= {"run": str(run.root), "stage": stage}
    if request.dry_run:
        record["estimates"] = dry_run(config, run, stage, request.shard, request.verify)
        return DONE
    prepare_folder(run, config)
    make_data(config, run, stage, request.shard)
    if stage == "synth":
        record["data"] = str(data_root(config, run))
        print(f"synthetic data: {record['data']}")
        return DONE
    with stop_on_signals() as stop:
        code = run_batch(request, config, run, stage, stop, record)
    if stage == "train" and code == DONE:
        from pipeline.training.stage import train_stage

        record["weights"] = str(train_stage(config, run))
        print(f"weights: {record['weights']}")
    return code


def default_out(config: str | None) -> Path:
    """runs/demo, or runs/NAME after the configuration file."""
    return Path("runs") / ("demo" if config is None else Path(config).stem)


def config_source(request: Request, out: Path) -> str | Path | None:
    """The file asked for, else the run's own resolved configuration, else the demo's."""
    if request.config is not None:
        return request.config
    own = RunFolder(out).config
    return own if request.out is not None and own.is_file() else None


def check_request(request: Request, stage: str) -> None:
    """What can be refused before any work: a wrong stage or combination of options."""
    if stage not in STAGES:
        raise UsageError(f"unknown stage {stage!r}; {nearest_name(stage, STAGES)}")
    if request.engine == "ray":
        from pipeline.runner.ray_engine import check_available

        check_available()
    if request.shard is not None and stage not in FRAME_STAGES:
        raise UsageError(
            f"--shard is for complete, augment and detect; run --stage {stage} once for all shards, without it"
        )


def stages_to_run(stage: str, config: Config, dataset: Dataset) -> list[str]:
    """The frame stages of a request, after a look at their settings and weights: refused now rather than per frame."""
    stages = frame_stages_for(stage, config, has_points(dataset))
    for name in stages:
        FRAME_STAGES[name].of(config).weights()
    return stages


def prepare_folder(run: RunFolder, config: Config) -> None:
    """Makes the run folder, clears what a killed run left behind, and writes the resolved configuration."""
    resolved = config.model_copy(update={"made_with": made_with()})
    try:
        run.root.mkdir(parents=True, exist_ok=True)
        remove_leftovers(run.root)
        write_text(run.config, dump_config(resolved))
    except OSError as error:
        raise UsageError(f"{run.root}: the run folder cannot be written: {error.strerror}") from None


def make_data(config: Config, run: RunFolder, stage: str, shard: tuple[int, int] | None) -> None:
    """Makes synthetic data when the run uses some that is not there yet."""
    if config.data.name != "synthetic":
        if stage == "synth":
            raise UsageError("--stage synth makes synthetic data: use data.name=synthetic (the default configuration)")
        return
    root = data_root(config, run)
    if shard is not None:
        if not root.is_dir():
            raise UsageError(f"{root}: make the data before starting shards: --stage synth")
        return
    from pipeline.synthetic import make_synthetic_data

    make_synthetic_data(config, root)


def dry_run(
    config: Config, run: RunFolder, stage: str, shard: tuple[int, int] | None, verify: bool = False
) -> list[dict[str, Any]]:
    """Prints what would be done, and gives it; writes nothing but the ledger of a run that exists."""
    from pipeline.runner.estimate import estimate_batch, unmeasured

    workers = config.run.workers or available_cores()
    if config.data.name == "synthetic" and not data_root(config, run).is_dir():
        frames = synth_settings(config).frames
        estimates = unmeasured(config, frame_stages_for(stage, config), frames, workers)
    elif run.root.is_dir():
        batch = open_batch(config, run, shard, StopRequest(), verify=verify)
        estimates = estimate_batch(batch, stages_to_run(stage, config, batch.dataset), workers)
        batch.close()
    else:
        dataset = open_frames(config, run)
        frames = len(shard_of(dataset.ids, shard))
        estimates = unmeasured(config, stages_to_run(stage, config, dataset), frames, workers)
    print_dry_run(estimates, run, config)
    return [asdict(item) for item in estimates]


def run_batch(
    request: Request, config: Config, run: RunFolder, stage: str, stop: StopRequest, record: dict[str, Any]
) -> int:
    """The frame stages, then the scores and the report when they are asked for."""
    batch = open_batch(config, run, request.shard, stop, request.engine, request.verify)
    for note in batch.dataset.notes:
        print(f"note: {note}", file=sys.stderr)
    try:
        stages = stages_to_run(stage, config, batch.dataset)
        summaries = [batch.run_stage(name) for name in stages if not stop()]
        if not stop() and stage in ("evaluate", "report"):
            score(config, batch, explicit=request.stage == "evaluate")
        needed = [*frame_stages_for("report", config, has_points(batch.dataset)), *stages, "evaluate"]
        failures = update_failures(run, request.command, batch.dataset.ids, needed)
    finally:
        batch.close()
    if not stop() and stage == "report":
        from pipeline.report.page import write_report

        write_report(config, run, batch.dataset, batch.frames)
    record |= run_record(run, stage, summaries, failures, stopped=bool(stop()))
    return conclude(request, run, stage, stop, summaries, bool(failures))


def score(config: Config, batch: Batch, explicit: bool) -> None:
    """metrics.json and tables.md of the run; frames that cannot be scored go to the ledger."""
    from pipeline.scoring.scores import evaluate_run

    batch.ledger.forget_failures("evaluate", batch.frames)
    frames = [frame_id for frame_id in batch.frames if frame_id not in batch.failed]
    collected = evaluate_run(config, batch.run, batch.dataset, frames)
    for failure in collected.failures:
        print(failure.line(), file=sys.stderr)
        batch.ledger.record(Outcome(Task("evaluate", failure.frame), failure=failure), key="")
    if explicit and not collected.labels and not collected.depth:
        raise UsageError(f"{batch.dataset.root}: nothing to evaluate: no frame has labels or true depth")


def conclude(
    request: Request, run: RunFolder, stage: str, stop: StopRequest, summaries: Sequence[StageSummary], failed: bool
) -> int:
    """Prints the end of the run and gives its exit code (128 + the signal's number after a signal)."""
    print_summary(summaries)
    if not stop() and stage in ("evaluate", "report"):
        print_results(run)
    if not stop() and stage == "report":
        print(f"report: {run.report}")
    if failed:
        print(f"some frames failed: {run.failures} says which and why", file=sys.stderr)
    if stop():
        print(f"{stop.reason}; to continue: {shlex.join(request.command)}", file=sys.stderr)
        if stop.signal_number:
            return 128 + stop.signal_number
        return SOME_FAILED if failed else REFUSED  # refused: the disk budget, and every frame so far went well
    return SOME_FAILED if failed else DONE
