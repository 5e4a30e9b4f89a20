# SPDX-License-Identifier: Apache-2.0
"""
The one declaration of every parameter of identification.

From the metadata of these fields come the validation, the names and descriptions of parameters in
files and nodes, the command line's help, the commented YAML files and `docs/parameters.md`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, replace
import difflib
import math
from typing import Any, Literal, NamedTuple

from ctsid_core.errors import SettingsError

LARGEST_INPUT = 1e12   # number of what lies before an input
LONGEST_DELAY = 60.0  # dead time that may be given, and is looked for [s], ...
_SHARE = 0.25          # ... as far as it is this part of a record at most
_NEAREST = 1e-5        # times e within a record, that a mode decays at least
OF_STRIDE = 0.8  # budget of a window: the rest is for publishing, and for estimates of work
Hold = Literal['zoh', 'linear', 'smooth']
METHODS = ('hd-pbsid', 'ct-pbsid', 'gobf')
UNCHECKED = 'none'
HOLDS: tuple[Hold, ...] = ('zoh', 'linear', 'smooth')


class Actuator(NamedTuple):
    """What lies between an input that is held and what acts, in this order; 0: nothing."""

    timeout: float = 0.0        # [s]: so long after a message it counts as 0, until the next one
    dead_zone: float = 0.0      # so much of it moves nothing [unit]
    limit: float = 0.0          # so much acts at most, of either sign [unit]
    backlash: float = 0.0       # play: of a turn back so much moves nothing [unit]
    rate_limit: float = 0.0     # what acts changes no faster [unit/s]


def parameter(
    default: Any, doc: str, *, name: str = '', unit: str = '', low: float | None = None,
    high: float | None = None, choices: tuple[str, ...] = (), words: tuple[str, ...] = (),
    auto: str = '', structural: bool = False, when: str = '',
) -> Any:
    """
    Declare one parameter as a dataclass field; its type is that of its default.

    `doc` says in a sentence what it means, `when` when to change it. `name` is dotted, the field's
    own where empty; the range `low` to `high` is inclusive; `choices` are the allowed words,
    `words` may replace a number, `auto` is what the value 0 means where it stands for 'automatic'.
    A structural one can only change while the node is not active.
    """
    return field(default=default, metadata={
        'doc': doc, 'name': name, 'unit': unit, 'low': low, 'high': high, 'choices': choices,
        'words': words, 'auto': auto, 'structural': structural, 'when': when})


def is_number(declared: Field[Any]) -> bool:
    """Return whether a declared parameter is a floating-point number, or a word in its place."""
    return isinstance(declared.default, float) or bool(declared.metadata['words'])


def parameter_name(declared: Field[Any]) -> str:
    """Return the dotted name under which a declared field appears in parameter files."""
    return declared.metadata['name'] or declared.name


@dataclass(frozen=True, kw_only=True)
class Settings:
    """
    Settings of an identification; with the defaults everything is chosen from the data.

    Raises
    ------
    SettingsError
        If any value is of wrong type or out of range; all faults are listed at once.
    """

    method: str = parameter(
        'hd-pbsid', 'Identification method; all but hd-pbsid give their plain subspace estimate, '
        'and do not estimate dead times.', structural=True,
        choices=METHODS)
    order: int = parameter(
        0, 'Number of states of the model.', low=0, high=50, auto='chosen from the data',
        when='Set it when the physics say how many states there are.')
    max_order: int = parameter(
        10, 'Largest order that the automatic choice considers.', low=1, high=50,
        when='Raise it for structures with many modes.')
    feedthrough: bool = parameter(
        True, 'Whether u acts on y at once (the matrix D).',
        when='Set it to false in closed loop and whenever the physics exclude it.')
    trim: bool = parameter(
        True, 'Whether constant offsets of states and outputs are estimated with the model.',
        when='Set it to false only if all signals are deviations from an equilibrium.')
    delay: float | str | tuple[float | str, ...] = parameter(
        'auto', 'Dead time of the inputs: one for all, or one per input; auto: estimated from '
        'the data.', unit='s', low=0.0, high=LONGEST_DELAY, words=('auto',), structural=True,
        when='Set it to 0.0 where commands act at once, or to a known value.')
    timeout: float | str | tuple[float | str, ...] = parameter(
        'auto', 'Time after a message from which on a held input counts as 0 until the next one: '
        'one for all, or one per input; 0.0: never; auto: found from the data.', unit='s',
        low=0.0, high=LONGEST_DELAY, words=('auto',), structural=True,
        when='Set it to the timeout of the driver (cmd_vel_timeout), or to 0.0 where the last '
        'command goes on.')
    dead_zone: float | str | tuple[float | str, ...] = parameter(
        'auto', 'How much of a held input, from 0 on, moves nothing: one for all, or one per '
        'input; 0.0: none; auto: found from the data.', low=0.0, high=LARGEST_INPUT,
        words=('auto',), structural=True,
        when='Set it to the dead band of the driver, or to 0.0 where small commands act.')
    limit: float | str | tuple[float | str, ...] = parameter(
        'auto', 'How much of a held input acts at most, of either sign: one for all, or one per '
        'input; 0.0: all of it; auto: found from the data.', low=0.0, high=LARGEST_INPUT,
        words=('auto',), structural=True,
        when='Set it to the limit of the driver or motor (max_velocity), or to 0.0 where large '
        'commands act.')
    backlash: float | str | tuple[float | str, ...] = parameter(
        'auto', 'Play between a held input and what it moves: one for all, or one per input; '
        '0.0: none; auto: found from the data.', low=0.0, high=LARGEST_INPUT, words=('auto',),
        structural=True, when='Set it to 0.0 where there is no gear.')
    rate_limit: float | str | tuple[float | str, ...] = parameter(
        'auto', 'How fast what acts of a held input changes at most, in its unit per second: one '
        'for all, or one per input; 0.0: at once; auto: found from the data.', low=0.0,
        high=LARGEST_INPUT, words=('auto',), structural=True,
        when='Set it to the limit of the driver (max_acceleration of a velocity), or to 0.0 where '
        'commands act at once.')
    refine: bool = parameter(
        True, 'Whether the subspace estimate is taken to the maximum of the likelihood.',
        when='Set it to false to see the plain subspace estimate.')
    edges: str = parameter(
        'exact', 'Treatment of the ends of the window: exact for any window, or as in the paper '
        'for signals that start and end at rest.', name='hermite.edges',
        choices=('exact', 'paper'))
    nmax: int = parameter(
        0, 'Highest order of the Hermite functions: the time-bandwidth product of the window.',
        name='hermite.nmax', low=0, high=5000, auto='from the bandwidth of the data',
        when='Raise it if fast dynamics are not modelled, lower it if noise dominates.')
    parts: int = parameter(
        0, 'Parts of equal length that a long record is divided into, each projected on a basis '
        'of its own; one model explains them all.', name='hermite.parts', low=0, high=50,
        auto='one, or as many as a long record needs')
    edge_margin: float = parameter(
        5.0, 'How far the basis stays inside the window, in widths of the Airy tail of its last '
        'function (edges: exact).', name='hermite.edge_margin', low=2.0, high=20.0)
    beta: float = parameter(
        0.0, 'Shift of the modified derivative operator.', name='hermite.beta', unit='rad/s',
        low=0.0, high=1e12, auto='chosen from the data')
    gamma: float = parameter(
        0.0, 'Radius of the region that contains the predictor poles.', name='hermite.gamma',
        unit='rad/s', low=0.0, high=1e12, auto='chosen from the data',
        when='It has to exceed |pole + beta| for every pole of interest.')
    past: int = parameter(
        0, 'Past window p.', name='pbsid.past', low=0, high=50, auto='chosen from the data',
        when='Raise it for lightly damped or high-order plants; lower it for noisy data.')
    future: int = parameter(
        0, 'Future window f, at most p.', name='pbsid.future', low=0, high=50, auto='equal to p')
    rank_tolerance: float = parameter(
        1e-10, 'Singular values below this fraction of the largest count as zero.',
        name='pbsid.rank_tolerance', low=1e-15, high=1e-2)
    tm_real: float | str | tuple[float | str, ...] = parameter(
        'auto', 'Real parts of the pole sequence of the filters (method: gobf), in their order; '
        'auto: spread evenly over the band that fits the data best.', unit='rad/s',
        name='takenaka_malmquist.poles_real', low=1e-9, high=1e9, words=('auto',))
    tm_imag: float | str | tuple[float | str, ...] = parameter(
        'auto', 'Imaginary parts of the pole sequence, as many as real parts, conjugates beside '
        'each other; auto: all zero.', unit='rad/s', name='takenaka_malmquist.poles_imag',
        low=-1e9, high=1e9, words=('auto',))
    tm_functions: int = parameter(
        0, 'Number of filters in the chain, where their poles are not given.',
        name='takenaka_malmquist.functions', low=0, high=100,
        auto='8, or twice as many as the order needs')
    laguerre_pole: float = parameter(
        0.0, 'Pole of the Laguerre functions (method: ct-pbsid).',
        name='laguerre.pole', unit='rad/s', low=0.0, high=1e12, auto='chosen from the data',
        when='A few times the fastest pole of interest, in steps of two if the model is poor.')
    held_out: float = parameter(
        0.3, 'Share of every window, in three parts, that is held out: a model of the rest '
        'is tested on it; 0: no test.',
        name='validation.held_out', low=0.0, high=0.5,
        when='Set it to 0 to save a little time, if models are tested elsewhere.')
    cross_check: str = parameter(
        UNCHECKED, 'Second method, by which every window is identified as well; a model is not '
        'GOOD if the two differ by more than the noise explains.', name='validation.cross_check',
        choices=(UNCHECKED, *METHODS),
        when='Set it to hd-pbsid where another method is used and there is time for it; it '
        'estimates dead times, too.')
    budget: float = parameter(
        0.0, 'Processor time that one identification may take, counted in work done, so that it '
        'ends at the same place on every computer.', unit='s', low=0.0, high=1e6,
        auto=f'{OF_STRIDE:g} of window.stride in the node and in replays, else no limit',
        when='Raise it, or window.stride, if models are wanted that take longer to find.')
    window_length: float = parameter(
        10.0, 'Length of the sliding window.', name='window.length', unit='s', low=1e-3,
        high=1e5, structural=True,
        when='At least a few times the slowest time constant of interest.')
    window_stride: float = parameter(
        1.0, 'Time from one window to the next.', name='window.stride', unit='s', low=1e-3,
        high=1e5, structural=True)
    window_max_delay: float = parameter(
        0.5, 'How late a message may arrive and still be put in order.',
        name='window.max_delay', unit='s', low=0.0, high=60.0, structural=True,
        when='Raise it if late samples are reported; models appear that much later.')

    def __post_init__(self) -> None:
        faults = [f for declared in fields(self)
                  for f in value_faults(declared, getattr(self, declared.name))]
        if not faults and self.past and self.future > self.past:
            faults.append(f'`pbsid.future` is {self.future} but must not exceed `pbsid.past` '
                          f'({self.past}); lower it or set it to 0')
        if not faults and self.cross_check == self.method:
            faults.append(f'`validation.cross_check` is {self.method!r}, as `method` is; choose '
                          f'another method, or {UNCHECKED!r}')
        if faults:
            raise SettingsError(faults)

    def replace(self, **changes: Any) -> Settings:
        """Return a copy with the given fields changed; raises `SettingsError` like `Settings`."""
        return replace(self, **changes)

    @property
    def share_held_out(self) -> float:
        """Share of a record that is held out: none where windows have the paper's edges."""
        return 0.0 if self.edges == 'paper' else self.held_out

    def delays(self, nu: int) -> tuple[float, ...]:
        """
        Return the dead time of each of `nu` inputs [s]; 0 where it is to be found from the data.

        Raises `SettingsError` if `delay` is a sequence of another length.
        """
        return tuple(0.0 if isinstance(d, str) else float(d) for d in self._each('delay', nu))

    def unknown_delays(self, nu: int) -> tuple[bool, ...]:
        """Return of which inputs the dead time is to be found; raises like `delays`."""
        return tuple(isinstance(d, str) for d in self._each('delay', nu))

    def actuators(self, nu: int) -> tuple[Actuator, ...]:
        """Return what lies before each of `nu` inputs; 0 where it is to be found from the data."""
        each = [[0.0 if isinstance(v, str) else float(v) for v in self._each(kind, nu)]
                for kind in Actuator._fields]
        return tuple(map(Actuator._make, zip(*each, strict=True)))

    def unknown_actuators(self, kind: str, nu: int) -> tuple[bool, ...]:
        """Return of which inputs one kind of actuator is to be found."""
        return tuple(isinstance(v, str) for v in self._each(kind, nu))

    def with_actuators(self, actuators: Sequence[Actuator]) -> Settings:
        """Return a copy that has these; as one number where all inputs have the same."""
        each = {kind: tuple(values) for kind, values in zip(
            Actuator._fields, zip(*actuators, strict=True), strict=False)}
        return self.replace(**{kind: values if len(set(values)) > 1 else values[0]
                               for kind, values in each.items()})

    def longest_delay(self, nu: int, length: float) -> float:
        """Return the longest dead time of `nu` inputs in a record of some length [s]."""
        return max((longest_sought(length) * any(self.unknown_delays(nu)), *self.delays(nu)))

    def with_known_delays(self) -> Settings:
        """Return a copy in which dead times that are to be found count as 0."""
        if isinstance(self.delay, tuple):
            return self.replace(delay=tuple(0.0 if isinstance(d, str) else d for d in self.delay))
        return self.replace(delay=0.0) if isinstance(self.delay, str) else self

    def for_windows(self) -> Settings:
        """Return a copy for consecutive windows, with a budget that suits their stride."""
        return self if self.budget else self.replace(budget=OF_STRIDE * self.window_stride)

    def _each(self, name: str, nu: int) -> tuple[float | str, ...]:
        given = getattr(self, name)
        if not isinstance(given, tuple):
            return (given,) * nu
        if len(given) != nu:
            raise SettingsError([f'`{name}` has {len(given)} values but there are {nu} '
                                 'inputs; give one for all, or one per input'])
        return given

    @classmethod
    def from_dict(cls, values: Mapping[str, object]) -> Settings:
        """
        Build settings from dotted names.

        Raises `SettingsError` if names are unknown or values wrong; all faults are listed at once.
        """
        settings: Settings = build_declared(cls, values)
        return settings

    def to_dict(self) -> dict[str, object]:
        """Return the values under their dotted names."""
        return {parameter_name(f): getattr(self, f.name) for f in fields(self)}


def longest_sought(length: float) -> float:
    """Return the longest dead time that is looked for in a record of some length [s]."""
    return min(_SHARE * length, LONGEST_DELAY)


def slowest_sought(length: float) -> float:
    """Return the least decay of a mode that is looked for in a record of some length [rad/s]."""
    # Nobody can tell it from 0, and nearer ones leave too few digits between a mode and the trim.
    return _NEAREST / length


def build_declared(cls: type[Any], values: Mapping[str, object], prefix: str = '') -> Any:
    """
    Build a declared dataclass from dotted names, listing unknown names and bad values at once.

    `values` are as a parameter file gives them; `prefix` is put before each name in messages.
    Raises `SettingsError` with one sentence per fault.
    """
    declared = {parameter_name(f): f for f in fields(cls)}
    faults, accepted = [], {}
    for name, value in values.items():
        if name not in declared:
            near = difflib.get_close_matches(name, declared, n=3)
            hint = f'did you mean {" or ".join(near)}?' if near else \
                f'known names: {", ".join(declared)}'
            faults.append(f'`{prefix}{name}` is not a parameter; {hint}')
            continue
        converted = tuple(value) if isinstance(value, list) else value
        new = value_faults(declared[name], converted, prefix)
        faults += new
        if not new:
            accepted[declared[name].name] = converted
    missing = [n for n, f in declared.items() if f.default is MISSING and n not in values]
    faults += [f'`{prefix}{name}` is missing; add it' for name in missing]
    if faults:
        try:  # faults between accepted values are found by the constructor: report them too
            cls(**accepted)
        except (SettingsError, TypeError) as error:
            faults += getattr(error, 'faults', ())
        raise SettingsError(faults)
    return cls(**accepted)


def value_faults(declared: Field[Any], value: object, prefix: str = '') -> list[str]:
    """Return what is wrong with `value` for a declared field, as sentences; empty if nothing."""
    name = prefix + parameter_name(declared)
    if isinstance(value, tuple) and 'tuple' not in str(declared.type):
        return [f'`{name}` is a list, but one {_kind(declared)} is wanted']
    items = value if isinstance(value, tuple) else (value,)
    return [f for item in items for f in _scalar_faults(name, declared, item)]


def _kind(declared: Field[Any]) -> str:
    if words := declared.metadata['words']:
        return f'number or {" or ".join(words)}'
    return {bool: 'true or false', int: 'whole number', float: 'number', str: 'word'}.get(
        _type_of(declared), 'value')


def _type_of(declared: Field[Any]) -> type[Any]:
    return type(declared.default) if declared.default is not MISSING else str


def _scalar_faults(name: str, declared: Field[Any], value: object) -> list[str]:
    wanted, meta = _type_of(declared), declared.metadata
    if value in meta['words'] and isinstance(value, str):
        return []
    good = isinstance(value, int | float) and not isinstance(value, bool) \
        if is_number(declared) else type(value) is wanted
    if not good:
        quotes = ' (in files, y, n, on, off, yes and no mean true and false: put quotes around ' \
            'the word)' if wanted is str and isinstance(value, bool) and not meta['words'] else ''
        return [f'`{name}` is {value!r} ({type(value).__name__}), but a {_kind(declared)} is '
                f'wanted{quotes}']
    if meta['choices'] and value not in meta['choices']:
        return [f'`{name}` is {value!r}; choose one of {", ".join(map(repr, meta["choices"]))}']
    if isinstance(value, int | float) and not isinstance(value, bool):
        low = -math.inf if meta['low'] is None else meta['low']
        high = math.inf if meta['high'] is None else meta['high']
        if not low <= value <= high or abs(value) == math.inf:
            unit = f' {meta["unit"]}' if meta['unit'] else ''
            return [f'`{name}` is {value!r}, but must lie between {low:g} and {high:g}{unit}']
    return []
