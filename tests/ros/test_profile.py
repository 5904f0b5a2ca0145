# SPDX-License-Identifier: MIT OR Apache-2.0
"""The profile of AXON_QKD_ROLE: two builds, two hosts, and keys of the simulator that comes with the first."""

import os
import pathlib
import shutil
import stat
import subprocess
import sys

import pytest

from lan import lan  # noqa: F401 (a fixture)
from test_hosts import listener, talker

SOURCE = pathlib.Path(__file__).resolve().parent.parent.parent / 'rmw_axon'


class Build:
    """A build folder of rmw_axon with a role; the core comes from the one that is tested."""

    def __init__(self, directory, role, material, *more):
        core = os.environ.get('RMW_AXON_CORE')
        if core is None:
            pytest.skip('RMW_AXON_CORE does not name the core folder of a build of rmw_axon')
        self.directory = directory
        directory.mkdir()
        (directory / 'core').symlink_to(core)
        self.configured = self._run(
            'cmake', '-S', SOURCE, '-B', directory, '-DBUILD_TESTING=OFF', '-Wno-dev',
            f'-DPython3_EXECUTABLE={sys.executable}', f'-DAXON_QKD_ROLE={role}',
            f'-DAXON_QKD_MATERIAL={material}', *more)

    def build(self):
        return self._run('cmake', '--build', self.directory, '--target', 'axon_qkd_profile')

    def install(self, prefix):
        """The installation that is tested, and the profile; returns what CMake did."""
        if not prefix.exists():
            shutil.copytree(installed(), prefix, symlinks=True)
        return self._run(
            'cmake', '--install', self.directory, '--prefix', prefix,
            '--component', 'axon_qkd_profile')

    @staticmethod
    def _run(*command):
        return subprocess.run(
            list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def installed():
    """The prefix of the rmw_axon that is tested."""
    for prefix in os.environ['AMENT_PREFIX_PATH'].split(':'):
        if (pathlib.Path(prefix) / 'lib/librmw_axon.so').exists():
            return pathlib.Path(prefix)
    pytest.skip('rmw_axon is not installed')


def use(host, prefix):
    """Has a host's processes use this installation."""
    for name, path in (('AMENT_PREFIX_PATH', prefix), ('LD_LIBRARY_PATH', prefix / 'lib')):
        host.env[name] = f'{path}:{host.env[name]}'
    # The profile beside the daemon is its configuration.
    del host.env['AXON_CONFIG']
    # The tool is installed elsewhere, and finds the profile by its daemon.
    host.tool_env = {'AXON_DAEMON_PATH': str(prefix / 'lib/rmw_axon/axon_daemon')}


def heard_both_ways(a, b):
    for here, there, topic in ((a, b, 'from_a'), (b, a, 'from_b')):
        talker(here, topic)
        listener(there, topic).said('I heard', count=3)


def test_a_role_that_is_none_is_refused(tmp_path):
    build = Build(tmp_path / 'build', 3, tmp_path / 'material')
    assert build.configured.returncode != 0
    assert 'AXON_QKD_ROLE: read "3", accepted: 1, 2' in build.configured.stdout


def test_two_hosts_with_roles_have_keys_and_can_do_without(lan, tmp_path):  # noqa: F811
    first = Build(tmp_path / '1', 1, tmp_path / 'material1', '-DAXON_QKD_ADDRESS=10.88.0.1')
    second = Build(tmp_path / '2', 2, tmp_path / 'material2')
    for build in (first, second):
        assert build.configured.returncode == 0, build.configured.stdout
        assert 'SIMULATED' in build.configured.stdout

    # Host 2 makes no keys of its own: they would fit nobody's.
    alone = second.build()
    assert alone.returncode != 0 and 'Build with AXON_QKD_ROLE=1 on host 1' in alone.stdout
    made = first.build()
    assert made.returncode == 0, made.stdout
    once = {path: path.read_bytes() for path in (tmp_path / 'material1').rglob('*.key')}
    again = first.build()
    assert again.returncode == 0 and once, again.stdout
    assert all(path.read_bytes() == key for path, key in once.items()), 'keys are drawn once'
    (tmp_path / 'material2').mkdir(mode=0o700)
    shutil.copytree(tmp_path / 'material1/host-2', tmp_path / 'material2/host-2')
    copied = second.build()
    assert copied.returncode == 0, copied.stdout

    prefixes = [tmp_path / 'prefix1', tmp_path / 'prefix2']
    for build, prefix in zip((first, second), prefixes):
        done = build.install(prefix)
        assert done.returncode == 0 and 'SIMULATED' in done.stdout, done.stdout
    keys = [path for prefix in prefixes for path in prefix.rglob('*.key')]
    assert all(stat.S_IMODE(path.stat().st_mode) == 0o600 for path in keys) and len(keys) > 2
    of_second = {path.name for path in prefixes[1].rglob('*.key')}
    assert of_second == {'simulated-host-2.key'}, 'host 2 has its own key and no other'

    a, b = lan.host('a'), lan.host('b')
    for host, prefix in zip((a, b), prefixes):
        use(host, prefix)
    kmes = a.start(
        'ros2', 'run', 'rmw_axon', 'kme-sim', 'run', '--strict',
        prefixes[0] / 'lib/rmw_axon/simulated-qkd/kmes')
    kmes.said('https://', count=2)
    heard_both_ways(a, b)
    for host, sae, peer in ((a, 1, 2), (b, 2, 1)):
        status = host.status()
        assert status['mode'] == 'qkd' and status['sae'] == f'simulated-host-{sae}'
        assert [link['sae'] for link in status['links']] == [f'simulated-host-{peer}']

    # One variable, and no other, turns the mode.
    for host in (a, b):
        host.end()
        host.env['AXON_SECURITY_MODE'] = 'classic'
    heard_both_ways(a, b)
    assert [host.status()['mode'] for host in (a, b)] == ['classic', 'classic']


def test_install_does_not_replace_an_existing_configuration(tmp_path):
    build = Build(tmp_path / 'build', 1, tmp_path / 'material')
    assert build.build().returncode == 0
    written = tmp_path / 'prefix/lib/rmw_axon/axon.toml'
    written.parent.mkdir(parents=True)
    written.write_text('security_mode = "qkd"\n')
    done = build.install(tmp_path / 'prefix')
    assert done.returncode != 0 and 'move it away' in done.stdout
    assert written.read_text() == 'security_mode = "qkd"\n'
    assert not list((tmp_path / 'prefix').rglob('*.key'))
