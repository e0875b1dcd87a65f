"""Stored English sentences in the reader's language, each by the template it was written from."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from twin.diagnosis import answer, experiments
from twin.diagnosis.answer import insufficient
from twin.diagnosis.retelling import retold, templates
from twin.diagnosis.unlisted import Unlisted
from twin.languages.catalogues import Catalogues
from twin.languages.texts import speaking
from twin.model.courses import Cause
from twin.model.mechanism import MECHANISMS
from twin.model.term import Term

TWIN = Path(__file__).resolve().parents[1] / "twin"
GERMAN = Catalogues().languages["de"]
ENGLISH_WORDS = re.compile(
    r"\b(the|and|of|with|is|are|from|that|not|no|which|while|until|record|predicted)\b"
)


def in_german(sentence: str) -> str:
    with speaking(GERMAN):
        return retold(sentence)


def test_in_english_a_sentence_stays_as_it_is() -> None:
    assert retold("part present comes at 12.5 mbar of vacuum; H2 is 600 mbar") == (
        "part present comes at 12.5 mbar of vacuum; H2 is 600 mbar"
    )


def test_a_sentence_without_a_template_stays_english() -> None:
    assert in_german("the moon is out, and shines") == "the moon is out, and shines"


def test_values_keep_their_place_and_have_a_decimal_comma() -> None:
    sentence = "part present comes at 512.5 mbar of vacuum; H2 is 600 mbar"
    said = "die Meldung Teil vorhanden kommt bei 512,5 mbar Vakuum; H2 ist 600 mbar"
    assert in_german(sentence) == said


@pytest.mark.parametrize("name", sorted(MECHANISMS))
def test_each_mechanism_is_told_with_all_its_numbers(name: str) -> None:
    mechanism = MECHANISMS[name]
    parameters = (*mechanism.place.parameters, *mechanism.when.parameters)
    values = {entry.name: 10.5 + position for position, entry in enumerate(parameters)}
    for sentence in (mechanism.sentence(values), mechanism.formula(values)):
        german = in_german(sentence)
        assert not ENGLISH_WORDS.search(german)
        assert sorted(re.findall(r"\d+,5", german)) == sorted(
            number.replace(".", ",") for number in re.findall(r"\d+\.5", sentence)
        )


def reasons() -> Iterator[str]:
    """Why logs cannot answer, as the answer says it."""
    evidence: Any = SimpleNamespace(bins=SimpleNamespace(count=np.zeros(0)))
    for cycles, saturated, judged in (
        (0, 0.0, 0),
        (3, 0.5, 2),
        (3, 0.0, 1),
        (3, 0.0, 2),
        (6, 0.0, 4),
    ):
        log: Any = SimpleNamespace(cycles=cycles, saturated=saturated, judged=range(judged))
        yield insufficient(log, evidence)


@pytest.mark.parametrize("reason", list(reasons()))
def test_why_a_log_cannot_answer_is_german(reason: str) -> None:
    assert reason
    assert not ENGLISH_WORDS.search(in_german(reason))


@pytest.mark.parametrize("sigmas", [12.0, 0.5])
@pytest.mark.parametrize(
    ("causes", "rivals"),
    [
        ("leakage", "porous_leakage, sensor_gain"),
        ("leakage and weak_blow_off", "porous_leakage"),
        ("the mechanism", "what else it may be"),
    ],
)
def test_what_to_record_is_german(
    monkeypatch: pytest.MonkeyPatch, causes: str, rivals: str, sigmas: float
) -> None:
    monkeypatch.setattr(experiments, "_settled", lambda _, hypothesis: hypothesis)
    monkeypatch.setattr(experiments, "_separation", lambda *_: sigmas)
    rival = (Cause("porous_leakage", {}),)
    evidence: Any = None
    sentence = experiments._recording(evidence, (), [rival], causes, rivals)
    assert sentence is not None
    german = in_german(sentence)
    assert not ENGLISH_WORDS.search(german)
    assert not re.search(r"leakage|_|mechanism\b", german)


@pytest.mark.parametrize("odd", [[2], [1, 3]])
def test_odd_cycles_are_german(monkeypatch: pytest.MonkeyPatch, odd: list[int]) -> None:
    chi2 = np.where(np.isin(np.arange(8), odd), 40.0, 1.0)
    monkeypatch.setattr(answer, "_left_by_cycle", lambda *_: chi2)
    bins = SimpleNamespace(cycle=np.arange(8), count=np.ones(8))
    evidence: Any = SimpleNamespace(
        off=lambda _: np.full((8, 1), 7.0), bins=bins, judged=range(8), numbers=np.arange(8)
    )
    healthy: Any = SimpleNamespace(of=lambda _: None)
    sentence = answer._odd_cycles(evidence, healthy)
    assert sentence is not None
    assert not ENGLISH_WORDS.search(in_german(sentence))


@pytest.mark.parametrize("told", [frozenset(), frozenset({"ambient"})])
def test_what_to_measure_beside_weather_is_german(
    monkeypatch: pytest.MonkeyPatch, told: frozenset[str]
) -> None:
    def explained(*_: object) -> npt.NDArray[np.float64]:
        return np.full(4, 5.6)

    monkeypatch.setattr(experiments, "explained_by_day", explained)
    bins = SimpleNamespace(count=np.ones(4))
    evidence: Any = SimpleNamespace(
        off=lambda _: np.zeros((4, 1)), bins=bins, told=told, judged=[1]
    )
    healthy: Any = SimpleNamespace(of=lambda _: SimpleNamespace(usual=1.0))
    sentence = experiments.beside_weather(evidence, healthy)
    assert sentence is not None
    assert not ENGLISH_WORDS.search(in_german(sentence))
    assert "5.6 mbar" in sentence


@pytest.mark.parametrize("phase", list(experiments.LONGER))
def test_what_shows_more_of_something_unlisted_is_german(phase: str) -> None:
    sentence = experiments.show_more(phase)
    assert f"is largest in {phase.replace('_', '-')}" in sentence
    assert not ENGLISH_WORDS.search(in_german(sentence))


@pytest.mark.parametrize(("mechanism", "asks"), [(None, True), (object(), False)])
def test_only_what_no_mechanism_explains_asks_for_more_of_it(
    monkeypatch: pytest.MonkeyPatch, mechanism: object, asks: bool
) -> None:
    monkeypatch.setattr(answer, "next_experiment", lambda *_: None)  # there are no rivals
    monkeypatch.setattr(answer, "beside_weather", lambda *_: None)
    unlisted = {"verdict": "unlisted", "causes": (), "searched": None, "mechanism": mechanism}
    findings: Any = SimpleNamespace(**unlisted, strange=SimpleNamespace(where="hold"))
    nothing: Any = None
    assert bool(answer._next_experiment(nothing, findings, nothing)) == asks


@pytest.mark.parametrize("over", ["time", "vacuum", None])
def test_the_shape_of_something_unlisted_is_german(over: Any) -> None:
    terms = (Term(where="hold", over=over, at=(0.0, 30.0), mbar=(1.0, 2.5)),) if over else ()
    german = in_german(Unlisted("hold", "vacuum", terms, 1.0).shape)
    assert not ENGLISH_WORDS.search(german)
    assert "+2,5 mbar" in german or not over


def test_evidence_of_an_alarm_is_german() -> None:
    warning = "t1 over limit (512 of 480 ms, set in [figures]); expected 455.5 ms"
    assert in_german(warning) == (
        "t1 über dem Grenzwert (512 von 480 ms, eingestellt in [figures]); erwartet 455,5 ms"
    )
    contradiction = (
        "at rest the barometer reads 20 mbar more than the pressure: compare both with a third,"
        " then check the scale of the tag ambient"
    )
    assert in_german(contradiction) == (
        "in Ruhe zeigt das Barometer 20 mbar mehr als der Drucksensor: beide mit einem dritten"
        " vergleichen, dann die Skalierung der Variable ambient prüfen"
    )


# --- templates are what the program writes --------------------------------------------------------


def written_in(file: str) -> set[str]:
    """Every text of a module, with {} for each value."""
    tree = ast.parse((TWIN / file).read_text(encoding="utf-8"))
    return {text for node in ast.walk(tree) if (text := written(node))}


def written(node: ast.AST) -> str:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(
            str(value.value) if isinstance(value, ast.Constant) else "{}" for value in node.values
        )
    return ""


def shape_of(template: str) -> str:
    return re.sub(r"\{\w+\}", "{}", template)


def test_each_contradiction_of_a_signal_has_a_template() -> None:
    tree = ast.parse((TWIN / "monitor" / "signal_checks.py").read_text(encoding="utf-8"))
    said = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) in ("finding", "action"):
            said.add(written(node.value))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "_contradicts":
            said |= {written(part) for part in node.args[1:]}
    said = {re.sub(r"\{\} \{\} than", "{} {} than", text) for text in said if text}
    assert len(said) > 10
    known = {shape_of(template) for template in templates()}
    known |= {text.replace(sense, "{}") for text in known for sense in ("more", "less")}
    assert said - known == set()


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("monitor/monitor.py", "no fresh sample for {} ms: check PLC and network"),
        ("monitor/monitor.py", "pressure signal: {}"),
        ("diagnosis/process.py", "no listed effect explains what is left in {}"),
        ("diagnosis/answer.py", "{}; fit the twin first to a log of healthy cycles: {}"),
        ("diagnosis/answer.py", "{}: record the commands as well"),
        ("tables/derive.py", "{} derived from the pressure: {}; {}; {}"),
        ("tables/derive.py", "releases go above the level of idle, so they are called blow-off"),
        ("figures/settings.py", "from the unit's data set"),
        ("figures/settings.py", "from its commissioning"),
        ("figures/settings.py", "changed by a person"),
    ],
)
def test_sentences_of_other_modules_still_have_templates(file: str, text: str) -> None:
    assert text in written_in(file)
    parts = [part for part in re.split(r"\{\}", text) if part.strip(" ;:")]
    assert any(all(part in template for part in parts) for template in templates())


@pytest.mark.parametrize(
    "sentence",
    [
        "suction: +9.1 mbar from healthy (+12 sigma); leakage 1.98 sl/min, or porous_leakage",
        "leakage (1.98 sl/min), since 2026-11-28 05:11:09; how sure: 83 %; look at cups",
        "Modbus 10.0.0.5: connection refused",
    ],
)
def test_nothing_is_translated_by_halves(sentence: str) -> None:
    assert in_german(sentence) == sentence
