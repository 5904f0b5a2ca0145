# SPDX-License-Identifier: MIT OR Apache-2.0
"""The programs that are built, and the machine that they run on."""

import os
import pathlib
import platform
import subprocess
import sys
import time

HERE = pathlib.Path(__file__).resolve().parent


def build(directory):
    """Builds the programs; returns the folder that they are in."""
    root = HERE.parent.parent.parent
    target = pathlib.Path(os.environ.get('CARGO_TARGET_DIR', root / 'target'))
    directory = (directory or target / 'ros_bench').resolve()
    # The default RMW is none of the programs' business.
    env = {name: value for name, value in os.environ.items() if name != 'RMW_IMPLEMENTATION'}
    for command in (
            ['cmake', '-S', HERE, '-B', directory, '-DCMAKE_BUILD_TYPE=Release', '-Wno-dev',
             '-DBUILD_TESTING=OFF', f'-DPython3_EXECUTABLE={sys.executable}'],
            ['cmake', '--build', directory, '--parallel', '2']):
        done = subprocess.run(
            list(map(str, command)), env=env, capture_output=True, text=True)
        if done.returncode != 0:
            sys.exit(f'{done.stdout}\n{done.stderr}')
    return directory


def machine():
    model = next(
        (line.split(':', 1)[1].strip() for line in open('/proc/cpuinfo') if 'model name' in line), '')
    return {
        'cpu': model, 'cpus': os.cpu_count(), 'kernel': platform.release(),
        'ros_distro': os.environ.get('ROS_DISTRO', ''),
        'date': time.strftime('%Y-%m-%d %H:%M', time.gmtime()),
        'load_before': os.getloadavg()[0]}
