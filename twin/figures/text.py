"""Key figures for people: a table of cycles, and trends in a sentence."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from twin.figures.curve import CURVE, Reading, Stretch, readings
from twin.figures.database import History
from twin.figures.key_figures import FIGURES, NO_DASH, Figure
from twin.figures.settings import Limits
from twin.figures.trend import FARTHEST, FEWEST_BINS, SURE, Line, Reach, Step, Trend, trend_of
from twin.instants import clock, instant, lasting
from twin.languages.texts import ntr, numeral, tr

SHOWN = ("t0", "t1", "leakage", "free_flow", "max_vacuum", "nozzle_share", "air", "supply")
NO_SCATTER = 1e-6  # of the level: equal values give no interval


def cycles_table(cycles: Sequence[Mapping[str, Any]]) -> str:
    """One line for each cycle: measured values, with the expected ones in brackets."""
    head = ["cycle", *(f"{name} ({FIGURES[name].unit})" for name in SHOWN), "warnings"]
    rows = [head, *([*_cells(cycle)] for cycle in cycles)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    )


def curve_table(suctions: Sequence[Stretch]) -> str:
    """One line for each suction: figures read off the curve, and why some are missing."""
    if not suctions:
        return "no suction in this record: nothing is read off its curve"
    all_figures = [readings(suction) for suction in suctions]
    head = ["suction", *(f"{name} ({figure.unit})" for name, figure in CURVE.items())]
    rows = [
        [str(number), *map(_reading, figures.values())]
        for number, figures in enumerate(all_figures)
    ]
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = [
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in (head, *rows)
    ]
    step = max(suction.step for suction in suctions) * 1e3
    title = (
        "read off the curve, without a model; vacuum counts from the record's own idle;"
        f" ± is half of a 95 % interval; a reading each {step:.3g} ms"
    )
    return "\n".join([title, *lines, *_missing(all_figures)])


def _reading(reading: Reading) -> str:
    if reading.why:
        return "-"
    if not reading.half > 0.0:
        return f"{reading.value:.3g}"
    decimals = max(1 - math.floor(math.log10(reading.half)), 0)
    return f"{reading.value:.{decimals}f} ± {reading.half:.{decimals}f}"


def _missing(all_figures: Sequence[Mapping[str, Reading]]) -> list[str]:
    """Why figures are missing: the most frequent reason of each."""
    lines = []
    for name in CURVE:
        reasons = Counter(figures[name].why for figures in all_figures if figures[name].why)
        if reasons:
            (reason, _), count = reasons.most_common(1)[0], sum(reasons.values())
            lines.append(f"{name} is missing in {count} of {len(all_figures)} suctions: {reason}")
    return lines


def curve_plain(suctions: Sequence[Stretch]) -> list[dict[str, Any]]:
    """The same for JSON: value, half of the 95 % interval, unit; or ``why`` it is missing."""
    return [
        {
            "begin_ns": suction.begin_ns,
            **{name: _reading_plain(name, reading) for name, reading in readings(suction).items()},
        }
        for suction in suctions
    ]


def _reading_plain(name: str, reading: Reading) -> dict[str, Any]:
    if reading.why:
        return {"value": None, "why": reading.why}
    value, half = round(reading.value, 4), round(reading.half, 4)
    return {"value": value, "half95": half, "unit": CURVE[name].unit}


def _cells(cycle: Mapping[str, Any]) -> list[str]:
    values = [
        f"{_number(cycle.get(f'{name}_measured'))} ({_number(cycle.get(f'{name}_expected'))})"
        for name in SHOWN
    ]
    return [str(cycle["cycle"]), *values, ", ".join(cycle["warnings"])]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def trend_of_figure(history: History, figure: Figure, limits: Limits) -> Trend:
    """Trend of a figure's record, with its limit."""
    values = history.values[f"{figure.name}_measured"]
    return trend_of(history.host_ns, values, limit_of(figure.name, limits))


def limit_of(name: str, limits: Limits) -> float | None:
    """The upper limit of a figure; None if it has none."""
    figure_limits = {"t1": limits.t1, "leakage": limits.leakage, "free_flow": limits.free_flow}
    limit = figure_limits.get(name, math.inf)
    return limit if math.isfinite(limit) else None


def title_of(name: str) -> str:
    """The name of a figure for people."""
    return tr(FIGURES[name].title)


def in_words(figure: Figure, trend: Trend, now_ns: int) -> str:
    """Trend of a figure in a sentence that begins with its name, for commands."""
    return f"{figure.name}: {course_in_words(figure, trend, now_ns)}"


def course_in_words(figure: Figure, trend: Trend, now_ns: int) -> str:
    """Trend of a figure in words, also if it has neither a step nor a drift."""
    unit = NO_DASH.get(figure.unit, f" {figure.unit}")
    texts = []
    if trend.lacking:
        last = ntr(
            "last measured at {at}, and not in the cycle since",
            "last measured at {at}, and not in the {count} cycles since",
            trend.lacking,
            at=instant(trend.end_ns, now_ns),
        )
        texts.append(last)
    if (step := trend.step) is not None:
        texts.append(_stepped(step, unit, now_ns))
    if (line := trend.line) is not None:
        runs = _ran if trend.lacking else _runs
        texts.append(runs(line, unit, since=step is not None))
    elif step is None and not trend.lacking:
        return tr("not enough to say: fewer than {count} stretches with cycles", count=FEWEST_BINS)
    if trend.limit is not None:
        texts.append(
            _limited(
                trend, tr("its limit of {value}", value=f"{numeral(trend.limit, '.4g')}{unit}")
            )
        )
    return "; ".join(filter(None, texts))


def _stepped(step: Step, unit: str, now_ns: int) -> str:
    before, after = (
        f"{numeral(level, '.4g')}{_give_or_take(half, level)}"
        for level, half in ((step.before, step.before_half), (step.after, step.after_half))
    )
    return tr(
        "stepped from {before} to {after} at {at} (95 %: {earliest} to {latest})",
        before=before,
        after=f"{after}{unit}",
        at=instant(step.host_ns, now_ns),
        earliest=clock(step.earliest_ns, now_ns),
        latest=clock(step.latest_ns, now_ns),
    )


def _runs(line: Line, unit: str, *, since: bool) -> str:
    """The line in words, since a step or through the whole record."""
    change = _changes(line, unit)
    if line.is_trend:
        text = tr("{change} since then", change=change) if since else change
    elif since:
        text = tr("no trend since then ({change})", change=change)
    else:
        text = tr("no trend ({change})", change=change)
    return text if since else f"{numeral(line.level, '.4g')}{unit}, {text}"


def _ran(line: Line, unit: str, *, since: bool) -> str:
    """The same for a figure that is no longer measured: its last level, and its trend if any.

    Without a trend it says nothing: "no trend" would sound as if all were well.
    """
    level = "" if since else f"{numeral(line.level, '.4g')}{unit}"
    change = _changes(line, unit) if line.is_trend else ""
    if change and since:
        change = tr("{change} after that", change=change)
    return ", ".join(filter(None, [level, change]))


def _changes(line: Line, unit: str) -> str:
    """Change of a line per day, or over a shorter record."""
    span = 1.0 if line.is_rate else line.span
    change = numeral(line.slope * span, "+.3g")
    change += _give_or_take(line.slope_half() * span, line.level)
    values = {"change": f"{change}{unit}", "time": lasting(line.span * 86_400.0)}
    if line.is_rate:
        return tr("{change} per day over {time}", **values)
    return tr("{change} over {time}", **values)


def _give_or_take(half: float, level: float) -> str:
    """Half of an interval in words; empty if the record shows no scatter."""
    return f" ± {numeral(half, '.2g')}" if half > NO_SCATTER * max(abs(level), 1.0) else ""


def _limited(trend: Trend, limit: str) -> str:
    """The figure's relation to its limit; empty if there is nothing to say."""
    assert trend.limit is not None
    line, step = trend.line, trend.step
    level = line.level if line is not None else step.after if step is not None else 0.0
    if level >= trend.limit and (step is not None or (line is not None and line.is_trend)):
        return tr("over {limit}", limit=limit)
    if line is None or not line.is_trend or not line.is_rate or trend.lacking:
        return ""
    return _comes(trend.comes, line, limit)


def _comes(comes: Reach | None, line: Line, limit: str) -> str:
    if comes is None:
        return tr("away from {limit}", limit=limit)
    if not math.isfinite(comes.expected):
        days = numeral(FARTHEST * line.span, ".1f")
        return tr("{limit} is more than {days} days away", limit=limit, days=days)
    return tr(
        "{limit} in {days} days ({earliest} to {latest})",
        limit=limit,
        days=numeral(comes.expected, ".1f"),
        earliest=numeral(comes.earliest, ".1f"),
        latest=numeral(comes.latest, ".1f") if math.isfinite(comes.latest) else tr("never"),
    )


def deleted_in_words(until_ns: int, now_ns: int) -> str:
    """Which cycles are no longer there to be judged."""
    until = clock(until_ns, now_ns)
    return tr("cycles up to {until} are deleted; only later ones are used", until=until)


def trend_plain(figure: Figure, trend: Trend) -> dict[str, Any]:
    """The same for JSON; null where there is nothing to say."""
    plain: dict[str, Any] = {"figure": figure.name, "unit": figure.unit, "limit": trend.limit}
    plain |= {"step": None, "line": None, "days_to_limit": None}
    plain["ended"] = {"host_ns": trend.end_ns, "cycles": trend.lacking} if trend.lacking else None
    if (step := trend.step) is not None:
        plain["step"] = {
            "from": step.before,
            "from_95": [step.before - step.before_half, step.before + step.before_half],
            "to": step.after,
            "to_95": [step.after - step.after_half, step.after + step.after_half],
            "host_ns": step.host_ns,
            "host_ns_95": [step.earliest_ns, step.latest_ns],
        }
    if (line := trend.line) is not None:
        change, half = line.slope * line.span, line.slope_half() * line.span
        plain["line"] = {
            "level": line.level,
            "change": change,
            "change_95": [change - half, change + half],
            "days": line.span,
            "per_day": line.slope if line.is_rate else None,
            "is_trend": line.is_trend,
            "sure": SURE,
        }
    if (comes := trend.comes) is not None:
        days = (comes.expected, comes.earliest, comes.latest)
        names = ("expected", "low95", "high95")
        plain["days_to_limit"] = {
            name: value if math.isfinite(value) else None
            for name, value in zip(names, days, strict=True)
        }
    return plain
