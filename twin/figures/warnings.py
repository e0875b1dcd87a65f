"""The table of the field's warnings, each evaluated on the measured figures of a whole cycle.

So each is latched to the end of its cycle, and stands until the next cycle has been evaluated.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from twin.figures.settings import HIGHEST, LIMITED, LOWEST, Limits
from twin.model.safeguards import PROTECTED_SWITCHES

Measured = Mapping[str, float]


@dataclass(frozen=True)
class Caution:
    """One warning: its condition and its text. An unknown figure raises none."""

    name: str
    figure: str  # without which it cannot be judged
    when: str
    stands: Callable[[Measured, Limits], bool]
    words: str  # with the figures, the limits as {limits}, and where they come from as {source}


CAUTIONS = {
    caution.name: caution
    for caution in (
        Caution(
            "valve_protection",
            "quick_switchings",
            f"`quick_switchings` is {PROTECTED_SWITCHES} or more",
            lambda m, _: m["quick_switchings"] >= PROTECTED_SWITCHES,
            "the air saving switches too often ({quick_switchings:.0f} times in 3 s)",
        ),
        Caution(
            "t1_over_limit",
            "t1",
            "`t1` is over `permitted_t1_ms`",
            lambda m, limits: m["t1"] > limits.t1,
            "t1 over limit ({t1:.0f} of {limits.t1:.0f} ms, {source})",
        ),
        Caution(
            "leakage_over_limit",
            "leakage",
            "`leakage` is over `permitted_leakage_mbar_s`",
            lambda m, limits: m["leakage"] > limits.leakage,
            "leakage over limit ({leakage:.0f} of {limits.leakage:.0f} mbar/s, {source})",
        ),
        Caution(
            "h1_not_reached",
            "h1_not_reached",
            "`h1_not_reached` is 1, and expected to be 0",
            lambda m, _: m["h1_not_reached"] > 0.0,
            "H1 not reached (highest {max_vacuum:.0f} mbar)",
        ),
        Caution(
            "free_flow_too_high",
            "free_flow",
            "`free_flow` is over `permitted_free_flow_mbar`",
            lambda m, limits: m["free_flow"] > limits.free_flow,
            "free-flow vacuum too high ({free_flow:.0f} of {limits.free_flow:.0f} mbar, {source}):"
            " an open cup is clogged, or a held part leaks",
        ),
        Caution(
            "supply_out_of_range",
            "lowest_supply",
            "`lowest_supply` or `highest_supply` is beyond `supply_low_bar` to `supply_high_bar`",
            lambda m, limits: (
                m["lowest_supply"] < limits.supply[0] or m["highest_supply"] > limits.supply[1]
            ),
            "supply out of range ({lowest_supply:.1f} to {highest_supply:.1f} of"
            " {limits.supply[0]:.1f} to {limits.supply[1]:.1f} bar, {source})",
        ),
    )
}


def warnings(measured: Measured, expected: Measured, limits: Limits) -> tuple[str, ...]:
    """The names of the warnings of a cycle, in the order of the table.

    A warning that the expected cycle gives too is suppressed: a program may end suction before H1,
    and a small tight volume switches often. Limits that the configuration does not set give way to
    what is expected; a figure that is clearly beyond that as well is still warned of.
    """
    given = limits.given(expected)
    return tuple(
        name
        for name, caution in CAUTIONS.items()
        if caution.stands(measured, given)
        and (caution.figure in LIMITED or not caution.stands(expected, given))
    )


def in_words(names: Sequence[str], measured: Measured, limits: Limits) -> list[str]:
    """The same for people, with figure, limit, and where the limit comes from."""
    return [
        caution.words.format(
            **measured, limits=limits, source=limits.source(_limited(caution, measured, limits))
        )
        for caution in map(CAUTIONS.__getitem__, names)
    ]


def _limited(caution: Caution, measured: Measured, limits: Limits) -> str:
    """The figure whose limit is exceeded; of a supply that is beyond both, the lowest."""
    is_upper_side = caution.figure == LOWEST and not measured[LOWEST] < limits.supply[0]
    return HIGHEST if is_upper_side else caution.figure


def table() -> str:
    """The warnings as a table for people."""
    rows = [f"| `{caution.name}` | {caution.when} |" for caution in CAUTIONS.values()]
    return "\n".join(["| warning | stands while |", "| --- | --- |", *rows])
