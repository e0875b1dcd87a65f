"""The data set of an ejector and what hangs on it, in the field's units, and its SI form.

An object-specific data set describes a type, an instance-specific one a single unit; both have this
shape. ``coefficients`` converts it into the vector of the compiled kernel: the only place where the
units of the model are converted.
"""

import hashlib
import math
from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, field_validator, model_validator

from twin.errors import ConfigError
from twin.model import theta as c
from twin.model.catalogue import CatalogueEffect, refuse_name
from twin.model.effects import FLATTEST, apply
from twin.model.gas import CRITICAL_RATIO, GAMMA, R
from twin.model.parts import Part, Tube, Vessel, lumped
from twin.model.term import Term
from twin.model.theta import Theta
from twin.settings import Settings
from twin.signals import BAR, MBAR, ML, MS, SL_MIN

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]

LEAST_SHARE = 1e-3  # of suction at its optimum supply, as in the plant
AFTER_BLOW_OFF = -5e5  # Pa of vacuum, which no blow-off reaches: the part goes when it ends
SHORTEST_SWING = 5e-3  # s, shortest period of a line that samples at 1 kHz show
UNSEEN_SWING = 3.5e-3  # s, longest period of a line that they do not show at all
RIPPLE = 1e-3  # of suction capacity: permitted fall from one hundredth of the range to the next

# Codes of the configured modes in the coefficients.
AIR_SAVING_MODES = {
    "off": c.OFF,
    "on": c.ON,
    "leak_monitoring": c.LEAK_MONITORING,
    "without_continuous": c.WITHOUT_CONTINUOUS,
}
BLOW_OFF_MODES = {
    "external": c.EXTERNAL,
    "internal": c.INTERNAL,
    "timed": c.TIMED,
}
CONTROL_SENSORS = {"own": c.OWN, "plc": c.PLC}


class Ambient(Settings):
    """The air around."""

    pressure_mbar: float = Field(1013.0, ge=500.0, le=1100.0)  # absolute
    temperature_c: float = Field(20.0, ge=-20.0, le=60.0)  # of air and walls


class Supply(Settings):
    """Operating pressure, and how suction and end pressure follow it."""

    pressure_bar: float = Field(4.5, gt=0.0, le=10.0)  # gauge, at the regulator
    droop_bar: NotNegative = 0.0  # less at the nozzle while a valve is open
    lag_ms: float = Field(20.0, ge=1.0, le=1000.0)  # of the supply line
    # At which suction is greatest: an ejector is made for the pressure that it is run at.
    optimum_bar: float = Field(
        default_factory=lambda values: values["pressure_bar"], gt=0.0, le=10.0
    )
    # Suction over its greatest is 1 − curvature · (supply / optimum − 1)².
    curvature: NotNegative = 1.0
    end_pressure_slope: NotNegative = 0.2  # relative rise of end pressure per bar missing

    @property
    def nozzle_bar(self) -> float:
        """Operating pressure at the nozzle while it is on (bar gauge)."""
        return self.pressure_bar - self.droop_bar

    @model_validator(mode="after")
    def _something_is_left(self) -> "Supply":
        if self.nozzle_bar <= 0.0:
            raise ValueError("droop_bar leaves no operating pressure: it is below ambient")
        return self


def closing_stage(x: npt.NDArray[np.float64], at: float) -> npt.NDArray[np.float64]:
    """Suction of a stage that closes at ``at``, relative to ambient; the same as in the kernel."""
    open_by, end, most = (
        np.hypot(distance, c.KINK_WIDTH) + distance for distance in (x - at, -at, 1.0 - at)
    )
    share: npt.NDArray[np.float64] = (open_by - end) / (most - end)
    return share


class Ejector(Settings):
    """Characteristic, timing, blow-off and control of the ejector."""

    suction_capacity_sl_min: Positive = 33.4  # at ambient and optimum supply
    end_pressure_mbar: Positive = 150.0  # absolute, at optimum supply: no flow is left
    # Of the characteristic over the straight line; 0 is straight.
    bulge: float = Field(0.0, ge=-1.0, le=4.0)
    skew: float = Field(0.0, ge=-20.0, le=20.0)  # the same, more near ambient
    bend_2: float = Field(0.0, ge=-40.0, le=40.0)  # the same, of second order
    bend_3: float = Field(0.0, ge=-40.0, le=40.0)  # the same, of third order
    kink: float = Field(
        0.0, ge=0.0, le=0.95
    )  # share of the suction at ambient that a second stage has
    # Where that stage closes, of the way from end pressure to ambient.
    kink_at: float = Field(0.4, ge=0.02, le=0.95)
    port_volume_ml: Positive = 1.0  # inside the ejector, before the hose
    air_consumption_sl_min: NotNegative = 80.0  # of the nozzle, at operating pressure
    response_ms: float = Field(15.0, ge=0.0, le=500.0)  # from the command to the valve's action
    # From the end of the command to the valve's action.
    response_off_ms: float = Field(12.0, ge=0.0, le=500.0)
    ramp_up_ms: float = Field(8.0, ge=0.5, le=500.0)  # of the jet, in two equal stages
    jet_full_at: float = Field(
        1.0, ge=0.02, le=1.0
    )  # share of a slow valve's opening at which the jet is full
    ramp_down_ms: float = Field(4.0, ge=0.5, le=500.0)  # of the jet as it ends, in two equal stages
    jet_depth: float = Field(1.0, ge=0.0, le=1.0)  # how much less deep a weaker jet draws
    blow_off_sl_min: NotNegative = 100.0  # into ambient pressure
    blow_off_shape: float = Field(0.0, ge=-0.9, le=3.0)  # how much more flows into full vacuum
    # Rate at which it drains a reservoir of its own; 0: it comes from the supply.
    blow_off_drain_per_s: NotNegative = 0.0
    blow_off_refill: NotNegative = 0.3  # rate at which that fills again, over that
    # From the command to the valve's action.
    blow_off_response_ms: float = Field(15.0, ge=0.0, le=500.0)
    # From the end of the command to the valve's action.
    blow_off_response_off_ms: float = Field(12.0, ge=0.0, le=500.0)
    blow_off_ramp_ms: float = Field(5.0, ge=0.5, le=500.0)  # time constant of the flow
    blow_off_closing_factor: float = Field(1.0, ge=0.02, le=50.0)  # of its end, over that
    exhaust_follows: float = Field(0.0, ge=0.0, le=1.0)  # a loss of suction narrows it as well
    filter_before_sensor: float = Field(0.0, ge=0.0, le=1.0)  # 1: the sensor is behind its filter
    end_follows_supply: float = Field(1.0, ge=0.1, le=20.0)  # times as end_pressure_slope has it
    relief_sl_min: NotNegative = 200.0  # out 100 mbar above the pressure where the relief opens
    exhaust_sl_min: NotNegative = 0.0  # out through the exhaust, sonic, where it is an opening
    cracking_pressure_mbar: NotNegative = 0.0  # above ambient, where the check valve lets out
    # Above ambient, where the relief opens: with the check valve, or a valve of its own.
    relief_pressure_mbar: NotNegative = Field(
        default_factory=lambda values: values["cracking_pressure_mbar"]
    )
    back_flow_sl_min: NotNegative = 0.0  # in through it while off, sonic; no check valve
    # Vacuum at which air saving switches the nozzle off.
    h1_mbar: float = Field(750.0, gt=0.0, le=998.0)
    h1_hysteresis_mbar: float = Field(150.0, gt=0.0)  # below H1, at which it is on again
    # 1: the ejector's own sensor counts from zero, so H1 moves with ambient pressure.
    h1_follows_ambient: float = Field(0.0, ge=0.0, le=1.0)
    h2_mbar: float = Field(550.0, gt=0.0, le=998.0)  # vacuum at which the part is present
    h2_hysteresis_mbar: float = Field(10.0, gt=0.0)  # below H2, at which the part is gone
    # As it is set at the ejector.
    air_saving: Literal["off", "on", "leak_monitoring", "without_continuous"] = "on"
    permitted_leakage_mbar_s: Positive = 250.0  # above it leak_monitoring keeps the nozzle on
    # By the command; a pulse after suction; or a pulse started from outside.
    blow_off: Literal["external", "internal", "timed"] = "external"
    blow_off_time_ms: float = Field(200.0, ge=100.0, le=9990.0)  # of a pulse
    control_sensor: Literal["own", "plc"] = "own"  # whose pressure H1 and H2 are compared with

    def share(self, x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Suction over suction capacity; ``x`` runs from 0 at end pressure to 1 at ambient."""
        bend = self.bulge + x * (self.skew + x * (self.bend_2 + x * self.bend_3))
        closing = closing_stage(x, self.kink_at)
        return (1.0 - self.kink) * x * (1.0 + (1.0 - x) * bend) + self.kink * closing

    @model_validator(mode="after")
    def _thresholds_fit(self) -> "Ejector":
        if self.h1_mbar < self.h2_mbar + self.h1_hysteresis_mbar:
            raise ValueError(
                f"h1_mbar must be at least h2_mbar + h1_hysteresis_mbar"
                f" = {self.h2_mbar + self.h1_hysteresis_mbar:g}: else air saving loses the part"
            )
        if self.h2_hysteresis_mbar >= self.h2_mbar:
            raise ValueError("h2_hysteresis_mbar must be less than h2_mbar")
        return self

    @model_validator(mode="after")
    def _characteristic_falls(self) -> "Ejector":
        """Less suction at more vacuum, as any ejector: the slope over x stays positive."""
        x = np.linspace(0.0, 1.0, 101)
        steps = np.diff(self.share(x))
        if (steps < -RIPPLE).any():
            worst = x[int(np.argmin(steps))]
            raise ValueError(
                "bulge, skew, bend_2 and bend_3 make a characteristic that is not monotonic:"
                f" suction falls towards ambient {100 * worst:.0f} % of the way from end pressure"
            )
        return self


class Wiring(Settings):
    """The pressure sensor the PLC reads, as a signal."""

    lag_ms: float = Field(3.0, ge=0.5, le=500.0)  # of sensor and input, in two equal stages
    noise_mbar: float = Field(0.4, gt=0.0, le=50.0)  # one standard deviation, steps included
    sampling_ms: float = Field(1.0, ge=0.5, le=100.0)  # from row to row
    renewed_ms: float = Field(0.0, ge=0.0, le=100.0)  # from reading to reading; 0: as rows come
    reference: Literal["absolute", "gauge"] = "absolute"  # what it counts from: zero, or ambient

    def noise_in_means(self, sampling_ms: float | None = None) -> float:
        """One sigma (mbar) of a row's noise as it counts in means over rows.

        Rows that repeat a reading say nothing new: in means each has √n times the noise.
        """
        repeated = self.renewed_ms / (sampling_ms or self.sampling_ms)
        return self.noise_mbar * math.sqrt(max(repeated, 1.0))


class System(Settings):
    """What the ejector evacuates: its parts outwards from the port, and how they are joined."""

    # Outwards from the ejector, each of its kind.
    parts: tuple[Part, ...] = (
        Tube(kind="tube", length_mm=100.0, diameter_mm=6.0),
        Vessel(kind="vessel", volume_ml=750.0),
    )
    # Their true volume is within this factor, with 95 %; flows and volumes found are as exact.
    volumes_within_factor: float = Field(1.06, ge=1.0, le=100.0)
    film_coefficient: NotNegative = 10.0  # W/(m² K), of vessel and cups
    free_convection: float = Field(
        0.0, ge=0.0, le=1.0
    )  # share of that at 10 K between gas and wall
    forced_convection: NotNegative = 0.0  # how many times more while all blow-off enters
    tube_film_coefficient: NotNegative = 60.0  # W/(m² K)
    line_factor: NotNegative = 1.0  # flow resistance over what the parts add up to
    line_volume_factor: Positive = 1.0  # the tubes' volume over what the parts add up to
    line_inertia_factor: NotNegative = 1.0  # inertia of their gas over the same
    line_share: float = Field(0.6, gt=0.0, lt=1.0)  # of the tubes' volume, half-way along
    sensor_shift: float = Field(0.0, ge=-1.0, le=1.0)  # of its place: 1 is the whole line outwards
    rim: Literal["laminar", "turbulent"] = "laminar"  # of a cup that stands open
    opening_factor: NotNegative = 1.0  # what flows through open cups over what they say
    shrinks_ml: NotNegative = 0.0  # at full vacuum, beside what the cups say
    softness: NotNegative = 0.0  # 0: shrinks in proportion to vacuum, n: half by 1/(n + 2) of it
    stiff_mbar: NotNegative = 0.0  # vacuum up to which cups hardly give way
    creep_share: float = Field(0.0, ge=0.0, le=1.0)  # of what they shrink by, that comes later
    creep_ms: Positive = 50.0  # time constant of that
    leak_sl_min: NotNegative = 0.3  # of seals and fittings, sonic
    leak_critical_ratio: float = Field(CRITICAL_RATIO, ge=0.1, le=0.6)  # up to which it is
    part_leaves: Literal["in_blow_off", "after_blow_off"] = (
        "in_blow_off"  # when a cup's part goes: at its release_mbar, or when blow-off ends
    )
    release_shift_mbar: float = 0.0  # more vacuum than its cup's release_mbar, at which it goes
    part_meets_ms: NotNegative = 0.0  # after suction is commanded: cups that move to the part

    @model_validator(mode="after")
    def _line_has_volume(self) -> "System":
        if not any(part.kind == "tube" for part in self.parts):
            raise ValueError("parts need a tube between the ejector and the rest")
        return self

    @model_validator(mode="after")
    def _ends_somewhere(self) -> "System":
        kinds = [part.kind for part in self.parts]
        if not {"vessel", "cups"} & set(kinds):
            raise ValueError("parts need a vessel or cups: there is nothing to evacuate")
        if kinds.count("sensor") > 1:
            raise ValueError("parts has more than one sensor; the PLC reads one")
        return self


class DataSet(Settings):
    """All values of the model for one type or one unit, with its parts."""

    ambient: Ambient = Ambient()
    supply: Supply = Supply()
    ejector: Ejector = Ejector()
    sensor: Wiring = Wiring()
    system: System = System()
    # What a diagnosis found beside all that: effects with their sizes, by name.
    effects: Mapping[str, Mapping[str, float]] = Field(default_factory=dict)
    terms: tuple[Term, ...] = ()  # the same: what data added where no effect is known
    # Effects that were found before and taken in: the search has them beside its table, by name.
    catalogue: Mapping[str, CatalogueEffect] = Field(default_factory=dict)

    @field_validator("catalogue")
    @classmethod
    def _named(cls, catalogue: Mapping[str, CatalogueEffect]) -> Mapping[str, CatalogueEffect]:
        try:
            for name in catalogue:
                refuse_name(name)
        except ConfigError as error:
            raise ValueError(str(error)) from error
        return catalogue

    @model_validator(mode="after")
    def _model_can_be_made(self) -> "DataSet":
        try:
            with np.errstate(over="raise", divide="raise", invalid="raise"):
                coefficients(self)
        except ConfigError as error:
            raise ValueError(f"effects: {error}") from error
        except ArithmeticError as error:
            raise ValueError("a value is too large or too small to calculate with") from error
        return self

    @model_validator(mode="after")
    def _pressures_fit(self) -> "DataSet":
        ambient = self.ambient.pressure_mbar
        if self.ejector.end_pressure_mbar >= ambient:
            raise ValueError("ejector.end_pressure_mbar must be below ambient.pressure_mbar")
        if self.ejector.h1_mbar >= ambient:
            raise ValueError("ejector.h1_mbar must be below ambient.pressure_mbar: it is a vacuum")
        return self

    def at_supply(self, pressure_bar: float) -> "DataSet":
        """The data set at another operating pressure (bar gauge), by its own laws of the supply.

        Suction, end pressure and blow-off are those at the pressure of the data set, so they are
        converted. ValidationError if nothing is left of them.
        """
        supply, ejector = self.supply, self.ejector
        drop = supply.pressure_bar - pressure_bar
        before, after = supply.nozzle_bar, supply.nozzle_bar - drop
        peaks = [
            1.0 - supply.curvature * (nozzle / supply.optimum_bar - 1.0) ** 2
            for nozzle in (before, after)
        ]
        ambient = self.ambient.pressure_mbar * MBAR / BAR
        rises = 1.0 + ejector.end_follows_supply * supply.end_pressure_slope * drop
        tables = self.model_dump()
        tables["supply"]["pressure_bar"] = pressure_bar
        tables["supply"]["end_pressure_slope"] /= max(rises, LEAST_SHARE)
        tables["ejector"]["suction_capacity_sl_min"] *= peaks[1] / max(peaks[0], LEAST_SHARE)
        tables["ejector"]["end_pressure_mbar"] *= rises
        tables["ejector"]["blow_off_sl_min"] *= (after + ambient) / (before + ambient)
        return DataSet.model_validate(tables)

    @property
    def hash(self) -> str:
        """Hash of the content: data sets with equal hashes give equal expected pressures."""
        expects = self.model_dump_json(exclude={"catalogue"})
        return hashlib.sha256(expects.encode()).hexdigest()[:16]


def coefficients(data: DataSet) -> Theta:
    """The coefficients of a data set, in SI units."""
    theta = np.zeros(len(c.COEFFICIENTS))
    ambient, temperature = data.ambient.pressure_mbar * MBAR, data.ambient.temperature_c + 273.15
    theta[[c.AMBIENT, c.AMBIENT_NOMINAL]] = ambient
    theta[c.TEMPERATURE] = temperature
    theta[[c.SENSOR_LAG, c.SENSOR_GAIN]] = data.sensor.lag_ms * MS / 2.0, 1.0
    theta[c.GAUGE] = data.sensor.reference == "gauge"
    _set_supply(theta, data.supply)
    _set_ejector(theta, data.ejector, data.ejector.end_pressure_mbar * MBAR / ambient)
    _set_system(theta, data.system, data.ejector.port_volume_ml * ML)
    for name, values in data.effects.items():
        theta = apply(theta, name, values)
    return theta


def _set_supply(theta: Theta, supply: Supply) -> None:
    theta[c.SUPPLY] = supply.pressure_bar * BAR
    theta[c.DROOP] = supply.droop_bar * BAR
    theta[c.SUPPLY_LAG] = supply.lag_ms * MS
    theta[c.SUPPLY_NOMINAL] = supply.nozzle_bar * BAR
    theta[c.SUPPLY_OPTIMUM] = supply.optimum_bar * BAR
    theta[c.SUPPLY_CURVATURE] = supply.curvature
    theta[c.END_SLOPE] = supply.end_pressure_slope / BAR


def _set_ejector(theta: Theta, ejector: Ejector, end_ratio: float) -> None:
    theta[c.SUCTION] = ejector.suction_capacity_sl_min * SL_MIN
    theta[c.END_RATIO] = end_ratio
    theta[[c.BULGE, c.SKEW]] = ejector.bulge, ejector.skew
    theta[[c.BEND_2, c.BEND_3]] = ejector.bend_2, ejector.bend_3
    theta[c.EXHAUST_FOLLOWS] = ejector.exhaust_follows
    theta[c.FILTER_AT] = ejector.filter_before_sensor
    theta[c.END_FOLLOWS] = ejector.end_follows_supply
    theta[[c.KINK, c.KINK_AT]] = ejector.kink, ejector.kink_at
    theta[c.RESPONSE] = ejector.response_ms * MS
    theta[c.RESPONSE_OFF] = ejector.response_off_ms * MS
    theta[c.RAMP_UP] = ejector.ramp_up_ms * MS / 2.0
    theta[c.JET_FULL_AT] = ejector.jet_full_at
    theta[c.JET_DEPTH] = ejector.jet_depth
    theta[c.RAMP_DOWN] = ejector.ramp_down_ms * MS / 2.0
    theta[c.BLOW_OFF] = ejector.blow_off_sl_min * SL_MIN
    theta[c.BLOW_OFF_SHAPE] = ejector.blow_off_shape
    theta[c.BLOW_OFF_DRAIN] = ejector.blow_off_drain_per_s
    theta[c.BLOW_OFF_REFILL] = ejector.blow_off_refill
    theta[c.BLOW_OFF_RESPONSE] = ejector.blow_off_response_ms * MS
    theta[c.BLOW_OFF_RESPONSE_OFF] = ejector.blow_off_response_off_ms * MS
    theta[c.BLOW_OFF_RAMP] = ejector.blow_off_ramp_ms * MS
    theta[c.BLOW_OFF_RAMP_DOWN] = ejector.blow_off_closing_factor * ejector.blow_off_ramp_ms * MS
    theta[c.RELIEF] = ejector.relief_sl_min * SL_MIN / (100.0 * MBAR)
    theta[c.RELIEF_PRESSURE] = ejector.relief_pressure_mbar * MBAR
    theta[c.BACK_FLOW] = ejector.back_flow_sl_min * SL_MIN
    theta[c.EXHAUST] = ejector.exhaust_sl_min * SL_MIN
    theta[c.CRACKING_PRESSURE] = ejector.cracking_pressure_mbar * MBAR
    theta[[c.H1, c.H2]] = ejector.h1_mbar * MBAR, ejector.h2_mbar * MBAR
    theta[c.H1_LOW] = (ejector.h1_mbar - ejector.h1_hysteresis_mbar) * MBAR
    theta[c.H1_FOLLOWS] = ejector.h1_follows_ambient
    theta[c.H2_LOW] = (ejector.h2_mbar - ejector.h2_hysteresis_mbar) * MBAR
    theta[c.AIR_SAVING] = AIR_SAVING_MODES[ejector.air_saving]
    theta[c.PERMITTED_LEAKAGE] = ejector.permitted_leakage_mbar_s * MBAR
    theta[c.BLOW_OFF_MODE] = BLOW_OFF_MODES[ejector.blow_off]
    theta[c.BLOW_OFF_TIME] = ejector.blow_off_time_ms * MS
    theta[c.CONTROL_SENSOR] = CONTROL_SENSORS[ejector.control_sensor]


def _set_system(theta: Theta, system: System, ejector_volume: float) -> None:
    suction, ambient, temperature = theta[[c.SUCTION, c.AMBIENT, c.TEMPERATURE]]
    total = lumped(system.parts, suction, ambient, temperature, system.leak_critical_ratio)
    half_way, ends = system.line_share, (1.0 - system.line_share) / 2.0
    line_volume = system.line_volume_factor * total.line_volume
    inertance = system.line_inertia_factor * total.inertance
    theta[c.PORT_VOLUME] = ejector_volume + total.port_volume + ends * line_volume
    theta[c.LINE_VOLUME] = half_way * line_volume
    theta[c.VOLUME] = total.vessel_volume + ends * line_volume
    port_area = total.port_area + ends * total.line_area
    theta[c.PORT_HEAT] = port_area * system.tube_film_coefficient
    theta[c.LINE_HEAT] = half_way * total.line_area * system.tube_film_coefficient
    theta[c.COMPLIANCE] = min(total.shrinks + system.shrinks_ml * ML, FLATTEST * theta[c.VOLUME])
    theta[c.SOFTNESS] = system.softness
    theta[c.STIFF_UNTIL] = system.stiff_mbar * MBAR
    theta[[c.CREEP, c.CREEP_TIME]] = system.creep_share, system.creep_ms * MS
    theta[c.FILM] = system.film_coefficient
    theta[c.FREE_CONVECTION] = system.free_convection
    if theta[c.BLOW_OFF] > 0.0:
        theta[c.FORCED_CONVECTION] = system.forced_convection**2 / theta[c.BLOW_OFF]
    theta[c.AREA] = total.vessel_area + ends * total.line_area
    near = 0.5 * _inertia_weight(theta, inertance)
    theta[[c.NEAR_INERTANCE, c.INERTANCE]] = near * inertance
    for line, value in ((c.RESISTANCE, total.resistance), (c.LAMINAR, total.laminar)):
        theta[line] = (1.0 - near) * value * system.line_factor
    theta[c.NEAR_RESISTANCE] = near * total.resistance * system.line_factor
    theta[c.NEAR_LAMINAR] = near * total.laminar * system.line_factor
    place = min(max(total.place + system.sensor_shift, 0.0), 1.0)
    theta[c.PLACE] = place * total.resistance * system.line_factor
    theta[c.LEAK_CRITICAL] = system.leak_critical_ratio
    theta[c.LEAK] = total.leak + system.leak_sl_min * SL_MIN
    theta[c.LAMINAR_LEAK] = total.open
    wide = c.OPENING if system.rim == "laminar" else c.HOLE
    theta[wide] = (total.opening if wide == c.OPENING else total.hole) * system.opening_factor
    late = system.part_leaves == "after_blow_off" and not math.isnan(total.release)
    release = total.release + system.release_shift_mbar * MBAR
    theta[c.RELEASE] = AFTER_BLOW_OFF if late else release
    theta[c.CONTACT] = system.part_meets_ms * MS


def sensor_place(data: DataSet) -> float:
    """Place of the sensor along the line: 0 at the port, 1 at the vessel."""
    theta = coefficients(data)
    line = float(theta[c.NEAR_RESISTANCE] + theta[c.RESISTANCE])
    return float(theta[c.PLACE]) / line if line > 0.0 else 0.0


def swing(theta: Theta, inertance: float) -> float:
    """Period (s) of a line with ``inertance`` (1/m); gas in the line and the port is the spring."""
    stored = (theta[c.PORT_VOLUME] + theta[c.LINE_VOLUME]) / (GAMMA * R * theta[c.TEMPERATURE])
    return 2.0 * math.pi * math.sqrt(inertance * float(stored))


def _inertia_weight(theta: Theta, inertance: float) -> float:
    """Weight (0 to 1) of the inertia of the line's gas; a line with a short period has none.

    The weight is continuous in the period, since a fit stops at a discontinuity.
    """
    share = (swing(theta, inertance) - UNSEEN_SWING) / (SHORTEST_SWING - UNSEEN_SWING)
    return min(max(share, 0.0), 1.0)
