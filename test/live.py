# SPDX-License-Identifier: Apache-2.0
"""
Real processes and real DDS on loopback: what the tests of the node have in common.

The identifier runs as a process of its own; the test publishes to it and listens to it with a
node in a context of its own, which a thread spins. Everything that was started is ended by its
process id, and what it printed is shown when the test fails.

Nothing here depends on how busy the computer is: what is waited for is an event, and patience
ends long after it is certain that it will not come.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
import os
from pathlib import Path
import signal
import subprocess
import sys
from threading import Thread
import time

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import GetParameterTypes, SetParametersAtomically
import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger

from ctsid_core.model.estimate import Estimate
from ctsid_ros.examples.domain import claim_domain
from ctsid_ros.messages import Health, decode_diagnostics, decode_metadata, decode_model

ROOT = Path(__file__).resolve().parent.parent
PATIENCE = 180.0  # s; discovery takes 0.02 s to 3 s
MATRICES = ('system_matrix', 'a', 'b', 'c', 'd', 'k', 'eigenvalues')
LATCHED = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
DEEP = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.RELIABLE)
TRANSITIONS = {'configure': 1, 'cleanup': 2, 'activate': 3, 'deactivate': 4}


class Program:
    """A process and what it prints."""

    def __init__(self, arguments, path: Path, env: dict[str, str]) -> None:
        self._path = path
        with open(path, 'wb') as out:
            self.process = subprocess.Popen([sys.executable, *map(str, arguments)], stdout=out,
                                            stderr=subprocess.STDOUT, env=env)

    @property
    def log(self) -> str:
        return self._path.read_text(encoding='utf-8', errors='replace')

    @property
    def alive(self) -> bool:
        return self.process.poll() is None

    def end(self, number: int = signal.SIGTERM) -> tuple[int, float]:
        """Return exit code and the time it took to end [s], see `seconds_until`."""
        self.process.send_signal(number)
        seconds = seconds_until(lambda: not self.alive, f'the end of {self.process.args}')
        return self.process.wait(0.0), seconds

    def memory(self) -> int:
        """Return the resident memory [bytes]."""
        words = Path(f'/proc/{self.process.pid}/statm').read_text(encoding='ascii').split()
        return int(words[1]) * os.sysconf('SC_PAGE_SIZE')

    def threads(self) -> int:
        return len(os.listdir(f'/proc/{self.process.pid}/task'))


class Live:
    """A ROS domain of its own, for one test."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.programs, self._clients = folder, [], {}
        self.domain, self._claim = claim_domain()
        self.env = os.environ | {
            'ROS_DOMAIN_ID': str(self.domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            'OPENBLAS_NUM_THREADS': '1', 'PYTHONUNBUFFERED': '1', 'PYTHONPATH': str(ROOT),
            'ROS_LOG_DIR': str(folder)}
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        self._context = Context()
        rclpy.init(context=self._context, domain_id=self.domain, args=[])
        self.node = Node('test', context=self._context, start_parameter_services=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = Thread(target=self._spin, daemon=True)
        self._thread.start()

    def __enter__(self) -> Live:
        return self

    def __exit__(self, *_: object) -> None:
        for program in self.programs:
            if program.alive:
                program.process.kill()
                program.process.wait()
            print(f'--- {" ".join(program.process.args[1:4])}\n{program.log}')
        self._executor.shutdown()
        self._thread.join()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)
        self._claim.close()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            self._executor.spin()

    def start(self, *arguments) -> Program:
        """Start a Python program in this domain."""
        path = self.folder / f'program{len(self.programs)}.log'
        self.programs.append(Program(arguments, path, self.env))
        return self.programs[-1]

    def identifier(self, text: str, *ros_arguments: str, name: str = '/identifier',
                   module: str = 'ctsid_ros.node') -> Identifier:
        """Start the node with a parameter file; name is its full name after remapping."""
        path = self.folder / f'params{len(self.programs)}.yaml'
        path.write_text(text, encoding='utf-8')
        program = self.start('-m', module, '--ros-args', '--params-file', path, *ros_arguments)
        return Identifier(self, program, name)

    def listen(self, kind, topic: str, qos=LATCHED) -> list:
        """Subscribe; return the list into which the messages come."""
        found: list = []
        self.node.create_subscription(kind, topic, found.append, qos)
        return found

    def publishers(self, kinds: Mapping[str, type], qos, *readers: str) -> list:
        """Return a publisher for each topic, which the nodes that are named hear from now on."""
        made = [self.node.create_publisher(kind, topic, qos) for topic, kind in kinds.items()]
        if readers:
            self.wait(lambda: all(p.get_subscription_count() >= len(readers) for p in made),
                      f'{readers} to subscribe to {[*kinds]}')
        for name in readers:
            self.meet(name)
        return made

    def meet(self, name: str) -> None:
        """Wait until a node knows everything that ours has."""
        meet(self.node, name, self.wait)

    def wait(self, condition: Callable[[], object], what: str):
        """Return what the condition returns once it is true."""
        return wait(condition, what)

    def call(self, kind, name: str, request):
        """Call a service; return its answer."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, name)
            self.wait(self._clients[name].service_is_ready, f'the service {name}')
            self.meet(name.rpartition('/')[0])
        future = self._clients[name].call_async(request)
        self.wait(future.done, f'an answer of {name}')
        return future.result()


class Identifier:
    """The node under test, as others see it."""

    def __init__(self, live: Live, program: Program, name: str) -> None:
        self._live, self.program, self.name = live, program, name
        self.models: list[String] = live.listen(String, f'{name}/model')
        self.matrices = {topic: live.listen(Float64MultiArray, f'{name}/{topic}')
                         for topic in MATRICES}
        self.summaries: list[DiagnosticArray] = live.listen(DiagnosticArray, f'{name}/summary')
        self._estimates: list[Estimate] = []  # what is decoded of the models
        self._said: list[Health] = []
        live.node.create_subscription(
            DiagnosticArray, '/diagnostics',
            lambda message: self._said.extend(decode_diagnostics(message)[1]), RELIABLE)

    @property
    def log(self) -> str:
        return self.program.log

    def estimates(self) -> list[Estimate]:
        for message in self.models[len(self._estimates):]:
            self._estimates.append(decode_model(message))
        return list(self._estimates)

    def accepted(self) -> list[Estimate]:
        return [estimate for estimate in self.estimates() if estimate.ok]

    def metadata(self) -> list[dict]:
        return [decode_metadata(message) for message in list(self.models)]

    def wait_models(self, count: int) -> list[Estimate]:
        self._live.wait(lambda: len(self.models) >= count, f'{count} models of {self.name}')
        return self.estimates()

    def health(self, part: str) -> list[Health]:
        """Return all that was said on 'ingest' or 'identification'."""
        return [health for health in list(self._said) if health.name == f'{self.name}: {part}']

    def wait_health(self, part: str, condition: Callable[[Health], object], what: str) -> Health:
        """Wait until the newest word on a part is as wanted; return it."""
        self._live.wait(lambda: (said := self.health(part)) and condition(said[-1]),
                        f'{what} in diagnostics')
        return self.health(part)[-1]

    def next_health(self, part: str) -> Health:
        """Return what is said from now on."""
        seen = len(self.health(part)) + 1  # one may be under way
        self._live.wait(lambda: len(self.health(part)) > seen, 'diagnostics')
        return self.health(part)[-1]

    def trigger(self, service: str) -> tuple[bool, str]:
        answer = self._live.call(Trigger, f'{self.name}/{service}', Trigger.Request())
        return answer.success, answer.message

    def set(self, **values: object) -> str:
        """Set parameters, `__` for a dot; return what is said against it."""
        request = SetParametersAtomically.Request(parameters=[
            ParameterMessage(name=name, value=Parameter(name, value=value).get_parameter_value())
            for name, value in ((k.replace('__', '.'), v) for k, v in values.items())])
        result = self._live.call(SetParametersAtomically,
                                 f'{self.name}/set_parameters_atomically', request).result
        assert result.successful == (not result.reason)
        return result.reason

    def change_state(self, transition: str) -> bool:
        request = ChangeState.Request()
        request.transition.id = TRANSITIONS[transition]
        return self._live.call(ChangeState, f'{self.name}/change_state', request).success

    def state(self) -> str:
        return self._live.call(GetState, f'{self.name}/get_state',
                               GetState.Request()).current_state.label

    def wait_state(self, label: str) -> None:
        self._live.wait(lambda: self.state() == label, f'the state {label}')


def wait(condition: Callable[[], object], what: str, between: Callable[[], object] | None = None):
    """Return what the condition returns once it is true; between two questions it sleeps."""
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        if time.monotonic() > end:
            raise AssertionError(f'waited {PATIENCE:g} s in vain for {what}')
        between() if between else time.sleep(0.01)
    return found


def seconds_until(condition: Callable[[], object], what: str) -> float:
    """
    Return how long it takes until a condition is true [s].

    It is the processor time that a loop beside it has: on a computer that does nothing else the
    time that passes, on a busy one its share of that.
    """
    start = time.thread_time()
    wait(condition, what, lambda: None)
    return time.thread_time() - start


def meet(node: Node, name: str, wait: Callable[[Callable[[], object], str], object]) -> None:
    """
    Wait until another node knows all publishers, subscriptions and clients that ours has.

    They are announced in the order in which they were made: who answers a client that was made
    last has heard of all. An answer may be lost while the client is being heard of.
    """
    client = node.create_client(GetParameterTypes, f'{name}/get_parameter_types')
    wait(client.service_is_ready, f'the services of {name}')
    asked: list = []

    def answered() -> bool:
        if len(asked) * 0.5 < time.monotonic() - start:
            asked.append(client.call_async(GetParameterTypes.Request()))
        return any(future.done() for future in asked)

    start = time.monotonic()
    wait(answered, f'an answer of {name}')
