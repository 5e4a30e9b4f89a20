# SPDX-License-Identifier: Apache-2.0
"""Recordings spoilt at random: no crash, and with checksums nothing that is wrong and not said."""

from __future__ import annotations

import warnings

from marks import slow
from mutations import CHECKED, FORMATS, bit_flipped, outcome_of, run, what_it_gives, zeroed
import numpy as np
import pytest

LIBRARIES = {'ULog': 'pyulog', 'ArduPilot': 'pymavlink', 'Parquet': 'pyarrow'}


@pytest.mark.parametrize('count', [8, *slow(400)])
@pytest.mark.parametrize('kind', [*FORMATS, 'message'])
def test_spoilt_recordings_give_messages_or_a_reason(kind, count):
    """Many more by `python test/mutations.py`."""
    if kind in LIBRARIES:
        pytest.importorskip(LIBRARIES[kind])
    failed = []
    with warnings.catch_warnings():
        outcome = run(count, 5, [kind], lambda name, number, spoilt: failed.append(number))
    assert failed == []
    assert outcome[kind].total() == count


@pytest.mark.parametrize(('flips', 'blocks'), [(60, 20), *slow((700, 170))])
@pytest.mark.parametrize('kind', ['zstd', *slow('lz4', 'none')])
def test_with_checksums_nothing_is_wrong_or_missing_and_not_said(tmp_path, kind, flips, blocks):
    """Bits that are others, and blocks of zeros, anywhere in the file, its summary included."""
    path = CHECKED[kind](tmp_path)
    data, sound = path.read_bytes(), what_it_gives(path)
    rng = np.random.default_rng(8)
    spoilt = [bit_flipped(data, rng) for _ in range(flips)] + [
        zeroed(data, rng) for _ in range(blocks)]
    found = [outcome_of(path, one, sound) for one in spoilt]
    assert found.count('silent') == 0
    assert found.count('said') > 0.6 * flips
