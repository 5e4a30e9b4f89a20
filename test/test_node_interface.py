# SPDX-License-Identifier: Apache-2.0
"""The running node has the topics and services that the documentation says it has."""

import pytest

pytest.importorskip('rclpy')
from live import Live  # noqa: E402
from robot import params  # noqa: E402

from ctsid_ros.messages.interface import OUTPUTS, SERVICES, SHARED  # noqa: E402


def test_topics_and_services_are_those_that_are_declared(tmp_path):
    with Live(tmp_path) as live:
        node = live.identifier(params('autostart: false\ningest.timeout: 60.0'))
        assert node.change_state('configure')
        declared = {f'{node.name}/{name}': [of.type] for name, of in OUTPUTS.items()} \
            | {name: [of.type] for name, of in SHARED.items()}

        def own() -> bool:
            found = dict(live.node.get_publisher_names_and_types_by_node('identifier', '/'))
            of_ros = {f'{node.name}/transition_event', '/parameter_events', '/rosout'}
            return {name: kinds for name, kinds in found.items() if name not in of_ros} == declared

        live.wait(own, 'the declared topics, and no others')

        def offered() -> set[str]:
            found = live.node.get_service_names_and_types_by_node('identifier', '/')
            return {name for name, kinds in found if kinds == ['std_srvs/srv/Trigger']}

        services = {f'{node.name}/{name}' for name in SERVICES}
        live.wait(lambda: offered() == services, 'the declared services, and no others')
        assert node.program.end()[0] == 0
