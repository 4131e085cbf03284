# SPDX-License-Identifier: Apache-2.0
from setuptools import setup

package = 'fam_bundle_control'

setup(
    name=package,
    version='0.1.0',
    description='Strain loop, pressure loop and recruitment of a bundle, with their nodes.',
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
            'lag_table_server = fam_bundle_control.lag_table_server_node:main',
            'pressure_controller = fam_bundle_control.pressure_controller_node:main',
            'recruitment_supervisor = fam_bundle_control.recruitment_supervisor_node:main',
            'strain_controller = fam_bundle_control.strain_controller_node:main',
        ],
    },
)
