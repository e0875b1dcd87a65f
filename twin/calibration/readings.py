"""What a record shows by itself, before any model: noise, steps, cadence, switching, flows.

A commissioning starts from these readings. They are rough, to some per cent, and need
nothing but commands and pressure; the fit refines them.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from twin.calibration.flow_meter import Suction, stored
from twin.figures.curve import flow_behind
from twin.model.gas import R
from twin.monitor.nozzle import reports_nozzle, told_edges
from twin.monitor.signal_checks import part_at
from twin.monitor.surroundings import told
from twin.signals import MBAR, MS, NS, UNUSABLE, Command, Reported, Samples

Floats = npt.NDArray[np.float64]

# Noise is what is left beside a parabola over two periods of the mains, so that hum counts. Edges
# are in few of such windows, so a low quantile of them is noise.
WINDOW_MS, FEWEST_ROWS = 40.0, 16
QUIET = 0.3
SMOOTH_MS = 20.0  # a period of the mains; over it turning points are looked for
CLEAR = 6.0  # sigmas of the smoothed pressure that make a turn
LEAST_TURN = 1.5 * MBAR  # Pa
EDGE_MS = 30.0  # after a command, in which a turn is still the valve's delay
DEEP = 0.3  # of the way down, from the lowest, in which the nozzle may go off
AGAIN = 0.5  # of a rise, by which the pressure falls after it where the nozzle is on again
STEEP_MS, BACK_MS = 10.0, 200.0  # what flows back without a check valve does so at once
LEAST_VACUUM = 20.0 * MBAR  # Pa
MOST_SUCTIONS = 0.5  # of all suctions must turn for an ejector that saves air
# Open cups draw some mbar before they meet a part: shares of the way down.
FIRST_FALL, DRAWN = 0.005, (0.15, 0.35)
LEAST_WAIT_MS = 15.0  # between them; ramp and sensor take less
# Shares of the way down. Where suction grows evenly the fall grows with the square of time: it is
# at the second twice as long after it began as at the first. Between the last two it is steepest.
GROWING, STEEP = (0.01, 0.04), (0.1, 0.25)
LEAST_GROWN = 0.05  # of the way, in the time between the first two at that slope: else it is short
OPENED_MS = 40.0  # of an idle, over which its pressure is averaged
OPENED_FROM, OPENED_TO = 0.6, 0.85  # of an idle, in which an opened system stands at ambient
STILL = 3.0  # sigmas by which the pressure of an opened system may still move in that time


@dataclass(frozen=True)
class Stretch:
    """Rows of one command, first to last exclusive."""

    command: int
    first: int
    last: int


@dataclass(frozen=True)
class Readings:
    """What a record shows without a model. Pressures in Pa, absolute; NaN where it shows none."""

    period: float  # s, the usual time between rows
    missing: float  # share of rows that are not there
    noise: float  # Pa, one standard deviation, steps of the converter included
    step: float  # Pa, the smallest difference between two readings
    idle: float  # Pa, the reading late in an idle: ambient, where the system is opened
    opened: bool  # idles stand still at one pressure
    suctions: int
    off: float  # Pa, at which the nozzle goes off (median of the turns)
    on: float  # Pa, at which it goes on again
    switches: int  # how many suctions show the nozzle go off
    deepest: float  # Pa, the lowest pressure
    highest: float  # Pa
    rises_in_suction: bool  # and falls in blow-off: commands or sign are swapped
    tells_blow_off: bool  # in any row
    fill_rate: float  # 1/s, dp/dt over ambient as blow-off begins
    draw_rate: float  # 1/s, −dp/dt over pressure as suction begins
    meets: float  # s after suction is commanded, when open cups meet a part; NaN if they have one
    back_rate: float  # 1/s, dp/dt over ambient at its steepest after suction, nothing commanded
    grows: float  # s, in which suction grows to its full strength; NaN where that does not show
    barometer: float = np.nan  # Pa, its median
    part: float = np.nan  # Pa, at which the ejector itself reports a part
    part_unsure: float = np.nan  # Pa, as that may be late
    stored: float = np.nan  # kg/Pa, gas that is evacuated, by a flow meter

    @property
    def least_vacuum(self) -> float:
        """Vacuum (Pa) that an ejector makes if it makes any."""
        return max(LEAST_VACUUM, 10.0 * self.noise)

    @property
    def saves_air(self) -> bool:
        """Whether the ejector switches its nozzle off by itself."""
        return self.switches > MOST_SUCTIONS * self.suctions

    def evacuated(self, temperature: float) -> float:
        """Volume (m³) that is evacuated, by a flow meter; NaN where none tells it."""
        return self.stored * R * temperature

    def capacity(self, volume: float, ambient: float, temperature: float) -> float:
        """Suction (kg/s) at ambient that empties ``volume`` (m³) as fast as the record shows."""
        return flow_behind(self.draw_rate, volume, ambient, temperature)

    def blow_off(self, volume: float, ambient: float, temperature: float) -> float:
        """Blow-off flow (kg/s) that fills ``volume`` (m³) as fast as the record shows."""
        return flow_behind(self.fill_rate, volume, ambient, temperature)

    def back_flow(self, volume: float, ambient: float, temperature: float) -> float:
        """Flow (kg/s) that fills ``volume`` (m³) as fast as it fills once suction has ended."""
        return flow_behind(self.back_rate, volume, ambient, temperature)


def read(samples: Samples) -> Readings:
    """Read ``samples``, at least one suction among them."""
    usable = ((samples["quality"] & UNUSABLE) == 0) & np.isfinite(samples["pressure"])
    rows = samples[usable]
    pressure = rows["pressure"].astype(np.float64)
    apart = np.diff(rows["time_ns"]) * NS
    period = float(np.median(apart))
    numbers = samples["sequence"]
    span = max(int(numbers[-1] - numbers[0]) + 1, 1)
    noise, step = noise_of(pressure, period), _step(pressure)
    noise = max(noise, step / np.sqrt(12.0))
    found = list(stretches(rows["commands"]))
    width = max(round(SMOOTH_MS * MS / period), 3)
    edge = max(round(EDGE_MS * MS / period), 1)
    turn = max(CLEAR * noise / np.sqrt(width), LEAST_TURN)
    suctions = [one for one in found if one.command == Command.SUCTION]
    offs, ons, switches = [], [], 0
    reported = reports_nozzle(rows["reported"][rows["commands"] == Command.SUCTION])
    nozzle = (rows["reported"] & np.uint8(Reported.NOZZLE)) != 0
    for one in suctions:
        smooth = _smoothed(pressure[one.first : one.last], width)[edge:]
        lows, highs = deep(smooth, *turns(smooth, turn))
        offs += list(smooth[lows])
        ons += list(smooth[highs])
        edges = [one.first + row for row in told_edges(nozzle[one.first : one.last])]
        switches += len(edges if reported else lows) > 0
        if reported and not lows:  # it holds so well that the pressure does not turn
            offs += list(pressure[edges[:1]])
    parts = [
        at
        for one in suctions
        if (at := part_at(rows[one.first : one.last], pressure[one.first : one.last]))
    ]
    idle, opened = _idle(pressure, found, round(OPENED_MS * MS / period), noise)
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
        rises_in_suction=_rises(pressure, found, Command.SUCTION)
        and not _rises(pressure, found, Command.BLOW_OFF),
        tells_blow_off=any(one.command == Command.BLOW_OFF for one in found),
        fill_rate=_fill_rate(pressure, found, period, idle),
        draw_rate=_draw_rate(pressure, suctions, period),
        meets=_meets(pressure, suctions, period, noise),
        back_rate=_back_rate(pressure, found, period, idle),
        grows=_grows(pressure, suctions, period, noise),
        barometer=told(samples).get("ambient", np.nan),
        part=_median([pascal for pascal, _ in parts]),
        part_unsure=_median([unsure for _, unsure in parts]),
        stored=stored(_metered(rows, suctions)),
    )


def _metered(rows: Samples, suctions: list[Stretch]) -> Iterator[Suction]:
    """Rows of each suction in which the flow is measured."""
    for one in suctions:
        here = rows[one.first : one.last]
        here = here[(here["reported"] & np.uint8(Reported.FLOW_KNOWN)) != 0]
        columns = here["time_ns"] * NS, here["pressure"], here["flow"]
        seconds, pressure, flow = (column.astype(np.float64) for column in columns)
        yield seconds, pressure, flow


def stretches(commands: npt.NDArray[np.uint8]) -> Iterator[Stretch]:
    """Stretches of one command, in order; blow-off wins over suction."""
    told = np.where(commands & Command.BLOW_OFF, int(Command.BLOW_OFF), commands & Command.SUCTION)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(told)) + 1, [len(told)]])
    for first, last in pairwise(edges.tolist()):
        yield Stretch(int(told[first]), first, last)


def noise_of(pressure: Floats, period: float) -> float:
    """Noise of readings (Pa), hum and steps of the converter included."""
    rows = max(round(WINDOW_MS * MS / period), FEWEST_ROWS)
    windows = pressure[: len(pressure) // rows * rows].reshape(-1, rows)
    if not len(windows):
        return float("nan")
    smooth = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, rows), 3))[0]
    left = windows - (windows @ smooth) @ smooth.T
    variance = np.sum(left**2, axis=1) / (rows - 3)
    return float(np.sqrt(np.quantile(variance, QUIET)))


def turns(smooth: Floats, least: float) -> tuple[list[int], list[int]]:
    """Rows of the lows and the highs between which ``smooth`` moves by at least ``least``.

    It begins by falling. A last low or high that nothing follows is none.
    """
    found: tuple[list[int], list[int]] = ([], [])
    falling, best = True, 0
    for row, value in enumerate(smooth.tolist()):
        if (value < smooth[best]) if falling else (value > smooth[best]):
            best = row
        elif abs(value - smooth[best]) >= least:
            found[0 if falling else 1].append(best)
            falling, best = not falling, row
    return found


def deep(smooth: Floats, lows: list[int], highs: list[int]) -> tuple[list[int], list[int]]:
    """Those of the turns that are down where air is saved; a line that is set off rings above."""
    if not lows:
        return [], []
    lowest = smooth.min()
    lows = [row for row in lows if smooth[row] - lowest < DEEP * (smooth[0] - lowest)]
    return drawn_again(smooth, lows, [row for row in highs if lows and row > lows[0]])


def drawn_again(smooth: Floats, lows: list[int], highs: list[int]) -> tuple[list[int], list[int]]:
    """Without the turns of a rise that goes on: waves in the line, and walls that warm the gas.

    Where the nozzle goes on again, it draws down to where it went off.
    """
    kept, on = lows[:1], list[int]()
    for high in highs:
        after = next((row for row in lows if row > high), high + int(np.argmin(smooth[high:])))
        risen, fallen = smooth[high] - smooth[[kept[-1], after]]
        if fallen > AGAIN * risen:
            on.append(high)
            kept += [after] if after in lows else []
    return kept, on


def _smoothed(pressure: Floats, width: int) -> Floats:
    """Mean over ``width`` rows about each; fewer at the ends."""
    sums = np.convolve(pressure, np.ones(width), "same")
    return sums / np.convolve(np.ones(len(pressure)), np.ones(width), "same")


def _step(pressure: Floats) -> float:
    """The smallest difference (Pa) between readings that many show: a step of the converter."""
    levels = np.unique(np.round(pressure, 1))
    return float(np.quantile(np.diff(levels), 0.1)) if len(levels) > 2 else 0.0


def _idle(pressure: Floats, found: list[Stretch], rows: int, noise: float) -> tuple[float, bool]:
    """What idles stand at, and whether each stands still, all at one pressure.

    A closed system that settles slowly moves too little in some milliseconds to be told from one
    that is open. Before the next suction begins a cup may touch its part already.
    """
    half = max(rows // 2, 1)
    idles = [one for one in found[1:] if one.command == 0 and one.last - one.first >= 2 * rows]
    if not idles:
        return float("nan"), False
    moves, levels = [], np.empty(len(idles))
    for number, one in enumerate(idles):
        first, last = (
            one.first + round(share * (one.last - one.first)) for share in (OPENED_FROM, OPENED_TO)
        )
        moves.append(abs(pressure[last - half : last].mean() - pressure[first:][:half].mean()))
        levels[number] = pressure[last - rows : last].mean()
    still = STILL * noise * np.sqrt(2.0 / half) + 0.1 * MBAR
    opened = bool(np.median(moves) < still and np.ptp(levels) < 2.0 * MBAR + 4.0 * noise)
    return float(np.median(levels)), opened


def _rises(pressure: Floats, found: list[Stretch], command: int) -> bool:
    """Whether the pressure ends higher than it began in most stretches of a command."""
    moves = [
        pressure[one.last - 1] - pressure[one.first] for one in found if one.command == command
    ]
    return bool(moves) and float(np.median(moves)) > 0.0


def _draw_rate(pressure: Floats, suctions: list[Stretch], period: float) -> float:
    """−dp/dt over p (1/s) at its steepest between a tenth and a third of the way down."""
    rates = []
    for one in suctions:
        part = pressure[one.first : one.last]
        way = part[0] - part.min()
        begun, ended = (np.flatnonzero(part < part[0] - share * way) for share in (0.1, 0.33))
        if len(ended) and ended[0] > begun[0] and part[ended[0]] > 0.0:
            first, last = begun[0], ended[0]
            rates.append(np.log(part[first] / part[last]) / ((last - first) * period))
    return _median(rates)


def _meets(pressure: Floats, suctions: list[Stretch], period: float, noise: float) -> float:
    """When the fall proper begins (s), where in most suctions a small one comes well before it.

    The fall proper is drawn back from between two shares of the way.
    """
    times = []
    for one in suctions:
        part = pressure[one.first : one.last]
        part = part[: int(part.argmin()) + 1]
        way = part[0] - part[-1]
        levels = (max(FIRST_FALL * way, CLEAR * noise), DRAWN[0] * way, DRAWN[1] * way)
        if levels[0] < levels[1]:
            first, early, late = (int(np.argmax(part <= part[0] - level)) for level in levels)
            begins = early - DRAWN[0] / (DRAWN[1] - DRAWN[0]) * (late - early)
            known = (begins - first) * period > LEAST_WAIT_MS * MS
            times.append(begins * period if known else np.nan)
    met = np.isfinite(times)
    return _median(np.array(times)[met].tolist()) if met.sum() > 0.5 * len(suctions) else np.nan


def _grows(pressure: Floats, suctions: list[Stretch], period: float, noise: float) -> float:
    """In what time (s) the fall grows to its full slope, where in most suctions it grows slowly."""
    times = []
    for one in suctions:
        part = pressure[one.first : one.last]
        part = part[: int(part.argmin()) + 1]
        way = part[0] - part[-1]
        if GROWING[0] * way < CLEAR * noise:
            continue
        rows = [int(np.argmax(part <= part[0] - share * way)) for share in (*GROWING, *STEEP)]
        first, second, third, fourth = (row * period for row in rows)
        share = (second - first) * (STEEP[1] - STEEP[0]) / max(fourth - third, period)
        grows = (second - first) * share / (2.0 * GROWING[0])
        times.append(grows if share > LEAST_GROWN else np.nan)
    slow = np.isfinite(times)
    return _median(np.array(times)[slow].tolist()) if slow.sum() > 0.5 * len(suctions) else np.nan


def _fill_rate(pressure: Floats, found: list[Stretch], period: float, ambient: float) -> float:
    """dp/dt over ambient (1/s) between a third and two thirds of the way up."""
    rates = []
    for one in found:
        if one.command == Command.BLOW_OFF:
            part = pressure[one.first : one.last]
            top = min(part.max(), ambient) if np.isfinite(ambient) else part.max()
            way = top - part[0]
            begun, ended = (np.flatnonzero(part > part[0] + share * way) for share in (0.33, 0.67))
            if len(ended) and ended[0] > begun[0]:
                rise = part[ended[0]] - part[begun[0]]
                rates.append(rise / ((ended[0] - begun[0]) * period) / top)
    return _median(rates)


def _back_rate(pressure: Floats, found: list[Stretch], period: float, ambient: float) -> float:
    """dp/dt over ambient (1/s), over STEEP_MS at its steepest soon after suction."""
    width, rows = max(round(STEEP_MS * MS / period), 2), round(BACK_MS * MS / period)
    rates = []
    for before, one in pairwise(found):
        part = pressure[one.first : min(one.last, one.first + rows)]
        if before.command == Command.SUCTION and one.command == 0 and len(part) > width:
            rise = float(np.max(part[width:] - part[:-width]))
            rates.append(rise / (width * period) / ambient)
    return _median(rates)


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else float("nan")
