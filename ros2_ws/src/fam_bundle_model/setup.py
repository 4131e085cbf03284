# SPDX-License-Identifier: Apache-2.0
from setuptools import setup

package = 'fam_bundle_model'

setup(
    name=package,
    version='0.1.0',
    description='Physics of a variable-recruitment bundle of fluidic artificial muscles.',
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
)
