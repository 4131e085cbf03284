# SPDX-License-Identifier: Apache-2.0
from setuptools import setup

package = 'fam_bundle_io'

setup(
    name=package,
    version='0.1.0',
    description='Recording, reading, metrics and figures of the runs of a bundle.',
    maintainer='fam_bundle maintainers',
    maintainer_email='maintainers@fam-bundle.example',
    license='Apache-2.0',
    packages=[package, f'{package}.hardware'],
    package_data={package: ['py.typed', '*.mplstyle']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{package}']),
        (f'share/{package}', ['package.xml']),
    ],
    install_requires=['setuptools'],
    extras_require={'test': ['pytest']},
    zip_safe=False,
    entry_points={
        'console_scripts': [
            'bag_recorder = fam_bundle_io.bag_recorder_node:main',
            'hardware_bridge = fam_bundle_io.hardware_bridge_node:main',
        ],
        'fam_bundle.backends': [
            'mock = fam_bundle_io.hardware.mock_backend:MockBackend',
            'nidaqmx = fam_bundle_io.hardware.nidaqmx_backend:NidaqmxBackend',
            'quanser = fam_bundle_io.hardware.quanser_backend:QuanserBackend',
        ],
    },
)
