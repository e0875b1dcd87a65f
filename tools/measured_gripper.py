"""Draw what a measured gripper shows without commands and without a model.

    python tools/measured_gripper.py

It writes docs/pictures/measured-gripper.svg and prints the tables of docs/measured-gripper.md. The
graded leaks are simulated: the measured set has none.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drivers.plc.faults import parse_fault
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import with_truth
from twin.compare.compare import WRONGLY, chance
from twin.config import Config
from twin.diagnosis.drawing import AFTER, ANONYMOUS, BEFORE, MEASURED, QUIET, STYLE
from twin.figures.curve import CURVE, Reading, Stretch, readings, stretches
from twin.figures.text import curve_table
from twin.settings import Document
from twin.signals import MBAR, NS, Samples
from twin.tables.derive import derive
from twin.tables.reader import open_table
from twin.tables.settings import ImportSettings

ROOT = Path(__file__).parent.parent
DATA = ROOT / "tests" / "data" / "suction_gripper"
PICTURE = ROOT / "docs" / "pictures" / "measured-gripper.svg"
PERIOD_S = 0.0256  # of the measured rows
GRADES = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # sl/min
SECONDS, SEED = 42.0, 11
TITLE = (
    "38 readings a second, no commands, no model: vacuum to half a mbar, an open cup, a lost hold\n"
    "and neighbouring grades of a leak are told. Valve times and the evacuation's shape are not."
)


def measured() -> Iterator[tuple[str, Samples, Stretch]]:
    """Name, rows and the suction of each measured record."""
    config = Config.of(Document.read(DATA / "gripper.toml"))
    wanted = config.document.section(ImportSettings, "import")
    ambient = config.data.ambient.pressure_mbar * MBAR
    for path in sorted(DATA.glob("*.csv")):
        table = open_table(path, wanted, ambient, derive=True).with_commands()
        rows = np.concatenate(list(table.blocks()))
        (suction,) = stretches([rows])
        yield path.stem, rows, suction


def graded(leak: float, seed: int) -> list[dict[str, Reading]]:
    """Readings of each suction of the simulated gripper, sampled like the slow logger."""
    plc = Document.read(ROOT / "configs" / "gripper.toml").section(PlcSettings, "plc")
    faults = [parse_fault(f"leakage={leak}@0")] if leak else []
    samples = np.concatenate([rows for rows, _ in with_truth(plc, SECONDS, faults, seed)])
    time = (samples["time_ns"] - samples["time_ns"][0]) * NS
    rng = np.random.default_rng(seed)
    logged_times = np.cumsum(rng.normal(PERIOD_S, 0.1 * PERIOD_S, round(1.1 * SECONDS / PERIOD_S)))
    rows = samples[np.unique(np.searchsorted(time, logged_times).clip(0, len(time) - 1))]
    rows["commands"] = 0
    rows["commands"] = derive(rows).commands
    return [readings(suction) for suction in stretches([rows]) if suction.ended][1:]


def values(suctions: list[dict[str, Reading]], name: str) -> npt.NDArray[np.float64]:
    """Values of a figure, of the suctions that have it."""
    return np.array([suction[name].value for suction in suctions if not suction[name].why])


def draw(runs: list[tuple[str, Samples, Stretch]], grades: list[list[dict[str, Reading]]]) -> None:
    """Write the picture."""
    with mpl.rc_context({**STYLE, "svg.hashsalt": "measured-gripper"}):
        figure = Figure(figsize=(10.0, 7.6), layout="constrained")
        grid = figure.add_gridspec(2, 2, height_ratios=(1.3, 1.0))
        _draw_record(figure.add_subplot(grid[0, :]), *runs[2])
        _draw_runs(figure.add_subplot(grid[1, 0]), runs)
        _draw_grades(figure.add_subplot(grid[1, 1]), grades)
        figure.suptitle(TITLE, x=0.01, ha="left", fontsize=11)
        figure.savefig(PICTURE, metadata=ANONYMOUS)


def _draw_record(axes: Axes, name: str, _rows: Samples, suction: Stretch) -> None:
    figures = readings(suction)
    axes.plot(suction.time, suction.pressure, color=MEASURED, lw=1.0, label="measured")
    axes.axhline(suction.idle, color=QUIET, lw=1.0, ls="--", label="idle, as the record has it")
    end = float(suction.time[suction.end])
    axes.axvspan(
        float(suction.time[0]), end, color=AFTER, alpha=0.12, lw=0, label="suction, derived"
    )
    for text, annotated, level in (
        (f"open cup: {_text(figures['open_cup'])}", 0.6, 950.0),
        (f"holds: {_text(figures['highest'])}", 7.0, 605.0),
        (f"loses its hold: {_text(figures['last'])} at the end", 8.6, 830.0),
    ):
        axes.annotate(text, (annotated, level), fontsize=9)
    axes.set_xlabel(f"time since the record begins (s), {name}.csv")
    axes.set_ylabel("pressure (mbar absolute)")
    axes.legend(loc="lower left", fontsize=9)


def _draw_runs(axes: Axes, runs: list[tuple[str, Samples, Stretch]]) -> None:
    """Draw the open-cup vacuum of every record."""
    for number, (_, _, suction) in enumerate(runs):
        figures = readings(suction)
        opened = figures["highest"] if figures["open_cup"].why else figures["open_cup"]
        held = figures["open_cup"].why == ""
        label = {
            0: "before the cup meets a surface (number: holds so much then)",
            3: "until it is vented",
        }.get(number)
        axes.errorbar(
            number,
            opened.value,
            opened.half,
            fmt="o" if held else "s",
            color=AFTER if held else BEFORE,
            ms=4.0,
            capsize=3.0,
            label=label,
        )
        if held:
            text = f"{figures['highest'].value:.0f}"
            axes.annotate(text, (number, opened.value + 2.0), ha="center", fontsize=8)
    names = [name.replace("hold_and_release_", "hold ").replace("_", " ") for name, _, _ in runs]
    axes.set_xticks(range(len(names)), names, rotation=35, ha="right", fontsize=8)
    axes.set_ylim(25.0, 62.0)
    axes.set_xlim(-0.7, len(runs) - 0.5)
    axes.set_ylabel("vacuum of the open cup (mbar)")
    axes.set_title("Records differ by more than readings do (95 %)", fontsize=10, loc="left")
    axes.legend(loc="lower right", fontsize=8)


def _draw_grades(axes: Axes, grades: list[list[dict[str, Reading]]]) -> None:
    positions = range(len(GRADES))
    values_by_grade = [values(grade, "evacuation") for grade in grades]
    for position, grade_values in zip(positions, values_by_grade, strict=True):
        label = None if position else "one suction"
        axes.plot(
            [position] * len(grade_values), grade_values, "_", color=QUIET, ms=9.0, label=label
        )
    means = [float(grade_values.mean()) for grade_values in values_by_grade]
    axes.plot(positions, means, "o-", color=AFTER, ms=4.0, lw=1.0, label="mean of 20")
    axes.set_xticks(positions, [f"{leak:g}" for leak in GRADES])
    axes.set_xlabel("leak at the lip (sl/min), simulated gripper at the same cadence")
    axes.set_ylabel("evacuation, 10 to 90 % (ms)")
    axes.set_title(
        "Seven grades of a leak: with the decay, all come apart", fontsize=10, loc="left"
    )
    axes.legend(loc="upper left", fontsize=8)


def _text(reading: Reading) -> str:
    return f"{reading.value:.1f} ± {reading.half:.1f} mbar"


def tell(runs: list[tuple[str, Samples, Stretch]], grades: list[list[dict[str, Reading]]]) -> None:
    """Print the tables."""
    print(curve_table([suction for _, _, suction in runs]), end="\n\n")
    names = ("evacuation", "decay", "highest", "last")
    print("| leak (sl/min) |", " | ".join(f"{name} ({CURVE[name].unit})" for name in names), "|")
    for leak, grade in zip(GRADES, grades, strict=True):
        cells = [values(grade, name) for name in names]
        texts = [
            f"{cell.mean():.1f} ± {cell.std(ddof=1):.1f}" if len(cell) > 4 else "-"
            for cell in cells
        ]
        print(f"| {leak:g} |", " | ".join(texts), "|")
    for lower, higher, a, b in zip(GRADES, GRADES[1:], grades, grades[1:], strict=False):
        distinct = [
            name for name in names if chance(values(a, name), values(b, name)) < WRONGLY / 8.0
        ]
        print(
            f"{lower:g} and {higher:g} sl/min are told apart by: {', '.join(distinct) or 'nothing'}"
        )


def main() -> None:
    """Write the picture and print the tables."""
    runs = list(measured())
    grades = [graded(leak, SEED + number) for number, leak in enumerate(GRADES)]
    tell(runs, grades)
    draw(runs, grades)
    print(f"{PICTURE.relative_to(ROOT)}: {PICTURE.stat().st_size / 1e3:.0f} kB", file=sys.stderr)


if __name__ == "__main__":
    main()
