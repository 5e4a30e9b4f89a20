# SPDX-License-Identifier: Apache-2.0
"""A model as YAML."""

from __future__ import annotations

from typing import Any

from ctsid_core.model.model_json import EQUATIONS
from ctsid_ros.export.content import Content, named


def yaml_document(content: Content) -> str:
    """Return the text: verdict, channels, matrices, poles with deviations; .nan is not known."""
    import yaml

    model, estimate = content.model, content.estimate
    document: dict[str, Any] = {
        'origin': content.origin, 'verdict': content.grade, 'reason': estimate.verdict.reason,
        'equations': EQUATIONS,
        'inputs': [{'name': name, 'unit': unit, 'delay': delay,
                    **{kind: value for kind, value in own._asdict().items() if value}}
                   for name, unit, delay, own in zip(
                       named(model.input_names, 'u'), model.input_units, model.delay,
                       model.actuators, strict=True)],
        'outputs': [{'name': name, 'unit': unit} for name, unit in zip(
            named(model.output_names, 'y'), model.output_units, strict=True)],
        **{name: getattr(model, name).tolist()
           for name in ('A', 'B', 'C', 'D', 'K', 'x_trim', 'y_trim')},
        'noise': None if model.noise is None else model.noise.tolist(),
        'poles': [{'re': pole.real, 'im': pole.imag} for pole in model.poles.tolist()],
        'pole_std': estimate.pole_std.tolist(), 'fit': estimate.fit.tolist()}
    text: str = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=99)
    return text
