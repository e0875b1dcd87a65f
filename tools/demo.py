"""The demo: a live twin beside a simulated PLC, a leak that opens half-way, alarm and cause.

Leaves ``demo/`` with the MCAP log, the diagnosis JSON and the HTML report. Exits with 0 only if
the leak was flagged while the twin ran and named by both diagnoses: the one that the live twin had
made of its last cycles, and the one of the whole log afterwards.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path

from twin.config import Config
from twin.events import Kind
from twin.live import compiled
from twin.log.reader import open_log
from twin.settings import Document

ROOT = Path(__file__).parent.parent
CONFIG = ROOT / "configs" / "test_rig.toml"
FOLDER = ROOT / "demo"
LIVE_S = 20
LEAK = "leakage=2.0@11"  # sl/min; the PLC runs for a second or two before the twin does


def main() -> int:
    """Run the demo; give its exit code."""
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir()
    print("Compiling the model (up to a minute the first time).", flush=True)
    compiled(Config.of(Document.read(CONFIG)).data)
    log, answer, report = (FOLDER / name for name in ("log.mcap", "diagnosis.json", "report.html"))
    print(f"Starting the simulated PLC; in it a leak of 2 sl/min opens half-way ({LEAK}).")
    plc = subprocess.Popen(
        [*_twin("plc"), str(CONFIG), "--port", "0", "--seed", "1", "--fault", LEAK],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        address = _address(plc)
        print(f"Running the live twin against {address} for {LIVE_S} s.\n", flush=True)
        lines = _watch([*_twin("run"), str(CONFIG), "--address", address, "--log", str(log)])
    finally:
        plc.terminate()
        plc.communicate(timeout=10)
    print("\nDiagnosing the whole log, for the report.\n", flush=True)
    command = [*_twin("diagnose"), str(log), "--json", str(answer), "--report", str(report)]
    subprocess.run(command, check=True)
    return _verdict(lines, log, answer)


def _twin(command: str) -> list[str]:
    return [sys.executable, "-m", "twin.cli", command]


def _address(plc: "subprocess.Popen[str]") -> str:
    """Wait until the PLC says where it listens."""
    line = plc.stdout.readline() if plc.stdout else ""
    if not line.startswith("listening on "):
        sys.exit(f"the simulated PLC did not start: {line!r}")
    return line.removeprefix("listening on ").strip()


def _watch(command: list[str]) -> list[str]:
    """Run the live twin, showing and keeping what it prints."""
    lines = []
    live = subprocess.Popen(
        [*command, "--duration", str(LIVE_S)], stdout=subprocess.PIPE, text=True
    )
    for line in live.stdout or ():
        print(f"  {line}", end="", flush=True)
        lines.append(line)
    if live.wait() != 0:
        sys.exit(f"the live twin failed with exit code {live.returncode}")
    return lines


def _verdict(lines: list[str], log: Path, answer: Path) -> int:
    """Say whether the demo showed what it is for."""
    live = [
        event.data.get("answer") for event in open_log(log).events() if event.kind is Kind.DIAGNOSIS
    ]
    print(f"\nLeft in {FOLDER.name}/: log.mcap, diagnosis.json, report.html")
    if not any(" deviation " in line and "leakage" in line for line in lines):
        return _failed("no alarm named the leak while the twin ran")
    for whose, found in (
        ("of the live twin", live[-1] if live else None),
        ("of the log", json.loads(answer.read_text())),
    ):
        causes = [cause["effect"] for cause in found["causes"]] if found else []
        if causes != ["leakage"]:
            return _failed(f"the diagnosis {whose} names {causes or 'nothing'}, not the leak")
    print("The leak was flagged and named while the twin ran, and named again from the log.")
    return 0


def _failed(why: str) -> int:
    print(f"The demo FAILED: {why}.")
    return 1


if __name__ == "__main__":
    sys.exit(main())
