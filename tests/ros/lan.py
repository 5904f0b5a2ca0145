# SPDX-License-Identifier: MIT OR Apache-2.0
"""Hosts on one network: network namespaces, each with a daemon of its own, on a switch."""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess

import pytest

from conftest import Host, Process
from namespace import Namespace, Unavailable

ADDRESS = '10.88.0.{}'


class Lan:
    """A switch, hosts, and key managers that stand on the switch."""

    def __init__(self, directory):
        self._directory = directory
        self._hosts, self._kmes = [], []
        self._switch = Namespace()
        self._namespaces = [self._switch]
        # Multicast goes to all: that is what discovery counts on.
        self._switch.ip('link', 'add', 'switch', 'type', 'bridge', 'mcast_snooping', 0)
        self._switch.ip('link', 'set', 'switch', 'up')

    def host(self, name, **variables):
        """A host called `name` with these settings; nothing runs on it."""
        number = len(self._hosts) + 1
        namespace = Namespace(inside=self._switch)
        self._namespaces.append(namespace)
        self._switch.ip(
            'link', 'add', f'port{number}', 'type', 'veth',
            'peer', 'name', 'eth0', 'netns', namespace.pid)
        self._switch.ip('link', 'set', f'port{number}', 'master', 'switch', 'up')
        namespace.ip('address', 'add', f'{ADDRESS.format(number)}/24', 'dev', 'eth0')
        namespace.ip('link', 'set', 'eth0', 'up')
        (self._directory / name).mkdir()
        host = LanHost(self._directory / name, namespace, **variables)
        if self._hosts:
            host.env['ROS_DOMAIN_ID'] = self._hosts[0].env['ROS_DOMAIN_ID']
        self._hosts.append(host)
        return host

    def kmes(self, *saes):
        """Starts a KME for each SAE, all of one QKD network; returns the settings of each SAE."""
        program = tool('kme-sim')
        directory = self._directory / f'kmes{len(self._kmes)}'
        sites = []
        for number, sae in enumerate(saes):
            address = ADDRESS.format(100 + 10 * len(self._kmes) + number)
            self._switch.ip('address', 'add', f'{address}/24', 'dev', 'switch')
            sites.append(f'--kme=kme-of-{sae}={address}:8443={sae}')
        printed = subprocess.run(
            [program, 'init', directory, *sites], check=True, capture_output=True, text=True)
        self.serve_keys(program, directory, len(saes))
        settings = {}
        for line in printed.stdout.splitlines():
            if line.startswith('# '):
                variables = settings.setdefault(line[2:], {})
            else:
                name, value = re.fullmatch(r"export (\w+)='(.*)'", line).groups()
                variables[name] = value
        return [settings[sae] for sae in saes]

    def serve_keys(self, program, directory, count):
        """Starts the `count` KMEs of a directory that `kme-sim init` made."""
        command = [*self._switch.enter, program, 'run', '--strict', directory]
        process = Process([str(part) for part in command], dict(os.environ))
        self._kmes.append(process)
        process.said('https://', count=count)

    def close(self):
        with contextlib.ExitStack() as last:
            for namespace in self._namespaces:
                last.callback(namespace.close)
            for process in self._kmes:
                last.callback(process.kill)
            for host in self._hosts:
                last.callback(host.close)


class LanHost(Host):
    """A host in a namespace, whose daemon is found by the others."""

    def __init__(self, directory, namespace, **variables):
        super().__init__(directory, ROS_AUTOMATIC_DISCOVERY_RANGE='SUBNET', **variables)
        self._namespace = namespace
        # What AXON's tool is told beside the host's settings.
        self.tool_env = {}

    def start(self, *command):
        return super().start(*self._namespace.enter, *command)

    def start_with(self, variables, *command):
        """Start a command with variables of its own beside the host's."""
        settings = [f'{name}={value}' for name, value in variables.items()]
        return self.start('env', *settings, *command)

    def status(self):
        """What this host's daemon says of itself; None where there is no daemon."""
        asked = subprocess.run(
            [*self._namespace.enter, tool('axon'), 'status', '--json'],
            env={**self.env, **self.tool_env}, capture_output=True, text=True)
        return json.loads(asked.stdout) if asked.returncode == 0 else None

    def linked(self):
        """Whether its daemon has a link to another host's."""
        status = self.status()
        return status is not None and any(
            link['state'] == 'connected' for link in status['links'])

    def refusals(self):
        """Whom its daemon refused, and why, as text."""
        status = self.status() or {'refusals': []}
        return '\n'.join(' '.join(map(str, refusal.values())) for refusal in status['refusals'])

    def kill_daemon(self):
        for pid in self.daemons():
            os.kill(pid, signal.SIGKILL)

    def end(self):
        """Ends all that runs on it, the daemon too, whose grace time is not waited for."""
        for process in self.processes:
            process.kill()
        for pid in self.daemons():
            os.kill(pid, signal.SIGTERM)
        super().close()

    def close(self):
        self.end()


def tool(name):
    """The path of a program of AXON's."""
    found = shutil.which(name)
    if found is None:
        pytest.skip(f'no {name} in PATH: cargo build, and put target/debug there')
    return found


@pytest.fixture
def lan(tmp_path):
    try:
        made = Lan(tmp_path)
    except Unavailable as why:
        pytest.skip(str(why))
    yield made
    made.close()
