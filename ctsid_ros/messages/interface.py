# SPDX-License-Identifier: Apache-2.0
"""The topics and services of the node as it declares them: what `docs/topics.md` is made of."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple


class Topic(NamedTuple):
    """
    A topic that the node publishes.

    Parameters
    ----------
    type : str
        Of its messages.
    when : str
        When it is published.
    meaning : str
        What is in it.
    """

    type: str
    when: str
    meaning: str


_WINDOW, _GOOD = 'for every window, accepted or not', 'for GOOD models'
_MATRIX = 'std_msgs/msg/Float64MultiArray'

# Names below that of the node. Latched: reliable, transient local, depth 1.
OUTPUTS: Mapping[str, Topic] = {
    'model': Topic('std_msgs/msg/String', _WINDOW,
                   'Everything, as JSON: model, deviations, fits, verdict, window, channels.'),
    'summary': Topic('diagnostic_msgs/msg/DiagnosticArray', _WINDOW,
                     'Verdict, fits [%] and poles [rad/s] by name, to be plotted; its stamp is '
                     'the end of the window.'),
    'system_matrix': Topic(_MATRIX, _GOOD, '[A B K; C D I], labelled x:n,y:ny by x:n,u:nu,y:ny.'),
    'a': Topic(_MATRIX, _GOOD, 'A, labelled x:n by x:n.'),
    'b': Topic(_MATRIX, _GOOD, 'B, labelled x:n by u:nu.'),
    'c': Topic(_MATRIX, _GOOD, 'C, labelled y:ny by x:n.'),
    'd': Topic(_MATRIX, _GOOD, 'D, labelled y:ny by u:nu.'),
    'k': Topic(_MATRIX, _GOOD, 'K, labelled x:n by y:ny.'),
    'eigenvalues': Topic(_MATRIX, _GOOD, 'One row per mode: re, im, natural frequency [rad/s], '
                                         'damping; rows are labelled mode 4,mode 7.'),
}

# Of the whole system, reliable and not latched.
DIAGNOSTICS = '/diagnostics'
SHARED: Mapping[str, Topic] = {
    DIAGNOSTICS: Topic('diagnostic_msgs/msg/DiagnosticArray', 'once a second',
                       'What ails the node now: ingest, and identification.'),
}

# std_srvs/srv/Trigger, below the name of the node.
SERVICES: Mapping[str, str] = {
    'identify': 'Identify the last window now, out of turn, unless a newer one is due first.',
    'reset': 'Forget data and models.',
    'save': 'Write the last accepted model to the folder save.folder, and tell its grade.',
}
