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
        (f'share/{package}', ['LICENSE', 'package.xml']),
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
