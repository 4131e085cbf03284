#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Print how a recorded bundle tracked, when it shifted, and how hard each motor unit worked."""

from pathlib import Path
import sys

from fam_bundle_io.bag import read_bag, trace_of
from fam_bundle_io.metrics import shift_times, tracking

for path in sys.argv[1:]:
    bag = read_bag(Path(path))  # a folder or a file; needs no ROS
    run = trace_of(bag)
    trace = run.trace  # arrays by name in SI units, a row for each tick
    for warning in bag.warnings + run.warnings:
        print(f'{path}: {warning}', file=sys.stderr)
    start, stop = trace['time'][0], trace['time'][-1]
    found = tracking(trace, start, stop)
    print(f'{path}: {len(run.ticks)} ticks, {start:.3f} to {stop:.3f} s')
    print(f'  IAE {found.iae:.6f} s, maximum error {found.max_error:.6f}')
    for name, times in zip(('up', 'down'), shift_times(trace), strict=True):
        print(f'  shifts {name} at (s):', *(f'{time:.3f}' for time in times))
    for unit, pressure in enumerate(trace['mu_pressure'].T, 1):
        print(f'  MU{unit}: {pressure.max() / 1e3:.1f} kPa at most')
    # Any topic is a table of pandas: what the supervisor foresaw, for one.
    table = bag.tables['/recruitment_state']
    print(f'  longest recruitment lag {table["recruitment_lag"].max():.3f} s')
