"""Fuzz what decodes bytes from elsewhere: whatever they are, there are rows or one clear error.

Inputs are kept ones and pieces of them, changed at random. An input with a new outcome is kept in
the corpus, and so is one that raises anything but an error for people or takes too long: those
count as found. Each target gets the same time, so that a fast one takes more of the inputs. Ctrl-C
ends it, and what was done until then is said. An input that ends the process stands in a file
``under-way`` of its target's corpus.

    python -m tools.fuzz --inputs 10_000_000    # of all targets together: a night
"""

import argparse
import json
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path

import numpy as np

from tools.fuzz_targets import TARGETS, seeds
from twin.errors import TwinError

CORPUS = Path(__file__).resolve().parents[1] / "tests" / "corpus"
LONGEST_S = 5.0  # for one input
UNDER_WAY = "under-way"
TURN_S = 0.2  # for a target, until it is the next one's turn


def changed(data: bytes, others: list[bytes], random: np.random.Generator) -> bytes:
    """The same with a few changes."""
    new = bytearray(data)
    for _ in range(int(random.integers(1, 5))):
        at = int(random.integers(len(new) + 1))
        match int(random.integers(5)):
            case 0 if at < len(new):
                new[at] ^= 1 << int(random.integers(8))
            case 1:
                new[at:at] = random.bytes(int(random.integers(1, 9)))
            case 2:
                del new[at : at + int(random.integers(1, 9))]
            case 3:
                new[at : at + 8] = random.choice([b"\xff", b"\0", b"\x7f"]) * 8
            case _:
                other = others[int(random.integers(len(others)))]
                new[at:] = other[int(random.integers(len(other) + 1)) :]
    return bytes(new)


def place_of(error: BaseException) -> str:
    """Where an error was raised, and where the one before it: a text would show the input."""
    *_, last = traceback.walk_tb(error.__traceback__)
    place = f"{type(error).__name__} at {Path(last[0].f_code.co_filename).name}:{last[1]}"
    before = error.__cause__
    return f"{place}, {place_of(before)}" if before is not None else place


@dataclass
class Campaign:
    """The inputs that one target is given; ``found`` has what was, with the files that show it."""

    name: str
    corpus: Path
    seed: int = 1
    inputs: int = 0
    seconds: float = 0.0
    found: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._random = np.random.default_rng(self.seed)
        self._folder = self.corpus / self.name
        self._folder.mkdir(parents=True, exist_ok=True)
        if (self._folder / UNDER_WAY).exists():
            print(f"{self._folder / UNDER_WAY}: this ended the process", file=sys.stderr)
        there = [path.read_bytes() for path in sorted(self._folder.iterdir())]
        self._kept = seeds(self.name) + there
        self._first = [*self._kept]  # they come as they are
        self._outcomes = set[str]()

    def begin(self) -> None:
        """Try what was kept."""
        with self._remembered() as remember:
            while self._first:
                self._try(self._first.pop(0), remember)

    def go_on(self, inputs: int, seconds: float = float("inf")) -> None:
        """Try so many more, but no longer than that."""
        begun = time.monotonic()
        with self._remembered() as remember:
            for _ in range(inputs):
                if time.monotonic() - begun > seconds:
                    break
                kept, random = self._kept, self._random
                data = changed(kept[int(random.integers(len(kept)))], kept, random)
                self._try(data, remember)
                self.inputs += 1
        self.seconds += time.monotonic() - begun

    @contextmanager
    def _remembered(self) -> Iterator[Callable[[bytes], None]]:
        """What keeps an input in a file until the next; it goes if the process has not ended."""
        path = self._folder / UNDER_WAY
        with path.open("wb", buffering=0) as file:

            def remember(data: bytes) -> None:
                file.seek(0)
                file.write(data)
                file.truncate()

            try:
                yield remember
            except KeyboardInterrupt:
                path.unlink()
                raise
        path.unlink()

    def _try(self, data: bytes, remember: Callable[[bytes], None]) -> None:
        remember(data)
        wrong, begun = "", time.monotonic()
        try:
            outcome = TARGETS[self.name](data)
        except TwinError as error:
            outcome = place_of(error)
        except Exception as error:  # what is looked for
            outcome, wrong = place_of(error), f"{place_of(error)}: {error}"
        if (seconds := time.monotonic() - begun) > LONGEST_S and not self._is_quick_again(data):
            outcome = wrong = f"took too long: {outcome}"
        if outcome in self._outcomes:
            return
        self._outcomes.add(outcome)
        path = self._folder / sha256(data).hexdigest()[:16]
        path.write_bytes(data)
        self._kept.append(data)
        if wrong:
            self.found.append(f"{path}: {wrong} ({seconds:.1f} s)")

    def _is_quick_again(self, data: bytes) -> bool:
        """Whether an input takes long the first time alone: something is loaded or compiled."""
        begun = time.monotonic()
        with suppress(Exception):
            TARGETS[self.name](data)
        return time.monotonic() - begun < LONGEST_S


def fuzz(name: str, inputs: int, corpus: Path, seed: int) -> list[str]:
    """Try what was kept and so many more; gives what was found."""
    campaign = Campaign(name, corpus, seed)
    campaign.begin()
    campaign.go_on(inputs)
    return campaign.found


def share(campaigns: list[Campaign], inputs: int) -> None:
    """Try so many of all together, each as long as the others."""
    for campaign in campaigns:
        campaign.begin()
    left = inputs
    while left > 0:
        for campaign in campaigns:
            before = campaign.inputs
            campaign.go_on(left, TURN_S)
            left -= campaign.inputs - before
            if sys.stderr.isatty():
                told = f"\r{inputs - left:,} of {inputs:,}; {campaign.name:<10}"
                print(told, end="", file=sys.stderr, flush=True)


def main() -> int:
    """Run from the command line; 1 if anything was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", type=int, default=100_000, help="of all targets together")
    parser.add_argument("--corpus", type=Path, default=CORPUS)
    parser.add_argument("--target", choices=sorted(TARGETS), action="append")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    chosen = given.target or TARGETS
    campaigns = [Campaign(name, given.corpus, given.seed) for name in chosen]
    try:
        share(campaigns, given.inputs)
    except KeyboardInterrupt:
        print("interrupted: what was found until then is in the corpus", file=sys.stderr)
    print(json.dumps({one.name: _told(one) for one in campaigns}, indent=1))
    return 1 if any(one.found for one in campaigns) else 0


def _told(campaign: Campaign) -> dict[str, object]:
    speed = round(campaign.inputs / campaign.seconds) if campaign.seconds else 0
    return {"inputs": campaign.inputs, "inputs_per_s": speed, "found": campaign.found}


if __name__ == "__main__":
    sys.exit(main())
