"""``twin figures``, from a log to tables, trends, counters and taught limits."""

import csv
import json
import time
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rigs
from pyarrow import parquet

from twin.assets.unit import Unit
from twin.cli.figures import figures_app
from twin.errors import ConfigError, SourceError
from twin.figures.database import VALUES, open_store
from twin.instants import clock
from twin.live import run as run_loop
from twin.log.header import LogHeader
from twin.log.recorder import Recorder

Run = Callable[..., str]
UNIT = Unit("compact-ejector-35", "gripper-01")
DAY = 86_400 * 10**9


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine healthy cycles of the gripper."""
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    config = rigs.config("gripper")
    metadata = {"data": config.data.model_dump_json(), "data_set": config.data.hash}
    header = LogHeader(*UNIT, "gripper.toml", config.document.text, metadata)
    recorded = rigs.cut(rigs.recorded("gripper", 20.0)[0], 100)
    sinks = [Recorder(path, header)]
    run_loop(recorded, rigs.twin("gripper"), rigs.monitor("gripper"), sinks)
    return path


def fill(days: float, count: int, unit: Unit = UNIT, **values: float) -> None:
    """A database in this folder with cycles over days, whose leakage rises by 5 mbar/s a day."""
    rng = np.random.default_rng(1)
    host = (10**18 + np.linspace(0, days, count) * DAY).astype(int)
    cycles = [
        {
            "cycle": number,
            "begin_ns": int(ns),
            "host_ns": int(ns),
            "warnings": [],
            "t1_measured": 250.0 + rng.normal(),
            "leakage_measured": 100 + 5 * (ns - host[0]) / DAY + rng.normal(),
            "switchings_measured": 1,
            **values,
        }
        for number, ns in enumerate(host)
    ]
    with open_store("figures.sqlite") as store:
        store.add(unit, "a", "test", cycles)


def counted(out: str) -> list[list[str]]:
    """Suction cycles, valve switchings and alarms: in all, and erasable."""
    return [line.split()[-2:] for line in out.splitlines()[1:]]


def test_a_log_that_was_cut_off_is_shown_and_said_to_be(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[:-100])
    figures_app(["show", str(cut)], standalone_mode=False)
    assert f"twin: {cut} is not complete; what can be read is used" in capsys.readouterr().err


def test_a_log_is_shown_with_what_was_expected(figures: Run, log: Path) -> None:
    cycles, curve = figures("show", log).split("\n\n")
    head, *rows = cycles.splitlines()
    assert curve.startswith("read off the curve, without a model; vacuum counts from the record's")
    assert "open_cup is missing in 10 of 10 suctions: the evacuation begins at once" in curve
    assert head.split()[:3] == ["cycle", "t0", "(ms)"]
    assert len(rows) == 10  # the last one cut off
    assert rows[3].split()[0] == "3"
    assert rows[3].split()[1:3] == ["189", "(189)"]


def test_a_log_as_json_and_as_tables(figures: Run, log: Path) -> None:
    figures("show", log, "--json", "f.json", "-o", "f.csv")
    figures("show", log, "-o", "f.parquet")
    cycles = json.loads(Path("f.json").read_text())["cycles"]
    with Path("f.csv").open() as file:
        rows = list(csv.DictReader(file))
    table = parquet.read_table("f.parquet")
    assert table.schema.field("leakage_measured").metadata[b"unit"] == b"mbar/s"
    assert len(cycles) == len(rows) == table.num_rows == 10
    for cycle, row, other in zip(cycles, rows, table.to_pylist(), strict=True):
        assert row["time"].startswith("2026-01-01 00:00:")
        assert row["asset_id"] == "gripper-01"
        for name in VALUES:
            assert other[name] == cycle.get(name)
            assert (float(row[name]) if row[name] else None) == cycle.get(name)


def test_another_suffix_is_refused(figures: Run, log: Path) -> None:
    with pytest.raises(ConfigError, match=r"f\.txt: the name does not end in"):
        figures("show", log, "-o", "f.txt")


def test_a_log_is_kept_once(figures: Run, log: Path) -> None:
    assert figures("show", log, "--keep").splitlines()[-1].startswith("10 new of 10 cycles, in ")
    assert figures("show", log, "--keep").splitlines()[-1].startswith("0 new of 10 cycles, in ")
    assert counted(figures("counters")) == [["10", "10"], ["10", "10"], ["0", "0"]]


def test_trends_are_said_drawn_and_written(figures: Run) -> None:
    fill(10, 2000)
    out = figures("trend", "leakage", "t1", "--json", "t.json")
    rising, flat = out.splitlines()
    assert rising.startswith(("leakage: 149.9 mbar/s, +", "leakage: 150 mbar/s, +"))
    assert "its limit of 250 mbar/s in 20.0 days (" in rising
    assert "no trend" in flat
    leakage, t1 = json.loads(Path("t.json").read_text())
    assert leakage["line"]["is_trend"]
    assert leakage["days_to_limit"]["low95"] < 20 < leakage["days_to_limit"]["high95"]
    assert t1["days_to_limit"] is None
    figures("trend", "leakage", "--picture", "t.png")
    assert Path("t.png").stat().st_size > 10_000
    assert len(figures("trend").splitlines()) == len(VALUES) // 2


def test_a_limit_too_far_to_be_dated_is_drawn_all_the_same(figures: Run, tmp_path: Path) -> None:
    fill(10, 500)
    config = tmp_path / "cell.toml"
    text = rigs.path_of("gripper").read_text()
    text = text.replace('id = "gripper-01"', 'id = "cell-1"')
    config.write_text(text + "\n[data.ejector]\npermitted_leakage_mbar_s = 900.0\n")
    out = figures(
        "trend", "leakage", "--config", config, "--id", "gripper-01", "--picture", "t.svg"
    )
    assert out.rstrip().endswith("its limit of 900 mbar/s is more than 29.8 days away")
    assert b"</svg>" in Path("t.svg").read_bytes()


def test_a_picture_is_of_one_figure_and_there_must_be_such(figures: Run) -> None:
    fill(10, 100)
    with pytest.raises(ConfigError, match="a picture shows one figure"):
        figures("trend", "--picture", "t.png")
    with pytest.raises(ConfigError, match="no figure is called leak"):
        figures("trend", "leak")
    with pytest.raises(ConfigError, match=r"t\.xyz: the name does not end in \.svg or \.png"):
        figures("trend", "leakage", "--picture", "t.xyz")


def test_only_the_last_days(figures: Run) -> None:
    fill(10, 100)
    with pytest.raises(ConfigError, match="no cycles of gripper-01 in that time"):
        figures("trend", "--days", "1")


def test_counters_are_erased(figures: Run) -> None:
    fill(1, 50)
    assert counted(figures("counters")) == [["50", "50"], ["50", "50"], ["0", "0"]]
    assert counted(figures("counters", "--erase")) == [["50", "0"], ["50", "0"], ["0", "0"]]


def test_deleted_cycles_are_named_and_still_counted(
    log: Path, figures: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Half of the cycles are deleted, and then those of a log."""
    fill(10, 100)
    with open_store("figures.sqlite") as store:
        store.delete(UNIT, 10**18 + 5 * DAY, most=1000)
        deleted = clock(store.deleted_until(UNIT) or 0, time.time_ns())
    note = f"twin: cycles up to {deleted} are deleted; only later ones are used\n"
    figures_app(["trend", "leakage"], standalone_mode=False)
    shown = capsys.readouterr()
    assert note in shown.err
    assert "over 5 days" in shown.out
    assert figures("export", "-o", "f.csv") == "50 cycles in f.csv\n"
    assert counted(figures("counters")) == [["100", "100"], ["100", "100"], ["0", "0"]]
    figures_app(["show", str(log), "--keep"], standalone_mode=False)
    assert "not added again" not in capsys.readouterr().err
    with open_store("figures.sqlite") as store:
        store.delete(UNIT, 2 * 10**18, most=1000)
    figures_app(["show", str(log), "--keep"], standalone_mode=False)
    shown = capsys.readouterr()
    assert "0 new of 10 cycles" in shown.out
    assert "twin: 10 cycles are as old as those that" in shown.err
    assert counted(figures("counters"))[0] == ["110", "110"]


def test_an_ejector_that_no_run_watches_gives_its_old_cycles_away(
    figures: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    fill(10, 100)
    with open_store("figures.sqlite") as store:
        store.delete(UNIT, 10**18 + 5 * DAY, most=1000)
    forgotten = figures("forget", "--older-than", "1")
    assert forgotten == "50 cycles of gripper-01 deleted; the counters go on counting them\n"
    assert counted(figures("counters"))[0] == ["100", "100"]
    with pytest.raises(ConfigError, match="gripper-01"):
        figures("trend", "--days", "1")
    assert figures("forget", "--older-than", "1").startswith("0 cycles")


def test_autoset_gives_what_stands_in_a_configuration(figures: Run) -> None:
    fill(10, 100)
    text = figures("autoset")
    table = tomllib.loads(text)["figures"]
    assert text.startswith("# from the last 5 good cycles of gripper-01\n")
    assert table["permitted_leakage_mbar_s"] == pytest.approx(150 * 1.25, abs=3)
    assert table["permitted_t1_ms"] == pytest.approx(250 * 1.25, abs=4)
    more = tomllib.loads(figures("autoset", "--tolerance", "0.5"))["figures"]
    assert more["permitted_leakage_mbar_s"] == pytest.approx(150 * 1.5, abs=3)
    assert tomllib.loads(figures("autoset", "--tolerance", "0"))["figures"]["permitted_t1_ms"] > 290


def test_counters_and_autoset_are_written_as_json(figures: Run, tmp_path: Path) -> None:
    fill(10, 100)
    answers = {}
    for command in ("counters", "autoset"):
        for option in ("--json", "-o"):
            file = tmp_path / f"{command}{option}.json"
            figures(command, option, str(file))
            answers[command, option] = json.loads(file.read_text())
        assert answers[command, "--json"] == answers[command, "-o"]
    counts, taught = answers["counters", "-o"], answers["autoset", "-o"]
    assert {counts["id"], taught["id"]} == {"gripper-01"}
    assert counts["total"] == counts["erasable"] == {"cycles": 100, "switchings": 100, "alarms": 0}
    table = tomllib.loads(figures("autoset"))["figures"]
    assert {name: round(taught[name]) for name in table} == table
    assert taught["cycles"] == 5


def test_autoset_learns_from_good_cycles_only(figures: Run) -> None:
    fill(1, 20, warnings=["leakage_over_limit"])  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="no good cycle is stored"):
        figures("autoset")


def test_kept_cycles_are_exported(figures: Run) -> None:
    fill(10, 100)
    assert figures("export", "-o", "f.parquet") == "100 cycles in f.parquet\n"
    assert parquet.read_table("f.parquet")["leakage_measured"][-1].as_py() == pytest.approx(
        150, abs=4
    )
    with pytest.raises(SourceError, match="there is already a file of that name"):
        figures("export", "-o", "f.parquet")
    assert figures("export", "-o", "f.parquet", "--force") == "100 cycles in f.parquet\n"


def test_of_several_units_one_is_named(figures: Run, tmp_path: Path) -> None:
    fill(1, 20)
    fill(1, 30, Unit("compact-ejector-35", "rig-01"))
    with pytest.raises(ConfigError, match="2 units") as caught:
        figures("counters")
    assert caught.value.hint == "choose with --id; known: gripper-01, rig-01"
    assert "30" in figures("counters", "--id", "rig-01")
    where = ("--figures", tmp_path / "figures.sqlite", "--config", rigs.path_of("gripper"))
    assert "20" in figures("counters", *where)
    with pytest.raises(ConfigError, match="0 units 'nobody'"):
        figures("counters", "--id", "nobody")


def test_without_a_database_there_is_nothing_to_read(figures: Run) -> None:
    with pytest.raises(SourceError, match=r"figures\.sqlite: no such figure database"):
        figures("trend")
    assert not Path("figures.sqlite").exists()
