"""Numbers and assumptions that the documents state are those of the program."""

import ast
import re
from dataclasses import replace
from typing import Any

import doc_examples
import numpy as np
import pytest
import rigs

from drivers.outputs.state import KEPT
from drivers.outputs.state import STALE_S as NO_ROW_S
from drivers.plc import partner, rig
from drivers.plc.plant import CV, R_GAS
from twin import files, throttle
from twin.alarms import statistics
from twin.alarms.loop import AGREEING
from twin.compare import compare, side
from twin.figures import cycle_view as course
from twin.figures import key_figures, retention, trend
from twin.figures import writer as figure_writer
from twin.fleet import peers, report
from twin.hil import LONGEST_GAP_S
from twin.log import recorder
from twin.log.columns import encode
from twin.log.schema import SAMPLES
from twin.model import air
from twin.monitor import change_detection as change
from twin.monitor import clock, detector_window, prediction_cache
from twin.monitor.cycles import LONGEST_PIECE
from twin.monitor.isolation import LEARNED
from twin.monitor.model_bank import SUSPECTS
from twin.notifications import data, dispatch, sender, uploader
from twin.page import plant_overview as hall
from twin.page import plant_overview_text as hall_words
from twin.page import ring, server, sessions
from twin.signals import MBAR, MS, SAMPLE, TICK
from twin.tables import reader, unit_check

DOCS = rigs.ROOT / "docs"

# A sentence of a page, and the numbers that it must have.
CLAIMS = (
    ("alarms", "is cleared after {} whole cycles without one", ("five",), (AGREEING,)),
    ("outlets", "pauses from {:g} s to {:g} s", (), (sender.FIRST_PAUSE_S, sender.LONGEST_PAUSE_S)),
    ("outlets", "up to {} changes wait in memory", (), (dispatch.MOST_IN_MEMORY,)),
    ("page", "nothing was heard of the run for {:g} s", (), (ring.STALE_S,)),
    ("alarms", "active for over {:g} h", (), (statistics.STANDING_NS / 3600e9,)),
    (
        "alarms",
        "share of the stretches of 10 min with more than {} alarms",
        (),
        (statistics.FLOOD,),
    ),
    ("alarms", "in 10 min on the average | up to {:g}", (), (statistics.MANAGEABLE,)),
    (
        "alarms",
        "raised {} times or more within {:g} s",
        (),
        (statistics.CHATTERING, statistics.CHATTER_NS / 1e9),
    ),
    ("page", "A row stands for {:g} ms", (), (ring.ROW_NS * 1e-6,)),
    ("page", "It also ends after {:g} h", (), (sessions.SESSION_S / 3600.0,)),
    ("page", "After {} wrong passwords", ("five",), (throttle.FREE_TRIES,)),
    ("page", "one that does not answer for {:g} s is let go", (), (server.QUIET_S,)),
    ("live-fleet", "no values for {:g} s", (), (hall_words.SILENT_S,)),
    ("live-fleet", "Rows of about {:g} s go in one message", (), (data.TOGETHER_S,)),
    ("live-fleet", "its newest {} rows of vacuum", (), (hall.MOST_ROWS,)),
    ("live-fleet", "the key figures of its newest {} cycles", (), (hall.MOST_CYCLES,)),
    ("live-fleet", "{} ejectors at most", (), (hall.MOST,)),
    ("live-fleet", "{} may wait", (), (uploader.MOST_OPEN,)),
    (
        "live-fleet",
        "pauses from {:g} s to {:g} min",
        (),
        (uploader.FIRST_PAUSE_S, uploader.LONGEST_PAUSE_S / 60.0),
    ),
    ("fleet", "Fewer than {} units of a type", ("eight",), (peers.FEWEST_PEERS,)),
    ("fleet", "From {} logs of a unit on", ("six",), (peers.FEWEST_LOGS,)),
    ("fleet", "From {:g} sigmas of the others' scatter on", (), (report.STANDS_OUT,)),
    ("fleet", "if it is {} of its sigmas", ("four",), (peers.DRIFTS,)),
    ("csv", "Unpacked, a file may have {:g} MiB", (), (files.MEMORY_BUDGET / 2**20,)),
    ("csv", "A column that is never above {:g} mbar", (), (unit_check.LEAST / MBAR,)),
    (
        "csv",
        "{:g} MiB at most: {:g} million rows, {:g} minutes at 1 kHz",
        (),
        (
            files.MEMORY_BUDGET / 2**20,
            round(files.MEMORY_BUDGET / reader.READING.itemsize / 1e6),
            round(files.MEMORY_BUDGET / reader.READING.itemsize / 60e3),
        ),
    ),
    ("engineer", "Below {} cycles on a side", ("five",), (compare.FEWEST,)),
    (
        "engineer",
        "shows at most {:g} s, in steps of {:g} ms",
        (),
        (side.LONGEST_S, side.BIN_S / MS),
    ),
    ("hil", "Where commands are missing for more than {:g} s", (), (LONGEST_GAP_S,)),
    ("hil", "gives a pick up after {:g} s", (), (partner.LONGEST_PICK * rig.SCAN,)),
    ("hil", "while the watchdog stands still for {:g} s", (), (partner.PATIENCE * rig.SCAN,)),
    ("isolation", "A cycle of more than {:g} s is judged by itself", (), (LONGEST_PIECE * MS,)),
    ("isolation", "learned from the first {} cycles on", ("ten",), (LEARNED,)),
    ("isolation", "({:g} sigma in any score)", (), (change.STRANGE,)),
    ("isolation", "none is learned as usual for {} cycles", ("four",), (change.WAITS,)),
    (
        "isolation",
        "(each phase within {:g} % or {:g} ms, each level within {:g} mbar)",
        (),
        (
            100.0 * prediction_cache.LONGER,
            prediction_cache.LONGER_MS,
            prediction_cache.LEVEL / MBAR,
        ),
    ),
    ("key-figures", "a hole in the readings of more than {:g} ms", (), (course.LONGEST_HOLE / MS,)),
    (
        "key-figures",
        "by less than {:g} mbar/s over its last half second",
        (),
        (key_figures.STEADY,),
    ),
    ("key-figures", "up to {} cycles wait in memory", (), (figure_writer.MOST_WAITING,)),
    ("key-figures", "in up to {} bins of time", (), (trend.BINS,)),
    ("key-figures", "unless the slope is sure to {:g} %", (), (100.0 * trend.SURE,)),
    ("key-figures", "Beyond {} times the length of the record", ("three",), (trend.FARTHEST,)),
    ("log-format", "A chunk is completed each {:g} s", (), (recorder.FLUSH_S,)),
    ("log-format", "receipts of {:g} s windows", (), (clock.WINDOW_NS * 1e-9,)),
    ("log-format", "from {:g} ms on where the PLC counts its scans", (), (clock.SET_NS * 1e-6,)),
    ("operation", "It deletes about {} rows at a time", (), (retention.PORTION,)),
    ("opcua", "the last {} events", (), (KEPT,)),
    ("opcua", "or no row has come for {}", ("a second",), (NO_ROW_S,)),
)
WORDS = {"a second": 1, "three": 3, "four": 4, "five": 5, "six": 6, "eight": 8, "ten": 10}


@pytest.mark.parametrize(
    ("page", "sentence", "words", "values"), CLAIMS, ids=[f"{c[0]}: {c[1]}" for c in CLAIMS]
)
def test_a_page_has_the_programs_numbers(
    page: str, sentence: str, words: tuple[str, ...], values: tuple[float, ...]
) -> None:
    assert not words or tuple(WORDS[word] for word in words) == values
    given = words or tuple(grouped(value) for value in values)
    stated = sentence.replace("{:g}", "{}").format(*given)
    text = " ".join((DOCS / f"{page}.md").read_text(encoding="utf-8").split())
    assert stated in text


def grouped(value: float) -> str:
    """A number as the pages write it, with a space before thousands from ten thousand on."""
    return f"{value:,.0f}".replace(",", " ") if value >= 10_000 else f"{value:g}"


@pytest.mark.parametrize("name", rigs.NAMES)
def test_the_model_is_as_far_behind_as_the_readme_says(name: str) -> None:
    shipped = rigs.detector(name)
    readme = " ".join((rigs.ROOT / "README.md").read_text(encoding="utf-8").split())
    match = re.search(
        r"by up to (\d+) ms on the shipped systems, by up to ([\d.]+) s where", readme
    )
    assert match is not None
    assert shipped.lag <= float(match[1])
    assert replace(shipped, window=detector_window.LONGEST_WINDOW).lag * MS <= float(match[2])


def test_the_bank_looks_for_every_effect_in_small_steps() -> None:
    steps = {suspect.effect: suspect.step for suspect in SUSPECTS}
    late = ("response_delay", "blow_off_delay", "slow_ramp_up", "sensor_lag")
    assert {steps[effect] for effect in late} == {0.5, 1.0}  # ms, as docs/isolation.md says


def test_what_is_measured_by_the_bench_is_stated_by_the_bench_alone() -> None:
    """Decisions say what was measured when they were made; pages point to what holds today."""
    pages = [page for page in DOCS.glob("*.md") if page.name != "bench.md"]
    for page in [rigs.ROOT / "README.md", *pages]:
        assert re.findall(r"[\d.]+ % of a core", page.read_text(encoding="utf-8")) == [], page


def test_the_example_that_unpacks_a_column_of_a_log_unpacks_it() -> None:
    (code,) = doc_examples.blocks("log-format.md", "python")
    names: dict[str, Any] = {"np": np}
    exec(code, names)
    rng = np.random.default_rng(1)
    samples, ticks = np.zeros(500, SAMPLE), np.zeros(500, TICK)
    samples["sequence"] = np.arange(70_000, 70_500)
    samples["time_ns"] = rng.integers(-(1 << 62), 1 << 62, 500)
    samples["pressure"] = rng.normal(50_000.0, 20_000.0, 500)
    samples["commands"], ticks["phase"] = rng.integers(0, 4, (2, 500))
    message = SAMPLES.message.FromString(encode(samples, ticks))
    for rows in (samples, ticks):
        for name in rows.dtype.names:
            packed, dtype = getattr(message, name), rows.dtype[name].str.lstrip("|<")
            unpacked = names["column"](packed, message.count, dtype)
            np.testing.assert_array_equal(unpacked, rows[name], err_msg=name)


# --- rig and model: CONTRIBUTING.md, Tests --------------------------------------------------------

VOCABULARY = (
    "signals",
    "quality",
    "errors",
    "settings",
    "secret",
    "users",
    "events",
    "cpu_target",
    "extras",
)


def test_rig_and_model_share_the_constants_that_are_said_to_be_shared() -> None:
    assert R_GAS == air.R
    assert pytest.approx(air.CP - air.R, rel=1e-3) == CV
    assert air.CRITICAL_RATIO == rig.CRITICAL == 0.528
    text = (rigs.ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    assert "the critical ratio 0.528" in text


def test_rig_and_model_share_no_code_but_the_vocabulary() -> None:
    allowed = {f"twin.{name}" for name in VOCABULARY}
    for path in (rigs.ROOT / "drivers" / "plc").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("twin"):
                assert node.module in allowed, path
            elif isinstance(node, ast.Import):
                assert not any(alias.name.startswith("twin") for alias in node.names), path
