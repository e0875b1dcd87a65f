"""Cost of a cause: the model's compressed air with the cause, less that without it.

The model runs the log's own commands. Other causes stay in it, except intermittent ones. So the
cost is the saving if this cause alone is put right.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from twin.config import Config
from twin.diagnosis.evidence import Evidence, Hypothesis, at_once
from twin.figures.costs import Tariff
from twin.figures.key_figures import Unit
from twin.figures.money import Interval
from twin.figures.settings import FigureSettings
from twin.figures.simulated import Program, mean_air, mean_cycle_time, simulated
from twin.inference.levels import SIGMAS_95
from twin.model.courses import Cause, Course
from twin.model.dataset import DataSet, coefficients
from twin.model.effects import apply, effect_of
from twin.model.theta import Theta
from twin.monitor.bins import Floats
from twin.monitor.uncertain_data import drawn

# Sampled shares of each half of an interval. The nozzle switches a whole number of times in a
# cycle, so air over size has steps: the ends alone would miss some.
SHARES = (1.0 / 3.0, 2.0 / 3.0, 1.0)
# Data sets drawn from the unit's uncertainty and the scatter of cycles. Cycles of a machine differ
# in their number of switchings, and their mean counts.
DRAWS = 12
SEED = 1  # of the draws, so that the same log gives the same answer

Values = Mapping[str, float]
Answer = Mapping[str, Any]


def costs(
    config: Config, evidence: Evidence, hypothesis: Hypothesis, causes: Sequence[Answer]
) -> list[dict[str, Any] | None]:
    """The cost of each cause for the answer, in order; empty if no price is configured.

    An entry is None for a cause without a known size. ``causes`` are the answer's entries for those
    of ``hypothesis``, with 95 % intervals.
    """
    settings = config.document.section(FigureSettings, "figures")
    tariff = Tariff.of(settings)
    if tariff.per_m3 is None:
        return []
    unit = Unit(config.data, settings.energy_kwh_m3)
    program = Program.of(evidence.samples, evidence.starts)
    model = _Model(evidence, unit, program, _thetas(config.data, evidence))
    return [model.cost(hypothesis, index, tariff, cause) for index, cause in enumerate(causes)]


def _thetas(data: DataSet, evidence: Evidence) -> list[Theta]:
    """Drawn coefficients of the unit, in the surroundings of its log."""
    rng, base = np.random.default_rng(SEED), coefficients(data)
    shift = np.zeros(len(base))
    differs = np.isfinite(base) & (evidence.theta != base)  # some are infinite or unset
    shift[differs] = evidence.theta[differs] - base[differs]
    return [drawn(data, evidence.healthy, rng) + shift for _ in range(DRAWS)]


@dataclass(frozen=True)
class _Model:
    """The calibrated twin of a log, run over the commands of its cycles."""

    evidence: Evidence
    unit: Unit
    program: Program
    thetas: Sequence[Theta]  # drawn coefficients of the unit

    @property
    def cycle_s(self) -> float:
        """Mean time of a cycle (s) of the log."""
        return mean_cycle_time(self.program.cycle_seconds)

    def cost(
        self, hypothesis: Hypothesis, index: int, tariff: Tariff, answer: Answer
    ) -> dict[str, Any] | None:
        """The cost of the cause at ``index`` for the answer; None if it is unknown."""
        if not answer["parameters"]:
            return None
        extra = self.extra_air(hypothesis, index, answer)
        is_known = all(map(math.isfinite, extra))  # the model may fail on a drawn data set
        return _plain(extra, self.cycle_s, tariff) if is_known else None

    def extra_air(self, hypothesis: Hypothesis, index: int, answer: Answer) -> Interval:
        """Mean extra air (Nl) of a cycle because of one cause, with its 95 % interval.

        The interval includes the uncertainty of the cause's size and of the data set. An
        intermittent cause counts with its share of the cycles.
        """
        other_causes = [
            (cause.effect, self._at_end(cause))
            for number, cause in enumerate(hypothesis)
            if number != index and cause.course != Course.INTERMITTENT
        ]
        cause = hypothesis[index]
        sizes = self._at_end(cause)
        without = self._air(other_causes)
        at_size = self._air([*other_causes, (cause.effect, sizes)]) - without
        extra = float(at_size.mean())
        down = up = SIGMAS_95 * float(at_size.std(ddof=1))
        for variants in _ways(sizes, cause.effect, answer["parameters"]):
            air = [
                float(np.mean(self._air([*other_causes, (cause.effect, variant)]) - without))
                for variant in variants
            ]
            down = math.hypot(down, max(extra - min(air), 0.0))
            up = math.hypot(up, max(max(air) - extra, 0.0))
        share = answer["share_pct"] / 100.0 if cause.course == Course.INTERMITTENT else 1.0
        return Interval(extra, extra - down, extra + up).times(share)

    def _at_end(self, cause: Cause) -> Values:
        """Values of a cause in the last cycle of the log in which it acts."""
        number = max(cause.cycles, default=int(self.evidence.numbers[-1]))
        return cause.at(self.evidence.theta, float(self.evidence.seconds[-1]), number)

    def _air(self, causes: Sequence[tuple[str, Values]]) -> Floats:
        """Mean air (Nl) of a cycle with ``causes``, for each of ``thetas``."""
        return np.array(at_once(partial(self._air_of, causes), self.thetas))

    def _air_of(self, causes: Sequence[tuple[str, Values]], theta: Theta) -> float:
        for effect, sizes in causes:
            theta = apply(theta, effect, sizes)
        return mean_air(simulated(theta, self.unit, self.program))


def _ways(sizes: Values, effect: str, parameters: Mapping[str, Answer]) -> Iterator[list[Values]]:
    """For each parameter with an interval: sizes sampled over it, other parameters unchanged."""
    for parameter in effect_of(effect).parameters:
        if parameter.name in parameters:
            interval = parameters[parameter.name]
            low = interval.get("at_end_low95", interval["low95"])
            high = interval.get("at_end_high95", interval["high95"])
            value = sizes[parameter.name]
            over = [value + share * (end - value) for end in (low, high) for share in SHARES]
            inside = np.clip(over, parameter.low, parameter.high).tolist()
            yield [{**sizes, parameter.name: size} for size in inside]


def _plain(extra: Interval, cycle_s: float, tariff: Tariff) -> dict[str, Any]:
    """The cost as JSON: air in Nl a cycle, money a year."""
    assert tariff.per_m3 is not None
    cycles = tariff.cycles_a_year(cycle_s)
    money = Interval(*(cycles * (tariff.money(air) or 0.0) for air in extra))
    return {
        "air_nl_per_cycle": _rounded(extra),
        "money_per_year": _rounded(money),
        "currency": tariff.currency,
        "cycles_per_year": round(cycles),
        "operating_hours": tariff.hours,
        "differs_from_zero": extra.is_sure,
    }


def _rounded(values: Interval) -> dict[str, float]:
    return {name: float(f"{value:.4g}") for name, value in values._asdict().items()}
