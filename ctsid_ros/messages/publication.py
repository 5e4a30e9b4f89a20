# SPDX-License-Identifier: Apache-2.0
"""What is published for a window: by the node on its topics, and beside a replay in a bag."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ctsid_core.sequence.tracking import Tracked
from ctsid_ros.messages.interface import OUTPUTS
from ctsid_ros.messages.making import Make, ros_message
from ctsid_ros.messages.matrices import encode_eigenvalues, encode_matrices, encode_system_matrix
from ctsid_ros.messages.models import encode_model
from ctsid_ros.messages.summary import encode_summary

# Names below that of the node, and types.
TOPICS: Mapping[str, str] = {name: topic.type for name, topic in OUTPUTS.items()}


def messages_of(tracked: Tracked, metadata: Mapping[str, object], make: Make = ros_message
                ) -> dict[str, Any]:
    """
    Return the messages of a window by topic.

    Arrays of a GOOD model only: they cannot say how far they are to be trusted.

    Parameters
    ----------
    tracked : Tracked
    metadata : mapping
        Of the model, see `provenance`.
    make : Make
        What makes messages, see `messages.making`.
    """
    found = {'model': encode_model(tracked, metadata, make),
             'summary': encode_summary(tracked, make)}
    model = tracked.estimate.model
    if model is not None and tracked.estimate.good:
        found |= {'system_matrix': encode_system_matrix(model, make),
                  **encode_matrices(model, make),
                  'eigenvalues': encode_eigenvalues(tracked, make)}
    return found
