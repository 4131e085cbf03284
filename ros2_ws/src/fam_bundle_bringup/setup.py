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

from glob import glob

from setuptools import setup

package = 'fam_bundle_bringup'

setup(
    name=package,
    version='0.1.0',
    description='Configuration and the experiment runner of a bundle.',
    maintainer='fam_bundle maintainers',
    maintainer_email='maintainers@fam-bundle.example',
    license='Apache-2.0',
    packages=[package],
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{package}']),
        (f'share/{package}', ['LICENSE', 'package.xml']),
        (f'share/{package}/config', sorted(glob('config/*.yaml') + glob('config/*.xml'))),
        (f'share/{package}/launch', sorted(glob('launch/*.launch.py'))),
        (f'share/{package}/layouts', sorted(glob('layouts/*'))),
        (f'share/{package}/security', sorted(glob('security/*.xml'))),
    ],
    install_requires=['setuptools'],
    extras_require={'test': ['pytest']},
    zip_safe=False,
    entry_points={
        'console_scripts': [
            'composed_loop = fam_bundle_bringup.composed_loop:main',
            'fam_bundle = fam_bundle_bringup.cli:main',
        ],
    },
)
