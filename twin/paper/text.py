"""The text of ``twin paper``: tables of 80 columns, with their assumptions and conclusions."""

import textwrap
from collections.abc import Iterable, Sequence

from twin.paper.evacuation import (
    APPLICATION,
    CUPS_CM2,
    END_MBAR,
    HOSE_CM2,
    INSTANCE_SL_MIN,
    OBJECT_SL_MIN,
    RIG,
    TANK_CM2,
    TUBES_CM2,
    Setup,
    isothermal,
)
from twin.paper.separation import BIG, Pair, Separation
from twin.paper.tables import Row, percent_more
from twin.signals import STANDARD_DENSITY

WIDTH = 80


def in_words(rows: Sequence[Row], separation: Separation) -> str:
    """The whole answer as text."""
    rig = [row for row in rows if row.setup is RIG]
    application = [row for row in rows if row.setup is APPLICATION]
    parts = [
        *_table("Table 2: the test rig", rig),
        "",
        *_paragraph(
            "Table 2 also prints the largest deviations along Fig. 7 (126, 128, 29 and 17 mbar)."
            " They cannot be recomputed: the measured curve is not printed as numbers."
        ),
        "",
        *_table("Table 4: the industrial application", application),
        "",
        "What gives these figures",
        *_points(_assumptions(separation)),
        "",
        "What this twin adds: wall heat, and a characteristic that bulges",
        *_alone(separation),
        "",
        "Pairs that all meet the rig's measured time, and what they say of other things",
        *_pairs(separation.pairs),
        "",
        "What two evacuation times can and cannot separate",
        *_points(_conclusions(separation)),
    ]
    return "\n".join(parts)


def _table(title: str, rows: Sequence[Row]) -> list[str]:
    setup = rows[0].setup
    lines = [
        f"{title}, {setup.volume_ml:g} ml from {setup.ambient_mbar:g} to"
        f" {setup.target_mbar:g} mbar,abs",
        f"{'':26}{'paper':>8}{'twin':>10}{'twin over':>12}{'over measured, %':>24}",
        f"{'':26}{'ms':>8}{'ms':>10}{'paper, %':>12}{'paper':>14}{'twin':>10}",
        f"{'measured':26}{setup.measured_ms:8.0f}{'-':>10}{'-':>12}{'-':>14}{'-':>10}",
    ]
    return lines + [_row(row) for row in rows]


def _row(row: Row) -> str:
    printed, recomputed = (
        percent_more(ms, row.setup.measured_ms) for ms in (row.paper_ms, row.twin_ms)
    )
    figures = f"{row.paper_ms:8.0f}{row.twin_ms:10.1f}{row.off_paper:+12.1f}"
    return f"{row.quantity:26}{figures}{printed:+14.1f}{recomputed:+10.1f}"


def _assumptions(separation: Separation) -> list[str]:
    return [
        f"S_N is {INSTANCE_SL_MIN} sl/min (instance-specific) or {OBJECT_SL_MIN} sl/min"
        f" (object-specific). A standard litre is {STANDARD_DENSITY} g of air (ISO 8778: 100 kPa,"
        " 20 °C, 65 % rh); the equations take it as volume of dry air at the system's ambient.",
        f"Rig: ambient {RIG.ambient_mbar:g} mbar, {RIG.temperature_c:g} °C; the paper prints"
        " neither. The ratio of its two equations gives the pressure within 1 mbar, their size"
        " the temperature within some degrees. Target: 600 mbar below ambient.",
        f"Application: standard conditions, {APPLICATION.ambient_mbar:g} mbar and"
        f" {APPLICATION.temperature_c:g} °C.",
        "The paper's model: one adiabatic vessel; a suction mass flow that falls in a straight"
        f" line from S_N at ambient pressure to 0 at {END_MBAR:g} mbar,abs; no delay, no ramp-up,"
        " no leak, no resistance of tubes. It runs on the kernel every other command uses.",
        f"The rig's printed model times are later than these, by {separation.delay_ms:.0f} ms with"
        " instance-specific data. A response delay would do that; the application's printed"
        " times leave no room for one.",
    ]


def _alone(separation: Separation) -> list[str]:
    lines = [
        *_paragraph(
            f"One film coefficient on all walls: rig {TANK_CM2:g} cm² of tank and {TUBES_CM2:g} of"
            f" tubes, application {CUPS_CM2:g} cm² of cups and {HOSE_CM2:.0f} of hose. The bulge b"
            " makes the straight line x of the characteristic x (1 + b (1 - x))."
        ),
        f"{'':36}{'rig':>20}{'application':>22}",
        f"{'':36}{'ms':>10}{'change, %':>11}{'ms':>11}{'change, %':>11}",
    ]
    base = separation.alone[0]
    for change in separation.alone:
        rig = percent_more(change.rig_ms, base.rig_ms)
        application = percent_more(change.application_ms, base.application_ms)
        lines.append(
            f"{change.what:36}{change.rig_ms:10.1f}{rig:+11.1f}"
            f"{change.application_ms:11.1f}{application:+11.1f}"
        )
    measured = f"{RIG.measured_ms:10.1f}{'':11}{APPLICATION.measured_ms:11.1f}"
    return [*lines, f"{'measured':36}{measured}"]


def _pairs(pairs: Sequence[Pair]) -> list[str]:
    lines = [
        f"{'film':>8}{'bulge':>8}{'rig':>8}{'application, ms':>24}{'5 l tank':>12}"
        f"{'vacuum lost':>16}",
        f"{'coeff.':>8}{'':16}{'as one':>8}{'hose, read at':>16}{'':12}{'in hold, mbar':>16}",
        f"{'W/(m² K)':>8}{'-':>8}{'ms':>8}{'vessel':>8}{'ejector':>9}{'cups':>7}{'ms':>12}"
        f"{'1 s':>9}{'4 s':>7}",
    ]
    return lines + [_pair(pair) for pair in pairs]


def _pair(pair: Pair) -> str:
    first, later = pair.lost_mbar
    return (
        f"{pair.unit.film:8.0f}{pair.unit.bulge:8.3f}{pair.rig_ms:8.1f}{pair.application_ms:8.1f}"
        f"{pair.at_ejector_ms:9.1f}{pair.in_cups_ms:7.1f}{pair.big_ms:12.0f}{first:9.1f}{later:7.1f}"
    )


def _conclusions(separation: Separation) -> list[str]:
    pairs = separation.pairs
    vessel_ms, tank = (
        [pair.application_ms for pair in pairs],
        [pair.big_ms for pair in pairs],
    )
    suctions, losses = (
        [pair.needed_sl_min for pair in pairs],
        [pair.lost_mbar[-1] for pair in pairs],
    )
    reference = next(pair for pair in pairs if pair.unit.film == separation.film)
    other_unit = separation.object_ms - reference.application_ms
    delayed = separation.delayed_ms - reference.application_ms
    return [
        "They speak against the equations, and with a straight characteristic they demand an energy"
        f" balance: from an isothermal vessel the same flow takes {isothermal(RIG):.0f} and"
        f" {isothermal(APPLICATION):.0f} ms, {_excess(RIG):.0f} and {_excess(APPLICATION):.0f} %"
        " too long. With a bulge they demand no more: an almost isothermal gas"
        f" ({pairs[-1].unit.film:g} W/(m² K)) meets the rig's time with a bulge of"
        f" {pairs[-1].unit.bulge:.2f}.",
        "The rig's time alone fixes a combination: to every film coefficient belongs a bulge.",
        "The application as one vessel only says it again: all pairs come to"
        f" {_span(vessel_ms, '.1f')} ms. Wall times time over volume is {_exposure(RIG):.0f} s/m on"
        f" the rig and {_exposure(APPLICATION):.0f} s/m there, so heat and bulge weigh alike."
        f" A mean ejector of the type instead of this unit moves it by {other_unit:+.1f} ms, a"
        f" response delay of {separation.delay_ms:.0f} ms in both by {delayed:+.1f} ms.",
        f"No pair meets the {APPLICATION.measured_ms:.0f} ms so. It would take"
        f" {_span(suctions, '.1f')} sl/min, and the paper does not say that the ejector measured"
        f" there was the one of {INSTANCE_SL_MIN} sl/min.",
        "With the hose as a line everything depends on where the pressure was read, which is not"
        f" said either: {_span([pair.at_ejector_ms for pair in pairs], '.0f')} ms at the ejector,"
        f" {_span([pair.in_cups_ms for pair in pairs], '.0f')} ms in the cups. Only who knows that,"
        " the hose's resistance and the unit may read a film coefficient from it.",
        "So two times, from two systems and perhaps two ejectors, cannot tell heat, bulge, suction"
        " capacity, delay and hose apart.",
        "The hold phase can: after the nozzle goes off, a tight tank loses"
        f" {_span(losses, '.0f')} mbar of vacuum in 4 s, only because its gas warms up. How fast it"
        " levels off gives the film coefficient; a leak goes on instead.",
        "A second volume on the same unit can as well, if its size differs:"
        f" {BIG.volume_ml / 1e3:g} l take {_span(tank, '.0f')} ms. But the smallest and the largest"
        f" film coefficient differ there by {abs(percent_more(tank[0], tank[-1])):.1f} % only, so"
        " the hold is the surer way.",
        "Whole cycles, blow-off and idle included, tell wall heat and bulge apart on one volume:"
        " docs/founding-model.md takes the paper's model as the nominal one and lets a fit find"
        " both.",
    ]


def _excess(setup: Setup) -> float:
    """Excess of an isothermal vessel over the measured time, in %."""
    return percent_more(isothermal(setup), setup.measured_ms)


def _exposure(setup: Setup) -> float:
    """Wall area × measured time / volume, in s/m: a measure of the influence of heat."""
    return setup.wall_cm2 * 1e-4 * setup.measured_ms * 1e-3 / (setup.volume_ml * 1e-6)


def _span(values: Iterable[float], number_format: str) -> str:
    ordered = sorted(values)
    return f"{ordered[0]:{number_format}} to {ordered[-1]:{number_format}}"


def _paragraph(text: str) -> list[str]:
    return textwrap.wrap(text, WIDTH)


def _points(texts: Iterable[str]) -> list[str]:
    """Lines of a list, one text each."""
    return [
        line
        for text in texts
        for line in textwrap.wrap(text, WIDTH, initial_indent="- ", subsequent_indent="  ")
    ]
