"""The data set of an ejector and its evacuated system, in the field's units, and its SI form.

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
from twin.model.air import CRITICAL_RATIO, GAMMA, R
from twin.model.catalogue import CatalogueEffect, refuse_name
from twin.model.effects import FLATTEST, apply
from twin.model.parts import Part, Tube, Vessel, lumped
from twin.model.term import Term
from twin.model.theta import Theta
from twin.settings import Settings
from twin.signals import BAR, MBAR, ML, MS, SL_MIN

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]

LEAST_SHARE = 1e-3  # least suction over that at its optimum supply, as in the plant
AFTER_BLOW_OFF = -5e5  # Pa of vacuum, which no blow-off reaches: the part leaves as it ends
SHORTEST_SWING = 5e-3  # s, shortest period of a line that rows at 1 kHz show in full
UNSEEN_SWING = 3.5e-3  # s, longest period of a line that rows at 1 kHz do not show at all
RIPPLE = 1e-3  # permitted fall of suction per hundredth of the range, over suction capacity

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
    """The air around the ejector."""

    pressure_mbar: float = Field(1013.0, ge=500.0, le=1100.0)  # absolute ambient pressure
    temperature_c: float = Field(20.0, ge=-20.0, le=60.0)  # temperature of air and walls


class Supply(Settings):
    """Operating pressure, and how suction and end pressure follow it."""

    pressure_bar: float = Field(4.5, gt=0.0, le=10.0)  # gauge pressure at the regulator
    droop_bar: NotNegative = 0.0  # pressure drop at the nozzle while a valve is open
    lag_ms: float = Field(20.0, ge=1.0, le=1000.0)  # time constant of the supply line
    # Gauge pressure of the greatest suction, by default pressure_bar.
    optimum_bar: float = Field(
        default_factory=lambda values: values["pressure_bar"], gt=0.0, le=10.0
    )
    # Suction over its greatest is 1 − curvature · (supply / optimum − 1)².
    curvature: NotNegative = 1.0
    end_pressure_slope: NotNegative = 0.2  # relative rise of end pressure per bar of missing supply

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
    """Suction of a stage that closes at ``at`` over that at ambient, as in the kernel."""
    open_by, end, most = (
        np.hypot(distance, c.KINK_WIDTH) + distance for distance in (x - at, -at, 1.0 - at)
    )
    share: npt.NDArray[np.float64] = (open_by - end) / (most - end)
    return share


class Ejector(Settings):
    """Characteristic, timing, blow-off and control of the ejector."""

    suction_capacity_sl_min: Positive = 33.4  # suction at ambient pressure and optimum supply
    end_pressure_mbar: Positive = 150.0  # absolute pressure without flow, at optimum supply
    # Relative bulge of the characteristic above a straight line; 0 is straight.
    bulge: float = Field(0.0, ge=-1.0, le=4.0)
    # Linear change of the bulge from end pressure to ambient.
    skew: float = Field(0.0, ge=-20.0, le=20.0)
    bend_2: float = Field(0.0, ge=-40.0, le=40.0)  # quadratic change of the bulge
    bend_3: float = Field(0.0, ge=-40.0, le=40.0)  # cubic change of the bulge
    # Share of a second stage in the suction at ambient.
    kink: float = Field(0.0, ge=0.0, le=0.95)
    # Where the second stage closes: 0 at end pressure, 1 at ambient.
    kink_at: float = Field(0.4, ge=0.02, le=0.95)
    port_volume_ml: Positive = 1.0  # volume inside the ejector, before the hose
    # Air consumption of the nozzle at operating pressure.
    air_consumption_sl_min: NotNegative = 80.0
    # Delay from the command to the suction valve's action.
    response_ms: float = Field(15.0, ge=0.0, le=500.0)
    # Delay from the end of the command to the suction valve's action.
    response_off_ms: float = Field(12.0, ge=0.0, le=500.0)
    # Time constant of both stages of the growing jet.
    ramp_up_ms: float = Field(8.0, ge=0.5, le=500.0)
    # Opening of a slow valve from which the jet is full, as a share.
    jet_full_at: float = Field(1.0, ge=0.02, le=1.0)
    # Time constant of both stages of the decaying jet.
    ramp_down_ms: float = Field(4.0, ge=0.5, le=500.0)
    # Dependence of end vacuum on the jet's strength; 0: none.
    jet_depth: float = Field(1.0, ge=0.0, le=1.0)
    blow_off_sl_min: NotNegative = 100.0  # blow-off flow into ambient pressure
    # Relative increase of the blow-off flow into full vacuum.
    blow_off_shape: float = Field(0.0, ge=-0.9, le=3.0)
    # Rate at which blow-off drains a reservoir; 0: the supply feeds it.
    blow_off_drain_per_s: NotNegative = 0.0
    blow_off_refill: NotNegative = 0.3  # refill rate of that reservoir over its drain rate
    # Delay from the command to the blow-off valve's action.
    blow_off_response_ms: float = Field(15.0, ge=0.0, le=500.0)
    # Delay from the command's end to the blow-off valve's action.
    blow_off_response_off_ms: float = Field(12.0, ge=0.0, le=500.0)
    # Time constant of the growing blow-off flow.
    blow_off_ramp_ms: float = Field(5.0, ge=0.5, le=500.0)
    # Time constant of the ending blow-off flow over the growing one's.
    blow_off_closing_factor: float = Field(1.0, ge=0.02, le=50.0)
    # Narrowing of the exhaust over a loss of suction, both as shares.
    exhaust_follows: float = Field(0.0, ge=0.0, le=1.0)
    # 1: the filter is between ejector and sensor; 0: behind the sensor.
    filter_before_sensor: float = Field(0.0, ge=0.0, le=1.0)
    # Factor on end_pressure_slope for a supply below nominal.
    end_follows_supply: float = Field(1.0, ge=0.1, le=20.0)
    # Share of a rise of the end pressure that moves the whole characteristic to higher pressures.
    end_loss_moves: float = Field(0.0, ge=0.0, le=1.0)
    relief_sl_min: NotNegative = 200.0  # relief flow at 100 mbar above the relief pressure
    exhaust_sl_min: NotNegative = 0.0  # sonic flow through an exhaust that is an opening
    # Port pressure above ambient that opens the check valve.
    cracking_pressure_mbar: NotNegative = 0.0
    # Port pressure above ambient that opens the relief, by default the check valve's.
    relief_pressure_mbar: NotNegative = Field(
        default_factory=lambda values: values["cracking_pressure_mbar"]
    )
    # Sonic flow into the port without a check valve, with the nozzle off.
    back_flow_sl_min: NotNegative = 0.0
    # Vacuum at which air saving switches the nozzle off.
    h1_mbar: float = Field(750.0, gt=0.0, le=998.0)
    # Air saving switches the nozzle on this far below H1.
    h1_hysteresis_mbar: float = Field(150.0, gt=0.0)
    # 1: H1 moves with ambient pressure, since the ejector's own sensor is absolute.
    h1_follows_ambient: float = Field(0.0, ge=0.0, le=1.0)
    h2_mbar: float = Field(550.0, gt=0.0, le=998.0)  # vacuum at which the part is present
    h2_hysteresis_mbar: float = Field(10.0, gt=0.0)  # the part counts as gone this far below H2
    # Air-saving mode set at the ejector.
    air_saving: Literal["off", "on", "leak_monitoring", "without_continuous"] = "on"
    # Leakage above which leak_monitoring keeps the nozzle on.
    permitted_leakage_mbar_s: Positive = 250.0
    # Start of blow-off: by the command, or a pulse after suction or from outside.
    blow_off: Literal["external", "internal", "timed"] = "external"
    blow_off_time_ms: float = Field(200.0, ge=100.0, le=9990.0)  # duration of a blow-off pulse
    control_sensor: Literal["own", "plc"] = "own"  # sensor that is compared with H1 and H2

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
        """Suction falls with vacuum, as with any ejector: the slope over x stays positive."""
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
    """The signal of the pressure sensor that the PLC reads."""

    lag_ms: float = Field(3.0, ge=0.5, le=500.0)  # time constant of both stages of sensor and input
    noise_mbar: float = Field(0.4, gt=0.0, le=50.0)  # one standard deviation, with quantisation
    sampling_ms: float = Field(1.0, ge=0.5, le=100.0)  # time from row to row
    # Time from one new reading to the next; 0: each row has one.
    renewed_ms: float = Field(0.0, ge=0.0, le=100.0)
    # Zero of the sensor: absolute zero, or ambient pressure.
    reference: Literal["absolute", "gauge"] = "absolute"

    def noise_in_means(self, sampling_ms: float | None = None) -> float:
        """Sigma (mbar) of independent rows with the same noise in means over rows.

        Repeated readings add no information: √n times the noise each for n equal rows.
        """
        repeated = self.renewed_ms / (sampling_ms or self.sampling_ms)
        return self.noise_mbar * math.sqrt(max(repeated, 1.0))


class System(Settings):
    """What the ejector evacuates: its parts outwards from the port, and how they are joined."""

    # Parts in order from the ejector outwards.
    parts: tuple[Part, ...] = (
        Tube(kind="tube", length_mm=100.0, diameter_mm=6.0),
        Vessel(kind="vessel", volume_ml=750.0),
    )
    # Accuracy factor (95 %) of the volumes; flows are as accurate.
    volumes_within_factor: float = Field(1.06, ge=1.0, le=100.0)
    film_coefficient: NotNegative = 10.0  # W/(m² K), vessel and cups
    # Share of free convection in film_coefficient at 10 K between gas and wall.
    free_convection: float = Field(0.0, ge=0.0, le=1.0)
    # Relative increase of film_coefficient at the full blow-off flow.
    forced_convection: NotNegative = 0.0
    tube_film_coefficient: NotNegative = 60.0  # W/(m² K)
    line_factor: NotNegative = 1.0  # flow resistance of the line over that of its parts
    line_volume_factor: Positive = 1.0  # volume of the tubes over that of their dimensions
    # Inertia of the tubes' gas over that of their dimensions.
    line_inertia_factor: NotNegative = 1.0
    # Share of the tubes' volume in the node half-way along.
    line_share: float = Field(0.6, gt=0.0, lt=1.0)
    # Shift of the sensor as a share of the line, positive away from the ejector.
    sensor_shift: float = Field(0.0, ge=-1.0, le=1.0)
    rim: Literal["laminar", "turbulent"] = "laminar"  # flow through the rim of an open cup
    opening_factor: NotNegative = 1.0  # flow through open cups over that of their data
    shrinks_ml: NotNegative = 0.0  # shrinkage at full vacuum in addition to that of the cups
    # 0: shrinkage in proportion to vacuum; n: half of it by 1/(n + 2) of full vacuum.
    softness: NotNegative = 0.0
    stiff_mbar: NotNegative = 0.0  # vacuum up to which cups hardly shrink
    # Share of the shrinkage that comes later, by creep.
    creep_share: float = Field(0.0, ge=0.0, le=1.0)
    creep_ms: Positive = 50.0  # time constant of creep
    leak_sl_min: NotNegative = 0.3  # sonic flow of leaks at seals and fittings
    # Largest pressure ratio at which the leaks are sonic.
    leak_critical_ratio: float = Field(CRITICAL_RATIO, ge=0.1, le=0.6)
    # Largest pressure ratio at which flow through the whole line is sonic (ISO 6358); 0: it is
    # isothermal pipe flow, as in a long tube.
    line_critical_ratio: float = Field(0.0, ge=0.0, le=0.5)
    # When a part leaves: at the release_mbar of its cup, or when blow-off ends.
    part_leaves: Literal["in_blow_off", "after_blow_off"] = (
        "in_blow_off"  # when a cup's part goes: at its release_mbar, or when blow-off ends
    )
    release_shift_mbar: float = 0.0  # difference of the release vacuum from the cup's release_mbar
    # Time from the suction command until moving cups meet the part.
    part_meets_ms: NotNegative = 0.0

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
    # Additional effects that a diagnosis found, with their sizes, by name.
    effects: Mapping[str, Mapping[str, float]] = Field(default_factory=dict)
    terms: tuple[Term, ...] = ()  # empirical terms that a diagnosis added where no effect is known
    # Mechanisms that were stored as effects by name; a diagnosis searches them too.
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
        follows = ejector.end_follows_supply if drop > 0.0 else 1.0  # of a lower supply
        rises = max(1.0 + follows * supply.end_pressure_slope * drop, LEAST_SHARE)
        tables = self.model_dump()
        tables["supply"]["pressure_bar"] = pressure_bar
        tables["supply"]["end_pressure_slope"] /= rises
        tables["ejector"]["suction_capacity_sl_min"] *= peaks[1] / max(peaks[0], LEAST_SHARE)
        tables["ejector"]["end_pressure_mbar"] *= rises
        tables["ejector"]["blow_off_sl_min"] *= (after + ambient) / (before + ambient)
        return DataSet.model_validate(tables)

    @property
    def hash(self) -> str:
        """Hash of the content; equal hashes mean equal expected pressures."""
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
    theta[c.END_MOVES] = ejector.end_loss_moves
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
    theta[c.LINE_CRITICAL] = system.line_critical_ratio
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
    """Position of the sensor along the line: 0 at the port, 1 at the vessel."""
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
