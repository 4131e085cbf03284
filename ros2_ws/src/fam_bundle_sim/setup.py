# SPDX-License-Identifier: Apache-2.0
from setuptools import setup

package = 'fam_bundle_sim'

setup(
    name=package,
    version='0.1.0',
    description='Simulated plant and sensors of a bundle, with the plant simulator node.',
    maintainer='fam_bundle maintainers',
    maintainer_email='maintainers@fam-bundle.example',
    license='Apache-2.0',
    packages=[package],
    package_data={package: ['py.typed']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{package}']),
        (f'share/{package}', ['package.xml']),
    ],
    install_requires=['setuptools'],
    extras_require={'test': ['pytest']},
    zip_safe=False,
    entry_points={
        'console_scripts': [
            'plant_simulator = fam_bundle_sim.plant_simulator_node:main',
            'volts_card = fam_bundle_sim.volts_card:main',
        ],
        'fam_bundle.backends': [
            'volts = fam_bundle_sim.volts_backend:VoltsBackend',
            'volts_card = fam_bundle_sim.volts_card:VoltsCard',
        ],
    },
)
