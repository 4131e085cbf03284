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

"""
The strain to be tracked, as a function of time: every kind of waveform is one law.

A law is sines over polynomials. Before it begins it is at rest at its first strain, after its end
at its last one. Harmonic kinds are ``a (1 - cos(phase))``, which begins at rest at zero; all
others are polynomials of time of at most fifth degree, one piece after another.

The paper tracks a sine of which it gives amplitude and frequency; that it begins at rest at zero
strain is our reading, all other kinds are ours.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
import math
import random
from typing import NamedTuple

from fam_bundle_model.compile import compiled
from fam_bundle_model.parameters import ReferenceParameters, step_time
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Floats = float | Array

ORDER = 6  # coefficients of a piece
FINENESS = 33  # points at which a piece is looked at for its extremes
SHORTEST = 1e-3  # s that a way takes at least
MOMENT = 1e-6  # s; what is braked in less than that stops at once
ANYWHERE = (-math.inf, math.inf)
# The largest rate of the way of least jerk from rest to rest over the mean one, and the largest
# acceleration over distance by time squared.
LEAST_JERK_RATE, LEAST_JERK_ACCELERATION = 15.0 / 8.0, 10.0 / math.sqrt(3.0)


class Reference(NamedTuple):
    """
    A trajectory; what lies before time zero of its own is the way to its beginning.

    ``start`` is that zero (s); from ``end`` (s after it) on its strain is held. The polynomials
    begin anew each ``cycle`` (s; infinite: never). ``sines`` holds a row of amplitude, frequency
    (Hz) and rise of the frequency (Hz/s) for each; ``breaks`` where each polynomial begins (s
    after ``start``), and ``coefficients`` its row of six, of the rising powers of the time since.
    """

    start: float
    end: float
    cycle: float
    sines: Array
    breaks: Array
    coefficients: Array


@compiled
def strain_reference(law: Reference, time: float) -> float:
    """Return the reference strain at ``time`` s."""
    since = min(max(time - law.start, law.breaks[0]), law.end)
    within = since % law.cycle if since > 0.0 else since
    piece = np.searchsorted(law.breaks, within, side='right') - 1
    passed = within - law.breaks[piece]
    strain = 0.0
    for power in range(law.coefficients.shape[1] - 1, -1, -1):
        strain = strain * passed + law.coefficients[piece, power]
    if since > 0.0:
        for k in range(law.sines.shape[0]):
            frequency, sweep = law.sines[k, 1], law.sines[k, 2]
            phase = 2.0 * math.pi * frequency * since + math.pi * sweep * since * since
            strain += law.sines[k, 0] * (1.0 - math.cos(phase))
    return strain


def reference_law(parameters: ReferenceParameters) -> Reference:
    """Return the trajectory of ``parameters``, which begins at 0 s."""
    return _KINDS[parameters.kind](parameters)


def still(strain: float = 0.0) -> Reference:
    """Return the trajectory that stays at ``strain`` (dimensionless)."""
    return _pieces([0.0], [[strain]], 0.0)


# ---- The kinds ----


def _sines(parameters: ReferenceParameters, rows: Sequence[Sequence[float]]) -> Reference:
    law = still()
    return law._replace(end=parameters.duration(), sines=np.array(rows, dtype=np.float64))


def _sine(p: ReferenceParameters) -> Reference:
    return _sines(p, [(p.amplitude, p.frequency, 0.0)])


def _sum_of_sines(p: ReferenceParameters) -> Reference:
    """Weights share the amplitude: the peak strain is at most twice that."""
    weights = p.weights if len(p.weights) > 1 else p.weights * len(p.multiples)
    scale = p.amplitude / sum(weights)
    pairs = zip(p.multiples, weights, strict=True)
    return _sines(p, [(scale * w, p.frequency * m, 0.0) for m, w in pairs])


def _chirp(p: ReferenceParameters) -> Reference:
    """Let the frequency rise or fall evenly over the whole duration."""
    sweep = (p.final_frequency - p.frequency) / p.duration()
    return _sines(p, [(p.amplitude, p.frequency, sweep)])


def _ramp(p: ReferenceParameters) -> Reference:
    """Up in half a cycle, as fast on average as the sine, and there it stays."""
    half, peak = 0.5 / p.frequency, 2.0 * p.amplitude
    return _pieces([0.0, half], [[0.0, peak / half], [peak]], p.duration())


def _trapezoid(p: ReferenceParameters) -> Reference:
    """Spend a quarter of a cycle each: up, held, down, held."""
    quarter, peak = 0.25 / p.frequency, 2.0 * p.amplitude
    rows = [[0.0, peak / quarter], [peak], [peak, -peak / quarter], [0.0]]
    breaks = [k * quarter for k in range(4)]
    return _pieces(breaks, rows, p.duration(), 1.0 / p.frequency)


def _levels(p: ReferenceParameters) -> tuple[float, list[tuple[float, float]]]:
    """Return the time of each level, and from where to where each step goes."""
    strains = [2.0 * p.amplitude * level for level in p.levels]
    return 1.0 / (p.frequency * len(strains)), [*pairwise((strains[-1], *strains))]


def _steps(p: ReferenceParameters) -> Reference:
    """Each as fast as the limits on rate and acceleration allow: trapezoids of strain rate."""
    share, moves = _levels(p)
    breaks, rows = [], []
    for k, (start, stop) in enumerate(moves):
        distance, sign = abs(stop - start), math.copysign(1.0, stop - start)
        rise = min(
            p.strain_rate / p.strain_acceleration, math.sqrt(distance / p.strain_acceleration)
        )
        taken = step_time(distance, p.strain_rate, p.strain_acceleration)
        rate, bend = sign * rise * p.strain_acceleration, sign * 0.5 * p.strain_acceleration
        near = bend * rise * rise
        for offset, row in (
            (0.0, [start, 0.0, bend]),
            (rise, [start + near, rate]),
            (taken - rise, [stop - near, rate, -bend]),
            (taken, [stop]),
        ):
            breaks.append(k * share + offset)
            rows.append(row)
    return _pieces(breaks, rows, p.duration(), 1.0 / p.frequency)


def _minimum_jerk(p: ReferenceParameters) -> Reference:
    """
    From rest to rest: of all ways the one with the least integral of the squared jerk.

    Flash and Hogan, The Coordination of Arm Movements, J. Neurosci. 5(7), 1985.
    """
    share, moves = _levels(p)
    starts, stops = np.array(moves).T
    rows = quintic(starts, 0.0, stops, 0.0, share)
    breaks = [k * share for k in range(len(rows))]
    return _pieces(breaks, rows, p.duration(), 1.0 / p.frequency)


def _random(p: ReferenceParameters) -> Reference:
    """Waypoints about half a cycle apart, anywhere up to the peak strain; seeded."""
    dice = random.Random(p.seed)  # the same on every machine
    parts = [0.5 + dice.random() for _ in range(2 * p.cycles)]
    times = [0.0, *(np.cumsum(parts) * (p.duration() / sum(parts))).tolist()]
    strains = [0.0, *(2.0 * p.amplitude * dice.random() for _ in parts)]
    return smooth(times, strains)


def _samples(p: ReferenceParameters) -> Reference:
    return smooth(p.times, p.strains)


def _topic(p: ReferenceParameters) -> Reference:
    """Hold the first strain; what comes on the topic takes its place."""
    return still(p.strains[0])._replace(end=p.duration())


_KINDS: dict[str, Callable[[ReferenceParameters], Reference]] = {
    'sine': _sine,
    'trapezoid': _trapezoid,
    'steps': _steps,
    'minimum_jerk': _minimum_jerk,
    'sum_of_sines': _sum_of_sines,
    'chirp': _chirp,
    'ramp': _ramp,
    'random': _random,
    'samples': _samples,
    'topic': _topic,
}


# ---- Pieces ----


def _pieces(
    breaks: Sequence[float] | Array,
    rows: Sequence[Sequence[float]] | Array,
    end: float,
    cycle: float = math.inf,
) -> Reference:
    coefficients = np.zeros((len(rows), ORDER))
    for full, row in zip(coefficients, rows, strict=True):
        full[: len(row)] = row
    return Reference(0.0, end, cycle, np.zeros((0, 3)), np.array(breaks, float), coefficients)


def quintic(start: Floats, rate: Floats, stop: Floats, final_rate: Floats, taken: Floats) -> Array:
    """
    Return the coefficients of the way of least jerk that takes ``taken`` s: (..., 6).

    From strain ``start`` to ``stop`` at the strain rates ``rate`` and ``final_rate`` (1/s) without
    acceleration at either end.
    """
    left = stop - start - rate * taken
    gain = (final_rate - rate) * taken
    third, fourth, fifth = 10 * left - 4 * gain, 7 * gain - 15 * left, 6 * left - 3 * gain
    bend = 0.0 * left
    row = (start, rate, bend, third / taken**3, fourth / taken**4, fifth / taken**5)
    return np.stack(np.broadcast_arrays(*row), axis=-1)


def smooth(times: Sequence[float], strains: Sequence[float]) -> Reference:
    """
    Return the trajectory through ``strains`` at rising ``times`` (s), from rest to rest.

    Strain rate and acceleration are continuous, and between two points it rises or falls
    throughout. Each point is passed without acceleration, at the smaller of the mean rates beside
    it, or at rest where these differ in sign. The rate of a piece from 0 to 1 in unit time, with
    rates a and b at its ends, has the Bernstein coefficients a, a, 5 - 2 a - 2 b, b, b: none is
    negative, for a and b are at most 1.
    """
    points, parts = np.array(strains, float), np.diff(times)
    slopes = np.diff(points) / parts
    before, beyond = slopes[:-1], slopes[1:]
    passing = np.where(np.abs(before) < np.abs(beyond), before, beyond)
    passing[before * beyond <= 0.0] = 0.0
    rates = np.concatenate(([0.0], passing, [0.0]))
    rows = quintic(points[:-1], rates[:-1], points[1:], rates[1:], parts)
    law = _pieces(np.array(times[:-1]) - times[0], rows, times[-1] - times[0])
    return law._replace(start=times[0])


# ---- From one trajectory to the next ----


def rate_of(law: Reference, time: float) -> float:
    """Return the strain rate in 1/s at ``time`` s; zero where the strain is held."""
    since = time - law.start
    if not law.breaks[0] <= since < law.end:
        return 0.0
    within = since % law.cycle if since > 0.0 else since
    piece = int(np.searchsorted(law.breaks, within, side='right')) - 1
    slope = np.polynomial.polynomial.polyder(law.coefficients[piece])
    rate = float(np.polynomial.polynomial.polyval(within - law.breaks[piece], slope))
    if since > 0.0:
        for amplitude, frequency, sweep in law.sines.tolist():
            speed = 2.0 * math.pi * (frequency + sweep * since)
            phase = 2.0 * math.pi * frequency * since + math.pi * sweep * since * since
            rate += amplitude * speed * math.sin(phase)
    return rate


def braked(
    before: Reference, time: float, acceleration: float, reach: tuple[float, float] = ANYWHERE
) -> Reference:
    """
    Return ``before`` brought to rest from ``time`` s on, and held where it comes to rest.

    It is braked at ``acceleration`` (1/s^2), or as much harder as it takes to stay within
    ``reach``, the lowest and the highest strain.
    """
    start, rate = strain_reference(before, time), rate_of(before, time)
    room = max(reach[1] - start if rate > 0.0 else start - reach[0], 0.0)
    distance = min(0.5 * rate * rate / acceleration, room)
    taken = 2.0 * distance / abs(rate) if rate else 0.0
    if taken < MOMENT:
        return still(start)._replace(start=time)
    way = np.zeros(ORDER)
    way[:3] = start, rate, -0.5 * rate / taken
    return _preceded(still(start + 0.5 * rate * taken), time, taken, way)


def after(
    before: Reference,
    time: float,
    wanted: Reference,
    rate: float,
    acceleration: float,
    reach: tuple[float, float] = ANYWHERE,
) -> Reference:
    """
    Return ``wanted``, begun as soon as a way leads to its first strain from ``before``.

    From ``time`` s on ``before`` is ``braked``; then the way of least jerk leads from rest to rest
    within ``rate`` (1/s) and ``acceleration`` (1/s^2). One polynomial for both would go far beyond
    the point of rest where it has to go back.
    """
    rest = braked(before, time, acceleration, reach)
    start, stop = strain_reference(rest, rest.start), strain_reference(wanted, wanted.start)
    distance = abs(stop - start)
    law = wanted._replace(start=rest.start)
    if distance > 0.0:
        slow = LEAST_JERK_RATE * distance / rate
        gentle = math.sqrt(LEAST_JERK_ACCELERATION * distance / acceleration)
        taken = max(slow, gentle, SHORTEST)
        law = _preceded(law, rest.start, taken, quintic(start, 0.0, stop, 0.0, taken))
    if rest.start > time:
        law = _preceded(law, time, rest.start - time, rest.coefficients[0])
    return law


def slewed(before: Reference, time: float, strain: float, rate: float) -> Reference:
    """Return the trajectory from ``before`` at ``time`` s straight to ``strain`` at ``rate``."""
    start = strain_reference(before, time)
    if start == strain:
        return still(strain)._replace(start=time)
    way = np.zeros(ORDER)
    way[:2] = start, math.copysign(rate, strain - start)
    return _preceded(still(strain), time, abs(strain - start) / rate, way)


def strain_range(law: Reference) -> tuple[float, float]:
    """Return the lowest and the highest strain of a trajectory, its sines at their widest."""
    last = min(law.cycle, law.end)
    lengths = np.diff(law.breaks, append=max(last, law.breaks[-1]))
    passed = lengths[:, None] * np.linspace(0.0, 1.0, FINENESS)
    strains = np.zeros_like(passed)
    for column in law.coefficients.T[::-1]:
        strains = strains * passed + column[:, None]
    widest = np.where(law.breaks >= 0.0, 2.0 * law.sines[:, 0].sum(), 0.0)
    return float(strains.min()), float((strains.max(axis=1) + widest).max())


def _preceded(wanted: Reference, time: float, taken: float, way: Array) -> Reference:
    """Return ``wanted`` after a ``way`` that begins at ``time`` and takes so many seconds."""
    first = wanted.breaks[0] - taken
    return wanted._replace(
        start=float(time - first),
        breaks=np.concatenate(([first], wanted.breaks)),
        coefficients=np.vstack((way, wanted.coefficients)),
    )
