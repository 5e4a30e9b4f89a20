# SPDX-License-Identifier: Apache-2.0
"""A ROS domain that nobody else on this computer uses."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
import random
import socket

_CLAIMS = 42_000            # a process that has claimed domain d holds this port + d
_FIRST, _PER_DOMAIN = 7_410, 250    # of participants, by the standard of DDS (RTPS 2.5, 9.6.2)
_PARTICIPANTS = 10          # of a domain that are looked for, of two ports each
_DOMAINS = range(1, 101)    # above, ports are those of outgoing connections; 0 is everybody's


def claim_domain(domains: Sequence[int] = _DOMAINS) -> tuple[int, socket.socket]:
    """
    Return a domain in which nobody is, and what keeps others who ask here from it until closed.

    Raises
    ------
    OSError
        If all are in use.
    """
    for domain in random.sample(domains, len(domains)):
        if (claim := _bound(_CLAIMS + domain)) is None:
            continue
        if _empty(domain):
            return domain, claim
        claim.close()
    raise OSError('all ROS domains of this computer are in use; end some programs of ROS')


def _empty(domain: int) -> bool:
    first = _FIRST + _PER_DOMAIN * domain
    with ExitStack() as stack:
        for port in range(first, first + 2 * _PARTICIPANTS):
            if (free := _bound(port)) is None:
                return False
            stack.enter_context(free)
    return True


def _bound(port: int) -> socket.socket | None:
    """Return a socket that holds a port; None if somebody else does."""
    one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        one.bind(('', port))
    except OSError:
        one.close()
        return None
    return one
