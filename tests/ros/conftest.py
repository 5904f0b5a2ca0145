# SPDX-License-Identifier: MIT OR Apache-2.0
"""A host for each test: a domain and a runtime directory of its own, and everything that runs on it."""

import itertools
import os
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import threading
import time

import pytest

# How long anything may take before a test fails: never a measure of speed, but what a machine that is busy
# with other things may need.
PATIENCE = 180

NODES = pathlib.Path(__file__).parent / 'nodes'

# The second distribution of test_distributions.py. AXON warns of a variable of its name that it does not know.
OTHER_SETUP = os.environ.pop('AXON_ROS_OTHER', '')

_domains = itertools.cycle(range(20, 80))


class Process:
    """A command that runs, and the lines that it has said so far on either stream."""

    def __init__(self, command, env):
        self.command = command
        self.lines = []
        self._said = threading.Condition()
        self._child = subprocess.Popen(
            command, env=env, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, errors='replace', start_new_session=True)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self):
        for line in self._child.stdout:
            with self._said:
                self.lines.append(line.rstrip('\n'))
                self._said.notify_all()
        with self._said:
            self._said.notify_all()

    @property
    def pid(self):
        return self._child.pid

    @property
    def running(self):
        return self._child.poll() is None

    @property
    def output(self):
        with self._said:
            return '\n'.join(self.lines)

    def said(self, pattern, count=1, since=0, patience=PATIENCE):
        """Wait until `count` lines from number `since` on match; returns them."""
        deadline = time.monotonic() + patience
        with self._said:
            while True:
                found = [line for line in self.lines[since:] if re.search(pattern, line)]
                if len(found) >= count:
                    return found
                left = deadline - time.monotonic()
                over = self._child.poll() is not None and not self._reader.is_alive()
                if left <= 0 or over:
                    text = '\n'.join(self.lines[-40:])
                    raise AssertionError(
                        f'{" ".join(self.command)} said {pattern!r} {len(found)} times, '
                        f'{count} expected; the last of it:\n{text}')
                self._said.wait(min(left, 0.2))

    def signal(self, number):
        """Send a signal to the process and all that it started."""
        if self.running:
            os.killpg(self._child.pid, number)

    def end(self, patience=PATIENCE):
        """Interrupt it as Ctrl-C does, and return its exit status."""
        self.signal(signal.SIGINT)
        return self.wait(patience)

    def wait(self, patience=PATIENCE):
        try:
            status = self._child.wait(patience)
        except subprocess.TimeoutExpired:
            text = self.output
            self.kill()
            raise AssertionError(f'{" ".join(self.command)} does not end:\n{text}') from None
        self._reader.join(5)
        return status

    def complete(self):
        """What it said until its end, whatever its status is."""
        self.wait()
        return self.output

    def kill(self):
        self.signal(signal.SIGKILL)
        self._child.wait()
        self._reader.join(5)


class Host:
    """One host: an environment, and the processes that were started in it."""

    def __init__(self, directory, **variables):
        self.runtime = directory / 'run'
        self.runtime.mkdir(mode=0o700)
        # A daemon that nobody needs would stay for longer.
        settings = directory / 'axon.toml'
        settings.write_text('[link]\ngrace_s = 2\n', encoding='utf-8')
        self.env = {
            **os.environ,
            'RMW_IMPLEMENTATION': os.environ.get('RMW_IMPLEMENTATION', 'rmw_axon'),
            'ROS_DOMAIN_ID': str(next(_domains)),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            'ROS_HOME': str(directory / 'ros'),
            'ROS_LOG_DIR': str(directory / 'log'),
            'AXON_RUNTIME_DIR': str(self.runtime),
            'AXON_CONFIG': str(settings),
            'PYTHONUNBUFFERED': '1',
            'RCUTILS_LOGGING_BUFFERED_STREAM': '0',
            **variables,
        }
        self.processes = []

    def start(self, *command):
        process = Process([str(part) for part in command], self.env)
        self.processes.append(process)
        return process

    def node(self, name, *arguments):
        """Start one of the programs in nodes/."""
        return self.start(sys.executable, NODES / f'{name}.py', *arguments)

    def run(self, *command, patience=PATIENCE):
        """Run a command to its end; returns what it said."""
        process = self.start(*command)
        status = process.wait(patience)
        assert status == 0, f'{" ".join(process.command)} ended with {status}:\n{process.output}'
        return process.output

    def shows(self, part, *command):
        """Whether a command that asks the graph shows `part` by now; it may fail meanwhile."""
        return part in self.start(*command).complete()

    def everything(self):
        """What runs in this host's environment: process IDs and the names of their programs."""
        ours = f'AXON_RUNTIME_DIR={self.runtime}'.encode()
        found = {}
        for entry in pathlib.Path('/proc').iterdir():
            if not entry.name.isdigit():
                continue
            try:
                if ours in (entry / 'environ').read_bytes().split(b'\0'):
                    found[int(entry.name)] = os.path.basename(os.readlink(entry / 'exe'))
            except OSError:
                continue
        return found

    def daemons(self):
        """Process IDs of this host's AXON daemons."""
        return [pid for pid, program in self.everything().items() if program == 'axon_daemon']

    def end_all(self):
        """Kill what was started, and all that this started in turn but the AXON daemon."""
        for process in self.processes:
            process.kill()
        # The daemon of ros2's command line is in a session of its own.
        for pid, program in self.everything().items():
            if program != 'axon_daemon':
                try:
                    os.kill(pid, signal.SIGKILL)
                except ProcessLookupError:
                    pass

    def close(self):
        self.end_all()
        # Nobody needs the daemon any more: it ends by itself.
        until(lambda: not self.everything(), 'the daemon ends when nobody needs it')
        assert not list(self.runtime.glob('*.sock')), 'a socket is left behind'


def until(reached, what, patience=PATIENCE):
    """Wait until `reached()`; fails saying `what` was awaited."""
    deadline = time.monotonic() + patience
    while not reached():
        assert time.monotonic() < deadline, f'in vain: {what}'
        time.sleep(0.1)


@pytest.fixture
def host(tmp_path):
    made = Host(tmp_path)
    yield made
    made.close()


def pytest_addoption(parser):
    parser.addoption(
        '--full', action='store_true', help='kill at random for minutes instead of a sample')


def pytest_collection_modifyitems(items):
    if shutil.which('ros2') is None:
        for item in items:
            item.add_marker(pytest.mark.skip(reason='no ros2 in PATH: source a ROS 2 first'))
