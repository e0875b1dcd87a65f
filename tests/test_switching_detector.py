"""Phases from commands and pressure: every unseen switch of the air saving, and no other."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import rigs
from hypothesis import given, settings
from hypothesis import strategies as st
from nozzle_found import Score, scored
from second_world import draw_rig, record

from drivers.plc.faults import parse_fault
from drivers.plc.settings import PlcSettings
from drivers.plc.simulate import blocks, with_truth
from tools.calibration_coverage import drawn
from twin.model import theta as c
from twin.model.dataset import DataSet, coefficients
from twin.model.effects import apply
from twin.monitor import detector_window, simulated_switching
from twin.monitor.detector_window import (
    LONGEST_WINDOW,
    detector_of,
    expected_detector,
    select_window,
)
from twin.monitor.switching_detector import (
    IDLE_ROWS,
    SHORTEST_WINDOW,
    DetectorSettings,
    PhaseFinder,
)
from twin.quality import BREAK, Quality
from twin.signals import MBAR, MS, NS, SAMPLE, Command, Phase, Samples, sampling_ms

NEAR = 20  # rows between a switch and where it is found, lag of sensor and jet included
SECONDS = 24.0
CONDITIONS = {
    "healthy": (),
    "slow sensor": ("sensor_lag=20",),
    "sticking sensor": ("sensor_backlash=10",),
    "leak": ("leakage=5",),
    "small leak": ("leakage=2",),
    "worn nozzle": ("suction_loss=15",),
    "leaking check valve": ("check_valve_leak=3",),
}
Found = tuple[Samples, npt.NDArray[np.uint8], npt.NDArray[np.float64]]


def find(samples: Samples, detector: DetectorSettings, block: int = 1000) -> Found:
    finder = PhaseFinder(detector)
    parts = [finder.push(part) for part in rigs.cut(samples, block)]
    parts.append(finder.flush())
    rows, phase, level = (np.concatenate(column) for column in zip(*parts, strict=True))
    return rows, phase, level


def switches(on: npt.NDArray[np.bool_], suction: npt.NDArray[np.bool_]) -> set[tuple[int, bool]]:
    """Rows at which ``on`` changes while suction is and stays commanded, and what it becomes."""
    rows = np.flatnonzero(np.diff(on.astype(int))) + 1
    return {(int(row), bool(on[row])) for row in rows if suction[row - 1] and suction[row]}


def since_edge(suction: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """Rows since ``suction`` last changed."""
    row = np.arange(len(suction))
    edges = np.concatenate(([True], suction[1:] != suction[:-1]))
    return row - np.maximum.accumulate(np.where(edges, row, 0))


def compare(
    name: str, faults: tuple[str, ...], seed: int, air_saving: bool = True, bad: float = 0.0
) -> list[int]:
    """Rows by which each switch is found late, with a share ``bad`` of rows without a pressure."""
    samples, truth = rigs.recorded(name, SECONDS, faults, seed, air_saving)
    if bad:
        samples = rigs.spoilt(samples, bad, seed)
    return found_where_true(samples, truth, rigs.detector(name))


def found_where_true(
    samples: Samples, truth: npt.NDArray[np.void], detector: DetectorSettings
) -> list[int]:
    """Rows by which each switch is found late; an assertion fails where one is not or is no one.

    A switch just before the end of suction cannot be told from it; one just after its beginning
    is the valve's answer to the command.
    """
    _, phase, _ = find(samples, detector)
    suction = samples["commands"] == Command.SUCTION
    to_end = since_edge(suction[::-1])[::-1]
    true = switches(truth["nozzle"] == 1, suction)
    true = {(row, on) for row, on in true if since_edge(suction)[row] > detector.settled}
    late = []
    found = switches(phase == Phase.SUCTION, suction)
    for row, on in sorted(true):
        near = [
            switching
            for switching in found
            if switching[1] == on and abs(switching[0] - row) <= NEAR
        ]
        if not near and to_end[row] <= detector.lag + NEAR:
            continue
        assert len(near) == 1, f"the nozzle switched to {on} at row {row}, found: {sorted(found)}"
        found -= set(near)
        late.append(near[0][0] - row)
    assert not found, "switches that never were"
    return late


@pytest.mark.parametrize("name", rigs.NAMES)
@pytest.mark.parametrize("condition", CONDITIONS)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_every_switch_is_found_and_none_invented(name: str, condition: str, seed: int) -> None:
    late = compare(name, CONDITIONS[condition], seed)
    reaches_h1 = (name, condition) != ("test_rig", "leak")
    assert (len(late) > 3) == reaches_h1


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", rigs.NAMES)
def test_a_few_bad_rows_hide_no_switch_and_make_none(name: str, seed: int) -> None:
    compare(name, (), seed, bad=0.05)


@pytest.mark.parametrize("name", rigs.NAMES)
def test_without_air_saving_there_is_no_switch(name: str) -> None:
    assert compare(name, (), seed=1, air_saving=False) == []


def test_a_gripper_that_leaks_switches_on_again() -> None:
    samples, truth = rigs.recorded("gripper", SECONDS, ("leakage=2",), 1)
    suction = samples["commands"] == Command.SUCTION
    again = {row for row, on in switches(truth["nozzle"] == 1, suction) if on}
    again = {row for row in again if since_edge(suction)[row] > rigs.detector("gripper").settled}
    assert len(again) >= 9  # so that the comparison above sees both directions


@pytest.mark.parametrize("name", rigs.NAMES)
def test_the_level_at_a_breakpoint_is_that_of_the_control(name: str) -> None:
    samples, _ = rigs.recorded(name, SECONDS)
    _, phase, level = find(samples, rigs.detector(name))
    vacuum = (
        rigs.theta(name)[c.AMBIENT] - level[(phase == Phase.HOLD) & np.isfinite(level)]
    ) / MBAR
    assert len(vacuum) >= 6
    assert vacuum == pytest.approx(750, abs=10)
    assert vacuum.std() < 2


# What commands say.


SETTINGS = DetectorSettings(
    window=10, noise=30.0, off_shift=0, on_shift=4, settled=30, again=30, longest=60
)


def stream(commands: npt.ArrayLike, pressure: float | npt.ArrayLike = 1e5) -> Samples:
    samples = np.zeros(np.size(commands), SAMPLE)
    samples["commands"] = commands
    samples["pressure"] = pressure
    samples["sequence"] = np.arange(len(samples))
    samples["time_ns"] = samples["host_ns"] = 1_000_000 * samples["sequence"]
    return samples


@settings(deadline=None)  # the first call compiles
@given(st.lists(st.integers(0, 255), min_size=1, max_size=200), st.integers(1, 50))
def test_at_constant_pressure_the_commands_are_the_phases(commands: list[int], block: int) -> None:
    rows, phase, _ = find(stream(commands), SETTINGS, block)
    wanted = [
        Phase.BLOW_OFF if value & 2 else Phase.SUCTION if value & 1 else Phase.IDLE
        for value in commands
    ]
    assert phase.tolist() == wanted
    assert rows["commands"].tolist() == commands


@given(st.integers(1, 40), st.integers(1, 100))
@settings(deadline=None)
def test_a_timed_pulse_is_as_long_as_the_ejector_makes_it(command_rows: int, block: int) -> None:
    detector = replace(SETTINGS, blow_off=(float(c.TIMED), 0.1))
    commands = [1] * 50 + [2] * command_rows + [0] * (200 - command_rows)
    _, phase, _ = find(stream(commands), detector, block)
    assert phase.tolist() == [1] * 50 + [3] * 100 + [0] * 100


def test_an_internal_pulse_follows_suction_by_itself() -> None:
    detector = replace(SETTINGS, blow_off=(float(c.INTERNAL), 0.1))
    _, phase, _ = find(stream([1] * 50 + [0] * 200), detector, 30)
    assert phase.tolist() == [1] * 50 + [3] * 100 + [0] * 100


def test_blow_off_wins() -> None:
    _, phase, _ = find(stream([1] * 50 + [3] * 50 + [1] * 50), SETTINGS)
    assert phase.tolist() == [1] * 50 + [3] * 50 + [1] * 50


@pytest.mark.parametrize("noise", [1.0, 30.0])
@pytest.mark.parametrize("command", [0, 1, 2])
def test_noise_alone_makes_no_breakpoint(noise: float, command: int) -> None:
    pressure = 3e4 + noise * np.random.default_rng(5).standard_normal(40_000)
    _, phase, _ = find(stream(np.full(40_000, command), pressure), SETTINGS)
    assert len(set(phase.tolist())) == 1


# Synchronisation.


@pytest.mark.parametrize("slope", [0.0, -5.0, 5.0])  # Pa per row: a closed vessel cools or warms
@pytest.mark.parametrize("block", [7, 1000])
def test_a_cycle_begins_where_the_last_idle_rows_lead(slope: float, block: int) -> None:
    pressure = 1e5 + slope * np.arange(150) + np.random.default_rng(1).normal(0.0, 3.0, 150)
    pressure[100:] = 5e4  # suction has no say in it
    _, _, level = find(stream([0] * 100 + [1] * 50, pressure), SETTINGS, block)
    assert np.flatnonzero(np.isfinite(level)).tolist() == [IDLE_ROWS - 1, 100]
    for row in (IDLE_ROWS - 1, 100):
        assert level[row] == pytest.approx(1e5 + slope * row, abs=6 + abs(slope))


def test_a_few_idle_rows_give_their_mean() -> None:
    pressure = 1e5 + np.arange(80.0)
    _, _, level = find(stream([1] * 20 + [0] * 10 + [1] * 50, pressure), SETTINGS)
    assert level[30] == pytest.approx(pressure[20:30].mean())


def test_unreadable_rows_have_no_say_in_it() -> None:
    samples = stream([0] * 60 + [1] * 50)
    for row, flag in ((30, Quality.BAD), (40, Quality.STALE), (50, Quality.OVERFLOW)):
        samples["pressure"][row] = 5e5
        samples["quality"][row] = flag
    samples["pressure"][55] = np.nan
    _, _, level = find(samples, SETTINGS)
    assert level[60] == 1e5


def test_too_short_an_idle_says_nothing() -> None:
    samples = stream([1] * 50 + [0] * 4 + [1] * 50)
    _, _, level = find(samples, SETTINGS)
    assert np.isnan(level).all()


def test_rows_before_a_break_say_nothing_about_those_after_it() -> None:
    samples = stream([0] * 60 + [1] * 50)
    samples["pressure"][:58] = 0.5e5
    samples["quality"][58] = Quality.CLOCK
    _, _, level = find(samples, SETTINGS)
    assert np.flatnonzero(np.isfinite(level)).tolist() == [IDLE_ROWS - 1]


@pytest.mark.parametrize("flag", Quality(BREAK))
def test_a_break_is_no_breakpoint(flag: Quality) -> None:
    falling = 1e5 - 100.0 * np.arange(300)
    samples = stream([1] * 600, np.concatenate([falling, np.full(300, falling[-1])]))
    samples["quality"][300] = flag
    _, phase, _ = find(samples, SETTINGS)
    assert (phase == Phase.SUCTION).all()
    samples["quality"][300] = 0
    _, phase, _ = find(samples, SETTINGS)
    assert (phase == Phase.HOLD).any()


def two_suctions(falls_for: int, goes_on: int) -> tuple[Samples, int]:
    """Two suctions, and the first row after the second one.

    In the first one the nozzle goes off after 200 rows, and the breakpoint shows. In the second one
    the pressure falls for ``falls_for`` rows, and suction ends ``goes_on`` rows later.
    """
    fall, idle = 1e5 - 300.0 * np.arange(max(falls_for, 200)), np.full(60, 1e5)
    rise = 10.0 * np.arange(1, 301)
    first = np.concatenate([fall[:200], fall[199] + rise])
    second = np.concatenate([fall[:falls_for], fall[falls_for - 1] + rise[:goes_on]])
    pieces = ((idle, 0), (first, 1), (idle, 2), (idle, 0), (second, 1), (idle, 2), (idle, 0))
    commands = np.concatenate([np.full(len(piece), command) for piece, command in pieces])
    pressure = np.concatenate([piece for piece, _ in pieces])
    pressure += SETTINGS.noise * np.random.default_rng(goes_on).standard_normal(len(pressure))
    return stream(commands, pressure), len(commands) - 2 * len(idle)


@pytest.mark.parametrize("block", [1, 7, 1000])
@pytest.mark.parametrize("goes_on", [2, 5, 8])
def test_where_suction_ends_before_the_breakpoint_shows_the_level_of_the_last_one_decides(
    goes_on: int, block: int
) -> None:
    samples, end = two_suctions(200, goes_on)
    detector = replace(SETTINGS, off_shift=8)
    _, phase, level = find(samples, detector, block)
    acted = end - goes_on - detector.off_shift
    assert (phase[acted - 60 : acted - 3] == Phase.SUCTION).all()
    assert (phase[acted + 3 : end] == Phase.HOLD).all()
    assert (phase[end : end + 60] == Phase.BLOW_OFF).all()
    # The breakpoint of the first one, and the idle before.
    assert np.isfinite(level[61:end]).sum() == 2


@pytest.mark.parametrize("block", [1, 1000])
def test_a_pressure_below_that_level_for_long_without_a_breakpoint_says_nothing(block: int) -> None:
    samples, end = two_suctions(260, 0)
    _, phase, _ = find(samples, replace(SETTINGS, off_shift=8), block)
    assert (phase[end - 260 : end] == Phase.SUCTION).all()


def test_a_jump_is_no_breakpoint() -> None:
    samples = stream([1] * 600, 1e5 - 100.0 * np.arange(600))
    samples["pressure"][300:] += 2500.0
    _, phase, level = find(samples, SETTINGS)
    assert (phase == Phase.SUCTION).all()
    assert not np.isfinite(level[1:]).any()


@pytest.mark.parametrize(("name", "rows"), [("gripper", 2), ("test_rig", 2), ("test_rig", 3)])
def test_a_sensor_that_is_slower_than_the_rows_hides_no_switch(name: str, rows: int) -> None:
    """It holds each reading for some rows: then the pressure goes in steps, and none is a jump."""
    samples, truth = rigs.recorded(name, SECONDS, ("leakage=2",) if name == "gripper" else (), 1)
    samples = samples.copy()
    samples["pressure"] = np.repeat(samples["pressure"][::rows], rows)[: len(samples)]
    assert len(found_where_true(samples, truth, rigs.detector(name))) > 3


def test_a_line_that_rings_does_not_hide_the_breakpoint() -> None:
    """Pressure may rise as fast as if it jumped, but it takes some rows for it."""
    rise = [2.4, 9.1, 16.6, 25.1, 29.2, 29.4, 28.0, 25.2, 22.7, 22.9, 23.9, 26.0, 28.8, 29.8]
    ringing = [*rise, 30.0, 28.5, 26.5, 24.0, 21.4, 20.1, *np.full(280, 20.0)]  # as on a gripper
    falling = -0.42 * np.arange(-300, 1)
    mbar = 261.0 + np.concatenate([falling, ringing])
    noise = np.random.default_rng(0).normal(0.0, 0.31, len(mbar))
    detector = DetectorSettings(
        window=11, noise=31.0, off_shift=0, on_shift=9, settled=36, again=36, longest=60
    )
    _, phase, _ = find(stream([1] * len(mbar), 100.0 * (mbar + noise)), detector)
    (break_row,) = np.flatnonzero(np.diff(phase)) + 1
    assert phase[break_row] == Phase.HOLD
    assert abs(int(break_row) - 301) <= 4


def test_the_nozzle_may_go_off_again_before_a_valve_could_have_followed_a_command() -> None:
    """It acts at once where the air saving switches; only lines ring."""
    slopes = np.repeat([-100.0, 20.0, -100.0, 20.0], [300, 100, 35, 200])  # Pa per row
    samples = stream([1] * len(slopes), 9e4 + np.cumsum(slopes))
    samples["pressure"] += np.random.default_rng(0).normal(0.0, SETTINGS.noise, len(slopes))
    _, phase, level = find(samples, SETTINGS)
    detector = np.flatnonzero(np.isfinite(level[1:])) + 1
    assert phase[detector].tolist() == [Phase.HOLD, Phase.SUCTION, Phase.HOLD]
    assert detector == pytest.approx([300, 400, 435], abs=3)


def on_other_tubes(seed: int) -> tuple[PlcSettings, DataSet]:
    """The gripper as another unit, on shorter or longer tubes, and its data set."""
    factor = float(np.random.default_rng([2, seed]).uniform(0.6, 2.5))
    document = rigs.config("gripper").document
    plc = drawn(document.section(PlcSettings, "plc"), seed).model_dump()
    plc["rig"]["line_length_m"] *= factor
    plc["rig"]["line_ml"] *= factor
    plc["program"]["start_ms"] = 500.0
    data = rigs.config("gripper").data.model_dump()
    for part in data["system"]["parts"]:
        if part["kind"] == "tube":
            part["length_mm"] *= factor
    data["ejector"]["end_pressure_mbar"] = plc["ejector"]["end_pressure_mbar"]
    return PlcSettings.model_validate(plc), DataSet.model_validate(data)


@pytest.mark.parametrize("fault", ["leakage=0", "leakage=2"])
@pytest.mark.parametrize("seed", range(6))
def test_a_tube_that_rings_does_not_switch_the_nozzle(seed: int, fault: str) -> None:
    plc, data = on_other_tubes(seed)
    parts = zip(*with_truth(plc, SECONDS, [parse_fault(fault)], seed), strict=True)
    samples, truth = (np.concatenate(column) for column in parts)
    detector = expected_detector(coefficients(data), data.sensor.noise_mbar * MBAR)
    assert len(found_where_true(samples, truth, detector)) >= 10


def of_20_ml(leak: float, hysteresis: float) -> tuple[PlcSettings, DataSet]:
    """A gripper of 20 ml with quick valves, and its data set; leak in sl/min, width in mbar."""
    plc = rigs.config("gripper").document.section(PlcSettings, "plc").model_dump()
    plc["rig"] |= {"line_ml": 1.3, "line_length_m": 0.1, "vessel_ml": 14.0, "opening_sl_min": 60.0}
    plc["rig"] |= {"vessel_area_m2": 0.005, "seal_leak_sl_min": leak}
    plc["ejector"] |= {"build_up_ms": 2.0, "collapse_ms": 1.0}
    plc["valves"] |= {"suction_on_ms": 4.0, "suction_off_ms": 3.0}
    plc["sensor"]["lag_ms"] = 0.5
    plc["control"]["h1_hysteresis_mbar"] = hysteresis
    plc["program"] |= {"suction_ms": 600.0, "start_ms": 500.0}
    data = rigs.config("gripper").data.model_dump()
    data["ejector"] |= {"response_ms": 4.0, "response_off_ms": 4.0, "port_volume_ml": 5.0}
    data["ejector"] |= {"ramp_up_ms": 2.0, "ramp_down_ms": 2.0, "h1_hysteresis_mbar": hysteresis}
    data["sensor"]["lag_ms"] = 1.0
    sensor, tube, cups = data["system"]["parts"]
    data["system"]["parts"] = (
        sensor,
        tube | {"length_mm": 100.0},
        cups | {"volume_ml": 14.0, "wall_area_cm2": 50.0},
    )
    data["system"]["leak_sl_min"] = leak
    return PlcSettings.model_validate(plc), DataSet.model_validate(data)


@pytest.mark.parametrize(("leak", "hysteresis"), [(2.0, 60.0), (3.0, 40.0), (4.0, 60.0)])
def test_a_nozzle_that_switches_every_40_ms_is_followed_live(
    leak: float, hysteresis: float
) -> None:
    plc, data = of_20_ml(leak, hysteresis)
    parts = zip(*with_truth(plc, SECONDS / 2.0, [], 3), strict=True)
    samples, truth = (np.concatenate(column) for column in parts)
    detector = expected_detector(coefficients(data), data.sensor.noise_mbar * MBAR)
    late = found_where_true(samples, truth, detector)
    assert len(late) >= 130
    assert max(map(abs, late)) <= 5
    with pytest.raises(AssertionError):  # lines of other grippers ring for longer
        found_where_true(samples, truth, replace(detector, again=rigs.detector("gripper").again))


def on_a_long_hose() -> DataSet:
    """The data set of a rig of the second world with a hose of 2.1 m and 12 mm."""
    ejector = {"suction_capacity_sl_min": 51.0, "end_pressure_mbar": 285.5, "bulge": -0.3}
    ejector |= {"skew": 2.3, "bend_2": -2.5, "bend_3": 1.1, "kink": 0.39, "kink_at": 0.11}
    ejector |= {"port_volume_ml": 14.3, "h1_mbar": 602.0, "h2_mbar": 452.0}
    ejector |= {"response_ms": 8.7, "response_off_ms": 12.0, "ramp_up_ms": 1.5, "ramp_down_ms": 6.7}
    hose = {"kind": "tube", "length_mm": 1000.0, "diameter_mm": 12.4}
    parts = [{"kind": "sensor"}, hose, {"kind": "vessel", "volume_ml": 653.0}]
    factors = {"line_factor": 2.2, "line_volume_factor": 1.9, "line_inertia_factor": 2.0}
    return DataSet.model_validate(
        {
            "ejector": ejector,
            "sensor": {"lag_ms": 3.1, "noise_mbar": 0.06},
            "system": {"parts": parts, **factors, "line_share": 0.5, "shrinks_ml": 34.0},
        }
    )


def test_a_hose_that_rings_as_suction_begins_is_no_switching(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    logged = record(draw_rig(208_000), 5, 4)

    def scores() -> Score:
        def live(samples: Samples, _: object) -> list[tuple[float, bool]]:
            rows, phase, _ = find(samples, detector)
            at = (rows["time_ns"] - rows["time_ns"][0]) * NS
            switched = switches(phase == Phase.SUCTION, np.isin(phase, (Phase.SUCTION, Phase.HOLD)))
            return [(float(at[row]), on) for row, on in sorted(switched)]

        detector = detector_of(on_a_long_hose())
        return scored("live", logged, live)

    seen = scores()
    assert (len(seen.errors), len(seen.missed), len(seen.false)) == (4, 0, 0)
    monkeypatch.setattr(detector_window, "_that_sees", lambda detector, *_: detector)
    blind = scores()
    assert len(blind.missed) >= 3
    assert len(blind.false) >= 3


def test_no_breakpoint_is_near_the_level_of_the_last() -> None:
    """The slope breaks as it does where the nozzle goes on, but the pressure has hardly risen."""
    slopes = np.repeat([-100.0, 100.0, -30.0, 10.0, -100.0], [300, 40, 40, 400, 200])  # Pa per row
    samples = stream([1] * len(slopes), 9e4 + np.cumsum(slopes))
    samples["pressure"] += np.random.default_rng(0).normal(0.0, SETTINGS.noise, len(slopes))
    for apart, first_on in ((0.0, 340), (5000.0, 780)):
        _, phase, _ = find(samples, replace(SETTINGS, on_shift=0, apart=apart))
        on = np.flatnonzero((phase[1:] == Phase.SUCTION) & (phase[:-1] == Phase.HOLD)) + 1
        assert on[0] == pytest.approx(first_on, abs=3)


def test_breakpoints_are_apart_where_the_line_rings_and_by_less_than_the_hysteresis() -> None:
    assert rigs.detector("test_rig").apart == 0.0
    assert rigs.detector("gripper").apart > 20.0 * MBAR
    theta = rigs.theta("gripper")
    theta[c.H1_LOW] = theta[c.H1] - 60.0 * MBAR
    assert expected_detector(theta, rigs.detector("gripper").noise).apart <= 40.0 * MBAR


def test_a_swing_that_the_model_does_not_show_is_no_breakpoint() -> None:
    """The window is then as long as the swing: over that a line that rings is level."""
    plc, data = on_other_tubes(4)
    parts = zip(*with_truth(plc, SECONDS, [], 4), strict=True)
    samples, truth = (np.concatenate(column) for column in parts)
    theta, noise = coefficients(data), data.sensor.noise_mbar * MBAR
    rings = replace(expected_detector(theta, noise), apart=0.0)
    theta[[c.NEAR_RESISTANCE, c.RESISTANCE]] *= 30.0
    damped = expected_detector(theta, noise)
    assert damped.apart == 0.0
    assert damped.window >= 3 * rings.window
    with pytest.raises(AssertionError, match="never were"):
        found_where_true(samples, truth, rings)
    assert len(found_where_true(samples, truth, replace(rings, window=damped.window))) >= 10


def found_late(name: str, factor: float) -> tuple[float, float]:
    """Median rows by which the nozzle is said to go off and on too late, with a slower sensor."""
    plc = rigs.config(name).document.section(PlcSettings, "plc").model_dump()
    plc["sensor"]["lag_ms"] *= factor
    plc["program"]["suction_ms"] = {"gripper": 2500.0, "test_rig": 9000.0}[name]
    rig, leak = PlcSettings.model_validate(plc), [parse_fault("leakage=2")]
    parts = zip(*with_truth(rig, 30.0, leak, 1), strict=True)
    samples, truth = (np.concatenate(column) for column in parts)
    theta = rigs.theta(name)
    theta[c.SENSOR_LAG] *= factor
    _, phase, _ = find(samples, expected_detector(theta, rigs.detector(name).noise))
    suction = samples["commands"] == Command.SUCTION
    true, found = (switches(on, suction) for on in (truth["nozzle"] == 1, phase == Phase.SUCTION))
    off, on = (
        [min((row - other for other, as_well in true if as_well == to), key=abs) for row in rows]
        for to in (False, True)
        for rows in ([row for row, what in found if what == to],)
    )
    assert min(len(off), len(on)) >= 6
    return float(np.median(off)), float(np.median(on))


@pytest.mark.parametrize("name", rigs.NAMES)
def test_a_slow_sensor_does_not_change_when_the_nozzle_is_said_to_switch(name: str) -> None:
    assert found_late(name, 6.0) == pytest.approx(found_late(name, 1.0), abs=3.0)


@pytest.mark.parametrize("every", [2, 5, 10])
@pytest.mark.parametrize("name", rigs.NAMES)
def test_in_rows_further_apart_each_switch_is_found_at_its_time(name: str, every: int) -> None:
    samples, truth = rigs.recorded(name, SECONDS, ("leakage=2",))
    samples, truth = samples[::every].copy(), truth[::every]
    samples["sequence"] = np.arange(len(samples))
    detector = detector_of(rigs.config(name).data, sampling_ms(samples))
    assert detector.period == pytest.approx(every * MS)
    late = found_where_true(samples, truth, detector)
    assert len(late) >= 6
    assert max(map(abs, late)) <= 5  # rows; the port's step pulls a breakpoint forward
    assert max(late) - min(late) <= 5


# The window.


@settings(max_examples=30)
@given(st.floats(1.0, 5000.0), st.sampled_from(rigs.NAMES))
def test_the_window_has_its_bounds(noise: float, name: str) -> None:
    detector = expected_detector(rigs.theta(name), noise)
    assert SHORTEST_WINDOW <= detector.window <= LONGEST_WINDOW
    assert detector.noise == noise
    assert detector.lag < 2 * LONGEST_WINDOW


def test_the_breakpoint_of_a_large_tank_is_flat_but_seen() -> None:
    """Ten times the volume, and a noisy sensor: the slope breaks by 0.04 mbar a row."""
    plc = rigs.config("test_rig").document.section(PlcSettings, "plc").model_dump()
    plc["rig"]["vessel_ml"] *= 10.0
    plc["sensor"]["noise_mbar"] = 0.5
    plc["program"] |= {"suction_ms": 26_000.0, "blow_off_ms": 3000.0}
    theta = rigs.theta("test_rig")
    theta[c.VOLUME] *= 10.0
    stream = list(blocks(PlcSettings.model_validate(plc), 58.0))
    _, phase, _ = find(np.concatenate(stream), expected_detector(theta, 50.0))
    off = np.count_nonzero((phase[1:] == Phase.HOLD) & (phase[:-1] == Phase.SUCTION))
    assert off == 2


def test_more_noise_takes_a_longer_window() -> None:
    theta = rigs.theta("test_rig")
    assert expected_detector(theta, 10.0).window < expected_detector(theta, 50.0).window


@given(st.integers(1, 400))
def test_a_row_is_held_back_only_where_a_breakpoint_may_be(block: int) -> None:
    finder = PhaseFinder(replace(SETTINGS, window=12))
    commands = [0] * 300 + [1] * 700 + [0] * 100 + [1] * 20 + [2] * 100
    # Row that may be at a breakpoint.
    first = 300 + finder.detector.settled + finder.detector.window + 1
    pushed = given_out = 0
    for part in rigs.cut(stream(commands), block):
        pushed += len(part)
        given_out += len(finder.push(part)[0])
        searched = max(pushed - finder.detector.window, first)
        assert given_out == (min(pushed, searched) if pushed <= 1000 else pushed)
    assert given_out == len(commands)


@pytest.mark.parametrize("name", rigs.NAMES)
def test_no_row_is_held_back_longer_than_the_lag(name: str) -> None:
    samples, _ = rigs.recorded(name, SECONDS)
    finder = PhaseFinder(rigs.detector(name))
    pushed = given_out = longest = 0
    for part in rigs.cut(samples, 10):
        pushed += len(part)
        given_out += len(finder.push(part)[0])
        longest = max(longest, pushed - given_out)
        if part["commands"][-1] != Command.SUCTION:
            assert given_out == pushed
    assert finder.detector.window <= longest <= finder.detector.lag


def test_a_slow_sensor_takes_a_longer_window() -> None:
    theta = rigs.theta("test_rig")
    as_built = expected_detector(theta, 31.0).window
    theta[c.SENSOR_LAG] = 25e-3
    assert as_built + 5 < expected_detector(theta, 31.0).window <= LONGEST_WINDOW


@pytest.mark.parametrize("name", rigs.NAMES)
def test_as_it_should_be_the_window_is_as_wide_as_needed(name: str) -> None:
    samples, _ = rigs.recorded(name, SECONDS)
    assert select_window(rigs.detector(name), rigs.cut(samples, 1000)) == rigs.detector(name)


@pytest.mark.parametrize(("name", "lag"), [("test_rig", 50), ("gripper", 100)])
def test_where_a_sensor_is_too_slow_for_its_window_a_wider_one_sees_more(
    name: str, lag: int
) -> None:
    samples, _ = rigs.recorded(name, SECONDS, (f"sensor_lag={lag}",))
    wider = select_window(rigs.detector(name), [samples])
    assert rigs.detector(name).window < wider.window <= rigs.detector(name).longest
    assert select_window(rigs.detector(name), rigs.cut(samples, 37)) == wider
    few, most = (
        int(np.count_nonzero((phase[1:] == Phase.HOLD) & (phase[:-1] == Phase.SUCTION)))
        for _, phase, _ in (find(samples, detector) for detector in (rigs.detector(name), wider))
    )
    assert few < most >= SECONDS // 3.2 - 1  # cycles are 3.2 s long


def test_by_each_law_the_detector_knows_how_far_the_end_pressure_is_away() -> None:
    theta = rigs.theta("gripper")
    left = float(theta[c.AMBIENT] * (1.0 - theta[c.END_RATIO]) - theta[c.H1]) / MBAR
    laws = [{"end_pressure_rise": 0.9 * left, "end_loss_moves": share} for share in (0.0, 1.0)]
    pivots, moves = (apply(theta, "end_vacuum_loss", law) for law in laws)
    longest = expected_detector(pivots, 30.0).longest
    assert expected_detector(moves, 30.0).longest == pytest.approx(longest, rel=0.3)


@pytest.mark.parametrize(("break_row", "late"), [(70, None), (1003, 3), (1080, 80), (1900, None)])
def test_a_breakpoint_far_from_the_valves_action_is_not_the_simulated_switching(
    break_row: int, late: int | None
) -> None:
    """A line that rings as suction begins can show one."""
    phase = np.full(2000, Phase.SUCTION, np.uint8)
    theta = coefficients(DataSet()).copy()
    theta[[c.SENSOR_LAG, c.SLOW_SENSOR]], theta[c.RESPONSE_OFF] = 0.0, 10.0 * MS
    phase[990:] = Phase.HOLD  # the valve acts in row 1000
    run = simulated_switching._Run(theta, phase, phase, np.full(2000, 5e4), MS)
    detected, level = np.full(2000, Phase.SUCTION, np.uint8), np.full(2000, np.nan)
    detected[break_row:], level[break_row] = Phase.HOLD, 5.1e4
    vacuum, rows, above = simulated_switching._first_switching(run, detected, level, Phase.HOLD)
    if late is None:
        assert np.isnan(vacuum)
        assert (rows, above) == (0, 0.0)
    else:
        assert (rows, above) == (late, 1e3)
