"""Numbers one can trust: against Radau, by order, in balance, and physical whatever is set."""

import numpy as np
import numpy.typing as npt
import pytest
import radau
import rigs
from hypothesis import Phase as Drawing
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from radau import Valves
from stepping import (
    HOSE,
    MASSES,
    PRESSURES,
    TANK,
    Rows,
    advance,
    closed,
    energy,
    mass,
    phase_rows,
    standing,
    states,
    switched_on,
    temperature,
    theta_of,
    volume,
)

from twin.model import kernel
from twin.model import theta as c
from twin.model.air import CP
from twin.model.plant import prepare
from twin.model.theta import Theta
from twin.signals import MBAR, ML, MS, SL_MIN, Phase

IDLE, SUCTION, HOLD, BLOW_OFF = Phase
EVACUATION = {"test_rig": 1200, "gripper": 500}  # ms
# Runs of the model shrink slowly; what failed is printed as it was drawn.
few = settings(max_examples=40, deadline=None, phases=(Drawing.explicit, Drawing.generate))


def cycle_of(name: str) -> list[tuple[Phase, int]]:
    return [(IDLE, 20), (SUCTION, EVACUATION[name]), (HOLD, 100), (BLOW_OFF, 200), (IDLE, 250)]


def moves_of(theta: Theta, phases: list[tuple[Phase, int]]) -> list[Valves]:
    """What valves and cup do in ``cycle_of``; a phase begins after its first row."""
    cup = 0.0 if np.isnan(theta[c.RELEASE]) else 1.0
    begins = [(1 + sum(rows for _, rows in phases[:n])) * MS for n in range(len(phases))]
    _, suction, hold, blow_off, idle = begins
    late = theta[c.CONTACT] > 0.0
    return [
        Valves(0.0, 0, 0, cup),
        Valves(suction, 0, 0, cup if late else 0.0),
        Valves(suction + theta[c.RESPONSE], 1, 0, cup if late else 0.0),
        *([Valves(suction + theta[c.CONTACT], 1, 0, 0.0)] if late else []),
        Valves(hold, 0, 0),  # seen in the pressure
        Valves(blow_off + theta[c.BLOW_OFF_RESPONSE], 0, 1),
        Valves(idle, 0, 1, cup),
        Valves(idle + theta[c.BLOW_OFF_RESPONSE_OFF], 0, 0),
    ]


def between_samples(name: str, soft_and_late: bool) -> Theta:
    """A rig whose valves act between two samples; also with soft cups that meet the part late."""
    theta = rigs.theta(name)
    theta[[c.RESPONSE, c.BLOW_OFF_RESPONSE]] += [0.37 * MS, 0.61 * MS]
    if soft_and_late:
        theta[[c.COMPLIANCE, c.SOFTNESS, c.STIFF_UNTIL]] = 0.2 * theta[c.VOLUME], 5.0, 3e4
        theta[[c.CREEP, c.CREEP_TIME, c.CONTACT]] = 0.6, 45.0 * MS, 60.43 * MS
    return theta


# Accuracy.


@pytest.mark.slow
@pytest.mark.parametrize("soft_and_late", [False, True])
@pytest.mark.parametrize("name", rigs.NAMES)
def test_a_whole_cycle_is_within_half_a_pascal_of_the_exact_solution(
    name: str, soft_and_late: bool
) -> None:
    theta = between_samples(name, soft_and_late)
    phases = cycle_of(name)
    expected = advance(theta, phases)
    times = (np.arange(len(expected)) + 1) * MS
    exact = radau.reference(theta, moves_of(theta, phases), times)
    assert np.abs(expected - exact[:, kernel.SENSED]).max() < 0.5


def test_so_it_is_where_gas_convects_behind_a_check_valve_and_a_blow_off_valve_leaks() -> None:
    theta = closed(tube_film_coefficient=60.0, film_coefficient=20.0, leak_sl_min=0.3)
    theta[[c.CRACKING_PRESSURE, c.EXHAUST]] = 8.0 * MBAR, 100.0 * SL_MIN
    theta[c.PORT_INFLOW] = 2.0 * SL_MIN
    theta[[c.FREE_CONVECTION, c.FORCED_CONVECTION]] = 0.9, 4.0 / theta[c.BLOW_OFF]
    phases = cycle_of("test_rig")
    expected = advance(theta, phases)
    times = (np.arange(len(expected)) + 1) * MS
    exact = radau.reference(theta, moves_of(theta, phases), times)
    assert np.abs(expected - exact[:, kernel.SENSED]).max() < 0.5


@pytest.mark.slow
@pytest.mark.parametrize(("parts", "factor"), [(TANK, 3000.0), (HOSE, 80.0)], ids=["tank", "hose"])
def test_so_it_is_where_a_narrow_line_chokes(parts: object, factor: float) -> None:
    """In suction; in blow-off it flows the other way."""
    theta = closed(parts, leak_sl_min=0.3, line_factor=factor, line_critical_ratio=0.35)
    phases = cycle_of("test_rig")
    expected = advance(theta, phases)
    times = (np.arange(len(expected)) + 1) * MS
    exact = radau.reference(theta, moves_of(theta, phases), times)
    port, vessel = exact[:, 0], exact[:, 2]
    assert (port / vessel).min() < 0.3
    assert (vessel / port).min() < 0.95
    assert np.abs(expected - exact[:, kernel.SENSED]).max() < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name", rigs.NAMES)
def test_so_it_is_where_blow_off_drains_a_reservoir_and_closes_more_quickly(name: str) -> None:
    theta = between_samples(name, soft_and_late=False)
    theta[[c.BLOW_OFF_DRAIN, c.BLOW_OFF_REFILL]] = 6.0, 0.4
    theta[c.BLOW_OFF_RAMP_DOWN] = 0.6 * theta[c.BLOW_OFF_RAMP]
    theta[[c.RELIEF_PRESSURE, c.RELEASE]] = 45.0 * MBAR, theta[c.RELEASE] - 30.0 * MBAR
    phases = cycle_of(name)
    expected = advance(theta, phases)
    times = (np.arange(len(expected)) + 1) * MS
    exact = radau.reference(theta, moves_of(theta, phases), times)
    assert np.abs(expected - exact[:, kernel.SENSED]).max() < 0.5
    assert exact[:, kernel.DRAINED].max() > 0.3


def in_long_steps(theta: Theta, phase: Phase, start: kernel.State) -> tuple[Rows, Rows]:
    """Expected pressure of 20 rows of 10 ms as a fit from afar has it, and from rows of 1 ms."""
    exact = advance(theta, [(phase, 200)], start.copy())[9::10]
    rows = np.full(20, 10.0 * MS), np.full(20, phase, "u1"), np.full(20, np.nan)
    kernel.advance(start, theta, *rows, expected := np.empty(20), tolerance=kernel.COARSE_TOLERANCE)
    return expected, exact


@pytest.mark.parametrize("shape", [-0.9, -0.4, 2.0])
def test_a_blow_off_of_any_shape_is_followed_in_long_steps(shape: float) -> None:
    theta = closed()
    theta[[c.PORT_VOLUME, c.BLOW_OFF_SHAPE]] = 1.0 * ML, shape
    advance(theta, [(BLOW_OFF, 30)], start := standing(theta, 0.3 * theta[c.AMBIENT]))
    expected, exact = in_long_steps(theta, BLOW_OFF, start)
    assert expected == pytest.approx(exact, abs=0.3 * MBAR)


@pytest.mark.parametrize("warmth", [0.0, 1.0, 10.0, 100.0])  # W/K
@pytest.mark.parametrize("node", ["LINE_HEAT", "PORT_HEAT"])
def test_so_are_nodes_that_take_the_temperature_of_their_wall_within_a_step(
    node: str, warmth: float
) -> None:
    theta = closed()
    theta[getattr(c, node)] = warmth
    start = switched_on(standing(theta, 0.9 * theta[c.AMBIENT]))
    advance(theta, [(SUCTION, 60)], start)
    expected, exact = in_long_steps(theta, SUCTION, start)
    assert expected == pytest.approx(exact, abs=0.1 * MBAR)


@pytest.mark.slow
@pytest.mark.parametrize("parts", [TANK, HOSE], ids=["tank", "hose"])
def test_the_scheme_is_of_third_order(parts: object) -> None:
    theta = closed(parts, tube_film_coefficient=60.0, film_coefficient=10.0, leak_sl_min=0.3)
    start = switched_on(standing(theta, 0.9 * theta[c.AMBIENT]))
    advance(theta, [(SUCTION, 60)], start)  # the swinging is over

    def after(steps: int) -> Rows:
        state, k = start.copy().reshape(-1, 1), prepare(theta.reshape(-1, 1))
        for _ in range(steps):
            kernel._substep(state, k, 0.064 / steps, 0)
        return state[[*PRESSURES, kernel.SENSED], 0]

    fine = after(2048)
    errors = [np.abs(after(steps) - fine).max() for steps in (32, 64, 128, 256)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (orders > 2.7).all()
    assert (orders < 4.0).all()


# A hypothesis alone and among others.


def bank(thetas: Theta, phases: list[tuple[Phase, int]]) -> Rows:
    """Expected pressure (rows, hypotheses)."""
    many = np.stack([kernel.at_rest(theta) for theta in thetas.T], axis=1)
    phase = phase_rows(phases)
    expected = np.empty((len(phase), thetas.shape[1]))
    dt, level = np.full(len(phase), MS), np.full(len(phase), np.nan)
    kernel.advance(many, np.ascontiguousarray(thetas), dt, phase, level, expected)
    return expected


@pytest.mark.parametrize("name", rigs.NAMES)
@pytest.mark.parametrize("others", [1, 2, 5, 64])
def test_the_same_bits_come_out_alone_and_among_others_alike(name: str, others: int) -> None:
    theta = rigs.theta(name)
    phases = cycle_of(name)
    alone = advance(theta, phases)
    among = bank(np.repeat(theta[:, None], others, axis=1), phases)
    assert all(column.tobytes() == alone.tobytes() for column in among.T.copy())


@pytest.mark.parametrize("name", rigs.NAMES)
def test_among_others_that_differ_it_is_stepped_as_finely_as_any_of_them(name: str) -> None:
    """Steps are common to all, so where others move it gives other bits, but the same pressure."""
    theta, phases = rigs.theta(name), cycle_of(name)
    thetas = np.repeat(theta[:, None], 8, axis=1)
    thetas[c.RESPONSE] += np.arange(8) * 1.3 * MS
    thetas[c.BLOW_OFF_RESPONSE] += np.arange(8) * 0.7 * MS
    thetas[c.VOLUME] *= np.linspace(1.0, 1.2, 8)
    among = bank(thetas, phases)
    for column, own in zip(among.T, thetas.T, strict=True):
        assert np.abs(advance(own.copy(), phases) - column).max() < 0.1
    assert np.abs(advance(theta, phases) - among[:, 0]).max() > 0.0  # not the same bits


# Balances.


@pytest.mark.parametrize("parts", [TANK, HOSE], ids=["tank", "hose"])
@given(p=st.floats(0.05e5, 1.5e5), warmer=st.floats(-80.0, 80.0))
@few
def test_a_closed_system_keeps_its_mass_and_energy(parts: object, p: float, warmer: float) -> None:
    """While its gas swings from node to node; the exhaust would let out what is above ambient."""
    assume(abs(p - 0.5e5) > 1.0)  # else nothing swings
    theta = closed(parts)
    theta[c.RELIEF] = 0.0
    state = standing(theta, 0.5e5, warmer)
    state[kernel.VESSEL_MASS] *= p / state[kernel.VESSEL]
    state[kernel.VESSEL] = p
    before = state.copy()
    advance(theta, [(IDLE, 60)], state)
    assert state[kernel.PORT] != before[kernel.PORT]
    assert mass(state) == pytest.approx(mass(before), rel=1e-12)
    assert energy(theta, state) == pytest.approx(energy(theta, before), rel=1e-12)


@pytest.mark.parametrize("warmer", [-80.0, 0.0, 80.0])
def test_a_closed_system_in_balance_stays_as_it_is(warmer: float) -> None:
    theta = closed()
    state = standing(theta, 0.4e5, warmer)
    before = state.copy()
    advance(theta, [(IDLE, 500)], state)
    assert state[PRESSURES] == pytest.approx(before[PRESSURES], rel=1e-12)
    assert state[MASSES] == pytest.approx(before[MASSES], rel=1e-12)


@pytest.mark.parametrize("parts", [TANK, HOSE], ids=["tank", "hose"])
def test_a_sonic_leak_brings_its_mass_and_its_enthalpy(parts: object) -> None:
    theta = closed(parts, leak_sl_min=4.0)
    rows = states(theta, [(IDLE, 300)], standing(theta, 0.1e5))
    seconds = np.arange(len(rows)) * MS
    assert rows[-1, kernel.VESSEL] < 0.528 * theta[c.AMBIENT]
    assert mass(rows) - mass(rows[0]) == pytest.approx(4.0 * SL_MIN * seconds, rel=1e-9)
    brought = CP * theta[c.TEMPERATURE] * 4.0 * SL_MIN * seconds  # J
    assert energy(theta, rows) - energy(theta, rows[0]) == pytest.approx(brought, rel=1e-9)


@pytest.mark.parametrize("warmer", [-80.0, 80.0])
def test_gas_takes_the_temperature_of_its_wall_at_the_rate_of_the_film(warmer: float) -> None:
    theta = closed(film_coefficient=50.0)
    state = standing(theta, 0.4e5, warmer)
    rows = states(theta, [(IDLE, 2000)], state)
    assert temperature(theta, rows[-1]) == pytest.approx(theta[c.TEMPERATURE], abs=0.5)
    assert mass(rows[-1]) == pytest.approx(mass(rows[0]), rel=1e-12)
    power = -50.0 * theta[c.AREA] * (temperature(theta, rows) - theta[c.TEMPERATURE])  # W
    heat = np.concatenate(([0.0], np.cumsum((power[1:] + power[:-1]) / 2) * MS))
    gained = energy(theta, rows) - energy(theta, rows[0])
    assert gained == pytest.approx(heat, rel=1e-3, abs=1e-3)


@pytest.mark.parametrize(
    ("compliance_ml", "softness", "stiff_mbar"),
    [(20.0, 0.0, 0.0), (100.0, 0.0, 0.0), (50.0, 5.0, 0.0), (50.0, 8.0, 300.0)],
)
def test_cups_that_shrink_are_worked_on_as_the_first_law_says(
    compliance_ml: float, softness: float, stiff_mbar: float
) -> None:
    theta = closed(leak_sl_min=4.0)
    theta[[c.COMPLIANCE, c.SOFTNESS]] = compliance_ml * ML, softness
    theta[c.STIFF_UNTIL] = stiff_mbar * MBAR
    rows = states(theta, [(IDLE, 400)], standing(theta, 0.2e5))
    p = rows[:, kernel.VESSEL]
    bigger = np.diff(volume(theta, p))
    work = np.concatenate(([0.0], np.cumsum((p[1:] + p[:-1]) / 2 * bigger)))
    stored = energy(theta, rows) - p * (theta[c.VOLUME] - volume(theta, p)) / 0.4
    brought = CP * theta[c.TEMPERATURE] * 4.0 * SL_MIN * np.arange(len(rows)) * MS
    assert stored - stored[0] + work == pytest.approx(brought, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("name", rigs.NAMES)
def test_over_a_whole_cycle_what_stays_is_what_came_less_what_went(name: str) -> None:
    theta = rigs.theta(name)
    fine = MS / 4
    rows = states(theta, [(phase, 4 * ms) for phase, ms in cycle_of(name)], dt=fine)
    flow = np.array([_net_flow(theta, row) for row in rows])
    flowed = np.cumsum((flow[1:] + flow[:-1]) / 2) * fine
    off = mass(rows[1:]) - mass(rows[0]) - flowed
    assert np.abs(off).max() < 2e-3 * np.abs(np.diff(mass(rows))).sum()


def _net_flow(theta: Theta, row: Rows) -> float:
    """What comes in less what goes out (kg/s), as the plain equations say."""
    ambient, port, vessel = theta[c.AMBIENT], row[kernel.PORT], row[kernel.VESSEL]
    out = radau.suction_flow(theta, port, row[kernel.JET], row[kernel.SUPPLIED])
    out += theta[c.RELIEF] * max(port - ambient, 0.0)
    blown = row[kernel.BLOWING] * theta[c.BLOW_OFF] * (row[kernel.SUPPLIED] + ambient)
    blown /= theta[c.SUPPLY_NOMINAL] + theta[c.AMBIENT_NOMINAL]
    blown *= 1.0 + theta[c.BLOW_OFF_SHAPE] * (1.0 - port / ambient)
    leak = radau.through_hole(theta[c.LEAK], vessel, ambient)
    return float(blown - out + leak + row[kernel.OPEN] * theta[c.OPENING] * (ambient - vessel))


# What must hold for every data set.


def floats(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


TUBES = st.fixed_dictionaries(
    {"kind": st.just("tube"), "length_mm": floats(20, 5000), "diameter_mm": floats(2, 12)}
)
OTHERS = st.one_of(
    TUBES,
    st.fixed_dictionaries({"kind": st.just("tee"), "diameter_mm": floats(3, 12)}),
    st.fixed_dictionaries({"kind": st.just("filter"), "pressure_drop_mbar": floats(0, 200)}),
)
ENDS = st.one_of(
    st.fixed_dictionaries({"kind": st.just("vessel"), "volume_ml": floats(5, 5000)}),
    st.fixed_dictionaries(
        {
            "kind": st.just("cups"),
            "volume_ml": floats(5, 50),
            "count": st.integers(1, 6),
            "shrinks_ml": floats(0, 3),
            "lip_leak_sl_min": floats(0, 1),
        }
    ),
)
PARTS = st.tuples(TUBES, st.lists(OTHERS, max_size=3), ENDS).map(lambda x: (x[0], *x[1], x[2]))
DATA_SETS = st.fixed_dictionaries(
    {
        "ambient": st.fixed_dictionaries(
            {"pressure_mbar": floats(700, 1100), "temperature_c": floats(-20, 60)}
        ),
        "supply": st.fixed_dictionaries({"pressure_bar": floats(3, 6)}),
        "ejector": st.fixed_dictionaries(
            {
                "suction_capacity_sl_min": floats(5, 100),
                "end_pressure_mbar": floats(50, 400),
                "bulge": floats(-0.5, 1.0),
                "ramp_up_ms": floats(1, 100),
                "blow_off_sl_min": floats(0, 200),
                "h1_mbar": st.just(690.0),
                "h2_mbar": st.just(500.0),
            }
        ),
        "system": st.fixed_dictionaries(
            {
                "parts": PARTS,
                "film_coefficient": floats(0, 50),
                "tube_film_coefficient": floats(0, 100),
                "leak_sl_min": floats(0, 20),
                "shrinks_ml": floats(0, 200),
                "softness": floats(0, 20),
                "stiff_mbar": floats(0, 500),
            }
        ),
    }
)


SOFT_CUP = {  # blow-off does not release its part, so it opens at a high vacuum
    "ambient": {"pressure_mbar": 951.5, "temperature_c": 0.0},
    "supply": {"pressure_bar": 5.1},
    "ejector": {
        "suction_capacity_sl_min": 95.0,
        "end_pressure_mbar": 324.0,
        "bulge": 0.8,
        "ramp_up_ms": 51.0,
        "blow_off_sl_min": 0.0,
        "h1_mbar": 690.0,
        "h2_mbar": 500.0,
    },
    "system": {
        "shrinks_ml": 173.0,
        "softness": 8.9,
        "stiff_mbar": 322.0,
        "parts": (
            {"kind": "tube", "length_mm": 3800.0, "diameter_mm": 10.7},
            {"kind": "cups", "volume_ml": 26.0, "lip_leak_sl_min": 0.22},
        ),
    },
}


@few
@given(DATA_SETS)
@example(SOFT_CUP)
def test_every_cycle_stays_physical(tables: dict[str, object]) -> None:
    theta = theta_of(**tables)
    rows = states(theta, [(SUCTION, 300), (HOLD, 60), (BLOW_OFF, 150), (IDLE, 150)])
    assert np.isfinite(rows).all()
    assert (rows[:, MASSES] > 0.0).all()
    assert (rows[:, PRESSURES] > 1e3).all()
    assert (rows[:, PRESSURES] < 8e5).all()
    assert (temperature(theta, rows) > 100.0).all()  # 1000 to 50 mbar without heat is 122 K
    assert (temperature(theta, rows) < 650.0).all()


@few
@given(DATA_SETS)
def test_without_inertia_and_heat_evacuation_only_goes_down_and_stays_above_end_pressure(
    tables: dict[str, object],
) -> None:
    theta = theta_of(**tables)
    theta[[c.NEAR_INERTANCE, c.INERTANCE, c.FILM, c.PORT_HEAT, c.LINE_HEAT, c.LEAK]] = 0.0
    theta[[c.LAMINAR_LEAK, c.DROOP]] = 0.0
    theta[c.SUPPLY] = theta[c.SUPPLY_NOMINAL]
    rows = states(theta, [(SUCTION, 500)])
    assert (np.diff(rows[:, kernel.VESSEL]) <= 2e-6 * theta[c.AMBIENT]).all()
    end = theta[c.END_RATIO] * theta[c.AMBIENT]
    assert (rows[:, PRESSURES] > end - 1.0).all()


@few
@given(DATA_SETS)
def test_blow_off_fills_the_vessel(tables: dict[str, object]) -> None:
    theta = theta_of(**tables)
    theta[[c.NEAR_INERTANCE, c.INERTANCE, c.FILM, c.PORT_HEAT, c.LINE_HEAT]] = 0.0
    theta[c.LEAK] = theta[c.LAMINAR_LEAK] = 0.0
    theta[c.RELEASE] = np.nan
    rows = states(theta, [(BLOW_OFF, 300)], standing(theta, 0.5 * theta[c.AMBIENT]))
    below = rows[:, kernel.PORT] < theta[c.AMBIENT]
    assert (np.diff(rows[below, kernel.VESSEL]) >= -1e-9 * theta[c.AMBIENT]).all()


# No chatter.


@few
@given(
    st.sampled_from([TANK, HOSE]),
    floats(0.0, 60.0),
    floats(-300.0, 300.0),
    st.sampled_from([0.0, 1e-6, 1.0]),
    st.sampled_from([0.0, 1e-3]),
)
def test_nothing_chatters_at_equal_pressures(
    parts: object, leak: float, start: float, friction: float, rim: float
) -> None:
    """No flow but noise, and it turns round no oftener than gas swings."""
    theta = closed(parts, leak_sl_min=leak, line_factor=friction)
    theta[c.LAMINAR_LEAK] = rim  # a cup that stands wide open
    rows = states(theta, [(IDLE, 200)], standing(theta, theta[c.AMBIENT] + start))
    assert np.isfinite(rows).all()
    vacuum = theta[c.AMBIENT] - rows[:, PRESSURES]
    assert np.abs(vacuum).max() <= abs(start) * 2.0 + 1e-6
    for flow in rows[:, [kernel.NEAR, kernel.FAR]].T:
        loud = flow[np.abs(flow) > 1e-9]
        assert np.count_nonzero(np.diff(np.sign(loud))) < 100  # every row would be 200


@few
@given(floats(-500.0, 500.0), floats(0.1, 60.0))
def test_a_short_line_settles_at_ambient_from_one_side(start: float, leak: float) -> None:
    theta = closed(leak_sl_min=leak)
    theta[c.RELIEF] = 0.0
    rows = states(theta, [(IDLE, 300)], standing(theta, theta[c.AMBIENT] + start))
    vacuum = theta[c.AMBIENT] - rows[:, kernel.VESSEL]
    assert (vacuum * -start >= -1e-6 * abs(start)).all()
    assert (np.diff(np.abs(vacuum)) <= 1e-6).all()


@pytest.mark.parametrize("name", rigs.NAMES)
@pytest.mark.parametrize("small", [1e-8, 1e-7])  # m³
def test_nodes_next_to_nothing_do_no_harm(name: str, small: float) -> None:
    theta = rigs.theta(name)
    theta[[c.PORT_VOLUME, c.LINE_VOLUME]] = small
    expected = advance(theta, cycle_of(name))
    assert np.isfinite(expected).all()
    assert expected.min() > theta[c.END_RATIO] * theta[c.AMBIENT] - 10 * MBAR
    assert expected.max() < 3e5


def test_a_runaway_hypothesis_stays_a_number() -> None:
    theta = rigs.theta("test_rig")
    theta[[c.SUCTION, c.BLOW_OFF]] *= 1e4
    theta[[c.VOLUME, c.PORT_VOLUME]] = 1e-9
    expected: npt.NDArray[np.float64] = advance(theta, cycle_of("test_rig"))
    assert np.isfinite(expected).all()
