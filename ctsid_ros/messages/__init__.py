# SPDX-License-Identifier: Apache-2.0
"""What the node publishes, as messages and back: the names that users import."""

from ctsid_ros.messages.health import Health, Level, decode_diagnostics, encode_diagnostics
from ctsid_ros.messages.matrices import (
    Eigenvalues,
    Matrices,
    decode_eigenvalues,
    decode_matrix,
    decode_system_matrix,
    encode_eigenvalues,
    encode_matrices,
    encode_matrix,
    encode_system_matrix,
)
from ctsid_ros.messages.models import decode_metadata, decode_model, encode_model, provenance
from ctsid_ros.messages.summary import encode_summary

__all__ = ['Eigenvalues', 'Health', 'Level', 'Matrices', 'decode_diagnostics',
           'decode_eigenvalues', 'decode_matrix', 'decode_metadata', 'decode_model',
           'decode_system_matrix', 'encode_diagnostics', 'encode_eigenvalues',
           'encode_matrices', 'encode_matrix', 'encode_model', 'encode_summary',
           'encode_system_matrix', 'provenance']
