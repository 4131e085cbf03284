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
Shared laws, and the FAM's equations transcribed a second time for the tests.

``ExactFam`` states energies and volumes and lets scipy find the roots; it shares no code with
``fam_bundle_model``. Forces are derivatives of its energies by a complex step, which has no
truncation error to speak of.
"""

import dataclasses
from pathlib import Path

from fam_bundle_model.bundle import motor_units
from fam_bundle_model.fam import fam_law
from fam_bundle_model.hydraulics import hydraulic_law
from fam_bundle_model.parameters import FamParameters, load_configuration
import numpy as np
import pytest
from scipy.optimize import brentq

CONFIGURATION = Path(__file__).parents[2] / 'fam_bundle_bringup' / 'config' / 'lhacd.yaml'
HIGHEST_PRESSURE = 1.4e6
BULK_MODULUS = 80e6

# Table 1 of the paper, with a mid-range silicone.
TABLE_1 = {
    'count': 2,
    'inner_radius': 0.0063,
    'thickness': 0.0016,
    'braid_angle': np.deg2rad(33.0),
    'length': 0.222,
    'youngs_modulus': 2.5e6,
    'youngs_modulus_factor': 1.3,
    'mooney_rivlin_share': 0.3,
    'poisson_ratio': 0.5,
    'collapse_moment_factor': 0.75,
    'end_spring_span': 1.0,
    'end_spring_slope': 0.9e-6,
    'end_spring_offset': 1.54,
    'transition_constant': 100.0,
}


class ExactFam:
    """One FAM of ``p`` (names as in ``FamParameters``), exact to the root finder's tolerance."""

    def __init__(self, **p):
        self.p = p
        self.r0, self.t0, self.l0 = p['inner_radius'], p['thickness'], p['length']
        self.outer = self.r0 + self.t0
        self.young = p['youngs_modulus'] * p['youngs_modulus_factor']
        self.a0 = p['braid_angle']

    def volume(self, e):
        """Equation 8: a cylinder whose braid keeps its thread length and its turns."""
        axial = 1.0 - e
        length = self.l0 * axial
        hoop2 = (1.0 - axial**2 * np.cos(self.a0) ** 2) / np.sin(self.a0) ** 2
        return np.pi * self.r0**2 * hoop2 * length

    def bladder_energy(self, e):
        """Mooney-Rivlin energy of the incompressible bladder, from the principal stretches."""
        a2 = (1.0 - e) ** 2
        h2 = (1.0 - a2 * np.cos(self.a0) ** 2) / np.sin(self.a0) ** 2
        r2 = 1.0 / (a2 * h2)
        share = self.p['mooney_rivlin_share']
        c = self.young / 6.0
        energy = c * (1.0 - share) * (a2 + h2 + r2 - 3.0)
        energy += c * share * (1.0 / a2 + 1.0 / h2 + 1.0 / r2 - 3.0)
        return np.pi * (self.outer**2 - self.r0**2) * self.l0 * energy

    def straight(self, pressure, e):
        """Force of a straight FAM by virtual work: F dx = P dV - dU, x = L0 e."""
        step = 1e-30j
        work = pressure * self.volume(e + step) - self.bladder_energy(e + step)
        return work.imag / (1e-30 * self.l0)

    def free_strain(self, pressure):
        stretched = 1.0 - 1.0 / np.cos(self.a0)  # braid along the axis, no hoop left
        return brentq(lambda e: self.straight(pressure, e), stretched + 1e-9, 0.6, xtol=1e-15)

    def spring(self, pressure):
        p = self.p
        second_moment = np.pi / 4.0 * (self.outer**4 - self.r0**4)
        base = self.young * second_moment / (p['end_spring_span'] * self.outer)
        return base * (p['end_spring_slope'] * pressure + p['end_spring_offset'])

    def rigidity(self, pressure, e):
        second_moment = np.pi / 4.0 * (self.outer**4 - self.r0**4)
        braid = 6.0 * (1.0 - e) * np.pi * self.r0**2 * pressure / np.tan(self.a0) ** 2
        return self.young * second_moment + self.outer**2 / 2.0 * braid

    def psi(self, pressure, e):
        """Sin psi + (2 / kappa) psi cos psi = 0 between pinned (pi/2) and clamped (pi) ends."""
        kappa = self.spring(pressure) * self.l0 * (1.0 - e) / self.rigidity(pressure, e)
        return brentq(
            lambda x: np.sin(x) + 2.0 / kappa * x * np.cos(x), np.pi / 2, np.pi, xtol=1e-15
        )

    def euler(self, pressure, e):
        """Critical load as a positive number."""
        bent = 2.0 * self.psi(pressure, e) / (self.l0 * (1.0 - e))
        return bent**2 * self.rigidity(pressure, e)

    def buckling(self, pressure):
        return brentq(
            lambda e: self.straight(pressure, e) + self.euler(pressure, e),
            self.free_strain(pressure),
            0.6,
            xtol=1e-15,
        )

    def collapse(self, pressure):
        """
        Strain at which the buckled shape's mid-span moment reaches the collapse moment.

        The shape's shortening is integrated numerically from its slope.
        """
        e_b = self.buckling(pressure)
        length, psi = self.l0 * (1.0 - e_b), self.psi(pressure, e_b)
        p = self.p
        mean_radius = self.r0 + self.t0 / 2.0
        brazier = 2.0 * np.sqrt(2.0) / 9.0 * np.pi * self.young * self.t0**2 * mean_radius
        brazier /= np.sqrt(1.0 - p['poisson_ratio'] ** 2)
        moment = p['collapse_moment_factor'] * (np.pi * pressure * self.r0**3 + brazier)
        wave = 2.0 * psi / length
        amplitude = moment / (self.rigidity(pressure, e_b) * wave**2)
        x, w = np.polynomial.legendre.leggauss(40)
        slope = amplitude * wave * np.sin(wave * x * length / 2.0)
        shortening = 0.5 * np.sum(w * slope**2) * length / 2.0
        return e_b + shortening / self.l0

    def folding_spring(self, pressure):
        """End spring in series with half a link as a beam."""
        e_b = self.buckling(pressure)
        arc = self.l0 * (1.0 - e_b)
        return 1.0 / (1.0 / self.spring(pressure) + arc / 6.0 / self.rigidity(pressure, e_b))


def build(values):
    """Return the law under test and its exact counterpart for one FAM's parameters."""
    parameters = FamParameters(**{k: (v,) for k, v in values.items()})
    return fam_law(parameters, 0, HIGHEST_PRESSURE, BULK_MODULUS), ExactFam(**values)


@pytest.fixture(scope='session')
def make_fam():
    """Return a function from changes to Table 1 to (law, exact)."""
    known = {}

    def make(**changes):
        key = tuple(sorted(changes.items()))
        if key not in known:
            known[key] = build({**TABLE_1, **changes})
        return known[key]

    return make


@pytest.fixture(scope='session')
def configuration_path():
    return CONFIGURATION


@pytest.fixture(scope='session')
def configuration():
    return load_configuration(CONFIGURATION)


@pytest.fixture(scope='session')
def units(configuration):
    return motor_units(configuration)


@pytest.fixture(scope='session')
def hydraulics(configuration):
    return hydraulic_law(configuration)


@pytest.fixture(scope='session')
def change(configuration):
    """Return a function that gives the configuration with one parameter of a group changed."""

    def changed(group, **values):
        part = dataclasses.replace(getattr(configuration, group), **values)
        return dataclasses.replace(configuration, **{group: part})

    return changed
