"""A writer in a process of its own: for each number that it reads it adds as many, telling ids."""

import itertools
import sys

import numpy as np

from twin.assets.database import open_assets
from twin.assets.record import Record

TYPE = "compact-ejector-35"


def main(url: str, unit: str) -> None:
    numbers = itertools.count()
    with open_assets(url, busy_s=60.0) as assets:
        say("ready")
        for line in sys.stdin:
            for number in itertools.islice(numbers, int(line)):
                data, arrays = {"number": number}, {"covariance": np.full((8, 8), number / 7)}
                say(assets.add(Record("instance", unit, TYPE, data, arrays=arrays)).id)


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
