# SPDX-License-Identifier: MIT OR Apache-2.0
"""Network namespaces, which end with who made them."""

import os
import shutil
import subprocess


class Unavailable(Exception):
    """There are no network namespaces for us here, and why."""


class Namespace:
    """A network namespace, which ends with the process that holds it, and that with this one."""

    def __init__(self, inside=None):
        for tool in ('ip', 'nsenter', 'unshare'):
            if shutil.which(tool) is None:
                raise Unavailable(f'no {tool} in PATH, for network namespaces')
        # Who is not root is root in a user namespace, where that is permitted.
        self._user = [] if os.geteuid() == 0 else ['--user']
        enter = inside.enter if inside else []
        root = ['--map-root-user'] if self._user and not inside else []
        self._holder = subprocess.Popen(
            [*enter, 'unshare', *root, '--net', 'sh', '-c', 'echo made; exec cat'],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        if self._holder.stdout.readline() != 'made\n':
            why = self._holder.stderr.read().strip()
            raise Unavailable(f'network namespaces are not permitted here: {why}')
        self.ip('link', 'set', 'lo', 'up')

    @property
    def pid(self):
        return self._holder.pid

    @property
    def enter(self):
        """What runs a command inside, in front of it."""
        keep = ['--preserve-credentials'] if self._user else []
        return ['nsenter', '--target', str(self.pid), *self._user, *keep, '--net', '--']

    def ip(self, *arguments):
        done = subprocess.run(
            [*self.enter, 'ip', *map(str, arguments)], capture_output=True, text=True)
        if done.returncode != 0:
            raise Unavailable(f'no network can be made here: ip {arguments}: {done.stderr.strip()}')

    def close(self):
        self._holder.kill()
        self._holder.communicate()
