# SPDX-License-Identifier: Apache-2.0
"""`python -m ctsid_ros.node`."""

import sys

from ctsid_ros.node.program import main

sys.exit(main())
