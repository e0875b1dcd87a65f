"""What a cause costs, against what the simulated rig takes with it and without it."""

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import pytest
import rigs
from nozzle_air import taken
from test_figures_costs import PRICE, priced

from twin.diagnosis.answer import diagnose
from twin.diagnosis.costs import costs
from twin.diagnosis.evidence import Evidence, collect
from twin.diagnosis.report import _page, in_words
from twin.diagnosis.text import Times, about
from twin.model.courses import Cause, Course

SECONDS = 40.0
LEAK = 1.0  # sl/min
TIMES = Times(0.0, None, None)


@cache
def evidence(name: str, fault: str = "") -> Evidence:
    faults = (fault,) if fault else ()
    return collect(rigs.config(name), [rigs.recorded(name, SECONDS, faults)[0]])


def entry(cause: Cause, low: float, high: float, **more: object) -> dict[str, Any]:
    """A cause with one parameter in the answer's form, its interval from ``low`` to ``high``."""
    (name, value), *_ = cause.values.items()
    known = {"value": value, "unit": "x", "low95": low, "high95": high}
    probable = {"probability": 0.99, "not_separable_from": [], "onset_s": cause.onset_s}
    return {
        "effect": cause.effect,
        "course": str(cause.course),
        "parameters": {name: known},
        **probable,
        **more,
    }


def cost(name: str, cause: Cause, low: float, high: float, **more: object) -> dict[str, Any]:
    """The cost of one cause of which somebody knows the size."""
    told = entry(cause, low, high, **more)
    (found,) = costs(priced(PRICE, name), evidence(name), (cause,), [told])
    assert found is not None
    return found


def said(cause: Cause, told: Mapping[str, Any], **more: object) -> str:
    value = next(iter(cause.values.values()))
    lines = dict(about({**entry(cause, value, value, **more), "cost": told}, TIMES, sure=True))
    return lines["cost"]


@cache
def leak_of(name: str) -> dict[str, Any]:
    return cost(name, Cause("leakage", {"sonic_flow": LEAK}), 0.9 * LEAK, 1.1 * LEAK)


@pytest.mark.slow
@pytest.mark.parametrize("name", rigs.NAMES)
def test_a_leak_costs_what_the_rig_takes_more(name: str) -> None:
    with_leak, without = (
        np.mean([taken(name, SECONDS, faults, seed) for seed in (1, 2)])
        for faults in ((f"leakage={LEAK}",), ())
    )
    told = leak_of(name)
    air, money = told["air_nl_per_cycle"], told["money_per_year"]
    assert air["low95"] <= with_leak - without <= air["high95"]
    per_nl = told["cycles_per_year"] / 1e3 * 0.12 * 0.30
    for end in ("value", "low95", "high95"):
        assert money[end] == pytest.approx(air[end] * per_nl, rel=2e-3)
    assert told["differs_from_zero"]


def test_a_year_is_the_operating_hours_at_the_logs_rate() -> None:
    cycle_s = SECONDS / (len(evidence("gripper").starts) - 1)
    assert leak_of("gripper")["cycles_per_year"] == pytest.approx(4000 * 3600 / cycle_s, rel=0.05)


def test_a_leaks_cost_is_said_with_its_interval() -> None:
    text = said(Cause("leakage", {"sonic_flow": LEAK}), leak_of("test_rig"))
    assert text.startswith("this leakage costs about ")
    assert "€ a year (95 %: " in text
    assert text.endswith("4000 h of operation")


def test_a_growing_leak_costs_what_it_has_come_to() -> None:
    hours = float(evidence("test_rig").seconds[-1]) / 3600.0
    rate = LEAK / hours
    growing = Cause("leakage", {"sonic_flow": rate}, Course.RAMP)
    told = entry(growing, 0.9 * rate, 1.1 * rate)
    at_end = {"at_end": LEAK, "at_end_low95": 0.9 * LEAK, "at_end_high95": 1.1 * LEAK}
    told["parameters"]["sonic_flow"] |= at_end
    (found,) = costs(priced(PRICE, "test_rig"), evidence("test_rig"), (growing,), [told])
    assert found is not None
    expected = leak_of("test_rig")["air_nl_per_cycle"]
    assert found["air_nl_per_cycle"]["value"] == pytest.approx(expected["value"], rel=0.02)


def test_a_cause_in_some_cycles_costs_its_share() -> None:
    sometimes = Cause(
        "leakage", {"sonic_flow": LEAK}, Course.INTERMITTENT, cycles=frozenset({2, 4})
    )
    told = cost("test_rig", sometimes, 0.9 * LEAK, 1.1 * LEAK, share_pct=25.0, cycles=[2, 4])
    for end, whole in leak_of("test_rig")["air_nl_per_cycle"].items():
        assert told["air_nl_per_cycle"][end] == pytest.approx(whole / 4.0, rel=1e-2)


def test_one_of_two_causes_costs_what_it_takes_beside_the_other() -> None:
    causes = Cause("leakage", {"sonic_flow": LEAK}), Cause("suction_loss", {"loss": 20.0})
    told = [entry(causes[0], 0.9, 1.1), entry(causes[1], 18.0, 22.0)]
    both = costs(priced(PRICE, "test_rig"), evidence("test_rig"), causes, told)
    assert both[0] is not None
    air = both[0]["air_nl_per_cycle"]
    with_leak, without = (
        taken("test_rig", SECONDS, faults)
        for faults in (("suction_loss=20", f"leakage={LEAK}"), ("suction_loss=20",))
    )
    assert air["low95"] <= with_leak - without <= air["high95"]
    assert air["value"] != leak_of("test_rig")["air_nl_per_cycle"]["value"]


def test_what_takes_no_air_is_said_not_to_differ_from_zero() -> None:
    reads_off = Cause("sensor_offset", {"offset": 20.0})
    told = cost("test_rig", reads_off, 19.0, 21.0)
    assert not told["differs_from_zero"]
    assert said(reads_off, told).startswith(
        "what this sensor offset costs cannot be told from zero"
    )
    small = cost("test_rig", Cause("leakage", {"sonic_flow": 0.02}), 0.0, 0.04)
    assert small["money_per_year"]["low95"] <= 0.0
    assert not small["differs_from_zero"]


def test_a_cause_that_saves_air_is_said_to() -> None:
    earlier = Cause("threshold_drift", {"h1_shift": -30.0})
    told = cost("test_rig", earlier, -32.0, -28.0)
    money = told["money_per_year"]
    assert money["low95"] < money["value"] < money["high95"] < 0.0
    text = said(earlier, told)
    assert text.startswith(f"this threshold drift takes less air: about {-money['value']:.0f} €")


def test_without_a_price_or_a_size_nothing_is_told() -> None:
    leak = Cause("leakage", {"sonic_flow": LEAK})
    told = entry(leak, 0.9, 1.1)
    assert costs(rigs.config("test_rig"), evidence("test_rig"), (leak,), [told]) == []
    unsized = {**told, "parameters": {}}
    assert costs(priced(PRICE, "test_rig"), evidence("test_rig"), (leak,), [unsized]) == [None]
    lines = dict(about(told, TIMES, sure=True))
    assert "cost" not in lines


@pytest.mark.slow
@pytest.mark.parametrize("extra", [PRICE, ""])
def test_a_diagnosis_has_it_in_text_answer_and_report_where_a_price_is(extra: str) -> None:
    samples, _ = rigs.recorded("test_rig", 20.0, (f"leakage={LEAK}",))
    diagnosis = diagnose(priced(extra, "test_rig"), [samples], "log.mcap", lambda _what: None)
    (cause,) = diagnosis.json["causes"]
    contract = {"effect", "course", "onset_s", "parameters", "probability"}
    contract |= {"not_separable_from", "why"}
    assert set(cause) == contract | ({"cost"} if extra else set())
    assert ("this leakage costs about " in in_words(diagnosis)) == bool(extra)
    assert ("this leakage costs about " in _page(diagnosis)) == bool(extra)
