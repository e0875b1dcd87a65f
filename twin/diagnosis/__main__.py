"""A diagnosis in a process of its own: the question on stdin, the answer as JSON on stdout."""

import json
import pickle
import sys

from twin.diagnosis.answer import diagnose
from twin.errors import TwinError


def main() -> None:
    """Answer; an error is one line on stderr and exit code 1."""
    config, samples, log = pickle.load(sys.stdin.buffer)  # noqa: S301  # from process.Asked
    try:
        answer = diagnose(config, [samples], log, lambda _what: None).json
    except TwinError as error:
        sys.exit(str(error))
    json.dump(answer, sys.stdout)


if __name__ == "__main__":
    main()
