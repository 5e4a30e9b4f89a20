# SPDX-License-Identifier: Apache-2.0
"""Small recordings of a simulated robot as autopilots and tables hold them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
import struct

import numpy as np
from plants import held_response, plant

from ctsid_ros.errors import BagError
from ctsid_ros.recordings.bag import open_bag


def ulog_message(kind: str, payload: bytes) -> bytes:
    """One message of a ULog: size, kind, content."""
    return struct.pack('<HB', len(payload), ord(kind)) + payload


class ULogWriter:
    """A ULog by its public description, https://docs.px4.io/main/en/dev_log/ulog_file_format."""

    def __init__(self, start_us: int = 1_000_000) -> None:
        self.content = b'ULog\x01\x12\x35\x01' + struct.pack('<Q', start_us)
        self.content += ulog_message('B', bytes(40))
        self.definitions: list[bytes] = []
        self.messages: list[tuple[int, bytes]] = []
        self.subscribed = b''
        self.count = 0

    def format(self, name: str, fields: str) -> None:
        self.definitions.append(ulog_message('F', f'{name}:{fields}'.encode()))

    def subscribe(self, name: str, multi_id: int = 0) -> int:
        number, self.count = self.count, self.count + 1
        self.subscribed += ulog_message('A', struct.pack('<BH', multi_id, number) + name.encode())
        return number

    def data(self, number: int, time_us: int, *packed: bytes) -> None:
        self.messages.append((time_us, ulog_message(
            'D', struct.pack('<HQ', number, time_us) + b''.join(packed))))

    def dropout(self, time_us: int, milliseconds: int) -> None:
        self.messages.append((time_us, ulog_message('O', struct.pack('<H', milliseconds))))

    def sync(self, time_us: int) -> None:
        """What a reader looks for behind a damaged place; PX4 writes it twice a second."""
        self.messages.append((time_us, ulog_message('S', bytes.fromhex('2f731320250cbb12'))))

    def bytes(self) -> bytes:
        ordered = sorted(self.messages, key=lambda pair: pair[0])
        return b''.join([self.content, *self.definitions, self.subscribed,
                         *(message for _, message in ordered)])


def write_ulog(path: Path, t_u, u, t_y, y) -> Path:
    """A torque setpoint and an angular velocity with its padding, as PX4 logs them."""
    log = ULogWriter()
    log.format('vehicle_torque_setpoint', 'uint64_t timestamp;uint64_t timestamp_sample;'
               'float[3] xyz;')
    log.format('vehicle_angular_velocity', 'uint64_t timestamp;uint64_t timestamp_sample;'
               'float[3] xyz;float[3] xyz_derivative;uint8_t[4] _padding0;')
    log.format('esc_report', 'uint64_t timestamp;int16_t rpm;bool armed;uint8_t[5] _padding0;')
    log.format('esc_status', 'uint64_t timestamp;esc_report[2] esc;uint8_t count;char[4] label;')
    torque, rate = (log.subscribe(name) for name in ('vehicle_torque_setpoint',
                                                     'vehicle_angular_velocity'))
    second = log.subscribe('vehicle_angular_velocity', 1)
    esc = log.subscribe('esc_status')
    for t, value in zip(t_u, u, strict=True):
        us = round(t * 1e6)
        log.data(torque, us, struct.pack('<Q3f', us - 500, value, 0.0, 0.0))
    for i, (t, value) in enumerate(zip(t_y, y, strict=True)):
        us = round(t * 1e6)
        # Stamped with the sampling, published 2 ms later. Padding at the end is not written.
        log.data(rate, us + 2000, struct.pack('<Q6f', us, value, 0.1, 0.2, 0.0, 0.0, 0.0))
        if i % 4 == 0:
            log.data(second, us + 2000, struct.pack('<Q6f', us, value, 0.1, 0.2, 0, 0, 0))
            report = struct.pack('<Qh?5x', us, 1000 + i, True)
            log.data(esc, us + 2000, report + report + struct.pack('<B4s', i % 200, b'left'))
    for time in np.arange(t_u[0], t_u[-1], 0.5):
        log.sync(round(time * 1e6))
    path.write_bytes(log.bytes())
    return path


def write_px4_log(path: Path, seed: int = 0, seconds: float = 40.0, axis: int = 0) -> Path:
    """
    A hover of a PX4 multicopter in which one axis is excited.

    Each axis turns by its torque (gain 20, lag of 0.05 s) under a rate loop, whose gyro is noisy.
    A takeoff moves thrust, battery and height once; the heading that is wanted follows the one
    that is measured; motors mix all torques.
    """
    rng, step = np.random.default_rng(seed), 0.004
    time = np.arange(0.0, seconds, step)
    count = len(time)
    up = 1.0 / (1.0 + np.exp(-(time - 6.0) / 0.5))
    wish = np.zeros((count, 3))
    wish[:, axis] = np.repeat(rng.choice([-0.6, 0.6], count // 100 + 1), 100)[:count] * (time > 10)
    torque, rate, seen = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 3))
    acting = np.zeros(3)
    gusts = 0.5 * rng.standard_normal((count, 3))
    for k in range(1, count):
        acting += step / 0.05 * (torque[k - 1] - acting)
        rate[k] = rate[k - 1] + step * (20.0 * acting - 0.5 * rate[k - 1] + gusts[k])
        seen[k] = rate[k] + 0.02 * rng.standard_normal(3)
        torque[k] = 0.15 * (wish[k] - seen[k])
    angle = np.cumsum(rate, axis=0) * step
    height = np.cumsum(up) * step * (time < 9) + (np.cumsum(up * (time < 9)) * step) * (time >= 9)
    thrust = -0.2 - 0.5 * up + 0.01 * rng.standard_normal(count)
    heading = np.repeat(angle[::50, 2], 50)[:count]
    motors = 0.5 * up[:, None] + torque @ rng.choice([-1.0, 1.0], (3, 4))
    log = ULogWriter()
    streams = {  # topic: fields, period [ticks], values
        'actuator_motors': ('float[4] control', 5, motors),
        'battery_status': ('float voltage_v;float current_a', 50, np.column_stack(
            [16.0 - 0.5 * up, 20.0 * up + 0.1 * rng.standard_normal(count)])),
        'cpuload': ('float load', 125, 0.3 + 0.1 * up[:, None] + 0.01 * rng.standard_normal(
            (count, 1))),
        'control_allocator_status': ('float[3] unallocated_thrust', 50, np.column_stack(
            [0.0 * up, 0.0 * up, np.where(up < 0.1, thrust, 0.0)])),
        'estimator_states': ('float[4] states', 250, np.column_stack(
            [angle, height + 0.05 * rng.standard_normal(count)])),
        'sensor_combined': ('float[3] gyro_rad;float[3] accelerometer_m_s2', 1, np.column_stack(
            [seen, rng.standard_normal((count, 2)), -9.8 + rng.standard_normal(count)])),
        'trajectory_setpoint': ('float[3] acceleration', 50, np.column_stack(
            [rng.standard_normal((count, 2)), up * (time < 9)])),
        'vehicle_angular_velocity': ('float[3] xyz', 2, seen),
        'vehicle_attitude': ('float[4] q', 5, np.column_stack(
            [np.cos(angle[:, 2] / 2), angle[:, 0] / 2, angle[:, 1] / 2,
             np.sin(angle[:, 2] / 2)])),
        'vehicle_attitude_setpoint': ('float yaw_body;float[3] thrust_body', 5, np.column_stack(
            [heading, 0.0 * up, 0.0 * up, thrust])),
        'vehicle_gps_position': ('float altitude_ellipsoid_m;float vel_d_m_s', 13,
                                 np.column_stack([height, -np.gradient(height, step)])),
        'vehicle_rates_setpoint': ('float roll;float pitch;float yaw', 5, wish),
        'vehicle_torque_setpoint': ('float[3] xyz', 2, torque)}
    for name, (fields, _, _) in streams.items():
        log.format(name, f'uint64_t timestamp;{fields};')
    for name, (_, period, values) in streams.items():
        number = log.subscribe(name)
        for k in range(0, count, period):
            log.data(number, 1_000_000 + round(time[k] * 1e6) + rng.integers(200),
                     np.asarray(values[k], '<f4').tobytes())
    path.write_bytes(log.bytes())
    return path


def dataflash(number: int, packed: bytes) -> bytes:
    """One message of an ArduPilot log."""
    return struct.pack('<BBB', 0xA3, 0x95, number) + packed


def dataflash_format(number: int, name: str, letters: str, columns: str, size: int) -> bytes:
    """The description of a message."""
    return dataflash(0x80, struct.pack('<BB4s16s64s', number, size + 3, name.encode(),
                                       letters.encode(), columns.encode()))


def write_ardupilot(path: Path, t_u, u, t_y, y) -> Path:
    """Motor commands (in hundredths), two gyros as instances of one message, a text."""
    parts = [dataflash_format(0x80, 'FMT', 'BBnNZ', 'Type,Length,Name,Format,Columns', 86),
             dataflash_format(1, 'FMTU', 'QBNN', 'TimeUS,FmtType,UnitIds,MultIds', 41),
             dataflash_format(2, 'RCOU', 'Qc', 'TimeUS,C1', 10),
             dataflash_format(3, 'IMU', 'QBff', 'TimeUS,I,GyrX,GyrY', 17),
             dataflash_format(4, 'MSG', 'QZ', 'TimeUS,Message', 72),
             dataflash(1, struct.pack('<QB16s16s', 1_000_000, 3, b's#EE', b'F-00')),
             dataflash(4, struct.pack('<Q64s', 1_000_000, b'hello'))]
    messages = [(t, dataflash(2, struct.pack('<Qh', round(t * 1e6), round(100 * value))))
                for t, value in zip(t_u, u, strict=True)]
    for t, value in zip(t_y, y, strict=True):
        messages += [(t, dataflash(3, struct.pack('<QBff', round(t * 1e6), i, value + i, 0.5)))
                     for i in range(2)]
    path.write_bytes(b''.join([*parts, *(m for _, m in sorted(messages, key=lambda p: p[0]))]))
    return path


def write_csv(path: Path, columns: Mapping[str, Sequence[object]], separator: str = ',',
              **form) -> Path:
    """A table; columns that are shorter end with empty cells."""
    length = max(map(len, columns.values()))
    rows = [[str(values[i]) if i < len(values) else '' for values in columns.values()]
            for i in range(length)]
    lines = [separator.join(columns), *(separator.join(row) for row in rows)]
    path.write_text('\n'.join(lines) + '\n', **form)
    return path


def flight(seconds: float = 20.0, start: float = 10.0, seed: int = 0):
    """Stamps and values of a command and of what it does: a pole at -3, gain 2, noise of 1 %."""
    rng = np.random.default_rng(seed)
    t_u = np.arange(0.0, seconds, 0.05)
    u = np.repeat(rng.choice([-1.0, 1.0], len(t_u) // 8 + 1), 8)[:len(t_u)]
    t_y = np.arange(0.002, seconds - 0.01, 0.01) + rng.uniform(0.0, 0.002, size=len(
        np.arange(0.002, seconds - 0.01, 0.01)))
    t_y = np.round(t_y, 6)
    y = held_response(plant([[-3.0]], [[6.0]], [[1.0]]), t_u, u[:, None], t_y)[:, 0]
    y += 0.01 * rng.standard_normal(len(y))
    return t_u + start, u, t_y + start, y


def samples_read(path: Path) -> int:
    """Return how many samples a damaged file gives; 0 if it is refused, by its name."""
    try:
        with open_bag(path) as bag:
            return sum(len(block) for topic in bag.topics
                       for block in bag.blocks({topic: bag.scalar_fields(topic)}))
    except BagError as error:
        assert str(path) in str(error)
        return 0
