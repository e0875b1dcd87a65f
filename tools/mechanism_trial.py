"""Hide mechanisms that are not in the table, extend the model, and judge it on other programs.

    python -m tools.mechanism_trial [--first SEED] [--cases 10] [--write docs/mechanisms.md]

Each mechanism of the first world's rig is hidden in turn in a log of 12 cycles. Its size, and one
of two calibrated units, are drawn by seed. The extended model is judged on new logs: with the same
program, and with suction twice and half as long.
"""

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.plc.settings import PlcSettings
from tools.battery_first import CYCLES, UNLISTED, drawn_case, fault
from tools.battery_page import marked
from tools.calibration_coverage import recorded
from twin.diagnosis.another_log import judged_on
from twin.diagnosis.answer import diagnose

UNITS = 2
PROGRAMS = {"same": 1.0, "twice": 2.0, "half": 0.5}  # times the suction of the log
HEAD = "| unit | hidden | what the answer says | same program | suction twice | suction half | s |"


@dataclass(frozen=True)
class Extended:
    """A hidden mechanism, its name in the answer, and rms (mbar) before and after."""

    unit: str
    hidden: str
    named: str
    gains: dict[str, tuple[float, float] | None]  # by program
    seconds: float

    def row(self) -> str:
        """The line of the table."""
        gains = (
            "–" if pair is None else f"{pair[0]:.1f} → {pair[1]:.1f}"
            for pair in self.gains.values()
        )
        cells = [self.unit, self.hidden, self.named, *gains, f"{self.seconds:.0f}"]
        return f"| {' | '.join(cells)} |"


def longer(plc: PlcSettings, times: float) -> PlcSettings:
    """The same rig with ``times`` the suction in its program."""
    program = plc.program.model_copy(update={"suction_ms": times * plc.program.suction_ms})
    return plc.model_copy(update={"program": program})


def trial(seed: int) -> Extended:
    """Hide a mechanism, extend the twin, and judge it on programs that it has not seen."""
    unit, (hidden,), samples = drawn_case("unlisted", seed, UNITS)
    begin = time.process_time()
    diagnosis = diagnose(unit.config, [samples], "trial", lambda _: None)
    seconds, answer = time.process_time() - begin, diagnosis.json
    rng = np.random.default_rng([31, seed])
    gains = {}
    for name, times in PROGRAMS.items():
        fault_there = fault(rng, longer(unit.plc, times), hidden)
        log = recorded(
            longer(unit.plc, times), CYCLES - 1, int(rng.integers(1 << 30)), [fault_there]
        )
        gains[name] = _rms(judged_on(diagnosis, unit.config, name, [log]))
    size = f"{hidden.effect} {hidden.size:.3g}"
    return Extended(unit.name, size, _named(answer), gains, seconds)


def _rms(judged: dict[str, Any] | None) -> tuple[float, float] | None:
    if judged is None:
        return None
    return judged["baseline"]["rms_mbar"], judged["extended"]["rms_mbar"]


def _named(answer: dict[str, Any]) -> str:
    causes = ", ".join(cause["effect"] for cause in answer["causes"])
    mechanism = (answer["unlisted"] or {}).get("mechanism")
    sentence = mechanism["sentence"] if mechanism else ""
    return f"{answer['verdict']}: {'; '.join(part for part in (causes, sentence) if part) or '–'}"


def table(results: Sequence[Extended]) -> str:
    """The results in Markdown."""
    rule = "|" + " --- |" * (HEAD.count("|") - 1)
    return "\n".join([HEAD, rule, *(result.row() for result in results)])


def _trials(first: int, cases: int) -> Iterator[Extended]:
    for seed in range(first, first + cases):
        result = trial(seed)
        print(result.row(), flush=True)
        yield result


def main() -> None:
    """Run the trial; write its table into a page if asked."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--first", type=int, default=int(time.time()) % 1_000_000)
    parser.add_argument("--cases", type=int, default=2 * len(UNLISTED))
    parser.add_argument("--write", type=Path)
    arguments = parser.parse_args()
    text = table(list(_trials(arguments.first, arguments.cases)))
    if arguments.write:
        page = arguments.write.read_text(encoding="utf-8")
        part = marked("mechanisms", page)
        page = page.replace(part[0], f"{part[1]}{text}\n{part[3]}")
        arguments.write.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
