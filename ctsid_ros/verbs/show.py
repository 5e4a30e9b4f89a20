# SPDX-License-Identifier: Apache-2.0
"""`ctsid show`: print a stored model, or several beside each other."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
import json
import math
from typing import TYPE_CHECKING, Any

from ctsid_ros.report.document import Section, to_text
from ctsid_ros.report.tables import Table
from ctsid_ros.verbs.arguments import (
    ACCEPTED,
    add_interval,
    add_params,
    add_results,
    add_style,
    date,
    model_file,
    tell,
)

if TYPE_CHECKING:
    from ctsid_core.model.estimate import Estimate
    from ctsid_core.model.statespace import StateSpace

HELP = 'show a stored model: poles, DC gain, frequency response; or several side by side'
EPILOG = """example: ctsid show results/demo/model.json
example: ctsid show results/monday results/tuesday --bag wednesday.mcap
         (several are drawn into one page, and compared on a bag if there is one)"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('model', nargs='+', metavar='MODEL',
                        help='a model.json, or a folder of results that has one')
    parser.add_argument('--bag', nargs='+', default=[], metavar='BAG',
                        help='data on which the models are compared')
    add_params(parser)
    add_interval(parser)
    add_results(parser)
    add_style(parser)


def command(args: argparse.Namespace) -> int:
    """Print it."""
    if len(args.model) > 1 or args.bag or args.out:
        from ctsid_ros.verbs.compare import of_models

        return of_models(args.model, args.bag, args, 'show')
    from ctsid_core.model.storage import load_estimate, load_metadata, to_json

    path = model_file(args.model[0])
    estimate, metadata = load_estimate(path), load_metadata(path)
    model = estimate.model or estimate.rejected_model
    if args.json:
        document = json.loads(to_json(estimate, metadata))
        tell({'verb': 'show', **document, 'frequency_response': _response(model)})
    else:
        print(to_text(list(_sections(path, estimate, metadata))))
    return ACCEPTED


def _sections(path: str, estimate: Estimate, metadata: Mapping[str, object]
              ) -> Iterator[Section]:
    from ctsid_ros.report.responses import excited
    from ctsid_ros.report.sections import bode_section, gain_section, model_section

    model = estimate.model or estimate.rejected_model
    bag = metadata.get('bag')
    words = [f'bag {", ".join(map(str, bag))}'] if isinstance(bag, list) else []
    length = (estimate.end_ns - estimate.start_ns) * 1e-9
    if length > 0:
        words.append(f'{length:.4g} s from {date(estimate.start_ns) or "its start"}')
    channels = metadata.get('channels')
    parts = [f'Identified from {", ".join(words)}.' if words else
             'Stored without its data: its origin is not known.']
    tables = [_channels(channels)] if isinstance(channels, list) and channels else []
    yield Section(path, (*parts, *tables))
    yield model_section(estimate, 'Model')
    if model:
        yield gain_section(model, estimate.covariance)
        yield bode_section(model, covariance=estimate.covariance, band=excited(estimate))


def _channels(channels: list[Any]) -> Table:
    head = ('role', 'name', 'topic', 'field', 'unit', 'hold')
    rows = tuple(tuple(str(c.get(key, '')) if isinstance(c, dict) else '' for key in head)
                 for c in channels)
    return Table(head, rows, head)


def _response(model: StateSpace | None) -> dict[str, Any] | None:
    if model is None:
        return None
    import numpy as np

    from ctsid_ros.report.responses import frequencies

    omega = frequencies(model, count=100)
    response = model.frequency_response(omega)
    with np.errstate(divide='ignore', invalid='ignore'):
        return {'omega': omega, 'magnitude_db': 20 * np.log10(np.abs(response)),
                'phase_deg': np.angle(response) * 180 / math.pi}
