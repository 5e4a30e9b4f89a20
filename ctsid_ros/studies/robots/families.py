# SPDX-License-Identifier: Apache-2.0
"""All families of robots, and any experiment of theirs by its seed and number."""

from __future__ import annotations

from zlib import crc32

from ctsid_ros.studies.robots import (
    actuator_families,
    linear_families,
    loop_families,
    negatives,
    sensor_families,
)
from ctsid_ros.studies.robots.experiment import Experiment, generator, of_robot

FAMILIES = {**linear_families.FAMILIES, **actuator_families.FAMILIES, **sensor_families.FAMILIES,
            **loop_families.FAMILIES, **negatives.FAMILIES}


def experiment(family: str, seed: int, number: int) -> Experiment:
    """
    Return an experiment; the same for the same arguments.

    Parameters
    ----------
    family : str
        One of `FAMILIES`.
    seed : int
    number : int
        From 0; kinds of inputs take turns, beginning with another one in each family.
    """
    of = FAMILIES[family]
    kind = of.kinds[(number + crc32(family.encode())) % len(of.kinds)]
    if of.make:
        return of.make(family, kind, seed, number)
    assert of.build is not None
    robot = of.build(generator(family, seed, number, 0), kind)
    return of_robot(robot, family, kind, seed, number)
