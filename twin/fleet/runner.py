"""Runs one job for each log of a fleet; skips stored answers, and stores new ones at once."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, as_completed
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import URL

from twin.assets.database import open_assets
from twin.calibration.save import add as add_calibrated
from twin.config import Config
from twin.errors import TwinError
from twin.fleet.engines import Submit, died
from twin.fleet.results_database import Key, Store, key_of
from twin.fleet.tasks import Done, Job, code, run
from twin.log.reader import Log, open_log

Configure = Callable[[Log], Config]


@dataclass(frozen=True)
class Wanted:
    """A job to run, and the key of its answer."""

    job: Job
    key: Key
    begin_ns: int
    complete: bool  # the log


@dataclass(frozen=True)
class Outcome:
    """The outcome for a log."""

    log: Path
    state: str  # done, known, failed
    key: Key | None = None  # of the answer, if there is one
    error: str = ""
    complete: bool = True  # the log, as far as it could be read


def ask(work: str, logs: Iterable[Path], configure: Configure) -> Iterator[Wanted | Outcome]:
    """Open every log; yields its job, or why there is none."""
    for path in logs:
        try:
            log = open_log(path)
            config = configure(log)
            job, key = Job(work, path, config, code()), key_of(work, log, config)
            yield Wanted(job, key, _begin_ns(log), log.complete)
        except (TwinError, OSError) as error:
            yield _failed(path, str(error))
        except Exception as error:  # the others go on
            yield _failed(path, f"a mistake of this program, please report it: {error!r}")


def go(
    wanted: Sequence[Wanted], submit: Submit, store: Store, assets: str | Path | URL
) -> Iterator[Outcome]:
    """Run jobs; yields each outcome once it is stored."""
    store.note({item.key.log_sha256: item.complete for item in wanted})
    stored = store.known([item.key for item in wanted])
    futures: dict[Future[Done], Wanted] = {}
    seen = set(stored)
    for item in wanted:
        if item.key in seen:
            yield Outcome(item.job.log, "known", item.key, complete=item.complete)
        else:
            seen.add(item.key)
            futures[submit(run, item.job)] = item
    for future in as_completed(futures):
        yield _store_outcome(future, futures.pop(future), store, assets)


def _store_outcome(
    future: Future[Done], item: Wanted, store: Store, assets: str | Path | URL
) -> Outcome:
    log = item.job.log
    try:
        outcome = future.result()
    except Exception as error:
        if not died(error):
            raise
        return _failed(log, f"the process that worked on it was killed: {error}")
    if outcome.answer is None:
        return _failed(log, outcome.error)
    if outcome.record is not None:
        with open_assets(assets) as database:
            add_calibrated(database, outcome.record)
    store.add(item.key, item.job.config, log, item.begin_ns, outcome.answer)
    return Outcome(log, "done", item.key, complete=item.complete)


def _failed(log: Path, reason: str) -> Outcome:
    """The outcome of a failed log; its text names the log."""
    return Outcome(log, "failed", error=reason if str(log) in reason else f"{log}: {reason}")


def _begin_ns(log: Log) -> int:
    """When the log was recorded: the receipt time of its first row, in ns."""
    for samples, _ in log.blocks(1):
        return int(samples["host_ns"][0])
    return 0
