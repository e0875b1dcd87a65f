"""The extended model: a data set with what a diagnosis found in it, kept as that of a unit."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.optimize import brentq

from twin.assets import provenance
from twin.assets.catalogue import carried_on
from twin.assets.database_url import open_chosen
from twin.assets.record import Record
from twin.config import Config, Known
from twin.diagnosis.answer import Diagnosis
from twin.diagnosis.evidence import HEALTHY, Evidence, Hypothesis
from twin.diagnosis.text import spoken
from twin.errors import ConfigError
from twin.inference.levels import SIGMAS_95
from twin.inference.sensitivities import derivatives
from twin.live import Twin
from twin.model.catalogue import mechanism_of
from twin.model.courses import Cause, Course
from twin.model.dataset import DataSet, coefficients
from twin.model.effects import Parameter, apply, effect_of
from twin.model.mechanism import MECHANISMS
from twin.model.term import AGAIN
from twin.monitor.bins import Floats
from twin.monitor.cycles import figures, whole
from twin.monitor.healthy import Healthy, Scatter
from twin.monitor.scatter_covariance import SCATTER
from twin.signals import Phase

Sizes = Mapping[str, float]


def extended(diagnosis: Diagnosis, config: Config) -> Known | None:
    """The data set of ``config`` with what was found, and what healthy cycles are like with it.

    None if nothing was found that is always there. ConfigError where an effect together with what
    the data set has of it already is beyond what the model can do.
    """
    data, terms = config.data, diagnosis.terms
    found = dict(_always(diagnosis))
    if not found and not terms:
        return None
    for effect, sizes in found.items():
        law = effect_of(effect).law
        if law and law.name in sizes:
            ejector = data.ejector.model_copy(update={law.name: sizes[law.name]})
            data = data.model_copy(update={"ejector": ejector})
        effects = {**data.effects, effect: _joined(data, effect, sizes)}
        data = data.model_copy(update={"effects": effects})
    tables = data.model_dump() | {"terms": [*data.terms, *terms]}
    data = DataSet.model_validate(tables)
    healthy = _healthy(diagnosis, data)
    return Known(data=data, healthy=_learned(diagnosis, data, healthy) if terms else healthy)


def remarks(diagnosis: Diagnosis) -> Iterator[str]:
    """What an extended model does not have, or only as it is now; a line each."""
    for cause, answer in zip(diagnosis.hypothesis, diagnosis.json["causes"], strict=True):
        name = spoken(cause.effect)
        if cause.course == Course.INTERMITTENT:
            yield f"{name} is not always there: it is not stored"
        elif cause.course == Course.RAMP:
            rates = (f"{p['value']:.3g} {p['unit']}" for p in answer["parameters"].values())
            yield f"{name} goes on growing ({', '.join(rates)}): it is stored as it was at the end"
    if diagnosis.terms:
        yield "the term from data holds for this program of commands only"
    elif diagnosis.json["verdict"] == "unlisted" and not diagnosis.mechanism:
        yield "what no listed effect explains is not in it"


def nothing(diagnosis: Diagnosis) -> str:
    """Why there is no extended model."""
    return {
        "consistent": "the data set there is fits already",
        "insufficient": "the log cannot answer",
        "unlisted": "what is off has no name",
    }.get(diagnosis.json["verdict"], "nothing that was found is always there")


def store(
    known: Known, diagnosis: Diagnosis, config: Config, unit: str, assets: str, log: Path
) -> tuple[Record, str]:
    """Add an extended model as the data set of ``unit``; give the record and the database's name.

    It holds from when everything that was found was there.
    """
    record = Record(
        kind="instance",
        name=unit,
        type=config.asset.type,
        data=known.data.model_dump(mode="json"),
        healthy=known.healthy.model_dump(mode="json"),
        provenance=provenance.of_log(log)
        | {
            "cycles": diagnosis.evidence.cycles,
            "extends": f"{config.asset.id or config.asset.type}, data set {diagnosis.data_set}",
            "from": config.origin,
            "causes": [cause.effect for cause in diagnosis.acting if _is_always(cause)],
            "terms": len(diagnosis.terms),
        },
        valid_from_ns=provenance.valid_from(_since(diagnosis)),
    )
    with open_chosen(assets, config.document, write=True) as database:
        record = replace(record, data=carried_on(database, config.asset.id or unit, record.data))
        return database.add(record), database.name


# --- sizes ----------------------------------------------------------------------------------------


def _is_always(cause: Cause) -> bool:
    return cause.course != Course.INTERMITTENT


def _always(diagnosis: Diagnosis) -> Iterator[tuple[str, Sizes]]:
    """What was found that goes on: laws and sizes at the end, but of what nothing depends on."""
    evidence = diagnosis.evidence
    at_end = float(evidence.seconds[-1]), int(evidence.numbers[-1])
    for cause, answer in zip(diagnosis.acting, diagnosis.told, strict=True):
        sizes = cause.at(evidence.theta, *at_end)
        known = {name: sizes[name] for name in answer["parameters"] if _is_always(cause)}
        mechanism = mechanism_of(cause.effect)
        if mechanism in MECHANISMS and sizes and _is_always(cause):
            yield mechanism, sizes  # its times are needed, known well or not
        elif known:
            yield cause.effect, {**cause.law(), **known}


def _joined(data: DataSet, effect: str, found: Sizes) -> dict[str, float]:
    """Sizes that alone do what those of the data set and those found do one after the other."""
    before = data.effects.get(effect, {})
    if effect in MECHANISMS:
        sizes = {one.name for one in MECHANISMS[effect].place.parameters}
        return {
            name: float(f"{value + before.get(name, 0.0) * (name in sizes):.6g}")
            for name, value in found.items()
        }
    goal = apply(coefficients(data), effect, found)
    together = dict(before)
    for parameter in effect_of(effect).parameters:
        name = parameter.name
        if name in before and name in found:
            together[name] = _solved(data, effect, parameter, goal)
        elif name in found:
            together[name] = found[name]
    return {name: float(f"{value:.6g}") for name, value in together.items()}


def _solved(data: DataSet, effect: str, parameter: Parameter, goal: Floats) -> float:
    """The value of one parameter that brings the data set's coefficients to the goal."""

    def at(value: float) -> Floats:
        effects = {**data.effects, effect: {**data.effects[effect], parameter.name: value}}
        return coefficients(data.model_copy(update={"effects": effects}))

    low, high = at(parameter.low), at(parameter.high)
    with np.errstate(invalid="ignore"):
        moves = np.nan_to_num(np.abs(high - low) / (np.abs(high) + np.abs(low)))  # unused: 0/0
    which = int(np.argmax(moves))
    if not min(low[which], high[which]) <= goal[which] <= max(low[which], high[which]):
        raise ConfigError(
            f"{effect}: what the data set has of it and what was found are together beyond"
            f" {parameter.low:g} to {parameter.high:g} {parameter.unit}",
            "repair first, or calibrate the unit anew: twin calibrate",
        )
    scale = abs(high[which] - low[which])
    found = brentq(lambda v: (at(v)[which] - goal[which]) / scale, parameter.low, parameter.high)
    return float(found)


# --- what healthy cycles are like with it ---------------------------------------------------------


def _healthy(diagnosis: Diagnosis, data: DataSet) -> Healthy:
    """Healthy figures with what was found: levels move, and all are less sure than they were."""
    evidence, found = diagnosis.evidence, _now(diagnosis)
    doubts = list(_doubts(diagnosis))
    wider = _wider(evidence, found, doubts)
    known = {
        name: _widened(usual, wider.get(name.rsplit("_", 1)[0], 0.0))
        for name, usual in evidence.healthy.figures.items()
    }
    before, after = evidence.seen(evidence.theta), evidence.seen(coefficients(data))
    others = [evidence.seen(evidence.course(doubt)[0][1]) for doubt in doubts]
    for name, end in (("h1_level", "off"), ("h1_low_level", "on")):
        if name in known:
            usual = known.pop(name)
            here = getattr(after, end)
            unsure = np.nansum([(getattr(other, end) - here) ** 2 for other in others])
            move = here - getattr(before, end)
            if np.isfinite(move):  # else it does not switch with one of them: nobody knows
                moved = usual.model_copy(update={"mean": usual.mean + float(move)})
                known[name] = _widened(moved, float(unsure))
    return evidence.healthy.model_copy(update={"figures": known})


def _learned(diagnosis: Diagnosis, data: DataSet, healthy: Healthy) -> Healthy:
    """Figures as they are in this log: terms that data gave say nothing of what they leave."""
    cycles = whole(Twin.of(data).over([diagnosis.evidence.samples]))
    found = [figures(one, diagnosis.evidence.theta) for one in cycles if one.settled]
    learned = dict(healthy.figures)
    for name, usual in diagnosis.evidence.healthy.figures.items():
        values = [one[name] for one in found if name in one]
        if len(values) > 1:
            sigma = math.hypot(usual.sigma, float(np.std(values, ddof=1)))
            mean = float(np.mean(values))
            learned[name] = Scatter(mean=mean, sigma=sigma, cycles=len(values))
    return healthy.model_copy(update={"figures": learned})


def _widened(usual: Scatter, variance: float) -> Scatter:
    return usual.model_copy(update={"sigma": math.sqrt(usual.sigma**2 + variance)})


def _now(diagnosis: Diagnosis) -> Hypothesis:
    """What was found, as it was at the end and from now on."""
    return tuple(Cause(effect, sizes) for effect, sizes in _always(diagnosis))


def _doubts(diagnosis: Diagnosis) -> Iterator[Hypothesis]:
    """The same with one size after the other a sigma away."""
    names = [mechanism_of(cause.effect) for cause in diagnosis.acting]
    parameters = [answer["parameters"] for answer in diagnosis.told]
    answers = dict(zip(names, parameters, strict=True))
    now = _now(diagnosis)
    for number, cause in enumerate(now):
        for p in effect_of(cause.effect).parameters:
            value, known = cause.values.get(p.name, 0.0), answers[cause.effect].get(p.name)
            if value and known:  # of a ramp they are rates
                sigma = abs(
                    value * (known["high95"] - known["low95"]) / (2 * SIGMAS_95 * known["value"])
                )
                moved = value + sigma if value + sigma <= p.high else value - sigma
                other = replace(cause, values={**cause.values, p.name: moved})
                yield (*now[:number], other, *now[number + 1 :])


def _wider(evidence: Evidence, found: Hypothesis, doubts: Sequence[Hypothesis]) -> dict[str, float]:
    """Variance (mbar²) that the figures of each phase have beyond that of healthy cycles.

    What differs from cycle to cycle acts otherwise where a cause is there (a scatter of supply that
    does nothing at the optimum does much below it), and sizes are known only so well.
    """
    scatter = [Cause(name, {SCATTER[name][0]: s}) for name, s in evidence.healthy.scatter.items()]
    usual = _squares(evidence, HEALTHY, [(one,) for one in scatter])
    here = _squares(evidence, found, [(*found, one) for one in scatter])
    more = np.maximum(here - usual, 0.0).sum(axis=1)
    more += _squares(evidence, found, doubts).sum(axis=1)
    return {phase.name.lower(): float(more[phase]) for phase in Phase}


def _squares(evidence: Evidence, about: Hypothesis, moved: Sequence[Hypothesis]) -> Floats:
    """By how much hypotheses differ from one, mean square in mbar², (phases, hypotheses)."""
    squares = derivatives(evidence.off([about, *moved]))[1] ** 2
    bins = evidence.bins
    phase = np.where(bins.kind == AGAIN, Phase.SUCTION, bins.kind)
    found = np.zeros((len(Phase), len(moved)))
    for one in Phase:
        there = phase == one
        if there.any():
            found[one] = np.average(squares[there], axis=0, weights=bins.count[there])
    return found


def _since(diagnosis: Diagnosis) -> int:
    """When (ns) the rows were received from which on all that was found is there."""
    evidence = diagnosis.evidence
    timed = (Course.STEP, Course.RAMP)
    onsets = [cause.onset_s for cause in diagnosis.acting if cause.course in timed]
    row = int(np.searchsorted(evidence.seconds, max(onsets, default=0.0)))
    return int(evidence.samples["host_ns"][min(row, len(evidence.samples) - 1)])
