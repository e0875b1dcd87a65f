"""The pauses before retries after failures."""


class Backoff:
    """Pauses (s) that double with each failure, up to a bound."""

    def __init__(self, first_s: float, longest_s: float) -> None:
        self._first_s, self._longest_s = first_s, longest_s
        self._pause_s = first_s

    def next_s(self) -> float:
        """The pause after one more failure."""
        pause_s, self._pause_s = self._pause_s, min(2.0 * self._pause_s, self._longest_s)
        return pause_s

    def reset(self) -> None:
        """Start again with the first pause, after a success."""
        self._pause_s = self._first_s
