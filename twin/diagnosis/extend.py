"""The extended model: a data set with the findings of a diagnosis, stored for a unit."""

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
from twin.figures.expected import free_flow, leakage_from_rest, t1_from_rest
from twin.figures.settings import HIGHEST, LIMITED, LOWEST
from twin.inference.levels import SIGMAS_95
from twin.inference.sensitivities import derivatives
from twin.live import Twin
from twin.model import theta as c
from twin.model.catalogue import mechanism_of
from twin.model.courses import Cause, Course
from twin.model.dataset import DataSet, coefficients
from twin.model.effects import Parameter, apply, effect_of
from twin.model.mechanism import MECHANISMS, RHYTHMIC
from twin.model.term import AGAIN
from twin.model.theta import Theta
from twin.monitor.bins import Floats
from twin.monitor.cycles import figures, whole
from twin.monitor.healthy import Healthy, Scatter
from twin.monitor.measured_supply import SUPPLY
from twin.monitor.scatter_covariance import SCATTER
from twin.signals import BAR, Phase

Sizes = Mapping[str, float]


def extended(diagnosis: Diagnosis, config: Config) -> Known | None:
    """The data set of ``config`` with the findings, and its healthy cycles.

    None if nothing lasting was found. Raises ConfigError if an effect, together with its size in
    the data set, is beyond its bounds.
    """
    data, terms = config.data, diagnosis.terms
    sizes_by_effect = dict(_lasting_causes(diagnosis))
    if not sizes_by_effect and not terms:
        return None
    for effect, sizes in sizes_by_effect.items():
        law = effect_of(effect).law
        if law and law.name in sizes:
            ejector = data.ejector.model_copy(update={law.name: sizes[law.name]})
            data = data.model_copy(update={"ejector": ejector})
        effects = {**data.effects, effect: _joined(data, effect, sizes)}
        data = data.model_copy(update={"effects": effects})
    tables = data.model_dump() | {"terms": [*data.terms, *terms]}
    data = DataSet.model_validate(tables)
    healthy = _healthy(diagnosis, data)
    doubted = [diagnosis.evidence.course(doubt)[0][1] for doubt in _doubts(diagnosis)]
    shifted = shifted_key_figures(healthy.key_figures, config.data, data, doubted)
    healthy = healthy.model_copy(update={"key_figures": shifted})
    return Known(data=data, healthy=_learned(diagnosis, data, healthy) if terms else healthy)


def remarks(diagnosis: Diagnosis) -> Iterator[str]:
    """Findings that the extended model lacks, or has only as they are now; a line each."""
    for cause, answer in zip(diagnosis.hypothesis, diagnosis.json["causes"], strict=True):
        name = spoken(cause.effect)
        if cause.course == Course.INTERMITTENT:
            yield f"{name} is not always there: it is not stored"
        elif cause.course == Course.RAMP:
            rates = (f"{p['value']:.3g} {p['unit']}" for p in answer["parameters"].values())
            yield f"{name} goes on growing ({', '.join(rates)}): it is stored as it was at the end"
    if any(map(has_rhythm, diagnosis.acting)):
        yield "what has a rhythm of its own begins anew in each recording: it is not stored"
    if diagnosis.terms:
        yield (
            "the curve from data holds for this program of commands only, and is added to any:"
            " where the program changes, go back to the data set without it"
        )
    elif diagnosis.json["verdict"] == "unlisted" and not diagnosis.mechanism:
        yield "what no listed effect explains is not in it"


def nothing(diagnosis: Diagnosis) -> str:
    """The reason why there is no extended model."""
    if any(map(has_rhythm, diagnosis.acting)):
        return "what has a rhythm of its own has another phase in each recording"
    return {
        "consistent": "the data set there is fits already",
        "insufficient": "the log cannot answer",
        "unlisted": "what is off has no name",
    }.get(diagnosis.json["verdict"], "nothing that was found is always there")


def store(
    extended_model: Known, diagnosis: Diagnosis, config: Config, unit: str, assets: str, log: Path
) -> tuple[Record, str]:
    """Add an extended model as the data set of ``unit``; give the record and the database's name.

    It is valid from the time at which all findings were present.
    """
    record = Record(
        kind="instance",
        name=unit,
        type=config.asset.type,
        data=extended_model.data.model_dump(mode="json"),
        healthy=extended_model.healthy.model_dump(mode="json"),
        provenance=provenance.of_log(log)
        | {
            "cycles": diagnosis.evidence.cycles,
            "extends": f"{config.asset.id or config.asset.type}, data set {diagnosis.data_set}",
            "from": config.origin,
            "causes": [cause.effect for cause in diagnosis.acting if _is_lasting(cause)],
            "terms": len(diagnosis.terms),
            **({provenance.WEAK: dict(config.weak)} if config.weak else {}),
        },
        valid_from_ns=provenance.valid_from(_since(diagnosis)),
    )
    with open_chosen(assets, config.document, write=True) as database:
        record = replace(record, data=carried_on(database, config.asset.id or unit, record.data))
        return database.add(record), database.name


# --- sizes ----------------------------------------------------------------------------------------


def has_rhythm(cause: Cause) -> bool:
    """Whether a cause has a rhythm of its own. Nobody knows its phase in another log."""
    mechanism = MECHANISMS.get(mechanism_of(cause.effect))
    return mechanism is not None and mechanism.when.code in RHYTHMIC


def _is_lasting(cause: Cause) -> bool:
    return cause.course != Course.INTERMITTENT and not has_rhythm(cause)


def _lasting_causes(diagnosis: Diagnosis) -> Iterator[tuple[str, Sizes]]:
    """Lasting causes with laws and sizes at the end, without sizes that the log does not show."""
    evidence = diagnosis.evidence
    at_end = float(evidence.seconds[-1]), int(evidence.numbers[-1])
    for cause, answer in zip(diagnosis.acting, diagnosis.told, strict=True):
        sizes = cause.at(evidence.theta, *at_end)
        known_sizes = {name: sizes[name] for name in answer["parameters"] if _is_lasting(cause)}
        mechanism = mechanism_of(cause.effect)
        if mechanism in MECHANISMS and sizes and _is_lasting(cause):
            yield mechanism, sizes  # its times are needed even if poorly known
        elif known_sizes:
            yield cause.effect, {**cause.law(), **known_sizes}


def _joined(data: DataSet, effect: str, new_sizes: Sizes) -> dict[str, float]:
    """Sizes equivalent to those of the data set and those found, applied in turn."""
    before = data.effects.get(effect, {})
    if effect in MECHANISMS:
        sizes = {p.name for p in MECHANISMS[effect].place.parameters}
        return {
            name: float(f"{value + before.get(name, 0.0) * (name in sizes):.6g}")
            for name, value in new_sizes.items()
        }
    goal = apply(coefficients(data), effect, new_sizes)
    joined = dict(before)
    for parameter in effect_of(effect).parameters:
        name = parameter.name
        if name in before and name in new_sizes:
            joined[name] = _solved(data, effect, parameter, goal)
        elif name in new_sizes:
            joined[name] = new_sizes[name]
    return {name: float(f"{value:.6g}") for name, value in joined.items()}


def _solved(data: DataSet, effect: str, parameter: Parameter, goal: Floats) -> float:
    """The value of one parameter for which the data set's coefficients reach the goal."""

    def at(value: float) -> Floats:
        effects = {**data.effects, effect: {**data.effects[effect], parameter.name: value}}
        return coefficients(data.model_copy(update={"effects": effects}))

    low, high = at(parameter.low), at(parameter.high)
    with np.errstate(invalid="ignore"):
        moves = np.nan_to_num(np.abs(high - low) / (np.abs(high) + np.abs(low)))  # unused: 0/0
    index = int(np.argmax(moves))
    if not min(low[index], high[index]) <= goal[index] <= max(low[index], high[index]):
        raise ConfigError(
            f"{effect}: what the data set has of it and what was found are together beyond"
            f" {parameter.low:g} to {parameter.high:g} {parameter.unit}",
            "repair first, or calibrate the unit anew: twin calibrate",
        )
    scale = abs(high[index] - low[index])
    root = brentq(lambda v: (at(v)[index] - goal[index]) / scale, parameter.low, parameter.high)
    return float(root)


# --- what healthy cycles are like with it ---------------------------------------------------------


def _healthy(diagnosis: Diagnosis, data: DataSet) -> Healthy:
    """Healthy figures with the findings: levels shift, and all sigmas are wider."""
    evidence, hypothesis = diagnosis.evidence, _now(diagnosis)
    doubts = list(_doubts(diagnosis))
    wider = _wider(evidence, hypothesis, doubts)
    by_name = {
        name: _widened(scatter, wider.get(name.rsplit("_", 1)[0], 0.0))
        for name, scatter in evidence.healthy.figures.items()
    }
    before, after = (
        evidence.detected_switching(evidence.theta),
        evidence.detected_switching(coefficients(data)),
    )
    doubted = [evidence.detected_switching(evidence.course(doubt)[0][1]) for doubt in doubts]
    for name, end in (("h1_level", "off"), ("h1_low_level", "on")):
        if name in by_name:
            scatter = by_name.pop(name)
            level = getattr(after, end)
            variance = np.nansum([(getattr(switching, end) - level) ** 2 for switching in doubted])
            shift = level - getattr(before, end)
            if np.isfinite(shift):  # else one of them does not switch, and the level is unknown
                moved = scatter.model_copy(update={"mean": scatter.mean + float(shift)})
                by_name[name] = _widened(moved, float(variance))
    return evidence.healthy.model_copy(update={"figures": by_name})


def shifted_key_figures(
    key_figures: Mapping[str, Scatter], before: DataSet, after: DataSet, doubted: Sequence[Theta]
) -> dict[str, Scatter]:
    """Key figures of healthy cycles, shifted by what an extended data set expects of them.

    ``doubted`` are its coefficients with each uncertain size in turn moved by one sigma: sigmas are
    wider by what that changes. A figure that one of the data sets does not expect is left out, so
    that its limit follows from the extended one.
    """
    usual = _from_rest(before, coefficients(before))
    moved = _from_rest(after, coefficients(after))
    others = [_from_rest(after, theta) for theta in doubted]
    shifted = {}
    for name, scatter in key_figures.items():
        shift = moved[name] - usual[name]
        if math.isfinite(shift):
            variance = sum(
                (other[name] - moved[name]) ** 2 for other in others if math.isfinite(other[name])
            )
            mean = scatter.mean + shift
            shifted[name] = _widened(scatter.model_copy(update={"mean": mean}), variance)
    return shifted


def _from_rest(data: DataSet, theta: Theta) -> dict[str, float]:
    """Key figures that a data set expects with coefficients ``theta``, in their units.

    One that cannot be measured is not finite.
    """
    t1 = t1_from_rest(data, theta)
    nozzle_bar = float(theta[c.SUPPLY] - theta[c.DROOP]) / BAR
    return {
        "t1": t1,
        "leakage": leakage_from_rest(data, theta) if math.isfinite(t1) else math.nan,
        "free_flow": free_flow(theta),
        **dict.fromkeys((LOWEST, HIGHEST, SUPPLY), nozzle_bar),
    }


def _learned(diagnosis: Diagnosis, data: DataSet, healthy: Healthy) -> Healthy:
    """Figures as in this log: learned terms do not predict their residuals.

    Key figures with limits are left out, as nothing says how these terms move them from rest.
    """
    cycles = whole(Twin.of(data).over([diagnosis.evidence.samples]))
    by_cycle = [figures(cycle, diagnosis.evidence.theta) for cycle in cycles if cycle.settled]
    learned = dict(healthy.figures)
    for name, usual in diagnosis.evidence.healthy.figures.items():
        values = [cycle_figures[name] for cycle_figures in by_cycle if name in cycle_figures]
        if len(values) > 1:
            sigma = math.hypot(usual.sigma, float(np.std(values, ddof=1)))
            mean = float(np.mean(values))
            learned[name] = Scatter(mean=mean, sigma=sigma, cycles=len(values))
    unlimited = {name: usual for name, usual in healthy.key_figures.items() if name not in LIMITED}
    return healthy.model_copy(update={"figures": learned, "key_figures": unlimited})


def _widened(usual: Scatter, variance: float) -> Scatter:
    return usual.model_copy(update={"sigma": math.sqrt(usual.sigma**2 + variance)})


def _now(diagnosis: Diagnosis) -> Hypothesis:
    """The lasting causes with their sizes at the end, constant."""
    return tuple(Cause(effect, sizes) for effect, sizes in _lasting_causes(diagnosis))


def _doubts(diagnosis: Diagnosis) -> Iterator[Hypothesis]:
    """``_now`` with each size in turn moved by one sigma."""
    names = [mechanism_of(cause.effect) for cause in diagnosis.acting]
    parameters = [answer["parameters"] for answer in diagnosis.told]
    answers = dict(zip(names, parameters, strict=True))
    now = _now(diagnosis)
    for number, cause in enumerate(now):
        for p in effect_of(cause.effect).parameters:
            value, estimate = cause.values.get(p.name, 0.0), answers[cause.effect].get(p.name)
            if value and estimate:  # of a ramp they are rates
                sigma = abs(
                    value
                    * (estimate["high95"] - estimate["low95"])
                    / (2 * SIGMAS_95 * estimate["value"])
                )
                moved = value + sigma if value + sigma <= p.high else value - sigma
                moved_cause = replace(cause, values={**cause.values, p.name: moved})
                yield (*now[:number], moved_cause, *now[number + 1 :])


def _wider(
    evidence: Evidence, hypothesis: Hypothesis, doubts: Sequence[Hypothesis]
) -> dict[str, float]:
    """Variance (mbar²) of the figures of each phase in excess of healthy cycles.

    Scatter has another response with a cause (that of the supply does nothing at the optimum, and
    much below it), and sizes are uncertain.
    """
    scatter = [Cause(name, {SCATTER[name][0]: s}) for name, s in evidence.healthy.scatter.items()]
    without_cause = _squares(evidence, HEALTHY, [(cause,) for cause in scatter])
    with_cause = _squares(evidence, hypothesis, [(*hypothesis, cause) for cause in scatter])
    excess = np.maximum(with_cause - without_cause, 0.0).sum(axis=1)
    excess += _squares(evidence, hypothesis, doubts).sum(axis=1)
    return {phase.name.lower(): float(excess[phase]) for phase in Phase}


def _squares(evidence: Evidence, about: Hypothesis, moved: Sequence[Hypothesis]) -> Floats:
    """Mean square difference (mbar²) of hypotheses from one, (phases, hypotheses)."""
    squares = derivatives(evidence.off([about, *moved]))[1] ** 2
    bins = evidence.bins
    phase = np.where(bins.kind == AGAIN, Phase.SUCTION, bins.kind)
    means = np.zeros((len(Phase), len(moved)))
    for kind in Phase:
        in_phase = phase == kind
        if in_phase.any():
            means[kind] = np.average(squares[in_phase], axis=0, weights=bins.count[in_phase])
    return means


def _since(diagnosis: Diagnosis) -> int:
    """Host time (ns) of the first row at which all findings are present."""
    evidence = diagnosis.evidence
    timed = (Course.STEP, Course.RAMP)
    onsets = [cause.onset_s for cause in diagnosis.acting if cause.course in timed]
    row = int(np.searchsorted(evidence.seconds, max(onsets, default=0.0)))
    return int(evidence.samples["host_ns"][min(row, len(evidence.samples) - 1)])
