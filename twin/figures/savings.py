"""Air that other settings of an ejector would save, predicted by the model for the log's program.

A setting is offered only if the hold stays above H2, uncertainty included, and if H1 and H2 are
reached as before.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin.errors import ConfigError
from twin.figures.cycle_view import Floats
from twin.figures.key_figures import Unit
from twin.figures.money import Interval
from twin.figures.simulated import Program, SimulatedCycle, mean_air, simulated
from twin.inference.levels import SIGMAS_95
from twin.model import theta as c
from twin.model.dataset import DataSet, coefficients
from twin.model.effects import apply, standing_for
from twin.model.safeguards import PROTECTED_S, PROTECTED_SWITCHES
from twin.model.theta import Theta
from twin.monitor.healthy import Healthy
from twin.monitor.uncertain_data import drawn
from twin.signals import MBAR

MOST_CYCLES = 12  # of a log, simulated
DRAWS = 24  # data sets for an interval: its width is then known to a seventh
SEED = 1  # of the draws, so that the same log gives the same answer
# mbar that the hold must stay above H2. Chosen: the error of a vacuum switch, 1 % of 1 bar.
LEAST_MARGIN = 10.0
# Changes of H1 and of its hysteresis (mbar) and of the supply (bar) that are tried. If H1 and
# hysteresis change alike, the nozzle goes on again at the same vacuum as before.
TRIED = (
    (-20.0, 0.0, 0.0),
    (-40.0, 0.0, 0.0),
    (-80.0, 0.0, 0.0),
    (0.0, 20.0, 0.0),
    (0.0, 40.0, 0.0),
    (0.0, -50.0, 0.0),
    (-50.0, -50.0, 0.0),
    (-100.0, -100.0, 0.0),
    (0.0, 0.0, -0.5),
    (0.0, 0.0, -1.0),
)


@dataclass(frozen=True)
class Setting:
    """What a person sets at the ejector and at the regulator."""

    h1: float  # mbar
    hysteresis: float  # H1 less the vacuum at which the nozzle goes on again, mbar
    supply: float  # bar gauge, at the regulator

    @classmethod
    def of(cls, data: DataSet) -> "Setting":
        """The setting of a data set."""
        ejector = data.ejector
        return cls(ejector.h1_mbar, ejector.h1_hysteresis_mbar, data.supply.pressure_bar)

    def act(self, theta: Theta, now: "Setting") -> Theta:
        """Coefficients with this setting; ``theta`` has the setting ``now``."""
        drop = now.supply - self.supply
        lower_supply, parameter = standing_for(c.SUPPLY)
        theta = apply(theta, lower_supply.name, {parameter.name: drop})
        theta[c.H1] += (self.h1 - now.h1) * MBAR
        theta[c.H1_LOW] += (self.h1 - self.hysteresis - now.h1 + now.hysteresis) * MBAR
        return theta


@dataclass(frozen=True)
class Prediction:
    """Prediction for one setting; means over cycles unless stated otherwise."""

    setting: Setting
    air: float  # Nl a cycle
    saved: Interval  # Nl a cycle less than now; the interval is NaN if unknown
    t0: float  # ms, NaN if H2 is not reached
    t1: float  # ms, NaN if H1 is not reached
    margin: Interval  # mbar that the lowest hold stays above H2
    refused: str = ""  # why it is not offered


@dataclass(frozen=True)
class Savings:
    """Predictions for the present setting and for others."""

    now: Prediction
    others: list[Prediction]
    is_uncertainty_known: bool

    @property
    def offered(self) -> list[Prediction]:
        """Settings that keep H2 and the hold, the greatest saving first."""
        kept = [prediction for prediction in self.others if not prediction.refused]
        return sorted(kept, key=lambda prediction: -prediction.saved.value)

    @property
    def refused(self) -> list[Prediction]:
        """Settings that do not."""
        return [prediction for prediction in self.others if prediction.refused]


def savings(unit: Unit, healthy: Healthy, program: Program) -> Savings:
    """Predict what the settings of TRIED save over the commands of a program.

    The uncertainty is that of the data set and of cycles in ``healthy``, and that of the response
    to the supply. It is unknown if the unit was not calibrated. Raises ConfigError if the present
    setting does not reach H2 in the program.
    """
    rng = np.random.default_rng(SEED)
    count = DRAWS if healthy.uncertain else 0
    drawn_data = [drawn(unit.data, healthy, rng) for _ in range(count)]
    predict = _Predictor(unit, program, [coefficients(unit.data), *drawn_data])
    now = predict(Setting.of(unit.data))
    if math.isnan(now.t0):
        raise ConfigError(
            "the model does not reach H2 in this log's program as it is: nothing can be saved",
            "diagnose the log first (twin diagnose), or give the unit's own data set (--id)",
        )
    others = [predict(setting) for setting in _settings(unit.data)]
    return Savings(now, others, is_uncertainty_known=count > 0)


def _settings(data: DataSet) -> Iterator[Setting]:
    """The settings to try; without air saving only the supply, as H1 then changes nothing."""
    now, saves = Setting.of(data), data.ejector.air_saving != "off"
    for h1, hysteresis, supply in TRIED:
        other = Setting(now.h1 + h1, now.hysteresis + hysteresis, now.supply + supply)
        is_possible = other.hysteresis > 0.0 and other.supply > data.supply.droop_bar
        if is_possible and (saves or (h1, hysteresis) == (0.0, 0.0)):
            yield other


class _Predictor:
    """Runs settings with the data set and with drawn ones, the same for each setting."""

    def __init__(self, unit: Unit, program: Program, thetas: Sequence[Theta]) -> None:
        self._unit, self._program, self._thetas = unit, program, thetas
        self._now = Setting.of(unit.data)
        self._saves = unit.data.ejector.air_saving != "off"
        runs = [self._run(theta, self._now) for theta in thetas]
        self._air_now = np.array([mean_air(run) for run in runs])
        self._h1_reached = not _count(runs[0], "h1_not_reached", 1.0)
        self._switchings = _most(runs[0], "quick_switchings")

    def __call__(self, setting: Setting) -> Prediction:
        runs = [self._run(theta, setting) for theta in self._thetas]
        air = np.array([mean_air(run) for run in runs])
        margins = np.array([min(cycle.held for cycle in run) - self._unit.h2 for run in runs])
        cycles, margin = runs[0], _interval(margins)
        prediction = Prediction(
            setting,
            _interval(air).value,
            _interval(self._air_now - air),
            _mean(cycles, "t0"),
            _mean(cycles, "t1"),
            margin,
        )
        return replace(prediction, refused=self._refused(setting, cycles, margin))

    def _run(self, theta: Theta, setting: Setting) -> list[SimulatedCycle]:
        ejector = self._unit.data.ejector.model_copy(update={"h1_mbar": setting.h1})
        data = self._unit.data.model_copy(update={"ejector": ejector})
        unit = Unit(data, self._unit.energy_kwh_m3)
        return simulated(setting.act(theta, self._now), unit, self._program)

    def _refused(self, setting: Setting, cycles: Sequence[SimulatedCycle], margin: Interval) -> str:
        """Why a setting is not offered; empty if it is."""
        on_again = setting.h1 - setting.hysteresis
        if self._saves and on_again - self._unit.h2 < LEAST_MARGIN:
            return (
                f"in a longer hold the nozzle goes on again at {on_again:g} mbar,"
                f" less than {LEAST_MARGIN:g} mbar above H2"
            )
        without_h2 = sum(math.isnan(cycle.figures["t0"]) for cycle in cycles)
        if without_h2:
            return f"H2 is not reached in {without_h2} of {len(cycles)} cycles"
        without_h1 = _count(cycles, "h1_not_reached", 1.0)
        if without_h1 and self._h1_reached:
            return f"H1 is not reached in {without_h1} of {len(cycles)} cycles: no air is saved"
        lowest = margin.value if math.isnan(margin.low95) else margin.low95
        if lowest < LEAST_MARGIN:
            return (
                f"the hold comes to {lowest:.0f} mbar above H2,"
                f" and at least {LEAST_MARGIN:g} mbar must stay"
            )
        switchings = _most(cycles, "quick_switchings")
        if switchings >= PROTECTED_SWITCHES > self._switchings:
            return f"valve protection: {switchings:.0f} switchings within {PROTECTED_S:g} s"
        return ""


def _interval(values: Floats) -> Interval:
    """The mean of the draws with a 95 % interval; without draws the first value without one.

    The first value is that of the data set itself, and the draws follow it.
    """
    if len(values) == 1:
        return Interval(float(values[0]), math.nan, math.nan)
    value, half = float(values[1:].mean()), SIGMAS_95 * float(values[1:].std(ddof=1))
    return Interval(value, value - half, value + half)


def _mean(cycles: Sequence[SimulatedCycle], figure: str) -> float:
    return float(np.mean([cycle.figures[figure] for cycle in cycles]))


def _most(cycles: Sequence[SimulatedCycle], figure: str) -> float:
    return max(cycle.figures[figure] for cycle in cycles)


def _count(cycles: Sequence[SimulatedCycle], figure: str, value: float) -> int:
    return sum(cycle.figures[figure] == value for cycle in cycles)
