"""Readings of a record without a model: noise, steps, cadence, switching, flows.

A commissioning starts from these readings. They need only commands and pressure, and are accurate
to some per cent; the fit refines them.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from twin.calibration.flow_meter import Suction, stored
from twin.figures.curve import flow_behind
from twin.model.air import R
from twin.monitor.breakpoints import SHARE_OF_STEP, converter_step, turns
from twin.monitor.offline_switching import reports_nozzle, told_edges
from twin.monitor.signal_checks import part_at
from twin.monitor.surroundings import told
from twin.quality import UNUSABLE
from twin.signals import MBAR, MS, NS, Command, Phase, Reported, Samples

Floats = npt.NDArray[np.float64]

# Noise is the residual of a parabola over two periods of the mains, so that hum counts. Few such
# windows contain edges, so a low quantile of their variances is noise.
WINDOW_MS, FEWEST_ROWS = 40.0, 16
QUIET = 0.3
SMOOTH_MS = 20.0  # a period of the mains: width of the mean before turning points are searched
CLEAR = 6.0  # sigmas of a pressure that differs from another
# Least height of a turn: sigmas of the smoothed pressure, and Pa. In holds of 5 to 20 s noise alone
# turns by 6 to 7 sigmas, and the quiet windows show a sigma that is a sixth too small.
TURN, LEAST_TURN = 9.0, 1.5 * MBAR
EDGE_MS = 30.0  # after a command: turns in it are due to the valve's delay
DEEP = 0.3  # share of the fall, above the lowest pressure, in which the nozzle may go off
AGAIN = 0.5  # least fall after a rise, over the rise, if the nozzle went on again
STEEP_MS, BACK_MS = 10.0, 200.0  # width of the slope, and the time in which gas flows back
LEAST_VACUUM = 20.0 * MBAR  # Pa
MOST_SUCTIONS = 0.5  # share of suctions that must turn for an ejector that saves air
# Shares of the fall: open cups draw some mbar before they meet a part; then the fall proper.
FIRST_FALL, DRAWN = 0.005, (0.15, 0.35)
LEAST_WAIT_MS = 15.0  # between them; ramp and sensor take less
# Shares of the fall. If suction grows evenly, the fall grows with the square of time: it takes
# twice as long to the second as to the first. Between the last two it is steepest.
GROWING, STEEP = (0.01, 0.04), (0.1, 0.25)
LEAST_GROWN = 0.05  # least share of the fall between the first two times at the full slope
OPENED_MS = 40.0  # of an idle, over which its pressure is averaged
OPENED_FROM, OPENED_TO = 0.6, 0.85  # part of an idle in which an opened system is at ambient
# A blow-off is steady in its last milliseconds, or is not; its valve closes within the others.
STEADY_MS, ENDS_MS = 20.0, 150.0
SUDDEN = 2.0  # times as steep as before: suction has ended, against which blow-off worked
COMMANDED = {0: Phase.IDLE, Command.SUCTION: Phase.SUCTION, Command.BLOW_OFF: Phase.BLOW_OFF}
STILL = 3.0  # sigmas by which the pressure of an opened system may move in that time


@dataclass(frozen=True)
class Stretch:
    """Rows of one command, first to last exclusive."""

    command: int
    first: int
    last: int


@dataclass(frozen=True)
class Readings:
    """Readings of a record. Pressures in Pa, absolute; NaN if the record does not show one."""

    period: float  # s, median time between rows
    missing: float  # share of missing rows
    noise: float  # Pa, one standard deviation, steps of the converter included
    step: float  # Pa, the smallest difference between two readings
    idle: float  # Pa, the reading late in an idle: ambient if the system is opened
    opened: bool  # all idles settle at one pressure
    suctions: int
    off: float  # Pa, at which the nozzle goes off (median of the turns)
    on: float  # Pa, at which it goes on again
    switches: int  # suctions in which the nozzle goes off
    deepest: float  # Pa, the lowest pressure
    highest: float  # Pa
    rises_in_suction: bool  # and falls in blow-off: commands or sign are swapped
    tells_blow_off: bool  # any row has blow-off commanded
    fill_rate: float  # 1/s, dp/dt over ambient as blow-off begins
    draw_rate: float  # 1/s, −dp/dt over pressure as suction begins
    meets: float  # s after suction is commanded, when open cups meet a part; NaN if they have one
    back_rate: float  # 1/s, steepest dp/dt over ambient after suction, nothing commanded
    blow_off_ends: float  # s after its command ends, when the pressure shows it; NaN: it does not
    suction_ends: float  # s after blow-off takes over from suction, if suction goes on; or NaN
    pushes: float  # Pa above ambient to which blow-off lifts a system without vacuum; NaN: others
    grows: float  # s, in which suction grows to its full strength; NaN if that does not show
    barometer: float = np.nan  # Pa, its median
    part: float = np.nan  # Pa, at which the ejector itself reports a part
    part_unsure: float = np.nan  # Pa, error of it as the report may be late
    stored: float = np.nan  # kg/Pa, evacuated gas by a flow meter

    @property
    def least_vacuum(self) -> float:
        """Least vacuum (Pa) that counts as made by an ejector."""
        return max(LEAST_VACUUM, 10.0 * self.noise)

    @property
    def saves_air(self) -> bool:
        """Whether the ejector switches its nozzle off by itself."""
        return self.switches > MOST_SUCTIONS * self.suctions

    def evacuated(self, temperature: float) -> float:
        """Evacuated volume (m³) by a flow meter; NaN without one."""
        return self.stored * R * temperature

    def capacity(self, volume: float, ambient: float, temperature: float) -> float:
        """Suction (kg/s) at ambient that empties ``volume`` (m³) as fast as the record shows."""
        return flow_behind(self.draw_rate, volume, ambient, temperature)

    def blow_off(self, volume: float, ambient: float, temperature: float) -> float:
        """Blow-off flow (kg/s) that fills ``volume`` (m³) as fast as the record shows."""
        return flow_behind(self.fill_rate, volume, ambient, temperature)

    def back_flow(self, volume: float, ambient: float, temperature: float) -> float:
        """Flow (kg/s) that fills ``volume`` (m³) as fast as the record shows after suction."""
        return flow_behind(self.back_rate, volume, ambient, temperature)


def read(samples: Samples) -> Readings:
    """Read ``samples``, which must have at least one suction."""
    usable = ((samples["quality"] & UNUSABLE) == 0) & np.isfinite(samples["pressure"])
    rows = samples[usable]
    pressure = rows["pressure"].astype(np.float64)
    intervals = np.diff(rows["time_ns"]) * NS
    period = float(np.median(intervals))
    numbers = samples["sequence"]
    span = max(int(numbers[-1] - numbers[0]) + 1, 1)
    noise, step = noise_of(pressure, period), converter_step(pressure)
    noise = max(noise, SHARE_OF_STEP * step)
    command_stretches = list(stretches(rows["commands"]))
    width = max(round(SMOOTH_MS * MS / period), 3)
    edge = max(round(EDGE_MS * MS / period), 1)
    turn = max(TURN * noise / np.sqrt(width), LEAST_TURN)
    suctions = [stretch for stretch in command_stretches if stretch.command == Command.SUCTION]
    offs, ons, switches = [], [], 0
    reported = reports_nozzle(rows["reported"][rows["commands"] == Command.SUCTION])
    nozzle = (rows["reported"] & np.uint8(Reported.NOZZLE)) != 0
    for stretch in suctions:
        if stretch.last - stretch.first <= edge:  # the record begins or ends in it
            continue
        smooth = _smoothed(pressure[stretch.first : stretch.last], width)[edge:]
        rows_of_turns = turns(smooth, turn)
        lows, highs = deep(smooth, rows_of_turns[0::2], rows_of_turns[1::2])
        offs += list(smooth[lows])
        ons += list(smooth[highs])
        edges = [stretch.first + row for row in told_edges(nozzle[stretch.first : stretch.last])]
        switches += len(edges if reported else lows) > 0
        if reported and not lows:  # the system is so tight that the pressure does not turn
            offs += list(pressure[edges[:1]])
    parts = [
        part
        for stretch in suctions
        if (
            part := part_at(
                rows[stretch.first : stretch.last], pressure[stretch.first : stretch.last]
            )
        )
    ]
    idle, opened = _idle(pressure, command_stretches, round(OPENED_MS * MS / period), noise)
    return Readings(
        period=period,
        missing=1.0 - len(rows) / span,
        noise=noise,
        step=step,
        idle=idle,
        opened=opened,
        suctions=len(suctions),
        off=_median(offs),
        on=_median(ons),
        switches=switches,
        deepest=float(pressure.min()),
        highest=float(pressure.max()),
        rises_in_suction=_rises(pressure, command_stretches, Command.SUCTION)
        and not _rises(pressure, command_stretches, Command.BLOW_OFF),
        tells_blow_off=any(stretch.command == Command.BLOW_OFF for stretch in command_stretches),
        fill_rate=_fill_rate(pressure, command_stretches, period, idle),
        draw_rate=_draw_rate(pressure, suctions, period),
        meets=_meets(pressure, suctions, period, noise),
        back_rate=_back_rate(pressure, command_stretches, period, idle),
        blow_off_ends=_blow_off_ends(pressure, command_stretches, period, noise),
        suction_ends=_suction_ends(pressure, command_stretches, period, noise),
        pushes=_pushes(pressure, command_stretches, idle, noise),
        grows=_grows(pressure, suctions, period, noise),
        barometer=told(samples).get("ambient", np.nan),
        part=_median([pascal for pascal, _ in parts]),
        part_unsure=_median([unsure for _, unsure in parts]),
        stored=stored(_metered(rows, suctions)),
    )


def _metered(rows: Samples, suctions: list[Stretch]) -> Iterator[Suction]:
    """Rows of each suction with a measured flow."""
    for stretch in suctions:
        metered = rows[stretch.first : stretch.last]
        metered = metered[(metered["reported"] & np.uint8(Reported.FLOW_KNOWN)) != 0]
        columns = metered["time_ns"] * NS, metered["pressure"], metered["flow"]
        seconds, pressure, flow = (column.astype(np.float64) for column in columns)
        yield seconds, pressure, flow


def stretches(commands: npt.NDArray[np.uint8]) -> Iterator[Stretch]:
    """Stretches of one command, in order; blow-off wins over suction."""
    command = np.where(
        commands & Command.BLOW_OFF, int(Command.BLOW_OFF), commands & Command.SUCTION
    )
    changes = (np.flatnonzero(np.diff(command)) + 1).tolist()
    edges = [0, *changes, len(command)] if len(command) else []
    for first, last in pairwise(edges):
        yield Stretch(int(command[first]), first, last)


def rows_by_phase(commands: npt.NDArray[np.uint8]) -> dict[Phase, float]:
    """Median rows of each commanded phase; the first and last stretch may be cut short.

    Suction lasts as long as its command, with what the ejector holds by itself.
    """
    rows: dict[Phase, list[float]] = {}
    for stretch in list(stretches(commands))[1:-1]:
        rows.setdefault(COMMANDED[stretch.command], []).append(stretch.last - stretch.first)
    return {phase: _median(lengths) for phase, lengths in rows.items()}


def noise_of(pressure: Floats, period: float) -> float:
    """One sigma (Pa) of the readings' noise, with hum and steps of the converter."""
    rows = max(round(WINDOW_MS * MS / period), FEWEST_ROWS)
    windows = pressure[: len(pressure) // rows * rows].reshape(-1, rows)
    if not len(windows):
        return float("nan")
    smooth = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, rows), 3))[0]
    residual = windows - (windows @ smooth) @ smooth.T
    variance = np.sum(residual**2, axis=1) / (rows - 3)
    return float(np.sqrt(np.quantile(variance, QUIET)))


def deep(smooth: Floats, lows: list[int], highs: list[int]) -> tuple[list[int], list[int]]:
    """The turns deep enough for air saving; oscillations of the line are above."""
    if not lows:
        return [], []
    lowest = smooth.min()
    lows = [row for row in lows if smooth[row] - lowest < DEEP * (smooth[0] - lowest)]
    return drawn_again(smooth, lows, [row for row in highs if lows and row > lows[0]])


def drawn_again(smooth: Floats, lows: list[int], highs: list[int]) -> tuple[list[int], list[int]]:
    """Lows and highs without turns within a longer rise, by waves or by walls that warm the gas.

    A nozzle that goes on again draws down to where it went off.
    """
    kept_lows, kept_highs = lows[:1], list[int]()
    for high in highs:
        next_low = next((row for row in lows if row > high), high + int(np.argmin(smooth[high:])))
        risen, fallen = smooth[high] - smooth[[kept_lows[-1], next_low]]
        if fallen > AGAIN * risen:
            kept_highs.append(high)
            kept_lows += [next_low] if next_low in lows else []
    return kept_lows, kept_highs


def _smoothed(pressure: Floats, width: int) -> Floats:
    """Moving mean over ``width`` rows; fewer at the ends."""
    sums = np.convolve(pressure, np.ones(width), "same")
    return sums / np.convolve(np.ones(len(pressure)), np.ones(width), "same")


def _idle(
    pressure: Floats, command_stretches: list[Stretch], rows: int, noise: float
) -> tuple[float, bool]:
    """Pressure of the idles (Pa), and whether all of them settle at it.

    A closed system that settles slowly moves little in some milliseconds, like an open one, so
    longer parts are compared. The end of an idle does not count, as a cup may touch its part then.
    If any idle follows blow-off, the others are pauses, which hold the vacuum of their suction.
    """
    half = max(rows // 2, 1)
    idles = _long_idles(command_stretches, 2 * rows)
    if not idles:
        return float("nan"), False
    moves, levels = [], np.empty(len(idles))
    for number, idle in enumerate(idles):
        first, last = (
            idle.first + round(share * (idle.last - idle.first))
            for share in (OPENED_FROM, OPENED_TO)
        )
        moves.append(abs(pressure[last - half : last].mean() - pressure[first:][:half].mean()))
        levels[number] = pressure[last - rows : last].mean()
    most_move = STILL * noise * np.sqrt(2.0 / half) + 0.1 * MBAR
    opened = bool(np.median(moves) < most_move and np.ptp(levels) < 2.0 * MBAR + 4.0 * noise)
    return float(np.median(levels)), opened


def _long_idles(command_stretches: list[Stretch], rows: int) -> list[Stretch]:
    """Idles of at least so many rows after blow-off; if there are none, after anything else."""
    long = [
        (previous.command, idle)
        for previous, idle in pairwise(command_stretches)
        if idle.command == 0 and idle.last - idle.first >= rows
    ]
    released = [idle for command, idle in long if command == Command.BLOW_OFF]
    return released or [idle for _, idle in long]


def _rises(pressure: Floats, command_stretches: list[Stretch], command: int) -> bool:
    """Whether the pressure rises in most stretches of a command."""
    moves = [
        pressure[stretch.last - 1] - pressure[stretch.first]
        for stretch in command_stretches
        if stretch.command == command
    ]
    return bool(moves) and float(np.median(moves)) > 0.0


def _draw_rate(pressure: Floats, suctions: list[Stretch], period: float) -> float:
    """−dp/dt over p (1/s) between a tenth and a third of the fall, median of the suctions."""
    rates = []
    for suction in suctions:
        curve = pressure[suction.first : suction.last]
        depth = curve[0] - curve.min()
        begun, ended = (np.flatnonzero(curve < curve[0] - share * depth) for share in (0.1, 0.33))
        if len(ended) and ended[0] > begun[0] and curve[ended[0]] > 0.0:
            first, last = begun[0], ended[0]
            rates.append(np.log(curve[first] / curve[last]) / ((last - first) * period))
    return _median(rates)


def _meets(pressure: Floats, suctions: list[Stretch], period: float, noise: float) -> float:
    """Time (s) at which the fall proper begins, if most suctions have a small fall before it.

    The begin is extrapolated from the times of two shares of the fall.
    """
    times = []
    for suction in suctions:
        curve = pressure[suction.first : suction.last]
        curve = curve[: int(curve.argmin()) + 1]
        depth = curve[0] - curve[-1]
        levels = (max(FIRST_FALL * depth, CLEAR * noise), DRAWN[0] * depth, DRAWN[1] * depth)
        if levels[0] < levels[1]:
            first, early, late = (int(np.argmax(curve <= curve[0] - level)) for level in levels)
            begins = early - DRAWN[0] / (DRAWN[1] - DRAWN[0]) * (late - early)
            is_met = (begins - first) * period > LEAST_WAIT_MS * MS
            times.append(begins * period if is_met else np.nan)
    shown = np.isfinite(times)
    return _median(np.array(times)[shown].tolist()) if shown.sum() > 0.5 * len(suctions) else np.nan


def _grows(pressure: Floats, suctions: list[Stretch], period: float, noise: float) -> float:
    """Time (s) in which the fall reaches its full slope; NaN if most suctions reach it at once."""
    times = []
    for suction in suctions:
        curve = pressure[suction.first : suction.last]
        curve = curve[: int(curve.argmin()) + 1]
        depth = curve[0] - curve[-1]
        if GROWING[0] * depth < CLEAR * noise:
            continue
        rows = [int(np.argmax(curve <= curve[0] - share * depth)) for share in (*GROWING, *STEEP)]
        first, second, third, fourth = (row * period for row in rows)
        share = (second - first) * (STEEP[1] - STEEP[0]) / max(fourth - third, period)
        grows = (second - first) * share / (2.0 * GROWING[0])
        times.append(grows if share > LEAST_GROWN else np.nan)
    shown = np.isfinite(times)
    return _median(np.array(times)[shown].tolist()) if shown.sum() > 0.5 * len(suctions) else np.nan


def _fill_rate(
    pressure: Floats, command_stretches: list[Stretch], period: float, ambient: float
) -> float:
    """dp/dt over ambient (1/s) between a third and two thirds of the rise in blow-off."""
    rates = []
    for stretch in command_stretches:
        if stretch.command == Command.BLOW_OFF:
            curve = pressure[stretch.first : stretch.last]
            top = min(curve.max(), ambient) if np.isfinite(ambient) else curve.max()
            rise_to_top = top - curve[0]
            begun, ended = (
                np.flatnonzero(curve > curve[0] + share * rise_to_top) for share in (0.33, 0.67)
            )
            if len(ended) and ended[0] > begun[0]:
                rise = curve[ended[0]] - curve[begun[0]]
                rates.append(rise / ((ended[0] - begun[0]) * period) / top)
    return _median(rates)


def _suction_ends(
    pressure: Floats, command_stretches: list[Stretch], period: float, noise: float
) -> float:
    """Time (s) until the pressure rises most, where blow-off is commanded as suction ends.

    NaN if it does not rise slowly before: then suction has ended as blow-off begins.
    """
    width, rows = max(round(STEEP_MS * MS / period), 2), round(ENDS_MS * MS / period)
    times, blow_offs = [], 0
    for previous, stretch in pairwise(command_stretches):
        if previous.command != Command.SUCTION or stretch.command != Command.BLOW_OFF:
            continue
        blow_offs += 1
        curve = pressure[stretch.first : min(stretch.last, stretch.first + rows)]
        risen = np.flatnonzero(curve - curve[0] > max(CLEAR * noise, LEAST_TURN))
        if len(curve) > width and len(risen):
            rise = curve[width:] - curve[:-width]
            begins, steepest = int(risen[0]), int(np.argmax(rise))
            before = (curve[steepest] - curve[0]) / max(steepest - begins, 1) * width
            if steepest - begins > width and rise[steepest] > SUDDEN * before:
                times.append(steepest * period)
    return _median(times) if len(times) > 0.5 * blow_offs else float("nan")


def _pushes(pressure: Floats, command_stretches: list[Stretch], idle: float, noise: float) -> float:
    """Pressure above ``idle`` (Pa) that blow-off reaches if it begins without vacuum, or NaN."""
    blow_offs = [
        pressure[stretch.first : stretch.last]
        for stretch in command_stretches
        if stretch.command == Command.BLOW_OFF
    ]
    before = idle - _median([float(rows[0]) for rows in blow_offs])
    above = _median([float(rows.max()) for rows in blow_offs]) - idle
    return above if before < LEAST_VACUUM and above > max(CLEAR * noise, LEAST_TURN) else np.nan


def _blow_off_ends(
    pressure: Floats, command_stretches: list[Stretch], period: float, noise: float
) -> float:
    """Time (s) from the end of its command until the pressure leaves a steady blow-off's level.

    NaN if it is not steady at its end, or if most idles do not show it.
    """
    steady, rows = max(round(STEADY_MS * MS / period), 4), round(ENDS_MS * MS / period)
    times, blow_offs = [], 0
    for stretch, following in pairwise(command_stretches):
        if stretch.command != Command.BLOW_OFF or following.command != 0:
            continue
        blow_offs += 1
        before = pressure[max(stretch.last - steady, stretch.first) : stretch.last]
        after = pressure[following.first : min(following.last, following.first + rows)]
        differs = np.abs(after - before.mean()) > CLEAR * noise
        left = np.flatnonzero(differs[1:] & differs[:-1])  # a single row may be an outlier
        if np.ptp(before) < 2.0 * CLEAR * noise and len(left):
            times.append(float(left[0]) * period)
    return _median(times) if len(times) > 0.5 * blow_offs else float("nan")


def _back_rate(
    pressure: Floats, command_stretches: list[Stretch], period: float, ambient: float
) -> float:
    """Steepest dp/dt over ambient (1/s) within BACK_MS after suction, over STEEP_MS."""
    width, rows = max(round(STEEP_MS * MS / period), 2), round(BACK_MS * MS / period)
    rates = []
    for previous, stretch in pairwise(command_stretches):
        curve = pressure[stretch.first : min(stretch.last, stretch.first + rows)]
        if previous.command == Command.SUCTION and stretch.command == 0 and len(curve) > width:
            rise = float(np.max(curve[width:] - curve[:-width]))
            rates.append(rise / (width * period) / ambient)
    return _median(rates)


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else float("nan")
