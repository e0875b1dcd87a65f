"""Air, energy and money of a log's days, and of a year at its rate."""

import csv
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rigs
from pyarrow import parquet

from twin.config import Config
from twin.errors import ConfigError
from twin.figures.costs import NO_PRICE, Tariff, days, year
from twin.figures.costs_text import days_table
from twin.figures.cycle import CycleFigures, KeyFigures
from twin.figures.key_figures import FIGURES
from twin.figures.money import Interval, amount, interval_text, significant
from twin.figures.settings import FigureSettings
from twin.figures.simulated import mean_cycle_time
from twin.instants import DAY_NS
from twin.live import run as run_loop
from twin.log.recorder import Recorder
from twin.monitor.cycles import cut
from twin.settings import Document

Run = Callable[..., str]
PRICE = "\n[figures]\nprice_per_kwh = 0.30\n"
NOON = 1_790_000_000 * 10**9  # some day by a clock that was set


def tariff(**settings: object) -> Tariff:
    return Tariff.of(FigureSettings.model_validate(settings))


@pytest.fixture(scope="module")
def cycles() -> list[CycleFigures]:
    """Complete cycles of the gripper, and one that the end of the log cuts off."""
    figures = KeyFigures(rigs.config("gripper").data)
    pieces = cut(rigs.twin("gripper").over([rigs.recorded("gripper", 19.0)[0]]))
    return [cycle for piece in pieces if (cycle := figures.take(piece)) is not None]


def priced(extra: str = PRICE, name: str = "gripper") -> Config:
    path = rigs.path_of(name)
    return Config.of(Document.parse(path.read_text() + extra, str(path)))


def logged(path: Path, extra: str = PRICE) -> Path:
    sinks = [Recorder(path, priced(extra).log_header())]
    blocks = rigs.cut(rigs.recorded("gripper", 19.0)[0], 100)
    run_loop(blocks, rigs.twin("gripper"), rigs.monitor("gripper"), sinks)
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return logged(tmp_path_factory.mktemp("log") / "run.mcap")


# Prices.


def test_a_price_per_kwh_and_one_per_m3_agree() -> None:
    by_energy = tariff(price_per_kwh=0.30, energy_kwh_m3=0.12)
    by_air = tariff(price_per_m3=0.036, energy_kwh_m3=0.12)
    assert by_energy.money(1e6) == pytest.approx(36.0)
    assert by_air.money(1e6) == pytest.approx(36.0)
    assert by_energy.energy(1e6) == pytest.approx(120.0)


def test_there_is_one_price_and_it_is_positive() -> None:
    with pytest.raises(ConfigError, match="set price_per_kwh or price_per_m3, not both"):
        priced("\n[figures]\nprice_per_kwh = 0.3\nprice_per_m3 = 0.03\n").document.section(
            FigureSettings, "figures"
        )
    with pytest.raises(ConfigError, match="price_per_kwh"):
        priced("\n[figures]\nprice_per_kwh = 0.0\n").document.section(FigureSettings, "figures")
    assert tariff().money(1e6) is None


def test_amounts_are_told_as_people_do() -> None:
    texts = [amount(money) for money in (1234.5, -20.0, 9.876, 0.0123, 1e-12)]
    assert texts == ["1234", "-20", "9.88", "0.012", "0"]
    text = interval_text(Interval(145.0, 110.0, 180.0), "€")
    assert text == "145 € a year (95 %: 110 to 180)"
    assert significant(4_493_447.0) == "4490000"


# Days and years.


def test_a_year_is_so_many_cycles_at_the_logs_rate_and_air(cycles: list[CycleFigures]) -> None:
    air = [cycle.measured["air"] for cycle in cycles if math.isfinite(cycle.measured["air"])]
    begins = np.array([cycle.begin_ns for cycle in cycles])
    rate = 3600e9 / np.diff(begins).mean()
    whole = year(cycles, tariff(operating_hours=2000.0))
    assert whole.cycles == pytest.approx(2000.0 * rate)
    assert whole.air == pytest.approx(2000.0 * rate * np.mean(air))
    assert year(cycles, tariff(operating_hours=4000.0)).air == pytest.approx(2.0 * whole.air)


def test_a_pause_is_no_operation(cycles: list[CycleFigures]) -> None:
    later = [
        replace(cycle, begin_ns=cycle.begin_ns + (number >= 5) * 3600 * 10**9)
        for number, cycle in enumerate(cycles)
    ]
    assert year(later, tariff()).cycles == pytest.approx(year(cycles, tariff()).cycles, rel=0.02)
    assert math.isnan(mean_cycle_time([]))


def test_days_are_those_of_the_clock_and_cycles_without_air_are_told(
    cycles: list[CycleFigures],
) -> None:
    dated = [
        replace(cycle, host_ns=NOON + (number >= 4) * DAY_NS) for number, cycle in enumerate(cycles)
    ]
    first, second = days(dated)
    assert (first.cycles, second.cycles) == (4, len(cycles) - 4)
    assert second.known == second.cycles - 1  # the last one was cut off
    assert len({first.name, second.name}) == 2
    text = days_table([first, second], year(dated, tariff()), tariff(price_per_m3=1.0))
    assert f"the air of 1 of {len(cycles)} cycles is unknown" in text


def test_without_a_clock_days_count_from_the_first_cycle(cycles: list[CycleFigures]) -> None:
    unset = [replace(cycle, host_ns=number // 5 * DAY_NS) for number, cycle in enumerate(cycles)]
    assert [day.name for day in days(unset)] == ["day 1", "day 2"]


def test_why_a_year_is_not_told_is_said(cycles: list[CycleFigures]) -> None:
    assert days([]) == []
    text = days_table([], year([], tariff()), tariff())
    assert "a year: unknown, the log has fewer than two cycles" in text
    unknown = [replace(cycle, measured={"air": math.nan}) for cycle in cycles]
    text = days_table(days(unknown), year(unknown, tariff()), tariff())
    assert "a year: unknown, no cycle's air is known" in text


# The command.


def test_a_log_costs_what_its_cycles_do(figures: Run, log: Path) -> None:
    out = figures("costs", log, "--json", "c.json", "-o", "c.csv")
    figures("costs", log, "-o", "c.parquet")
    figures("show", log, "--json", "f.json")
    shown = json.loads(Path("f.json").read_text())["cycles"]
    air = sum(cycle.get("air_measured", 0.0) for cycle in shown)
    content = json.loads(Path("c.json").read_text())
    (day,) = content["days"]
    assert day["air_nl"] == pytest.approx(air, rel=1e-3)
    assert day["cost"] == pytest.approx(air / 1e3 * 0.12 * 0.30, rel=1e-3)
    assert day["cycles"] == len(shown) == day["cycles_with_air"] + 1
    assert out.splitlines()[0].split()[-2:] == ["cost", "(€)"]
    assert f"a year of 4000 h at this rate: {significant(content['year']['cycles'])} cycles" in out
    with Path("c.csv").open() as file:
        (row,) = csv.DictReader(file)
    table = parquet.read_table("c.parquet")
    assert float(row["air"]) == table["air"][0].as_py() == pytest.approx(air, rel=1e-3)
    assert table.schema.field("cost").metadata[b"unit"] == "€".encode()
    assert FIGURES["air"].unit.encode() == table.schema.field("air").metadata[b"unit"]


def test_without_a_price_the_key_to_set_is_named(figures: Run, tmp_path: Path) -> None:
    log = logged(tmp_path / "free.mcap", "")
    out = figures("costs", log, "--json", "c.json", "-o", "c.csv")
    assert out.splitlines()[-1] == NO_PRICE
    assert "price_per_kwh" in NO_PRICE
    assert "cost" not in out
    assert "energy (kWh)" in out
    content = json.loads(Path("c.json").read_text())
    assert content["year"]["cost"] is content["days"][0]["cost"] is None
    assert content["year"]["energy_kwh"] > 0.0


def test_a_configuration_and_a_unit_take_the_place_of_the_logs(
    figures: Run, log: Path, tmp_path: Path
) -> None:
    config = tmp_path / "cell.toml"
    dearer = '\n[figures]\nprice_per_m3 = 0.072\ncurrency = "CHF"\n'
    config.write_text(rigs.path_of("gripper").read_text() + dearer)
    figures("costs", log, "--json", "a.json")
    out = figures("costs", log, "--config", config, "--id", "gripper-01", "--json", "b.json")
    own, other = (json.loads(Path(name).read_text()) for name in ("a.json", "b.json"))
    assert "cost (CHF)" in out
    assert other["year"]["cost"] == pytest.approx(2.0 * own["year"]["cost"], rel=1e-4)
    with pytest.raises(ConfigError, match="no unit is called 'nobody'"):
        figures("costs", log, "--id", "nobody")
