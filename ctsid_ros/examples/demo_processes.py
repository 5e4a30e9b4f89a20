# SPDX-License-Identifier: Apache-2.0
"""The processes of the live demonstration."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import signal
from signal import SIGINT, SIGTERM
import subprocess
import sys
import tempfile
from types import FrameType

_PATIENCE = 5.0  # time for a process to end by itself [s]
_LOG_LINES = 15  # of each process, shown if something goes wrong


class Processes:
    """
    The programs of the demonstration; each writes its output into a file.

    Attributes
    ----------
    interrupted : bool
        Whether SIGINT or SIGTERM has come: it is time to end.
    """

    def __init__(self, folder: Path) -> None:
        self.interrupted = False
        self._folder = folder
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, module: str, *arguments: str) -> None:
        """Start a program of this package with ROS arguments."""
        with open(self._log(module), 'wb') as log:
            self._running[module] = subprocess.Popen(
                [sys.executable, '-m', module, '--ros-args', *arguments], stdout=log, stderr=log,
                start_new_session=True)  # an interrupt reaches us, and we end them in order

    def ended(self) -> list[str]:
        """Return those that have ended by themselves."""
        return [name for name, process in self._running.items() if process.poll() is not None]

    def stop(self) -> list[str]:
        """End all, the last started first; return those that did not end cleanly."""
        unclean = []
        for name, process in reversed(self._running.items()):
            process.terminate()
            try:
                code = process.wait(_PATIENCE)
            except subprocess.TimeoutExpired:
                process.kill()
                code = process.wait()
            unclean += [f'{name} ended with {code}'] if code else []
        self._running.clear()
        return unclean

    def logs(self) -> str:
        """Return the ends of what the programs have written."""
        return '\n'.join(
            f'--- {path.name}\n' + '\n'.join(path.read_text(errors='replace').splitlines()
                                             [-_LOG_LINES:])
            for path in sorted(self._folder.glob('*.log')))

    def _log(self, module: str) -> Path:
        return self._folder / f'{module.rpartition(".")[2]}.log'


@contextmanager
def processes() -> Iterator[Processes]:
    """
    Keep processes for as long as the context lasts; their logs go with it.

    Signals are only noted: an exception while a process is started would lose track of it.
    """
    with tempfile.TemporaryDirectory(prefix='ctsid_demo_') as folder:
        os.environ['ROS_LOG_DIR'] = f'{folder}/ros'
        started = Processes(Path(folder))

        def note(number: int, frame: FrameType | None) -> None:
            started.interrupted = True

        before = {number: signal.signal(number, note) for number in (SIGINT, SIGTERM)}
        try:
            yield started
        finally:
            started.stop()
            for number, handler in before.items():
                signal.signal(number, handler)
