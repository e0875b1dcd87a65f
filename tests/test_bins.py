"""Bins: means over rows, and over lines between the rows that were drawn."""

import numpy as np

from twin.monitor.bins import binned, sparse
from twin.signals import Phase


def test_a_mean_of_lines_is_that_of_every_row_on_them() -> None:
    phase = np.repeat([Phase.IDLE, Phase.SUCTION, Phase.HOLD], [300, 900, 800]).astype(np.uint8)
    usable = np.random.default_rng(1).random(len(phase)) < 0.9
    bins = binned(phase, usable, np.zeros(1, np.int64))
    kept = sparse(np.diff(phase, prepend=255) != 0)
    values = np.random.default_rng(2).normal(size=(len(kept), 3))
    rows = [np.interp(np.arange(len(phase)), kept, column) for column in values.T]
    np.testing.assert_allclose(bins.through(kept, values), bins.mean(np.stack(rows, axis=1)))


def test_what_is_not_known_beside_a_bin_does_not_spoil_its_mean() -> None:
    phase = np.full(60, Phase.IDLE, np.uint8)
    usable = np.arange(60) >= 30
    bins = binned(phase, usable, np.zeros(1, np.int64))
    kept = np.array([0, 29, 30, 59])
    values = np.array([[np.nan], [np.nan], [1.0], [1.0]])
    np.testing.assert_allclose(bins.through(kept, values), 1.0)
