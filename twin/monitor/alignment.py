"""Knees of one kind, moved to where each fits the mean course of all of them best.

The valve's stroke, the line and the sensor round a knee, and in one record they do so alike. What
is alike is found from all knees together; what noise leaves of each is then only when it was.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from twin.monitor.breakpoints import OF_A_ROW, WANTED, Course, Floats, fits, vertex
from twin.signals import MS

FEWEST = 3  # knees that have a mean course
ROUNDS, NARROWS = 4, 0.7
OF_NOISE = 40.0  # as in breaks, with all that is alike known
LEAST, LEAST_ROWS = 80.0 * MS, 12  # on either side
ROOM = 0.8  # of what most knees have on either side
POINTS, PLACES = 60, 61
FARTHEST, ROWS, SHARE = 30.0 * MS, 2.0, 0.4  # that a knee is moved in a round; share of the window
ROUNDED = (-0.2, -0.1, -0.05, 0.05, 0.1, 0.2)  # of the window: where the mean course may bend
OWN, ALIKE = (
    [0, 1, 4],
    [2, 3, *range(5, 7 + len(ROUNDED))],
)  # columns: level and slopes are a knee's own


@dataclass
class Knee:
    """The nozzle's switching as it shows in the pressure."""

    on: bool
    time: float  # s
    level: float  # Pa
    rows: tuple[int, int]  # from the knee or command before it to that after it
    jump: float  # Pa/s, by which the slope breaks
    scale: float  # s, over which the course beside it may be taken for a parabola
    stepped: bool = False
    held: float = np.nan  # Pa, as suction ends, if the nozzle is off until then


def align(course: Course, knees: Sequence[Knee]) -> None:
    """Move ``knees``, all of one kind, in place. Those with a step are where it is."""
    if len(knees) < FEWEST or np.mean([knee.stepped for knee in knees]) > 0.5:
        return
    half = _window(course, knees)
    many = max(1, round(half / course.period / POINTS))
    grid = many * course.period
    count = round(half / grid)
    reach = min(FARTHEST + ROWS * course.period, SHARE * half)
    wide = count + int(np.ceil(reach / grid))
    about = np.arange(-float(wide), wide + 1.0) * grid
    around = _Around(course, many, half, about, count)
    times = np.array([knee.time for knee in knees])
    ends = course.time[np.array([[knee.rows[0], knee.rows[1] - 1] for knee in knees])]
    for _ in range(ROUNDS):
        mean = around.alike(times, ends)
        moved = np.array(
            [around.moved(*each, mean, reach) for each in zip(times, ends, strict=True)]
        )
        times = times + moved - np.median(moved)
        reach = max(NARROWS * reach, 2.0 * course.period)
    times = times + around.middle(times, ends, -1.0 if knees[0].on else 1.0)
    for knee, time, (low, high) in zip(knees, times.tolist(), ends.tolist(), strict=True):
        knee.time = min(max(time, low + course.period), high - course.period)


def _window(course: Course, knees: Sequence[Knee]) -> float:
    """Time (s) on either side that places a knee well, and that most of them have."""
    period, noise = course.period, course.noise
    jump, scale = (
        float(np.median(one)) for one in zip(*((k.jump, k.scale) for k in knees), strict=True)
    )
    wanted = max(WANTED, OF_A_ROW * period)
    wide = max(OF_NOISE * noise.at(jump) / (jump * wanted) ** 2, LEAST_ROWS * period, LEAST)
    room = [
        min(knee.time - course.time[knee.rows[0]], course.time[knee.rows[1] - 1] - knee.time)
        for knee in knees
    ]
    least = 6.0 * period
    most = max(ROOM * float(np.quantile(room, 0.25)), least), max(scale, least)
    return min(max(wide, noise.window), *most)


@dataclass(frozen=True)
class _Around:
    """The course about knees, at the same times before and after each."""

    course: Course
    many: int  # rows of which each value is the mean
    half: float  # s
    wide: Floats  # s, times about a knee, further than it is moved
    count: int  # of them, on either side, that are compared

    @property
    def narrow(self) -> Floats:
        """Times (s) about a knee that are compared."""
        beyond = len(self.wide) // 2 - self.count
        return self.wide[beyond : len(self.wide) - beyond]

    def at(self, times: Floats) -> Floats:
        """Pressure (Pa) about ``times``."""
        within = (np.arange(self.many) - 0.5 * (self.many - 1)) * self.course.period
        fine = np.interp((times[:, None] + within).ravel(), self.course.time, self.course.pressure)
        mean: Floats = fine.reshape(-1, self.many).mean(axis=1)
        return mean

    def alike(self, times: Floats, ends: Floats) -> Floats:
        """What the courses about all knees have in common beside their own level and slopes."""
        columns = _bent(self.wide / self.half)
        rest, left = list[Floats](), list[Floats]()
        for time, (low, high) in zip(times, ends, strict=True):
            here = (time + self.wide >= low) & (time + self.wide <= high)
            if np.count_nonzero(here) < self.count:
                continue
            own = np.linalg.qr(columns[here][:, OWN])[0]
            for values, of in (
                (columns[here][:, ALIKE], rest),
                (self.at(time + self.wide[here]), left),
            ):
                of.append(values - own @ (own.T @ values))
        if not rest:
            return np.zeros(len(self.wide))
        common = np.linalg.lstsq(np.concatenate(rest), np.concatenate(left), rcond=1e-6)[0]
        mean: Floats = columns[:, ALIKE] @ common
        return mean

    def moved(self, time: float, ends: Floats, mean: Floats, reach: float) -> float:
        """By how much (s) a knee must be moved for ``mean`` to fit best."""
        narrow = self.narrow
        here = (time + narrow >= ends[0]) & (time + narrow <= ends[1])
        if np.count_nonzero(here) < max(8, self.count):
            return 0.0
        places = np.linspace(-reach, reach, PLACES)
        z = narrow[here] - places[:, None]
        left = self.at(time + narrow[here]) - np.interp(z, self.wide, mean)
        own = np.stack([np.ones_like(z), z / self.half, np.maximum(z, 0.0) / self.half], axis=2)
        basis = np.linalg.qr(own)[0]
        along = np.einsum("mnk,mn->mk", basis, left)
        rss = np.sum(left**2, axis=1) - np.sum(along**2, axis=1)
        least = int(rss.argmin())
        return float(places[least]) + vertex(rss, least) * float(places[1] - places[0])

    def middle(self, times: Floats, ends: Floats, sign: float) -> float:
        """Where (s) the mean course breaks."""
        narrow = self.narrow
        whole = [
            self.at(time + narrow)
            for time, (low, high) in zip(times, ends, strict=True)
            if time + narrow[0] >= low and time + narrow[-1] <= high
        ]
        if not whole:
            return 0.0
        mean = np.mean([one - one.mean() for one in whole], axis=0)
        places = np.linspace(-0.5, 0.5, PLACES)
        rss, bent = fits(narrow / self.half, mean, places, step=False)
        rss = np.where(sign * bent[:, 3] > 0.0, rss, np.inf)
        least = int(rss.argmin())
        return self.half * float(places[least]) if np.isfinite(rss[least]) else 0.0


def _bent(u: Floats) -> npt.NDArray[np.float64]:
    """Columns of a course with a rounded knee at 0: cubics either side, and bends about it."""
    after = np.maximum(u, 0.0)
    columns = [u**0, u, u * u, u**3, after, after**2, after**3]
    return np.stack(columns + [np.maximum(u - one, 0.0) for one in ROUNDED], axis=1)
