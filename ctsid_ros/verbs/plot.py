# SPDX-License-Identifier: Apache-2.0
"""`ctsid plot`: stored models in one figure file, for papers and slides."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from ctsid_core.errors import StorageError
from ctsid_ros.verbs.arguments import ACCEPTED, model_file, read_models

HELP = 'draw stored models: frequency response, step response, poles'
EPILOG = """example: ctsid plot results/monday/model.json results/tuesday/model.json -o both.pdf

Models of the same inputs and outputs are drawn into the same axes, with bands of two standard
deviations; rejected ones are named so. The page of a report (report.html) shows more."""

_WIDE, _HIGH = 420.0, 250.0     # of one drawing [points]
_SUFFIXES = ('.pdf', '.png', '.svg')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('model', nargs='+', metavar='MODEL',
                        help='a model.json, or a folder of results that has one')
    parser.add_argument('-o', '--output', required=True, metavar='FILE',
                        help='file to write: .pdf, .png or .svg')
    parser.add_argument('--force', action='store_true', help='replace the file if it exists')


def command(args: argparse.Namespace) -> int:
    """Read, draw, write."""
    path = Path(args.output)
    if path.suffix.lower() not in _SUFFIXES:
        raise StorageError(f'{path} ends in {path.suffix!r}; name it {", ".join(_SUFFIXES)}')
    if path.exists() and not args.force:
        raise StorageError(f'{path} exists already; choose another name, or add --force')
    from ctsid_ros.report.poles import pole_figure
    from ctsid_ros.report.responses import bode_figures, step_figures
    from ctsid_ros.report.static import write_drawings

    models = {name: (model, e.covariance) for name, e in read_models(
        [*map(model_file, args.model)]).items() if (model := e.model or e.rejected_model)}
    rows = []
    for bode, step in zip(bode_figures(models), step_figures(models), strict=True):
        magnitude, phase = bode.drawing.panels
        own = replace(step.drawing.panels[0], title=f'{step.title}: unit step')
        rows.append([replace(axes, width=_WIDE, height=_HIGH) for axes in (
            replace(magnitude, title=f'{bode.title}: magnitude [dB]', x_label=phase.x_label),
            replace(phase, title=f'{bode.title}: phase [deg]'), own)])
    rows.append([replace(pole_figure(models).drawing.panels[0], title='poles',
                         y_label='imaginary part [rad/s]', width=3 * _WIDE, height=1.4 * _HIGH)])
    write_drawings(path, rows)
    print(f'Drawn: {path}')
    return ACCEPTED
