"""The tasks for one log of a fleet; a worker runs them independently of other logs.

A worker reads its log, computes and returns the answer. Only the caller writes to the database. So
a worker that dies costs only its log.
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from twin.assets.record import Record
from twin.calibration import report as calibration_report
from twin.calibration.calibrate import calibrate as fit_unit
from twin.calibration.save import record_of
from twin.config import Config
from twin.diagnosis.answer import diagnose as find_cause
from twin.diagnosis.evidence import CORES
from twin.errors import ConfigError, TwinError
from twin.fleet.watch import watched
from twin.log.reader import open_log
from twin.signals import Samples


@dataclass(frozen=True)
class Job:
    """One log to be worked on, with the configuration of its unit."""

    work: str  # of WORKS
    log: Path
    config: Config
    code: str  # of the caller


@dataclass(frozen=True)
class Done:
    """The outcome of a job: an answer, or why there is none."""

    answer: Mapping[str, Any] | None
    error: str = ""
    record: Record | None = None  # for the asset database


@cache
def code() -> str:
    """16 hex digits of a hash over the sources: other sources may give another answer."""
    sources, root = hashlib.sha256(), Path(__file__).parents[1]
    for path in sorted(root.rglob("*.py")):
        sources.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return sources.hexdigest()[:16]


def run(job: Job) -> Done:
    """Run a job on one core; any error concerns this log only and stops no other one."""
    if job.code != code():
        return Done(None, f"{job.log}: {_OTHER_VERSION}")
    CORES.set(1)
    try:
        answer, record = WORKS[job.work](job)
    except TwinError as error:
        return Done(None, str(error))
    except Exception as error:  # the others go on
        return Done(None, f"{job.log}: a mistake of this program, please report it: {error!r}")
    return Done(answer, record=record)


def _calibrate(job: Job) -> tuple[dict[str, Any], Record | None]:
    calibration = fit_unit(job.config, _samples(job), _no_progress)
    if calibration.verdict.word == "refused":
        raise ConfigError(calibration_report.calibration_verdict(calibration.verdict))
    record = record_of(calibration, job.config, job.log)
    return calibration_report.as_json(calibration, job.config.asset, record), record


def _diagnose(job: Job) -> tuple[dict[str, Any], Record | None]:
    return find_cause(job.config, _samples(job), str(job.log), _no_progress).json, None


def _replay(job: Job) -> tuple[dict[str, Any], Record | None]:
    return watched(job.config, _samples(job)), None


_OTHER_VERSION = (
    "the worker has another version of ejector-twin; install the same one there as here"
)

WORKS: Mapping[str, Callable[[Job], tuple[dict[str, Any], Record | None]]] = {
    "calibrate": _calibrate,
    "diagnose": _diagnose,
    "replay": _replay,
}


def _samples(job: Job) -> Iterable[Samples]:
    """The log's rows in blocks; ConfigError if nobody recorded the commands."""
    log = open_log(job.log)
    log.header.require_commands(str(job.log))
    return log.samples


def _no_progress(_what: str) -> None:
    """Report no progress, since nobody watches one log of many."""
