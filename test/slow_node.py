# SPDX-License-Identifier: Apache-2.0
"""
The node with an identification that takes as long as the file SLOW_NODE_SECONDS says.

It asks whether it is cancelled every 5 ms, as `identify` promises, and says so if another runs
beside it; then the real one follows.
"""

import os
from pathlib import Path
import sys
from threading import Lock
import time

from ctsid_core.errors import Cancelled
from ctsid_core.sequence import tracking
from ctsid_ros.node.program import main

_real, _alone = tracking.identify, Lock()


def slowly(record, settings=None, *, cancelled=None):
    if not _alone.acquire(blocking=False):
        print('TWO AT ONCE', flush=True)
        os._exit(1)
    try:
        seconds = float(Path(os.environ['SLOW_NODE_SECONDS']).read_text(encoding='ascii'))
        print('begun', flush=True)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(0.005)
            if cancelled is not None and cancelled():
                print('cancelled', flush=True)
                raise Cancelled
        return _real(record, settings, cancelled=cancelled)
    finally:
        _alone.release()


if __name__ == '__main__':
    tracking.identify = slowly
    sys.exit(main())
