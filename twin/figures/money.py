"""Amounts of money as text, and their intervals."""

from typing import NamedTuple

from twin.languages.texts import numeral, tr

EXACT_FROM = 10.0  # of a currency: amounts from here on have no decimals
NOTHING = 1e-9  # of a currency: smaller amounts are rounding errors of zero


class Interval(NamedTuple):
    """A value with its 95 % interval."""

    value: float
    low95: float
    high95: float

    @property
    def is_sure(self) -> bool:
        """Whether the interval excludes zero."""
        return self.low95 > 0.0 or self.high95 < 0.0

    def times(self, factor: float) -> "Interval":
        """The same in another unit; ``factor`` is positive."""
        return Interval(*(factor * part for part in self))


def amount(money: float) -> str:
    """An amount of money without its currency, with cents below EXACT_FROM.

    Amounts below a tenth have two significant digits, so none is rounded to zero.
    """
    if abs(money) < NOTHING:
        return "0"
    if abs(money) < 0.1:
        return numeral(money, ".2g")
    return numeral(money, ".0f" if abs(money) >= EXACT_FROM else ".2f")


def significant(value: float, digits: int = 3) -> str:
    """A number with ``digits`` significant digits, without an exponent."""
    return numeral(float(f"{value:.{digits}g}"), ".10g")


def interval_text(money: Interval, currency: str) -> str:
    """An amount with its 95 % interval: "145 € a year (95 %: 110 to 180)"."""
    low, high = amount(money.low95), amount(money.high95)
    value = f"{amount(money.value)} {currency}"
    return tr("{amount} a year (95 %: {low} to {high})", amount=value, low=low, high=high)
