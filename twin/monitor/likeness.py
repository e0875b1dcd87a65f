"""An effect as a possible cause of a deviation."""

from dataclasses import dataclass

from twin.model.effects import UNKNOWN, find_effect

UNNAMED = "its cause is sought in the first whole cycle"


@dataclass(frozen=True)
class Likeness:
    """An effect that may explain a deviation: its size and probability."""

    effect: str
    size: float | None  # in the unit of the effect's first parameter; None if unknown
    unit: str
    share: float  # probability

    @property
    def is_small(self) -> bool:
        """Whether the size is at most typical, so that the response is nearly linear in it."""
        effect = find_effect(self.effect)
        typical = effect.parameters[0].typical if effect else 0.0
        return self.size is not None and abs(self.size) <= typical

    @property
    def words(self) -> str:
        """The effect and its size for people, or why it has none."""
        if self.effect == UNKNOWN:
            return UNNAMED
        if self.size is None:
            return f"fits {self.effect}; its size cannot be told, the estimate is out of its bounds"
        return f"fits {self.effect} {self.size:.3g} {self.unit}"

    def plain(self) -> dict[str, float | int | str]:
        """The effect for JSON; without a size if that is unknown."""
        values: dict[str, float | int | str] = {"effect": self.effect, "share": self.share}
        return values if self.size is None else {**values, "size": self.size, "unit": self.unit}
