# SPDX-License-Identifier: Apache-2.0
"""The node by the other methods: real messages, models near the truth, and the replay's bits."""

from marks import slow
import numpy as np
import pytest

pytest.importorskip('rclpy')
from live import Live  # noqa: E402
from plants import match  # noqa: E402
from robot import SOFT, Robot, motion, params  # noqa: E402

from ctsid_core.model.model_json import to_json  # noqa: E402
from ctsid_ros.config.parameter_file import read_config  # noqa: E402
from ctsid_ros.recordings.bag import open_bag  # noqa: E402
from ctsid_ros.replay.replay import Replay  # noqa: E402


@pytest.fixture
def live(tmp_path):
    with Live(tmp_path) as made:
        yield made


@pytest.mark.parametrize(('method', 'checker'), [
    *slow(('gobf', 'hd-pbsid'), ('gobf', 'none'), ('ct-pbsid', 'none'))])
def test_models_by_another_method_are_published_and_replayed(live, tmp_path, method, checker):
    path = tmp_path / 'flight.mcap'
    node = live.identifier(params(
        f"method: {method}\nvalidation.cross_check: {checker}\ningest.record: '{path}'\n"
        'ingest.timeout: 60.0'))
    Robot(live, motion(5.5), node.name).feed(node)
    estimates = node.wait_models(2)
    assert len(node.accepted()) == len(estimates)
    for estimate in estimates:
        assert estimate.settings.method == method
        found = match(estimate.model.poles, SOFT.poles)
        assert np.all(abs(found - SOFT.poles) < 0.1 * abs(SOFT.poles))
        agreement = estimate.verdict.agreement
        assert (agreement is None) == (checker == 'none')
        assert agreement is None or (agreement.agrees and agreement.method == checker)
    said = node.next_health('identification').values
    assert said.get('cross-check', '').startswith('hd-pbsid agrees') == (checker != 'none')
    assert said['skipped windows'] == '0'
    assert f"is '{method}', as `method` is" in node.set(validation__cross_check=method)
    assert node.program.end()[0] == 0
    with open_bag(path) as bag:
        replay = Replay(bag, read_config(tmp_path / 'params0.yaml'))
        replay.run()
    again = {r.estimate.end_ns: to_json(r.estimate) for r in replay.results}
    assert {e.end_ns: again.get(e.end_ns) for e in estimates} == {
        e.end_ns: to_json(e) for e in estimates}
