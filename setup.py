# SPDX-License-Identifier: Apache-2.0
"""Build of the ROS 2 package `ctsid` (ament_python); also a plain pip package."""

from glob import glob
from pathlib import Path
from zlib import crc32

from setuptools import Extension, find_packages, setup

PACKAGE = 'ctsid'
KERNEL = Path(__file__).parent / 'ctsid_core/likelihood/kernel.c'
ROS = ['ros-jazzy-rclpy[fastrtps]', 'ros-jazzy-common-interfaces']
# Recordings other than bags, each by its library.
FILES = {'px4': ['pyulog'], 'ardupilot': ['pymavlink'], 'parquet': ['pyarrow'],
         'remote': ['fsspec[http]']}
EVERY_FILE = [library for libraries in FILES.values() for library in libraries]
BATCH = ['distributed', 'pyarrow']  # distributed brings dask along
TEST = [*EVERY_FILE, *BATCH, 'pytest>=8', 'pytest-xdist', 'hypothesis', 'mpmath', 'control',
        'jsonschema', 'nlohmann-json', 'playwright', 'colcon-core', 'colcon-ros',
        'setuptools>=70.1']  # builds wheels without the package `wheel`
DOCS = ['sphinx', 'myst-parser', 'furo']

setup(
    name=PACKAGE,
    version='0.1.0',
    description='Continuous-time system identification for robots, from a bag or online',
    license='Apache-2.0',
    author='The ctsid developers',
    maintainer='The ctsid developers',
    maintainer_email='ctsid@users.noreply.github.com',
    packages=find_packages(include=['ctsid_core*', 'ctsid_ros*']),
    # Without a compiler NumPy does the same, in more time.
    ext_modules=[Extension(
        'ctsid_core.likelihood._kernel', ['ctsid_core/likelihood/kernel.c'], optional=True,
        define_macros=[('EDITION', f'{crc32(KERNEL.read_bytes())}u')],
        extra_compile_args=['-std=c11', '-O3', '-fcx-limited-range', '-ffp-contract=off',
                            '-fno-math-errno'])],
    package_data={'ctsid_core': ['py.typed', 'model/*.json'],
                  'ctsid_ros': ['py.typed', 'report/page/*']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        *((f'share/{PACKAGE}/{folder}', sorted(glob(f'{folder}/{pattern}')))
          for folder, pattern in (('config', '*.*'), ('launch', '*.launch.py'))
          if glob(f'{folder}/{pattern}')),
    ],
    python_requires='>=3.11',
    install_requires=['numpy>=1.26', 'scipy', 'mcap', 'rosbags', 'lz4', 'zstandard',
                      'PyYAML', 'rich', 'jinja2', 'matplotlib', 'plotly', 'threadpoolctl>=3.8',
                      # Faster checksums than zlib's, which serve where there is no wheel of it.
                      'isal; platform_machine in "x86_64 AMD64 aarch64 arm64"'],
    extras_require={
        'ros': ROS,
        **FILES,
        'files': EVERY_FILE,
        'batch': BATCH,
        'test': TEST,
        'docs': DOCS,
        'bench': ['ctrlsys', 'nfoursid', 'sippy_unipi'],
        'dev': [*TEST, 'ruff', 'mypy'],
    },
    entry_points={'console_scripts': [
        'ctsid = ctsid_ros.cli:main',
        'identifier = ctsid_ros.node:main',
        'gain_tuner = ctsid_ros.examples.gain_tuner:main',
        'simulated_robot = ctsid_ros.examples.simulated_robot:main',
    ]},
    zip_safe=False,
)
