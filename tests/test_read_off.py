"""What a record shows without a fit, on page, terminal and JSON: value, unit and source."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from written_pages import UNIT, commissioned, visible

from twin.calibration.commission import Commissioned
from twin.calibration.page import write_page
from twin.calibration.parameters import AMBIENT
from twin.calibration.read_off import ReadOff, read_off
from twin.calibration.report import commissioned_as_json, commissioned_in_words
from twin.signals import MBAR


def shown(found: Commissioned) -> dict[str, ReadOff]:
    return {entry.key: entry for entry in read_off(found)}


def read(**changed: float | bool) -> Commissioned:
    """The commissioning of the test rig with other readings."""
    found = commissioned("good")
    return replace(found, readings=replace(found.readings, **changed))


def test_each_reading_has_its_value_with_unit_and_source() -> None:
    found = commissioned("good")
    entries, readings = shown(found), found.readings
    ejector = found.calibration.fitted.data.ejector
    assert (entries["h1"].value, entries["h1"].unit) == (ejector.h1_mbar, "mbar")
    assert entries["noise"].value == pytest.approx(readings.noise / MBAR)
    assert (entries["sampling"].value, entries["sampling"].unit) == (8.0, "ms")
    highest = found.calibration.fitted.data.ambient.pressure_mbar - readings.deepest / MBAR
    assert entries["highest_vacuum"].value == pytest.approx(highest)
    assert {key for key, entry in entries.items() if entry.source == "record"} >= {
        *("air_saving", "h1", "noise", "converter_step", "missing"),
    }


def test_a_threshold_that_the_record_does_not_show_is_assumed() -> None:
    assert shown(read(part=np.nan))["h2"].source == "assumed"
    assert shown(read(part=45_000.0))["h2"].source == "record"
    never = shown(read(switches=0))
    assert (never["h1"].source, never["air_saving"].shown) == ("assumed", "no")
    assert shown(read(on=np.nan))["h1_hysteresis"].source == "assumed"


@pytest.mark.parametrize(
    ("opened", "barometer", "source"),
    [
        (True, np.nan, "idle"),
        (True, 100_500.0, "barometer"),
        (True, 90_000.0, "idle"),  # it contradicts the pressure
        (False, 90_000.0, "barometer"),
        (False, np.nan, "assumed"),
    ],
)
def test_ambient_pressure_says_where_it_is_from(
    opened: bool, barometer: float, source: str
) -> None:
    found = read(opened=opened, barometer=barometer, idle=100_000.0)
    assert shown(found)["ambient"].source == source


@pytest.mark.parametrize(("barometer", "source"), [(np.nan, "assumed"), (100_500.0, "barometer")])
def test_a_sensor_that_counts_from_ambient_does_not_show_it(barometer: float, source: str) -> None:
    """Its idle is the configured ambient pressure, whatever the weather."""
    found = read(opened=True, barometer=barometer, idle=100_000.0)
    fitted = found.calibration.fitted
    sensor = fitted.data.sensor.model_copy(update={"reference": "gauge"})
    fitted = replace(fitted, data=fitted.data.model_copy(update={"sensor": sensor}))
    found = replace(found, calibration=replace(found.calibration, fitted=fitted))
    assert shown(found)["ambient"].source == source


def test_ambient_pressure_may_be_that_of_the_fit() -> None:
    found = read(opened=False, barometer=np.nan)
    fitted = found.calibration.fitted
    fitted = replace(fitted, free=(*fitted.free, AMBIENT))
    found = replace(found, calibration=replace(found.calibration, fitted=fitted))
    assert shown(found)["ambient"].source == "fit"


def test_page_terminal_and_json_have_all_of_it(tmp_path: Path) -> None:
    found = commissioned("usable")
    write_page(found, UNIT, tmp_path / "a.html")
    page = visible((tmp_path / "a.html").read_text(encoding="utf-8"))
    words = commissioned_in_words(found)
    answer = commissioned_as_json(found, UNIT, None)["read_off"]
    for entry in read_off(found):
        assert entry.name in page
        assert f"{entry.name:<50}{entry.shown:>8} {entry.unit}" in words
        assert answer[entry.key]["from"] == entry.source
    assert "Read off the record" in page


def test_raw_keys_open_on_demand(tmp_path: Path) -> None:
    write_page(commissioned("good"), UNIT, tmp_path / "a.html")
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    before, _, inside = page.partition("<details>")
    assert "ejector.<wbr>" not in before
    assert "ejector.<wbr>" in inside.partition("</details>")[0]


def without_remarks(word: str) -> Commissioned:
    return replace(commissioned(word), remarks=(), contradictions=())


def test_a_refused_page_says_what_to_check(tmp_path: Path) -> None:
    """Without a remark as well: then the configuration may be wrong in what no record shows."""
    pages = {}
    for word in ("good", "refused"):
        write_page(without_remarks(word), UNIT, tmp_path / "a.html")
        pages[word] = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "Nothing to change" in pages["good"]
    assert "Nothing to change" not in pages["refused"]
    assert "hoses (length, inner diameter), volumes, and whether parts are" in pages["refused"]
    assert "hoses (length, inner diameter)" in commissioned_in_words(without_remarks("refused"))
    assert "hoses (length, inner diameter)" not in commissioned_in_words(commissioned("usable"))


def test_a_refused_fit_has_reason_and_advice_for_programs() -> None:
    answer = commissioned_as_json(commissioned("refused"), UNIT, None)
    assert answer["reason"].startswith("the twin is off by more than its cycles differ")
    assert "hoses" in answer["do"]
    assert "reason" not in commissioned_as_json(commissioned("usable"), UNIT, None)
