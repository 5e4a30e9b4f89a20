# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from ctsid_core.likelihood.spectral_peak import highest_peak


def white(rng, ny, count):
    return rng.standard_normal((ny, count)) + 1j * rng.standard_normal((ny, count))


@pytest.mark.parametrize(('ny', 'count'), [(1, 110), (3, 110), (1, 800), (4, 2000)])
def test_white_errors_alarm_as_rarely_as_they_should(ny, count):
    rng = np.random.default_rng(ny * count)
    scale = 10.0 ** np.arange(ny)[:, np.newaxis]                # outputs of any unit
    chances = [highest_peak(scale * white(rng, ny, count)).p_value for _ in range(2000)]
    assert np.mean(np.array(chances) < 0.1) < 0.12              # a bound, and three deviations
    assert np.mean(np.array(chances) < 0.01) < 0.017


def test_a_mode_shows_whether_narrow_or_broad():
    rng, w = np.random.default_rng(0), np.linspace(0.0, 60.0, 400)
    for pole in (-0.3 + 20.0j, -8.0 + 30.0j):
        shape = 1.0 + 40.0 / np.abs((1j * w - pole) / pole.real)
        peak = highest_peak(shape * white(rng, 2, 400))
        assert peak.p_value < 1e-12
        assert peak.ratio > 1.5


def test_few_lines_and_no_errors_are_no_fault():
    assert highest_peak(np.zeros((2, 5), dtype=complex)).p_value > 0.1
    assert 0.0 < highest_peak(white(np.random.default_rng(1), 1, 3)).p_value <= 1.0
