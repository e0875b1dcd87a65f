"""A fleet's logs, one job each: what is known already is left out, what is done is kept at once."""

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
    """A job that is to be done, and by what its answer will be known."""

    job: Job
    key: Key
    begin_ns: int
    complete: bool  # the log


@dataclass(frozen=True)
class Told:
    """What became of a log."""

    log: Path
    state: str  # done, known, failed
    key: Key | None = None  # of the answer, where there is one
    error: str = ""
    complete: bool = True  # the log, as far as it could be read


def ask(work: str, logs: Iterable[Path], configure: Configure) -> Iterator[Wanted | Told]:
    """Open every log; give its job, or why there is none."""
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
) -> Iterator[Told]:
    """Have jobs done; tell of each as it is done, and kept."""
    store.note({one.key.log_sha256: one.complete for one in wanted})
    known = store.known([one.key for one in wanted])
    futures: dict[Future[Done], Wanted] = {}
    asked = set(known)
    for one in wanted:
        if one.key in asked:
            yield Told(one.job.log, "known", one.key, complete=one.complete)
        else:
            asked.add(one.key)
            futures[submit(run, one.job)] = one
    for future in as_completed(futures):
        yield _keep(future, futures.pop(future), store, assets)


def _keep(future: Future[Done], one: Wanted, store: Store, assets: str | Path | URL) -> Told:
    log = one.job.log
    try:
        done = future.result()
    except Exception as error:
        if not died(error):
            raise
        return _failed(log, f"the process that worked on it was killed: {error}")
    if done.answer is None:
        return _failed(log, done.error)
    if done.record is not None:
        with open_assets(assets) as database:
            add_calibrated(database, done.record)
    store.add(one.key, one.job.config, log, one.begin_ns, done.answer)
    return Told(log, "done", one.key, complete=one.complete)


def _failed(log: Path, why: str) -> Told:
    """Of which log it is said, where that is not said yet."""
    return Told(log, "failed", error=why if str(log) in why else f"{log}: {why}")


def _begin_ns(log: Log) -> int:
    """When it was recorded: its first row's receipt."""
    for samples, _ in log.blocks(1):
        return int(samples["host_ns"][0])
    return 0
