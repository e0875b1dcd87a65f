"""Fuzz what decodes bytes from elsewhere: whatever they are, there are rows or one clear error.

Inputs are kept ones and pieces of them, changed at random. An input with a new outcome is kept in
the corpus. An input that takes too long, or raises anything but an error for people, is kept as
well and counts as found. Each target gets the same time, so that a fast one takes more of the
inputs. Ctrl-C ends the run with a report. An input that ends the process is in the file
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
TURN_S = 0.2  # for a target, before the next one has its turn


def changed(data: bytes, others: list[bytes], random: np.random.Generator) -> bytes:
    """``data`` with a few random changes."""
    new = bytearray(data)
    for _ in range(int(random.integers(1, 5))):
        position = int(random.integers(len(new) + 1))
        match int(random.integers(5)):
            case 0 if position < len(new):
                new[position] ^= 1 << int(random.integers(8))
            case 1:
                new[position:position] = random.bytes(int(random.integers(1, 9)))
            case 2:
                del new[position : position + int(random.integers(1, 9))]
            case 3:
                new[position : position + 8] = random.choice([b"\xff", b"\0", b"\x7f"]) * 8
            case _:
                donor = others[int(random.integers(len(others)))]
                new[position:] = donor[int(random.integers(len(donor) + 1)) :]
    return bytes(new)


def place_of(error: BaseException) -> str:
    """Places of an error and of its causes; the text of an error would contain the input."""
    *_, last = traceback.walk_tb(error.__traceback__)
    origin = f"{type(error).__name__} at {Path(last[0].f_code.co_filename).name}:{last[1]}"
    before = error.__cause__
    return f"{origin}, {place_of(before)}" if before is not None else origin


@dataclass
class Campaign:
    """The inputs of one target; ``found`` has the problems, with the files that show them."""

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
        corpus = [path.read_bytes() for path in sorted(self._folder.iterdir())]
        self._kept = seeds(self.name) + corpus
        self._first = [*self._kept]  # they come as they are
        self._outcomes = set[str]()

    def begin(self) -> None:
        """Try the kept inputs."""
        with self._remembered() as remember:
            while self._first:
                self._try(self._first.pop(0), remember)

    def go_on(self, inputs: int, seconds: float = float("inf")) -> None:
        """Try more inputs, at most for ``seconds``."""
        begun = time.monotonic()
        with self._remembered() as remember:
            for _ in range(inputs):
                if time.monotonic() - begun > seconds:
                    break
                inputs_kept, random = self._kept, self._random
                data = changed(
                    inputs_kept[int(random.integers(len(inputs_kept)))], inputs_kept, random
                )
                self._try(data, remember)
                self.inputs += 1
        self.seconds += time.monotonic() - begun

    @contextmanager
    def _remembered(self) -> Iterator[Callable[[bytes], None]]:
        """Keep each input in a file until the next; the file is deleted unless the process dies."""
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
        """Whether an input is slow only the first time, as something is loaded or compiled."""
        begun = time.monotonic()
        with suppress(Exception):
            TARGETS[self.name](data)
        return time.monotonic() - begun < LONGEST_S


def fuzz(name: str, inputs: int, corpus: Path, seed: int) -> list[str]:
    """Try the kept inputs and so many more; gives the problems found."""
    campaign = Campaign(name, corpus, seed)
    campaign.begin()
    campaign.go_on(inputs)
    return campaign.found


def share(campaigns: list[Campaign], inputs: int) -> None:
    """Try so many inputs of all targets together, with equal time for each."""
    for campaign in campaigns:
        campaign.begin()
    remaining = inputs
    while remaining > 0:
        for campaign in campaigns:
            before = campaign.inputs
            campaign.go_on(remaining, TURN_S)
            remaining -= campaign.inputs - before
            if sys.stderr.isatty():
                text = f"\r{inputs - remaining:,} of {inputs:,}; {campaign.name:<10}"
                print(text, end="", file=sys.stderr, flush=True)


def main() -> int:
    """Run from the command line; 1 if anything was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", type=int, default=100_000, help="of all targets together")
    parser.add_argument("--corpus", type=Path, default=CORPUS)
    parser.add_argument("--target", choices=sorted(TARGETS), action="append")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    chosen = arguments.target or TARGETS
    campaigns = [Campaign(name, arguments.corpus, arguments.seed) for name in chosen]
    try:
        share(campaigns, arguments.inputs)
    except KeyboardInterrupt:
        print("interrupted: what was found until then is in the corpus", file=sys.stderr)
    print(json.dumps({campaign.name: _summary(campaign) for campaign in campaigns}, indent=1))
    return 1 if any(campaign.found for campaign in campaigns) else 0


def _summary(campaign: Campaign) -> dict[str, object]:
    speed = round(campaign.inputs / campaign.seconds) if campaign.seconds else 0
    return {"inputs": campaign.inputs, "inputs_per_s": speed, "found": campaign.found}


if __name__ == "__main__":
    sys.exit(main())
