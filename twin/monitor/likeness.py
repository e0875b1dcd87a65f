"""An effect as a possible cause of what differs."""

from dataclasses import dataclass

from twin.model.effects import UNKNOWN, find_effect

UNNAMED = "its cause is sought in the first whole cycle"


@dataclass(frozen=True)
class Likeness:
    """One effect beside a deviation: its size, and how probable it is."""

    effect: str
    size: float | None  # in the unit of the effect's first parameter; None where it is not known
    unit: str
    share: float  # probability

    @property
    def is_small(self) -> bool:
        """Whether what it does is about in proportion to its size: typical ones are the limit."""
        effect = find_effect(self.effect)
        typical = effect.parameters[0].typical if effect else 0.0
        return self.size is not None and abs(self.size) <= typical

    @property
    def words(self) -> str:
        """The effect and its size, or why none is told."""
        if self.effect == UNKNOWN:
            return UNNAMED
        if self.size is None:
            return f"fits {self.effect}; its size cannot be told, the estimate is out of its bounds"
        return f"fits {self.effect} {self.size:.3g} {self.unit}"

    def plain(self) -> dict[str, float | int | str]:
        """The same as JSON has it; without a size where none is known."""
        told: dict[str, float | int | str] = {"effect": self.effect, "share": self.share}
        return told if self.size is None else {**told, "size": self.size, "unit": self.unit}
