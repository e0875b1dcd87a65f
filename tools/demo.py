"""The demo: a live twin beside a simulated PLC, a leak that opens half-way, alarm and cause.

It writes ``demo/`` with the MCAP log, the diagnosis JSON and the HTML report. Exit code 0 requires
that the live twin raised and named the leak, and reported neither a stale PLC nor another cause.
Both diagnoses, the live twin's and the log's, must name the leak with its onset.

All steps are rehearsed first on simulated rows, so that nothing is compiled while the PLC runs.
Each step waits for the output of the programs, not for times: a busy machine only takes longer.
"""

import json
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from drivers.plc.faults import parse_fault
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks
from twin.cli.run import WAITS
from twin.cli.setup import pair_of
from twin.cli.stopping import INTERRUPTED
from twin.config import Config
from twin.diagnosis.answer import diagnose
from twin.events import Event, Kind
from twin.live import run
from twin.log.reader import Log, open_log
from twin.log.recorder import Recorder
from twin.model.effects import UNKNOWN
from twin.settings import Document
from twin.signals import NS

ROOT = Path(__file__).parent.parent
CONFIG = ROOT / "configs" / "test_rig.toml"
FOLDER = ROOT / "demo"
LEAK_S = 13  # after the PLC's start: three healthy cycles before it, three with the leak after
LEAK = f"leakage=2.0@{LEAK_S}"  # sl/min
REHEARSED_S = 26  # of rows: as many cycles as the live twin sees before it makes a diagnosis
LONGEST_S = 300  # with the PLC: a twin that makes no diagnosis is ended
ONSET_S = 0.2  # largest error of the onset


def main() -> int:
    """Run the demo; give its exit code."""
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir()
    _rehearse()
    log, answer, report = (FOLDER / name for name in ("log.mcap", "diagnosis.json", "report.html"))
    print("The live twin waits for the PLC. Then the PLC starts; a leak of 2 sl/min opens in it")
    print(f"{LEAK_S} s later, and the twin runs until it has made a diagnosis.\n", flush=True)
    _run_both(log)
    print("\nDiagnosing the whole log, for the report.\n", flush=True)
    command = [*_twin("diagnose"), str(log), "--json", str(answer), "--report", str(report)]
    subprocess.run(command, check=True)
    print(f"\nLeft in {FOLDER.name}/: log.mcap, diagnosis.json, report.html")
    recorded = open_log(log)
    return judged(list(recorded.events()), json.loads(answer.read_text()), *_times(recorded))


def _rehearse() -> None:
    """Run all steps on simulated rows first, so that everything is compiled before time counts.

    It takes minutes where nothing is compiled yet, and seconds later.
    """
    print("Getting ready before the PLC starts:", flush=True)
    settings = Config.of(Document.read(CONFIG))
    with _timed("the simulated PLC"):
        plc = settings.document.section(PlcSettings, "plc")
        rows = list(blocks(plc, REHEARSED_S, [parse_fault(LEAK)]))
    with _timed("the live twin"), tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log.mcap"
        run(rows, *pair_of(settings), [Recorder(log, settings.log_header())])
        recorded = [samples for samples, _ in open_log(log).blocks()]
    with _timed("the diagnosis"):
        diagnose(settings, recorded, "rehearsal", lambda _what: None)


@contextmanager
def _timed(step: str) -> Iterator[None]:
    """Print the step that is done, and how long it took."""
    begun = time.monotonic()
    yield
    print(f"  {step} is ready ({time.monotonic() - begun:.0f} s)", flush=True)


def _twin(command: str) -> list[str]:
    return [sys.executable, "-m", "twin.cli", command]


@contextmanager
def _program(
    command: list[str], stderr: int | None = None
) -> Iterator[tuple["subprocess.Popen[str]", Iterable[str]]]:
    """A program that runs in the background, with the lines that it prints; ended at the end."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=stderr, text=True) as process:
        assert process.stdout is not None
        try:
            yield process, process.stdout
        finally:
            with suppress(ProcessLookupError):
                process.terminate()


def _run_both(log: Path) -> None:
    """Run the live twin, and the PLC as soon as the twin waits for it, up to the diagnosis.

    So the twin sees the PLC from its start, however long its own takes.
    """
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = str(free.getsockname()[1])
    options = ["--address", f"127.0.0.1:{port}", "--log", str(log), "--duration", str(LONGEST_S)]
    with _program([*_twin("run"), str(CONFIG), *options], subprocess.STDOUT) as (live, lines):
        _show_until(WAITS, lines)
        of_plc = [*_twin("plc"), str(CONFIG), "--port", port, "--seed", "1", "--fault", LEAK]
        with _program(of_plc) as (_, plc_lines):
            if not any(line.startswith("listening") for line in plc_lines):
                sys.exit("the simulated PLC did not start; above it says why")
            _show_until(f"  {Kind.DIAGNOSIS}  ", lines)
            live.send_signal(signal.SIGINT)
            _show_until(None, lines)
            if live.wait() not in (0, INTERRUPTED):
                sys.exit(f"the live twin failed with exit code {live.returncode}")


def _show_until(text: str | None, lines: Iterable[str]) -> None:
    """Print lines up to the first one with the text; all remaining lines without one."""
    for line in lines:
        print(f"  {line}", end="", flush=True)
        if text is not None and text in line:
            return


def judged(
    events: Sequence[Event], answer: dict[str, Any], began_ns: int | None, opened_ns: int | None
) -> int:
    """Print whether the demo reached its goals; give its exit code.

    ``events`` and ``answer`` (the diagnosis JSON) are of the log, which began at ``began_ns``; the
    leak opened at ``opened_ns`` (PLC time, None where the log does not hold it).
    """
    if began_ns is None or opened_ns is None:
        failure = "the log does not hold the moment when the leak opens"
    else:
        failure = _missed(events, answer, began_ns, opened_ns)
    if failure:
        print(f"The demo FAILED: {failure}.")
        return 1
    print("The leak was flagged and named while the twin ran, and named again from the log.")
    return 0


def _missed(events: Sequence[Event], answer: dict[str, Any], began_ns: int, opened_ns: int) -> str:
    """The goals that the demo missed; empty if it reached all."""
    if any(event.kind is Kind.PLC_STALE for event in events):
        return "the PLC was called stale, and it was not"
    raised = [event for event in events if event.kind is Kind.DEVIATION]
    if any(event.time_ns < opened_ns for event in raised):
        return "an alarm came before the leak opened"
    named = [str(event.data["effect"]) for event in raised if event.data["effect"] != UNKNOWN]
    if "leakage" not in named:
        return "no alarm named the leak while the twin ran"
    if set(named) != {"leakage"}:
        return f"alarms named {', '.join(named)}, and it was the leak alone"
    live = [event for event in events if event.kind is Kind.DIAGNOSIS and "answer" in event.data]
    if not live:
        return "the live twin made no diagnosis"
    diagnoses = (
        ("of the live twin", live[-1].data["answer"], int(live[-1].data["begin_ns"])),
        ("of the log", answer, began_ns),
    )
    problems = (
        _wrong(diagnosis, (opened_ns - begin) * NS, source)
        for source, diagnosis, begin in diagnoses
    )
    return next(filter(None, problems), "")


def _wrong(diagnosis: dict[str, Any], opened_s: float, source: str) -> str:
    """Errors of a diagnosis; ``opened_s`` is the time of the leak in its rows."""
    causes = diagnosis["causes"]
    if [cause["effect"] for cause in causes] != ["leakage"]:
        names = ", ".join(cause["effect"] for cause in causes) or "nothing"
        return f"the diagnosis {source} names {names}, not the leak"
    onset_s = causes[0]["onset_s"]
    if onset_s is None:
        return f"the diagnosis {source} does not say since when the leak is there"
    off_s = onset_s - opened_s
    return f"the onset {source} is {off_s:+.2f} s off" if abs(off_s) > ONSET_S else ""


def _times(log: Log) -> tuple[int | None, int | None]:
    """PLC time of the first row, and of that at which the leak opens."""
    first = opened = None
    for samples, _ in log.blocks():
        if first is None:
            first = int(samples["time_ns"][0])
        rows = np.flatnonzero(samples["sequence"] == LEAK_S * 1000)  # a scan each ms
        opened = int(samples["time_ns"][rows[0]]) if len(rows) else opened
    return first, opened


if __name__ == "__main__":
    sys.exit(main())
