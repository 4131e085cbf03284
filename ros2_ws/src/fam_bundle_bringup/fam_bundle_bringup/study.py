# Copyright 2026 fam_bundle maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The study file: which schemes, references and parameters, and the cases that they make."""

from collections.abc import Iterator, Mapping, Sequence
import itertools
import math
from pathlib import Path
from typing import Any, NamedTuple

from fam_bundle_bringup.experiment import default_configuration
from fam_bundle_bringup.study_case import RIVALS, Setting
from fam_bundle_model.parameters import (
    Configuration,
    GROUPS,
    make_configuration,
    read_yaml,
)
from fam_bundle_model.schema import ConfigurationError, Declaration, declarations, unknown

Changes = Mapping[str, Any]  # values by 'group.parameter'

KEYS = ('config', 'changes', 'schemes', 'grid', 'sample', 'rivals', 'heat_map')
SAMPLE_KEYS = ('number', 'seed', 'ranges')
SCHEME = 'recruitment.scheme'
RIG = 'rig.'  # before a parameter: that of the rig alone, which the laws do not know
NOT_OF_THE_RIG = (  # groups of which the rig has nothing
    'strain_loop',
    'pressure_loop',
    'recruitment',
    'allocation',
    'lag_table',
    'reference',
    'simulation',
)
WITHOUT_EFFECT = ('run', 'process', 'bridge')  # groups that change no offline run
MOST_CASES = 100_000


class Axis(NamedTuple):
    """One axis of the grid: what each of its labels changes."""

    name: str
    choices: dict[str, Changes]


class Range(NamedTuple):
    """The range of a sampled parameter, linear or logarithmic."""

    low: float
    high: float
    log: bool


class Sample(NamedTuple):
    """A Latin hypercube: how many points, the seed, and the ranges by 'group.parameter'."""

    number: int
    seed: int
    ranges: dict[str, Range]


class Study(NamedTuple):
    """
    A study file that has been read and checked.

    ``base`` are the values of the parameter file, ``changes`` what every case changes of them.
    The first of ``schemes`` is the one that the others are compared with.
    """

    path: Path
    text: str
    base: Mapping[str, Mapping[str, Any]]
    changes: Changes
    schemes: Axis
    grid: tuple[Axis, ...]
    sample: Sample | None
    rivals: tuple[str, ...]
    heat_map: tuple[str, ...]


class Case(NamedTuple):
    """
    One run: its scheme, its labels on named axes, its varied parameters by name.

    ``situation`` is the setting without what the scheme changes: the rivals run in it.
    Where no setting can be made of the values it is None, and ``reason`` says why.
    """

    scheme: str
    labels: dict[str, str]
    values: dict[str, Any]
    setting: Setting | None
    situation: Setting | None
    reason: str


# ---- Reading ----


def read_study(path: Path) -> Study:
    """
    Return the study in ``path``.

    Raises ConfigurationError naming file, entry, value and bound.
    """
    try:
        return _study(path, path.read_text(encoding='utf-8'))
    except OSError as error:
        raise ConfigurationError(f'{path}: cannot be read ({error.strerror})') from None
    except UnicodeDecodeError as error:
        raise ConfigurationError(f'{path}: not YAML ({error})') from None
    except ConfigurationError as error:
        raise ConfigurationError(f'{path}: {error}') from None


def _study(path: Path, text: str) -> Study:
    content = _mapping('study', _parsed(text), f'of {", ".join(KEYS)}')
    _check_keys('', content, KEYS)
    config = content.get('config')
    if config is not None and not isinstance(config, str):
        raise ConfigurationError(f'config = {config}: must be the name of a file')
    base = read_yaml(default_configuration() if config is None else path.parent / config)
    make_configuration(base)
    study = Study(
        path=path,
        text=text,
        base=base,
        changes=_changes('changes', content.get('changes', {})),
        schemes=_schemes(content.get('schemes', base['recruitment']['scheme'])),
        grid=_grid(content.get('grid', {})),
        sample=_sample(content['sample']) if 'sample' in content else None,
        rivals=_words('rivals', content.get('rivals', []), tuple(RIVALS)),
        heat_map=(),
    )
    _check_set_once(study)
    cases = math.prod(len(axis.choices) for axis in (*study.grid, study.schemes))
    cases *= study.sample.number if study.sample else 1
    if cases > MOST_CASES:
        raise ConfigurationError(f'{cases} cases: must be <= {MOST_CASES}')
    axes = ('scheme', *(axis.name for axis in study.grid))
    heat_map = _words('heat_map', content.get('heat_map', []), axes)
    if heat_map and len(heat_map) != 2:
        raise ConfigurationError(f'heat_map = {", ".join(heat_map)}: must be two axes')
    return study._replace(heat_map=heat_map)


def _parsed(text: str) -> Any:
    import yaml

    class Loader(yaml.SafeLoader):
        """Refuses what YAML forbids and PyYAML takes: a name twice in one mapping."""

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            names = [self.construct_object(key, deep=True) for key, _ in node.value]
            for name in names:
                if names.count(name) > 1:
                    raise ConfigurationError(f'{name}: stands twice')
            return super().construct_mapping(node, deep)

    try:
        return yaml.load(text, Loader)
    except yaml.YAMLError as error:
        raise ConfigurationError(f'not YAML ({" ".join(str(error).split())})') from None


def _mapping(entry: str, content: Any, of: str) -> Mapping[str, Any]:
    if not isinstance(content, Mapping):
        raise ConfigurationError(f'{entry} = {content}: must be a mapping {of}')
    return content


def _check_keys(entry: str, content: Mapping[str, Any], known: Sequence[str]) -> None:
    for key in content:
        if key not in known:
            message = unknown(f'{entry}{key}', [f'{entry}{name}' for name in known])
            raise ConfigurationError(message.replace('no such parameter', 'no such entry'))


def _words(entry: str, content: Any, known: Sequence[str]) -> tuple[str, ...]:
    words = content if isinstance(content, list) else [content]
    for word in words:
        if word not in known:
            raise ConfigurationError(f'{entry} = {word}: must be one of {", ".join(known)}')
        if words.count(word) > 1:
            raise ConfigurationError(f'{entry} = {word}: stands twice')
    return tuple(words)


def declared(name: Any) -> Declaration:
    """
    Return the declaration of the parameter 'group.parameter' or 'rig.group.parameter'.

    Raises ConfigurationError where there is none, or where it changes no offline run.
    """
    text = str(name).removeprefix(RIG)
    group, _, parameter = text.partition('.')
    if text != str(name) and group in NOT_OF_THE_RIG:
        raise ConfigurationError(f"{name}: a rig has no such parameter; {text} is the laws'")
    if group in WITHOUT_EFFECT:
        raise ConfigurationError(f'{name}: changes no offline run')
    if group not in GROUPS or parameter not in declarations(GROUPS[group]):
        known = [f'{g}.{p}' for g in GROUPS for p in declarations(GROUPS[g])]
        raise ConfigurationError(unknown(text, known))
    return declarations(GROUPS[group])[parameter]


def _changes(entry: str, content: Any) -> Changes:
    """Return values by parameter, each within its own bounds."""
    found = _mapping(entry, content, 'from parameters to values')
    try:
        return {name: declared(name).convert(name, value) for name, value in found.items()}
    except ConfigurationError as error:
        raise ConfigurationError(f'{entry}: {error}') from None


def _axis(name: str, content: Any, parameter: str, entry: str) -> Axis:
    """Return one axis: values of ``parameter``, or labels with what each changes."""
    if isinstance(content, Mapping):
        if '.' in name:
            raise ConfigurationError(f'{entry}: the name of an axis with labels has no dot')
        choices = {str(k): _changes(f'{entry}: {k}', changes) for k, changes in content.items()}
    else:
        values = content if isinstance(content, list) else [content]
        found = [_changes(entry, {parameter: value}) for value in values]
        choices = {text_of(changes[parameter]): changes for changes in found}
        if len(choices) < len(values):
            raise ConfigurationError(f'{entry}: holds a value twice')
    if not choices:
        raise ConfigurationError(f'{entry}: must hold at least one value')
    return Axis(name, choices)


def _schemes(content: Any) -> Axis:
    return _axis('scheme', content, SCHEME, 'schemes')


def _grid(content: Any) -> tuple[Axis, ...]:
    found = _mapping('grid', content, 'from parameters to lists of values')
    if 'scheme' in found or SCHEME in found:
        raise ConfigurationError('grid: schemes have an entry of their own, schemes')
    return tuple(_axis(str(name), c, str(name), f'grid: {name}') for name, c in found.items())


def _sample(content: Any) -> Sample:
    found = _mapping('sample', content, f'of {", ".join(SAMPLE_KEYS)}')
    _check_keys('sample: ', found, SAMPLE_KEYS)
    for key in SAMPLE_KEYS:
        if key not in found:
            raise ConfigurationError(f'sample: {key}: missing')
    number = Declaration(int, '', '', 1, MOST_CASES).convert('sample: number', found['number'])
    seed = Declaration(int, '', '', 0, 2**31 - 1).convert('sample: seed', found['seed'])
    ranges = _mapping('sample: ranges', found['ranges'], 'from parameters to [low, high]')
    if not ranges:
        raise ConfigurationError('sample: ranges: must hold at least one parameter')
    return Sample(number, seed, {str(name): _range(name, r) for name, r in ranges.items()})


def _range(name: Any, content: Any) -> Range:
    entry = f'sample: {name}'
    try:
        kind = declared(name)
    except ConfigurationError as error:
        raise ConfigurationError(f'sample: {error}') from None
    if kind.kind not in (float, int):
        raise ConfigurationError(f'{entry}: is no number; name its values under grid')
    log = isinstance(content, list) and content[2:] == ['log']
    if not isinstance(content, list) or not (log or len(content) == 2):
        raise ConfigurationError(f'{entry} = {content}: must be [low, high] or [low, high, log]')
    ends = [kind.convert(entry, end) for end in content[:2]]
    low, high = (end[0] if kind.array else end for end in ends)
    if not low < high or (log and not low > 0.0):
        bound = '0 < low < high' if log else 'low < high'
        raise ConfigurationError(f'{entry} = {content}: must be {bound}')
    return Range(low, high, log)


def _check_set_once(study: Study) -> None:
    """Raise ConfigurationError where two entries set one parameter."""
    owners = dict.fromkeys(study.changes, 'changes')
    for entry, names in (
        *((f'grid: {axis.name}', _set_by(axis)) for axis in study.grid),
        ('sample', list(study.sample.ranges) if study.sample else []),
        ('schemes', _set_by(study.schemes)),
    ):
        for name in names:
            if name in owners:
                raise ConfigurationError(f'{entry}: {name}: is set by {owners[name]} too')
            owners[name] = entry


def _set_by(axis: Axis) -> list[str]:
    return list(dict.fromkeys(name for changes in axis.choices.values() for name in changes))


def text_of(value: Any) -> str:
    """Return a parameter's value as text, the shortest that reads back to it."""
    return ', '.join(map(text_of, value)) if isinstance(value, tuple) else str(value)


# ---- Cases ----


def varied(study: Study) -> list[str]:
    """Return every parameter that differs between cases, the sampled ones first."""
    sample = study.sample.ranges if study.sample else ()
    return [*sample, *(name for axis in (*study.grid, study.schemes) for name in _set_by(axis))]


def sampled(sample: Sample | None) -> Iterator[Changes]:
    """
    Yield the points of a Latin hypercube; one without changes where nothing is sampled.

    Each parameter's range falls into as many parts, equal or equal in logarithm, as there are
    points, and each part holds one point: SciPy's ``qmc.LatinHypercube``. Whole numbers are
    rounded, from ranges that reach half of one further.
    """
    if sample is None:
        yield {}
        return
    import numpy as np
    from scipy.stats import qmc

    cube = qmc.LatinHypercube(len(sample.ranges), seed=np.random.default_rng(sample.seed))
    for point in cube.random(sample.number):
        yield {
            name: _scaled(declared(name), name, found, float(share))
            for (name, found), share in zip(sample.ranges.items(), point, strict=True)
        }


def _scaled(kind: Declaration, name: str, found: Range, share: float) -> Any:
    margin = 0.5 if kind.kind is int else 0.0
    low, high = found.low - margin, found.high + margin
    value = low * (high / low) ** share if found.log else low + (high - low) * share
    value = round(value) if margin else value
    return kind.convert(name, min(max(value, found.low), found.high))


def cases_of(study: Study) -> list[Case]:
    """Return all cases: the sample, outermost, by the grid by the schemes."""
    named = [axis.name for axis in study.grid if '.' not in axis.name]
    names = varied(study)
    cases = []
    for point in sampled(study.sample):
        for chosen in itertools.product(*(axis.choices.items() for axis in study.grid)):
            labels = {a.name: label for a, (label, _) in zip(study.grid, chosen, strict=True)}
            situation = {**study.changes, **point}
            for _, changes in chosen:
                situation |= changes
            base, _ = _setting(study, situation)
            for scheme, changes in study.schemes.choices.items():
                found, reason = _setting(study, {**situation, **changes})
                values = {name: _value(found, {**situation, **changes}, name) for name in names}
                here = {name: labels[name] for name in named}
                cases.append(Case(scheme, here, values, found, base, reason))
    return cases


def _setting(study: Study, changes: Changes) -> tuple[Setting | None, str]:
    """Return what the laws believe in and the rig: as believed but for what is its own."""
    own = {name.removeprefix(RIG): v for name, v in changes.items() if name.startswith(RIG)}
    shared = {name: value for name, value in changes.items() if not name.startswith(RIG)}
    try:
        believed = _configuration(study, shared)
        return Setting(believed, _configuration(study, shared | own) if own else None), ''
    except ConfigurationError as error:
        return None, str(error)


def _configuration(study: Study, changes: Changes) -> Configuration:
    values = {group: dict(content) for group, content in study.base.items()}
    for name, value in changes.items():
        group, _, parameter = name.partition('.')
        values.setdefault(group, {})[parameter] = value
    return make_configuration(values)


def _value(setting: Setting | None, changes: Changes, name: str) -> Any:
    if setting is None:
        return changes.get(name)
    configuration = setting.rig() if name.startswith(RIG) else setting.believed
    group, _, parameter = name.removeprefix(RIG).partition('.')
    return getattr(getattr(configuration, group), parameter)
