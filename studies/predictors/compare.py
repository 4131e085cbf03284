# SPDX-License-Identifier: Apache-2.0
"""
How far each predictor is off, on strains that follow a reference with some error and noise.

There is no plant here. The strain follows its reference as a PI loop around a spring does, at the
outer loop's gains in ``lhacd.yaml`` and a stiffness of 4 MPa per unit strain: the error of the
paper's runs between the shifts, without the shifts.
"""

import argparse
from collections.abc import Iterator
import dataclasses

from fam_bundle_bringup.experiment import default_configuration
from fam_bundle_control.predictors import (
    expected_strain,
    Predictor,
    predictor,
    predictor_start,
    predictor_step,
    PredictorState,
)
from fam_bundle_model.compile import compiled
from fam_bundle_model.parameters import Configuration, load_configuration, PREDICTORS
from fam_bundle_model.reference import Reference, reference_law, strain_reference
import numpy as np
import numpy.typing as npt

DT = 1e-3  # s
STIFFNESS = 4e6  # Pa per unit strain, about that of the bundle between 4 and 12 % strain
NOISES = (0.0, 1e-4, 5e-4)  # standard deviation of the measured strain
Array = npt.NDArray[np.float64]

REFERENCES = {
    **{
        f'sine {f} Hz': {'kind': 'sine', 'frequency': f, 'cycles': max(3, round(40 * f))}
        for f in (0.03, 0.05, 0.1, 0.2, 0.3, 0.5)
    },
    'chirp 0.05 to 0.3 Hz': {
        'kind': 'chirp',
        'frequency': 0.05,
        'final_frequency': 0.3,
        'cycles': 3,
    },
    'sum of sines': {'kind': 'sum_of_sines', 'frequency': 0.08, 'cycles': 5},
    'minimum jerk': {'kind': 'minimum_jerk', 'frequency': 0.1, 'cycles': 5},
    'random smooth': {'kind': 'random', 'frequency': 0.1, 'cycles': 8},
    'trapezoid': {'kind': 'trapezoid', 'frequency': 0.1, 'cycles': 5},
    'steps with limits': {'kind': 'steps', 'frequency': 0.1, 'cycles': 5},
}


@compiled
def expectations(
    law: Predictor,
    state: PredictorState,
    reference: Reference,
    measured: Array,
    ahead: float,
    dt: float,
) -> Array:
    """Return what is expected ``ahead`` s after each of the ``measured`` strains."""
    found = np.empty(measured.shape[0])
    for k in range(measured.shape[0]):
        state = predictor_step(law, state, reference, k * dt, measured[k], dt)
        found[k] = expected_strain(law, state, reference, ahead)
    return found


@compiled
def followed(reference: Reference, ticks: int, loop: float, integral: float, dt: float) -> Array:
    """Return the strain of a PI loop around a spring: loop gain, and integral gain in 1/s."""
    strain, summed = np.empty(ticks), 0.0
    for k in range(ticks):
        wanted = strain_reference(reference, k * dt)
        # strain = loop * (error + integral * summed), error = wanted - strain, summed grows by it
        share = loop * (1.0 + integral * dt)
        strain[k] = (share * wanted + loop * integral * summed) / (1.0 + share)
        summed += (wanted - strain[k]) * dt
    return strain


def rows(configuration: Configuration, ahead: float) -> Iterator[tuple[str, float, list[float]]]:
    """Yield each reference, noise and the predictors' errors from the first cycle's end on."""
    outer = configuration.strain_loop
    loop = outer.proportional_gain / STIFFNESS
    integral = outer.integral_gain / outer.proportional_gain
    for name, changes in REFERENCES.items():
        parameters = dataclasses.replace(configuration.reference, **changes)
        reference = reference_law(parameters)
        ticks = round(parameters.duration() / DT)
        strain = followed(reference, ticks, loop, integral, DT)
        later = round(ahead / DT)
        first = round(1.0 / parameters.frequency / DT)
        for noise in NOISES:
            measured = strain + noise * np.random.default_rng(1).standard_normal(ticks)
            errors = []
            for kind in PREDICTORS:
                chosen = dataclasses.replace(
                    configuration,
                    reference=parameters,
                    recruitment=dataclasses.replace(
                        configuration.recruitment, predictor=kind, prediction_horizon=ahead
                    ),
                )
                law = predictor(chosen)
                expected = expectations(law, predictor_start(), reference, measured, ahead, DT)
                wrong = (strain[later:] - expected[:-later])[first:]
                errors.append(float(np.sqrt(np.mean(wrong * wrong))))
            yield name, noise, errors


def main() -> None:
    """Print the table."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument('--ahead', type=float, default=0.3, help='s (%(default)s)')
    ahead = arguments.parse_args().ahead
    configuration = load_configuration(default_configuration())
    print(f'| reference | noise | {" | ".join(PREDICTORS)} |')
    print('|---|---|' + '---|' * len(PREDICTORS))
    for name, noise, errors in rows(configuration, ahead):
        numbers = ' | '.join(f'{1e3 * error:.3f}' for error in errors)
        print(f'| {name} | {noise:g} | {numbers} |')


if __name__ == '__main__':
    main()
