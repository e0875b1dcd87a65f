"""The table of effects: as promised to the outside, and each one acts as an effect must."""

import ast
import re
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import rigs
from hypothesis import given
from hypothesis import strategies as st
from stepping import PRESSURES, states, temperature

from twin.errors import ConfigError
from twin.model import kernel
from twin.model import theta as c
from twin.model.dataset import coefficients
from twin.model.effects import EFFECTS, WEATHER, Law, apply, standing_for, table
from twin.model.plant import reading_of
from twin.model.theta import Theta
from twin.monitor.model_bank import SUSPECTS
from twin.monitor.scatter_covariance import SCATTERING
from twin.signals import BAR, MBAR, ML, MS, SL_MIN, Command, Phase

TWIN = Path(__file__).parents[1] / "twin"

# What people, scripts and other systems hold on to.
CONTRACT = """
leakage: sonic_flow (sl/min)
porous_leakage: flow_at_600mbar (sl/min)
check_valve_leak: sonic_flow (sl/min)
suction_loss: loss (%)
end_vacuum_loss: end_pressure_rise (mbar)
supply_pressure_drop: drop (bar)
filter_clogging: pressure_drop_at_nominal (mbar)
added_volume: volume (ml)
cup_compliance: volume_at_full_vacuum (ml)
heat_exchange: film_coefficient (W/(m²·K))
response_delay: delay (ms)
slow_ramp_up: time_constant (ms)
threshold_drift: h1_shift (mbar), h2_shift (mbar)
weak_blow_off: loss (%)
blow_off_delay: delay (ms)
sensor_offset: offset (mbar)
sensor_gain: error (%)
sensor_lag: time_constant (ms)
ambient_pressure: shift (mbar)
"""

every_effect = pytest.mark.parametrize("name", EFFECTS)
every_rig = pytest.mark.parametrize("rig", rigs.NAMES)
PARAMETERS = [(name, p) for name, effect in EFFECTS.items() for p in effect.parameters]
each_parameter = pytest.mark.parametrize(
    ("name", "parameter"), PARAMETERS, ids=[f"{name}.{p.name}" for name, p in PARAMETERS]
)


def cycle(theta: Theta) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Free-running cycle with evacuation, hold, blow-off, idle: pressure read and final state."""
    steps = ((Command.SUCTION, 2300), (Command.BLOW_OFF, 250), (Command(0), 250))
    commands = np.concatenate([np.full(rows, command, "u1") for command, rows in steps])
    phase, expected = np.empty(len(commands), "u1"), np.empty(len(commands))
    state = kernel.at_rest(theta)
    kernel.simulate(state, theta, np.full(len(commands), MS), commands, phase, expected)
    return expected, state


def leaking(rig: str) -> Theta:
    """Coefficients of a rig that leaks so much that its air saving switches on again."""
    theta = rigs.theta(rig)
    theta[c.LEAK] *= 5.0
    theta[c.H1], theta[c.H1_LOW] = 650 * MBAR, 640 * MBAR
    return theta


@pytest.mark.parametrize("name", rigs.NAMES)
def test_a_change_worth_an_alarm_is_smaller_on_a_small_unit(name: str) -> None:
    """A leak of 0.2 sl/min is a tenth of what an ejector of 2 sl/min draws."""
    theta, (leak,) = rigs.theta(name), EFFECTS["leakage"].parameters
    (volume,), (loss,) = EFFECTS["added_volume"].parameters, EFFECTS["suction_loss"].parameters
    usual = [p.typical_on(theta) for p in (leak, volume, loss)]
    assert usual == [p.typical for p in (leak, volume, loss)]
    small = theta.copy()
    small[c.SUCTION] = 3.0 * SL_MIN
    small[[c.PORT_VOLUME, c.LINE_VOLUME, c.VOLUME]] = 1.0 * ML, 2.0 * ML, 12.0 * ML
    assert [p.typical_on(small) for p in (leak, volume, loss)] == pytest.approx(
        [0.1 * leak.typical, 0.1 * volume.typical, loss.typical]
    )


def test_the_table_has_every_effect_that_was_promised() -> None:
    """More may be added."""
    lines = [
        f"{name}: " + ", ".join(f"{p.name} ({p.unit})" for p in effect.parameters)
        for name, effect in EFFECTS.items()
    ]
    promised = CONTRACT.strip().splitlines()
    assert [line for line in lines if line in promised] == promised


@every_effect
def test_every_effect_is_said_in_a_sentence(name: str) -> None:
    effect = EFFECTS[name]
    assert effect.name == name
    assert len(effect.sentence.split()) > 4
    assert effect.sentence[0].isupper()


@each_parameter
@every_rig
def test_neutral_and_typical_lie_within_the_bounds(name: str, parameter, rig: str) -> None:
    neutral = parameter.neutral(rigs.theta(rig))
    assert parameter.low <= neutral <= parameter.high
    assert neutral < neutral + parameter.typical <= parameter.high


@every_effect
@every_rig
def test_at_neutral_nothing_changes_to_the_last_bit(name: str, rig: str) -> None:
    theta = leaking(rig)
    neutral = {p.name: p.neutral(theta) for p in EFFECTS[name].parameters}
    for values in ({}, neutral):
        changed = apply(theta, name, values)
        assert changed is not theta
        assert changed.tobytes() == theta.tobytes()
    assert cycle(changed)[0].tobytes() == cycle(theta)[0].tobytes()


@each_parameter
@pytest.mark.parametrize("bound", ["low", "high"])
@every_rig
def test_at_its_bounds_it_stays_physical(name: str, parameter, bound: str, rig: str) -> None:
    theta = apply(leaking(rig), name, {parameter.name: getattr(parameter, bound)})
    expected, state = cycle(theta)
    assert np.isfinite(expected).all()
    assert -0.4 * BAR < expected.min() <= expected.max() < 6 * BAR  # readings, sensor faults too
    assert (state[PRESSURES] > 0.01 * BAR).all()
    assert (state[PRESSURES] < 6 * BAR).all()
    assert 150 < temperature(theta, state) < 600
    assert 0 <= state[kernel.JET] <= 1


@each_parameter
@every_rig
def test_at_typical_size_it_shows(name: str, parameter, rig: str) -> None:
    theta = leaking(rig)
    changed = apply(theta, name, {parameter.name: parameter.neutral(theta) + parameter.typical})
    difference = cycle(changed)[0] - cycle(theta)[0]
    assert np.abs(difference).max() > 1 * MBAR


@each_parameter
@given(share=st.floats(0.0, 1.0))
def test_theta_itself_is_left_alone(name: str, parameter, share: float) -> None:
    theta = rigs.theta("gripper")
    before = theta.copy()
    apply(theta, name, {parameter.name: parameter.low + share * (parameter.high - parameter.low)})
    assert theta.tobytes() == before.tobytes()


def test_effects_add_up() -> None:
    theta = rigs.theta("test_rig")
    both = apply(apply(theta, "sensor_offset", {"offset": 3.0}), "sensor_offset", {"offset": 4.0})
    assert both[c.SENSOR_OFFSET] == 7 * MBAR


def test_cups_that_give_way_keep_a_volume() -> None:
    """A search tries 100 ml on cups of 30 ml, too: nothing may be less than empty there."""
    theta = rigs.theta("gripper")
    theta[c.VOLUME] = 30e-6
    soft = apply(theta, "cup_compliance", {"volume_at_full_vacuum": 100.0})
    assert 0.5 * theta[c.VOLUME] < soft[c.COMPLIANCE] < theta[c.VOLUME]


# What an effect does where it can be said in one number.


@pytest.mark.parametrize(
    ("name", "value", "coefficient", "expected"),
    [
        ("leakage", 2.0, c.LEAK, 2.0 * 1.185e-3 / 60),
        ("check_valve_leak", 2.0, c.BACK_FLOW, 2.0 * 1.185e-3 / 60),
        ("porous_leakage", 6.0, c.LAMINAR_LEAK, 6.0 * 1.185e-3 / 60 / 60e3),
        ("supply_pressure_drop", 0.5, c.SUPPLY, -0.5e5),
        ("added_volume", 20.0, c.VOLUME, 20e-6),
        ("cup_compliance", 10.0, c.COMPLIANCE, 10e-6),
        ("response_delay", 7.0, c.RESPONSE, 7e-3),
        ("slow_ramp_up", 7.0, c.SLOW_RAMP_UP, 7e-3),
        ("blow_off_delay", 7.0, c.BLOW_OFF_RESPONSE, 7e-3),
        ("sensor_offset", -7.0, c.SENSOR_OFFSET, -700.0),
        ("sensor_gain", 2.0, c.SENSOR_GAIN, 0.02),
        ("sensor_lag", 7.0, c.SLOW_SENSOR, 7e-3),
        ("ambient_pressure", -20.0, c.AMBIENT, -2000.0),
        ("end_vacuum_loss", 10.13, c.END_RATIO, 0.01),
    ],
)
def test_the_fields_units_become_si(
    name: str, value: float, coefficient: int, expected: float
) -> None:
    theta = rigs.theta("test_rig")
    (parameter,) = EFFECTS[name].parameters
    change = apply(theta, name, {parameter.name: value}) - theta
    assert change[coefficient] == pytest.approx(expected, rel=1e-6)
    change[coefficient] = 0.0
    other = {c.RESPONSE: c.RESPONSE_OFF, c.BLOW_OFF_RESPONSE: c.BLOW_OFF_RESPONSE_OFF}
    if coefficient in other:  # a valve that is late is late both ways
        assert change[other[coefficient]] == pytest.approx(expected, rel=1e-6)
        change[other[coefficient]] = 0.0
    assert not np.nan_to_num(change).any()


@pytest.mark.parametrize(
    ("name", "coefficient"), [("suction_loss", c.SUCTION), ("weak_blow_off", c.BLOW_OFF)]
)
def test_losses_are_shares(name: str, coefficient: int) -> None:
    theta = rigs.theta("test_rig")
    assert apply(theta, name, {"loss": 15.0})[coefficient] == pytest.approx(
        0.85 * theta[coefficient]
    )


def test_heat_exchange_replaces_the_film_coefficient() -> None:
    theta = rigs.theta("test_rig")
    assert apply(theta, "heat_exchange", {"film_coefficient": 42.0})[c.FILM] == 42.0


@pytest.mark.parametrize(("is_gauge", "moved"), [(False, -20.0), (True, 0.0)])
def test_weather_moves_the_reading_of_an_open_system_unless_a_gauge_reads_it(
    *, is_gauge: bool, moved: float
) -> None:
    healthy = coefficients(rigs.config("gripper").with_sensor(is_gauge=is_gauge).data)
    lower = apply(healthy, "ambient_pressure", {"shift": -20.0})
    change = reading_of(float(lower[c.AMBIENT]), lower) - float(healthy[c.AMBIENT])
    assert change / MBAR == pytest.approx(moved, abs=1e-6)


def test_clogging_costs_the_drop_it_says_at_nominal_suction() -> None:
    theta = rigs.theta("test_rig")
    theta[c.RESISTANCE] = 0.0
    clogged = apply(theta, "filter_clogging", {"pressure_drop_at_nominal": 100.0})
    after = np.sqrt(theta[c.AMBIENT] ** 2 - clogged[c.RESISTANCE] * theta[c.SUCTION] ** 2)
    assert theta[c.AMBIENT] - after == pytest.approx(100 * MBAR)


def strength(theta: Theta, milliseconds: int) -> npt.NDArray[np.float64]:
    """Of the jet, each millisecond from its valve's action on."""
    still = theta.copy()
    still[c.RESPONSE] = 0.0
    rows = states(still, [(Phase.SUCTION, milliseconds)])
    found: npt.NDArray[np.float64] = rows[:, kernel.JET]
    return found


def test_by_the_law_of_a_wide_valve_a_slow_one_is_a_late_one() -> None:
    theta = rigs.theta("test_rig")
    slow = {"time_constant": 100.0}
    wide = strength(apply(theta, "slow_ramp_up", {**slow, "jet_full_at": 0.08}), 400)
    grows = strength(apply(theta, "slow_ramp_up", {**slow, "jet_full_at": 1.0}), 400)
    healthy = strength(theta, 400)

    def rises(jet: npt.NDArray[np.float64]) -> tuple[int, int]:
        """From 10 to 50, and from there to 90 % of its strength, in ms."""
        first, half, last = (int(np.argmax(jet > share)) for share in (0.1, 0.5, 0.9))
        return half, last - first

    assert rises(wide)[0] - rises(healthy)[0] in range(3, 12)
    assert rises(wide)[1] < rises(healthy)[1] + 12
    assert rises(grows)[0] > 60
    assert rises(grows)[1] > 120


@pytest.mark.parametrize("law", [effect.law for effect in EFFECTS.values() if effect.law])
def test_a_law_without_its_effect_changes_nothing(law: Law) -> None:
    theta = rigs.theta("gripper")
    expected = cycle(theta)[0]
    for value in law.tried:
        other = theta.copy()
        other[law.coefficient] = value
        assert np.array_equal(cycle(other)[0], expected)


def by_two_laws(theta: Theta, effect: str, size: float, value: float) -> tuple[Theta, Theta]:
    """An effect's coefficients by the data set's law, and by another value of it."""
    (parameter,), law = EFFECTS[effect].parameters, EFFECTS[effect].law
    assert law is not None
    sized = {parameter.name: size}
    return apply(theta, effect, sized), apply(theta, effect, {**sized, law.name: value})


def test_dirt_on_the_way_of_both_narrows_the_exhaust_as_well() -> None:
    theta = rigs.theta("test_rig")
    worn, dirty = by_two_laws(theta, "suction_loss", 20.0, 1.0)
    assert worn[c.RELIEF] == theta[c.RELIEF]
    assert dirty[c.RELIEF] == pytest.approx(0.8 * theta[c.RELIEF])
    assert dirty[c.SUCTION] == worn[c.SUCTION]


def test_end_pressure_follows_a_missing_supply_as_steeply_as_the_law_says() -> None:
    """What sags by itself was fitted, and stays."""
    theta = rigs.theta("test_rig")
    flat, steep = by_two_laws(theta, "supply_pressure_drop", 0.8, 6.0)
    rise = 0.8 * BAR * theta[c.END_SLOPE]
    assert (steep[c.SUPPLY], steep[c.END_SLOPE]) == (flat[c.SUPPLY], theta[c.END_SLOPE])
    assert steep[c.END_RATIO] * (1.0 + rise) == pytest.approx(
        theta[c.END_RATIO] * (1.0 + 6.0 * rise)
    )
    assert cycle(steep)[0].min() > cycle(flat)[0].min() + 10.0 * MBAR  # less vacuum
    _, hardly = by_two_laws(theta, "supply_pressure_drop", 1e-9, 6.0)
    assert hardly[c.END_RATIO] == pytest.approx(theta[c.END_RATIO])


def test_a_filter_before_the_sensor_takes_the_sensor_with_it() -> None:
    theta = rigs.theta("gripper")
    behind, before = by_two_laws(theta, "filter_clogging", 50.0, 1.0)

    def to_vessel(theta: Theta) -> float:
        """Resistance between the sensor and the vessel."""
        return float(theta[c.NEAR_RESISTANCE] + theta[c.RESISTANCE] - theta[c.PLACE])

    assert to_vessel(before) == pytest.approx(to_vessel(theta))
    assert to_vessel(behind) > to_vessel(theta)
    assert before[c.NEAR_RESISTANCE] + before[c.RESISTANCE] == pytest.approx(
        behind[c.NEAR_RESISTANCE] + behind[c.RESISTANCE]
    )


# What cannot be meant.


@pytest.mark.parametrize(
    ("name", "values", "complaint"),
    [
        ("leek", {}, "unknown effect 'leek'"),
        ("leakage", {"flow": 1.0}, "leakage has no parameter flow"),
        ("leakage", {"sonic_flow": -0.1}, r"leakage.sonic_flow = -0.1 sl/min is out of bounds"),
        ("leakage", {"sonic_flow": 60.1}, "out of bounds"),
        ("sensor_gain", {"error": float("nan")}, "out of bounds"),
        ("threshold_drift", {"h1_shift": 0.0, "h2_shift": 900.0}, "threshold_drift.h2_shift"),
    ],
)
def test_what_cannot_be_meant_is_refused_with_a_hint(
    name: str, values: dict[str, float], complaint: str
) -> None:
    with pytest.raises(ConfigError, match=complaint) as refused:
        apply(rigs.theta("test_rig"), name, values)
    assert refused.value.hint


def test_the_printed_table_lists_all() -> None:
    lines = table().splitlines()
    assert len(lines) == 2 + len(EFFECTS)
    for line, (name, effect) in zip(lines[2:], EFFECTS.items(), strict=True):
        assert line.startswith(f"| `{name}` | {effect.sentence} |")
        for p in effect.parameters:
            assert f"`{p.name}` {p.low:g} to {p.high:g} {p.unit}" in line


def test_the_page_of_effects_has_their_laws() -> None:
    page = (Path(__file__).parent.parent / "docs" / "effects.md").read_text(encoding="utf-8")
    for effect in EFFECTS.values():
        if effect.law:
            (row,) = (
                line
                for line in page.splitlines()
                if line.startswith(f"| `{effect.name}` | `{effect.law.name}`")
            )
            tried = re.sub(r"\(.*?\)", "", row.split("|")[3])
            assert tuple(float(value) for value in tried.split(",")) == effect.law.tried


def test_only_the_table_asks_whether_a_parameter_is_a_time() -> None:
    asks = re.compile(r"""\.unit\s*[!=]=\s*["']|\.unit\s+in\b""")
    files = sorted((Path(__file__).parent.parent / "twin").rglob("*.py"))
    assert len(files) > 300
    asking = {path.name for path in files if asks.search(path.read_text(encoding="utf-8"))}
    assert asking == {"effects.py"}, "declare it in the Parameter"


def test_weather_and_set_up_alone_cannot_be_mended() -> None:
    fixed = {effect.name for effect in EFFECTS.values() if not effect.can_be_mended}
    assert fixed == {"ambient_pressure", "heat_exchange"}
    assert {suspect.effect for suspect in SUSPECTS if suspect.often < 1.0} == fixed


# --- an effect is one entry ---------------------------------------------------------------------

# Words that are also names of effects but mean something else there, by file below twin/.
OTHER_MEANINGS = {
    # "leakage" is the key figure (mbar/s) of a cycle, with limits and warnings of its own.
    "alarms/limits.py": {"leakage"},
    "calibration/doubts.py": {"leakage"},
    "diagnosis/extend.py": {"leakage"},
    "figures/autoset.py": {"leakage"},
    "figures/cycle.py": {"leakage"},
    "figures/settings.py": {"leakage"},
    "figures/key_figures.py": {"leakage"},
    "figures/text.py": {"leakage"},
    "figures/warnings.py": {"leakage"},
    "page/plant_overview_text.py": {"leakage"},
}
TABLE = "model/effects.py"


def quoted_effects(source: str) -> set[str]:
    """Names of effects, also before a parameter's, that a module has as strings of its own."""
    strings = (node.value for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Constant))
    return {text.split(".")[0] for text in strings if isinstance(text, str)} & set(EFFECTS)


def test_no_module_asks_for_an_effect_by_its_name() -> None:
    """What depends on an effect is declared in its entry; there it is read from.

    A new effect is then one entry in the table, and its truth in the simulated worlds.
    """
    modules = {
        path.relative_to(TWIN).as_posix(): quoted_effects(path.read_text(encoding="utf-8"))
        for path in TWIN.rglob("*.py")
    }
    assert modules.pop(TABLE) == set(EFFECTS)
    assert {module: names for module, names in modules.items() if names} == OTHER_MEANINGS


@each_parameter
def test_a_parameter_touches_what_it_declares(name: str, parameter) -> None:
    """In any law, on a unit on which all laws act; the law's own coefficient is not its doing."""
    theta = rigs.theta("gripper")
    theta[c.GAUGE], theta[c.EXHAUST] = 1.0, 1e-4
    theta[c.NEAR_RESISTANCE] = theta[c.PLACE] * 2.0 + 1.0
    touched: set[int] = set()
    for place in (0.0, theta[c.NEAR_RESISTANCE]):
        theta[c.PLACE] = place  # of the sensor: before, and behind the near resistance
        for law in EFFECTS[name].laws():
            unchanged = apply(theta, name, law)
            size = parameter.neutral(theta) + parameter.typical
            changed = apply(theta, name, {**law, parameter.name: size})
            differs = (changed != unchanged) & ~np.isnan(theta)
            touched |= set(np.flatnonzero(differs).tolist())
    assert touched == set(parameter.touches)


def test_an_effect_is_found_by_what_it_stands_for() -> None:
    for name, parameter in PARAMETERS:
        effect, standing = standing_for(parameter.touches[0])
        assert (effect.name, standing) == (name, parameter)


def test_weather_is_the_effect_on_ambient_pressure() -> None:
    assert [name for name, effect in EFFECTS.items() if effect.is_weather] == [WEATHER]
    assert EFFECTS[WEATHER].parameters[0].touches[0] == c.AMBIENT


def test_what_scatters_is_declared_by_the_entries() -> None:
    """Delays stand last, as a diagnosis takes the columns; healthy data are stored by name."""
    assert list(SCATTERING) == [
        "supply_pressure_drop",
        "leakage",
        "response_delay",
        "blow_off_delay",
    ]
    for name, parameter in SCATTERING.items():
        assert parameter in EFFECTS[name].parameters
        assert 0.0 < parameter.healthy_sigma < parameter.typical
