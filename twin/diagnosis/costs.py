"""What a cause costs: the compressed air that the model takes with it, less that without it.

The model runs the log's own commands. Each other cause that is always there stays in it, so the
cost is what is saved where this one alone is put right.
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
from twin.figures.money import Interval
from twin.figures.settings import FigureSettings
from twin.figures.simulated import Program, mean_air, mean_cycle_time, simulated
from twin.figures.table import Unit
from twin.inference.levels import SIGMAS_95
from twin.model.courses import Cause, Course
from twin.model.dataset import DataSet, coefficients
from twin.model.effects import apply, effect_of
from twin.model.theta import Theta
from twin.monitor.bins import Floats
from twin.monitor.uncertain_data import drawn

# Of each half of an interval. The nozzle switches a whole number of times in a cycle, so that air
# runs in steps over a size: the ends alone would miss some.
SHARES = (1.0 / 3.0, 2.0 / 3.0, 1.0)
# Data sets that the unit may have, drawn with the scatter of cycles: in a machine not all cycles
# switch as often, and their mean is what counts.
DRAWS = 12
SEED = 1  # of these draws: the same log gives the same answer

Values = Mapping[str, float]
Answer = Mapping[str, Any]


def costs(
    config: Config, evidence: Evidence, hypothesis: Hypothesis, causes: Sequence[Answer]
) -> list[dict[str, Any] | None]:
    """The cost of each cause in the answer's form, in order; none where no price is configured.

    It is None for a cause of which no size is known. ``causes`` are those of ``hypothesis`` as
    the answer has them, with their 95 % intervals.
    """
    settings = config.document.section(FigureSettings, "figures")
    tariff = Tariff.of(settings)
    if tariff.per_m3 is None:
        return []
    unit = Unit(config.data, settings.energy_kwh_m3)
    program = Program.of(evidence.samples, evidence.starts)
    model = _Model(evidence, unit, program, _thetas(config.data, evidence))
    return [model.cost(hypothesis, place, tariff, cause) for place, cause in enumerate(causes)]


def _thetas(data: DataSet, evidence: Evidence) -> list[Theta]:
    """Coefficients that the unit may have, in the surroundings of its log."""
    rng, base = np.random.default_rng(SEED), coefficients(data)
    around = np.zeros(len(base))
    differs = np.isfinite(base) & (evidence.theta != base)  # some are infinite or unset
    around[differs] = evidence.theta[differs] - base[differs]
    return [drawn(data, evidence.healthy, rng) + around for _ in range(DRAWS)]


@dataclass(frozen=True)
class _Model:
    """The calibrated twin of a log, run over the commands of its cycles."""

    evidence: Evidence
    unit: Unit
    program: Program
    thetas: Sequence[Theta]  # that the unit may have

    @property
    def cycle_s(self) -> float:
        """Mean time of a cycle (s), as the log has it."""
        return mean_cycle_time(self.program.cycle_seconds)

    def cost(
        self, hypothesis: Hypothesis, place: int, tariff: Tariff, answer: Answer
    ) -> dict[str, Any] | None:
        """The cost of the cause at ``place`` in the answer's form, None where it is unknown."""
        if not answer["parameters"]:
            return None
        extra = self.extra_air(hypothesis, place, answer)
        is_known = all(map(math.isfinite, extra))  # the model of a data set drawn may break down
        return _plain(extra, self.cycle_s, tariff) if is_known else None

    def extra_air(self, hypothesis: Hypothesis, place: int, answer: Answer) -> Interval:
        """Air (Nl) that one cause takes in a cycle in the mean, with its 95 % interval.

        The interval is of the cause's size and of the data set. An intermittent cause counts with
        its share of the cycles.
        """
        others = [
            (cause.effect, self._at_end(cause))
            for number, cause in enumerate(hypothesis)
            if number != place and cause.course != Course.INTERMITTENT
        ]
        cause = hypothesis[place]
        sizes = self._at_end(cause)
        without = self._air(others)
        at_size = self._air([*others, (cause.effect, sizes)]) - without
        extra = float(at_size.mean())
        down = up = SIGMAS_95 * float(at_size.std(ddof=1))
        for ways in _ways(sizes, cause.effect, answer["parameters"]):
            air = [
                float(np.mean(self._air([*others, (cause.effect, way)]) - without)) for way in ways
            ]
            down = math.hypot(down, max(extra - min(air), 0.0))
            up = math.hypot(up, max(max(air) - extra, 0.0))
        share = answer["share_pct"] / 100.0 if cause.course == Course.INTERMITTENT else 1.0
        return Interval(extra, extra - down, extra + up).times(share)

    def _at_end(self, cause: Cause) -> Values:
        """Values of a cause at the end of the log, where it acts."""
        number = max(cause.cycles, default=int(self.evidence.numbers[-1]))
        return cause.at(self.evidence.theta, float(self.evidence.seconds[-1]), number)

    def _air(self, causes: Sequence[tuple[str, Values]]) -> Floats:
        """Mean air (Nl) of a cycle under some causes, for each of ``thetas``."""
        return np.array(at_once(partial(self._air_of, causes), self.thetas))

    def _air_of(self, causes: Sequence[tuple[str, Values]], theta: Theta) -> float:
        for effect, sizes in causes:
            theta = apply(theta, effect, sizes)
        return mean_air(simulated(theta, self.unit, self.program))


def _ways(sizes: Values, effect: str, parameters: Mapping[str, Answer]) -> Iterator[list[Values]]:
    """For each parameter with an interval the sizes over it, the others as they are."""
    for parameter in effect_of(effect).parameters:
        if parameter.name in parameters:
            known = parameters[parameter.name]
            low = known.get("at_end_low95", known["low95"])
            high = known.get("at_end_high95", known["high95"])
            value = sizes[parameter.name]
            over = [value + share * (end - value) for end in (low, high) for share in SHARES]
            inside = np.clip(over, parameter.low, parameter.high).tolist()
            yield [{**sizes, parameter.name: size} for size in inside]


def _plain(extra: Interval, cycle_s: float, tariff: Tariff) -> dict[str, Any]:
    """The cost in the answer's form: air in Nl a cycle, money a year."""
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
