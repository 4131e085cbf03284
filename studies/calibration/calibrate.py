# SPDX-License-Identifier: Apache-2.0
"""
Find the parameters that Kim & Bryant 2025 does not publish, from the six numbers of Table 2.

A fit, not a validation: more free parameters than numbers. Bounds keep each parameter physical;
objections keep the loop one that an engineer would accept: two shifts per cycle, no ripple in the
pressures, an inner loop that follows its reference. Local least-squares searches from the given
configuration and from random points around the best so far. ``--help`` lists what it takes.
"""

import argparse
import json
import multiprocessing
from pathlib import Path
from typing import Any

from fam_bundle_bringup.demo import PAPER
from fam_bundle_bringup.experiment import measure_tracking
from fam_bundle_bringup.offline import run_offline
from fam_bundle_io.metrics import shift_times
from fam_bundle_io.trace import Trace
from fam_bundle_model.lag_table import build_lag_table
from fam_bundle_model.parameters import load_configuration
from fam_bundle_model.schema import ConfigurationError
import numpy as np
import numpy.typing as npt

# Parameter: lowest, highest; searched on a logarithmic scale.
BOUNDS = {
    'fam.youngs_modulus': (2.2e6, 3.1e6),  # Shore A50: 2 to 3 MPa by common conversions
    'source.droop': (1.0e9, 5.0e9),
    'source.time_constant': (0.005, 0.05),
    'hose.length': (0.3, 3.0),
    'oil.bulk_modulus': (50.0e6, 300.0e6),  # entrained air and hose walls
    'load.damping': (100.0, 2000.0),
    'load.friction_force': (0.5, 10.0),
    'strain_loop.proportional_gain': (1.0e7, 1.0e8),
    'strain_loop.integral_gain': (5.0e6, 2.0e8),
    'strain_loop.tracking_time': (0.03, 1.0),
    'pressure_loop.proportional_gain': (1.0e-6, 1.0e-5),
    'pressure_loop.integral_gain': (1.0e-7, 1.0e-4),
    'recruitment.strain_rate_time_constant': (0.01, 0.06),
    'recruitment.force_time_constant': (0.01, 0.06),
}
SETTLED = 0.6  # s after a shift that the penalties leave alone
RIPPLE = 500.0  # Pa, tolerated standard deviation of the pressure around its 21 ms mean
INNER_ERROR = 15e3  # Pa, tolerated mean error of the inner loop


def changes_of(point: npt.NDArray[np.float64]) -> dict[str, dict[str, Any]]:
    """Return the configuration changes of a point of the search, by group."""
    changes: dict[str, dict[str, Any]] = {}
    for name, value in zip(BOUNDS, np.exp(point).tolist(), strict=True):
        group, parameter = name.split('.')
        changes.setdefault(group, {})[parameter] = value
    return changes


def away_from_shifts(trace: Trace, start: float) -> npt.NDArray[np.bool_]:
    """Return the mask of the ticks after ``start`` s with no shift in the last moments."""
    time = trace['time']
    mask = time >= start
    up, down = shift_times(trace)
    for shift in [*up, *down]:
        mask &= (time < shift) | (time > shift + SETTLED)
    return mask


def objections(trace: Trace, cycles: int, start: float) -> list[float]:
    """
    Return what an engineer would object to, each 0 when there is nothing.

    Shifts beyond one pair per cycle, ripple of the pressures, error of the inner loop.
    """
    up, down = shift_times(trace)
    calm = away_from_shifts(trace, start)
    pressure = trace['mu_pressure']
    mean = np.apply_along_axis(np.convolve, 0, pressure, np.ones(21) / 21.0, 'same')
    ripple = float(np.std((pressure - mean)[calm][:-20]))
    wanted = trace['pressure_reference'] + trace['pressure_compensation']
    inner = float(np.mean(np.abs(wanted - pressure[:, 0])[calm]))
    return [
        2.0 * (abs(len(up) - cycles) + abs(len(down) - cycles)),
        max(ripple / RIPPLE - 1.0, 0.0),
        max(inner / INNER_ERROR - 1.0, 0.0),
    ]


def evaluate(config: Path, changes: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the metrics and the objections of each scheme of the paper."""
    result: dict[str, Any] = {}
    changes = {**changes, 'lag_table': {'source_points': 16, 'deslack_points': 16}}
    table = build_lag_table(load_configuration(config, changes))
    for scheme in PAPER:
        changes['recruitment'] = {**changes.get('recruitment', {}), 'scheme': scheme}
        configuration = load_configuration(config, changes)
        trace = run_offline(configuration, table=table)
        cycles, start = configuration.reference.cycles, 1.0 / configuration.reference.frequency
        found = measure_tracking(configuration, trace)
        result[scheme] = {**found._asdict(), 'objections': objections(trace, cycles, start)}
    return result


def residuals(point: npt.NDArray[np.float64], config: Path, aim: float) -> list[float]:
    """Return relative errors over ``aim`` and objections; large where a point cannot run."""
    try:
        result = evaluate(config, changes_of(point))
    except ConfigurationError:
        return [100.0] * (5 * len(PAPER))
    values: list[float] = []
    for scheme, (iae, max_error) in PAPER.items():
        found = result[scheme]
        values += [(found['iae'] / iae - 1.0) / aim, (found['max_error'] / max_error - 1.0) / aim]
        values += found['objections']
    return np.nan_to_num(values, nan=100.0, posinf=100.0).tolist()


def search(job: tuple[npt.NDArray[np.float64], argparse.Namespace]) -> tuple[float, list[float]]:
    """Return cost and point of one local least-squares search (log of each parameter)."""
    from scipy.optimize import least_squares

    start, options = job
    bounds = np.log(np.array(list(BOUNDS.values()))).T
    inside = np.clip(start, bounds[0] + 1e-6, bounds[1] - 1e-6)
    # A shift moves by whole ticks, so the steps of the differences must not be small.
    best = least_squares(
        residuals,
        inside,
        bounds=(bounds[0], bounds[1]),
        diff_step=2e-3,
        x_scale=0.3,
        max_nfev=options.iterations,
        args=(options.config, options.aim),
    )
    return 2.0 * float(best.cost), best.x.tolist()


def main() -> None:
    """Search around the given configuration, then around the best found; write the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--config', type=Path, required=True, help='configuration to start from')
    parser.add_argument('--out', type=Path, required=True, help='JSON file for the result')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--rounds', type=int, default=2, help='each starts from the last best')
    parser.add_argument('--starts', type=int, default=10, help='searches in each round')
    parser.add_argument(
        '--spread', type=float, default=0.4, help='of the starts in log units, halved each round'
    )
    parser.add_argument('--iterations', type=int, default=12, help='of each local search')
    parser.add_argument('--aim', type=float, default=0.03, help='relative error that costs 1')
    parser.add_argument('--workers', type=int, default=2)
    options = parser.parse_args()

    configuration = load_configuration(options.config)
    known = [
        getattr(getattr(configuration, group), parameter)
        for group, parameter in (name.split('.') for name in BOUNDS)
    ]
    best = (np.inf, np.log([float(v[0] if isinstance(v, tuple) else v) for v in known]).tolist())
    generator = np.random.default_rng(options.seed)
    with multiprocessing.Pool(options.workers) as pool:
        for k in range(options.rounds):
            spread = options.spread / 2**k
            offsets = spread * generator.standard_normal((options.starts, len(known)))
            offsets[0] = 0.0
            jobs = [(np.array(best[1]) + offset, options) for offset in offsets]
            for found in pool.imap_unordered(search, jobs):
                best = min(best, found)
                print(f'round {k + 1}: cost {found[0]:.3f}, best {best[0]:.3f}', flush=True)
                write(np.array(best[1]), options, best[0])


def write(point: npt.NDArray[np.float64], options: argparse.Namespace, value: float) -> None:
    """Write parameters, metrics, cost, seed and bounds as JSON."""
    changes = changes_of(point)
    content = {
        'cost': value,
        'seed': options.seed,
        'rounds': options.rounds,
        'starts': options.starts,
        'spread': options.spread,
        'iterations': options.iterations,
        'aim': options.aim,
        'bounds': BOUNDS,
        'parameters': changes,
        'metrics': evaluate(options.config, changes),
        'paper': PAPER,
    }
    options.out.write_text(json.dumps(content, indent=1) + '\n', encoding='utf-8')


if __name__ == '__main__':
    main()
