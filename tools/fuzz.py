"""Fuzz what decodes bytes from elsewhere: whatever they are, there are rows or one clear error.

Inputs are kept ones and pieces of them, changed at random. An input with a new outcome is kept in
the corpus, and so is one that raises anything but an error for people or takes too long: those
count as found. Ctrl-C ends it, and what was done until then is said.

    python -m tools.fuzz --inputs 10_000_000    # a night
"""

import argparse
import json
import re
import struct
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import UTC, datetime
from functools import cache
from hashlib import sha256
from itertools import count
from pathlib import Path

import numpy as np
from asyncua import ua
from asyncua.common.utils import Buffer
from asyncua.ua.ua_binary import from_binary, to_binary

from drivers import opcua_values, telegram
from drivers.lasting import Clock
from drivers.link import ModbusSettings
from drivers.opcua_bounds import refuse_null_arrays
from drivers.opcua_settings import Node
from drivers.ring import Trace
from drivers.sources import settings_of
from drivers.tags import Address, Words
from twin.errors import SourceError, TwinError
from twin.events import Event, Kind
from twin.log.header import LogHeader
from twin.log.reader import open_log
from twin.log.recorder import Recorder
from twin.settings import Document
from twin.signals import SAMPLE, TICK

NODE = Node("s=Fuzz")
CONFIG = Document.read(Path(__file__).resolve().parents[1] / "configs" / "test_rig.toml")
HEADER = struct.pack(">IqHHHHhH", 9, 10**18, 7, 1000, 4096, 4, 5000, 0)
RECORDS = b"".join(struct.pack(">HHf", number, 0, 900.0) for number in (8, 9))
CORPUS = Path(__file__).resolve().parents[1] / "tests" / "corpus"
LONGEST_S = 5.0  # for one input
TOLD = 1000  # inputs between two words on how far it is
DEPTH_BLOCKS = 4  # readings of the ring with one input


class Served:
    """A link that answers from an input, again and again."""

    def __init__(self, data: bytes) -> None:
        self._words = np.frombuffer(data[: len(data) // 2 * 2] or b"\0\0", ">u2").astype(np.uint16)
        self._next = 0

    def read(self, address: Address, number: int) -> Words:
        """As ``Link.read``; an address that no request can hold is a mistake."""
        telegram.Request(address, number).question(1, 1)
        places = np.arange(self._next, self._next + number) % len(self._words)
        self._next += number
        return self._words[places]


@cache
def _settings() -> ModbusSettings:
    found = settings_of(CONFIG)
    assert isinstance(found, ModbusSettings)
    return found


def ring(data: bytes) -> str:
    """The trace over Modbus."""
    ticks = count(step=5_000_000)  # so that a fetch is over soon
    clock = Clock(lambda: 0, lambda: next(ticks), lambda _seconds: None)
    trace, rows = Trace(_settings(), clock), 0
    link = Served(data)
    trace._header = trace.start(link)  # type: ignore[arg-type]
    for _ in range(DEPTH_BLOCKS):
        rows += len(trace._read(link))  # type: ignore[arg-type]
    return f"{rows} rows"


def values(data: bytes) -> str:
    """A value over OPC UA, as each kind that a node may be asked for."""
    refuse_null_arrays()
    try:
        value = from_binary(ua.DataValue, Buffer(data))
    except Exception as error:  # the library's; the link makes a lost connection of it
        return type(error).__name__
    kinds: list[Callable[[ua.DataValue, Node], object]] = [
        opcua_values.number,
        opcua_values.whole,
        opcua_values.moment,
        opcua_values.numbers,
        opcua_values.wholes,
    ]
    taken = ""
    for kind in kinds:
        try:
            kind(value, NODE)
            taken += kind.__name__ + " "
        except SourceError:
            continue
    opcua_values.quality(opcua_values.code_of(value))
    opcua_values.time_ns(value)
    return taken


def log(data: bytes) -> str:
    """A log."""
    with tempfile.NamedTemporaryFile(suffix=".mcap") as file:
        file.write(data)
        file.flush()
        opened = open_log(Path(file.name))
        rows = sum(len(samples) for samples, _ in opened.blocks(1000))
        return f"{rows} rows, {len(list(opened.events()))} events"


def _seeds() -> dict[str, list[bytes]]:
    numbers = [
        ua.Variant(1.5, ua.VariantType.Double),
        ua.Variant([1, 2, 3], ua.VariantType.UInt32, None, True),
        ua.Variant(datetime(2026, 1, 1, tzinfo=UTC), ua.VariantType.DateTime),
    ]
    return {
        "ring": [HEADER + RECORDS, HEADER],
        "values": [to_binary(ua.DataValue, ua.DataValue(one)) for one in numbers],
        "log": [b"\x89MCAP0\r\n" + bytes(40), _small_log()],
    }


def _small_log() -> bytes:
    """A whole log of a few rows and an event."""
    rows, ticks = np.zeros(30, SAMPLE), np.zeros(30, TICK)
    rows["sequence"] = range(30)
    rows["time_ns"] = rows["host_ns"] = 10**18 + rows["sequence"] * 1_000_000
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        with Recorder(path, LogHeader("type", "id", "a.toml", "[data]\n")) as recorder:
            recorder.write(rows, ticks, [Event(10**18, Kind.GAP, "gap", {"missing": 1})])
        return path.read_bytes()


TARGETS: dict[str, Callable[[bytes], str]] = {"ring": ring, "values": values, "log": log}


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


def fuzz(
    name: str,
    inputs: int,
    corpus: Path,
    seed: int,
    say: Callable[[int], None] = lambda _number: None,
) -> list[str]:
    """Try so many; gives what was found, with the files that show it. ``say`` hears how far."""
    target, random = TARGETS[name], np.random.default_rng(seed)
    folder = corpus / name
    folder.mkdir(parents=True, exist_ok=True)
    kept = _seeds()[name] + [path.read_bytes() for path in sorted(folder.iterdir())]
    outcomes, found = set[str](), list[str]()
    for number in range(inputs + len(kept)):
        data = (
            kept[number]
            if number < len(kept)
            else changed(kept[int(random.integers(len(kept)))], kept, random)
        )
        if number % TOLD == 0:
            say(number)
        wrong, begun = False, time.monotonic()
        try:
            outcome = target(data)
        except TwinError as error:
            outcome = str(error)
        except Exception as error:  # what is looked for
            outcome, wrong = f"{type(error).__name__}: {error}", True
        if (seconds := time.monotonic() - begun) > LONGEST_S:
            outcome, wrong = f"took {seconds:.0f} s: {outcome}", True
        outcome = re.sub(r"/\S+|-?\d+", "", outcome)
        if outcome not in outcomes:
            outcomes.add(outcome)
            path = folder / sha256(data).hexdigest()[:16]
            path.write_bytes(data)
            kept.append(data)
            if wrong:
                found.append(f"{path}: {outcome}")
    return found


def _tried(name: str, inputs: int, corpus: Path, seed: int) -> dict[str, object]:
    """What came of it, for people."""
    begun, done = time.monotonic(), 0

    def say(number: int) -> None:
        nonlocal done
        done = number
        if sys.stderr.isatty():
            print(f"\r{name}: {number:,} of {inputs:,}", end="", file=sys.stderr, flush=True)

    try:
        found = fuzz(name, inputs, corpus, seed, say)
        done = inputs
    except KeyboardInterrupt:
        found = ["interrupted: what was found until then is in the corpus"]
    speed = round(done / (time.monotonic() - begun))
    return {"inputs": done, "inputs_per_s": speed, "found": found}


def main() -> int:
    """Run from the command line; 1 if anything was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", type=int, default=100_000, help="of each target")
    parser.add_argument("--corpus", type=Path, default=CORPUS)
    parser.add_argument("--target", choices=sorted(TARGETS), action="append")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    answer: dict[str, dict[str, object]] = {}
    for name in given.target or TARGETS:
        answer[name] = _tried(name, given.inputs, given.corpus, given.seed)
    print(json.dumps(answer, indent=1))
    return 1 if any(one["found"] for one in answer.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
