"""Reasons to doubt that a record is of a healthy unit, though all its cycles are alike."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibrations import log_of, quiet, typed
from test_retelling import ENGLISH_WORDS, in_german
from written_pages import UNIT, commissioned, visible

from twin.calibration import commission as module
from twin.calibration.commission import Commissioned, commission
from twin.calibration.cycles import Cycles
from twin.calibration.doubts import Doubt, doubts_of_fit, doubts_of_type, measured_doubts
from twin.calibration.fit import BEST_END, Fitted
from twin.calibration.page import write_page
from twin.calibration.readings import read
from twin.calibration.report import commissioned_as_json, commissioned_in_words
from twin.calibration.verdict import Residual, Verdict
from twin.config import HAND_WRITTEN
from twin.model.dataset import DataSet
from twin.monitor.healthy import Healthy, Scatter
from twin.signals import MBAR, Phase, Samples

NAME = "gripper"


def leaking(mbar_s: float) -> Healthy:
    return Healthy(key_figures={"leakage": Scatter(mean=mbar_s, sigma=1.0)})


@pytest.mark.parametrize(("mbar_s", "limit", "said"), [(310, 250, 1), (240, 250, 0), (310, 400, 0)])
def test_a_leakage_beyond_the_usual_limit_is_told(mbar_s: float, limit: float, said: int) -> None:
    data = typed(NAME).data
    ejector = data.ejector.model_copy(update={"permitted_leakage_mbar_s": limit})
    data = data.model_copy(update={"ejector": ejector})
    found = list(measured_doubts(data, read(log_of(NAME)), leaking(mbar_s)))
    assert len(found) == said
    assert not said or "leaks 310 mbar/s in hold; 250 mbar/s is the usual limit" in found[0].text


@pytest.mark.parametrize(
    ("deepest", "switches", "configured", "said"),
    [
        (400.0, 0, "on", True),
        (400.0, 0, "off", False),  # nobody expects it
        (200.0, 0, "on", False),  # it is passed: the nozzle does not go off
        (270.0, 9, "on", False),
    ],
)
def test_h1_that_is_never_reached_is_told(
    deepest: float, switches: int, configured: str, said: bool
) -> None:
    data = typed(NAME).data
    ejector = data.ejector.model_copy(update={"air_saving": configured, "h1_mbar": 750.0})
    data = data.model_copy(update={"ejector": ejector})
    readings = replace(read(log_of(NAME)), deepest=deepest * MBAR, switches=switches)
    found = list(measured_doubts(data, readings, Healthy()))
    assert ["never reaches H1, 750 mbar" in doubt.text for doubt in found] == [True] * said


def fitted_with(determined: bool = True, **ejector: float) -> Fitted:
    """A fit of the test rig whose values of the ejector are others."""
    fitted = commissioned("good").calibration.fitted
    data = fitted.data.model_copy(
        update={"ejector": fitted.data.ejector.model_copy(update=ejector)}
    )
    sigma = 0.01 * fitted.prior if determined else fitted.prior
    return replace(fitted, data=data, covariance=np.diag(sigma**2), factor=np.diag(sigma))


def test_a_leak_that_the_record_does_not_tell_from_suction_is_told() -> None:
    fitted = fitted_with()
    assert list(doubts_of_fit(fitted)) == []
    data = fitted.data
    leaky = data.model_copy(
        update={
            "ejector": data.ejector.model_copy(update={"end_pressure_mbar": 101.4}),
            "system": data.system.model_copy(update={"leak_sl_min": 4.16}),
        }
    )
    fitted = replace(fitted, leaky=leaky)
    (found,) = doubts_of_fit(fitted)
    assert "may leak 4.2 sl/min: with an end pressure of 101 mbar" in found.text
    determined = dict(zip([free.name for free in fitted.free], fitted.determined, strict=True))
    assert not determined["system.leak_sl_min"]
    assert determined["ejector.response_ms"]
    assert fitted.interval("system.leak_sl_min")[1] == 4.16
    assert fitted.interval("ejector.end_pressure_mbar")[0] == BEST_END / MBAR


def test_a_value_far_from_its_type_is_told() -> None:
    config = typed("test_rig")
    blow_off = config.data.ejector.blow_off_sl_min
    assert list(doubts_of_type(config, fitted_with())) == []
    (found,) = doubts_of_type(config, fitted_with(blow_off_response_ms=150.0))
    assert found.text.startswith("response of blow-off is 150 ms, where ")
    assert found.text.endswith("is healthy for its type")
    assert list(doubts_of_type(config, fitted_with(blow_off_sl_min=1.3 * blow_off))) == []


def test_no_type_no_doubt_nor_for_what_the_record_does_not_determine() -> None:
    config, late = typed("test_rig"), {"blow_off_response_ms": 150.0}
    assert list(doubts_of_type(replace(config, origin=HAND_WRITTEN), fitted_with(**late))) == []
    assert list(doubts_of_type(config, fitted_with(determined=False, **late))) == []


DOUBTS = (
    Doubt(
        "what counts as healthy from now on leaks 310 mbar/s in hold; 250 mbar/s is the usual"
        " limit",
        "repair first and record again, or leave it if it is as built",
    ),
    Doubt(
        "what counts as healthy from now on never reaches H1, 750 mbar: the vacuum is 613 mbar at"
        " most",
        "look for leaks and a low supply, or let suction last longer, and record again",
    ),
    Doubt(
        "response of blow-off is 150.5 ms, where 2.5 to 42 is healthy for its type",
        "repair first and record again, or leave it if it is as built",
    ),
)


def test_page_terminal_and_json_ask_whether_the_unit_is_healthy(tmp_path: Path) -> None:
    found = replace(commissioned("good"), doubts=DOUBTS)
    words, answer = commissioned_in_words(found), commissioned_as_json(found, UNIT, None)
    write_page(found, UNIT, tmp_path / "a.html")
    page = visible((tmp_path / "a.html").read_text(encoding="utf-8"))
    assert "Nothing to change" not in page
    for doubt, stored in zip(DOUBTS, answer["doubts"], strict=True):
        assert f"is the unit healthy? {doubt.text}\n  {doubt.action}" in words
        assert f"Is the unit healthy? {doubt.text[:1].upper()}{doubt.text[1:]}" in page
        assert stored == {"what": doubt.text, "do": doubt.action}


@pytest.mark.parametrize("text", [part for doubt in DOUBTS for part in (doubt.text, doubt.action)])
def test_doubts_are_german(text: str) -> None:
    german = in_german(text)
    assert german != text
    assert not ENGLISH_WORDS.search(german)
    assert "." not in german


def as_if_fitted(
    samples: Samples, monkeypatch: pytest.MonkeyPatch, times: float = 1.0
) -> Commissioned:
    """A commissioning of the gripper whose fit ends at the values of its type."""
    of = commissioned("good").calibration.fitted

    def best(
        samples: Samples, _noise: float, guesses: list[DataSet], *_: object
    ) -> tuple[Fitted, Cycles, Verdict]:
        fitted = replace(of, data=guesses[0])
        residuals = {phase: Residual(times * MBAR, MBAR) for phase in Phase}
        return fitted, Cycles.found(samples, fitted.data), Verdict(residuals)

    monkeypatch.setattr(module, "_best", best)
    return commission(typed(NAME), [samples], quiet)


@pytest.mark.parametrize("leak", [0.0, 4.0])
def test_a_leak_in_all_cycles_is_no_refusal_and_is_told(
    leak: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = as_if_fitted(log_of(NAME, faults=(f"leakage={leak}",) if leak else ()), monkeypatch)
    assert found.verdict.word == "good"
    told = [doubt.text for doubt in found.doubts]
    assert any("mbar/s in hold" in text or "never reaches H1" in text for text in told) == bool(
        leak
    )
