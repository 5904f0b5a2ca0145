# SPDX-License-Identifier: MIT OR Apache-2.0
"""What is measured, and how."""

import json
import pathlib
import select
import subprocess
import time

from namespace import Namespace, Unavailable
from rmws import daemons

# Bytes, and messages a second: of the large ones no more than each implementation keeps up with.
PACES = [(64, 200), (1024, 200), (65536, 200), (1048576, 100), (4194304, 50)]
PARTS = ['latency', 'latency, lent', 'throughput', 'first message', 'launch', 'network latency',
         'network throughput']
PATIENCE = 120


class Bench:
    """The programs, and how long each stream lasts."""

    def __init__(self, programs, seconds):
        self._programs = programs
        self.seconds = seconds

    def start(self, env, program, *arguments, enter=()):
        # The types' own libraries are opened by name.
        libraries = f"{self._programs}:{env.get('LD_LIBRARY_PATH', '')}"
        return subprocess.Popen(
            [*enter, str(self._programs / f'bench_{program}'), *map(str, arguments)],
            env={**env, 'LD_LIBRARY_PATH': libraries}, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


class Stream:
    """Latency, or with `hz` 0 throughput, of one publisher and one subscription."""

    def __init__(self, kind, size, hz, network=False):
        self.kind, self.size, self.hz, self.network = kind, size, hz, network
        pace = f', {hz} Hz' if hz else ''
        self.title = f'{size} B{pace}'

    def measure(self, bench, rmw, end):
        try:
            hosts = two_hosts(rmw, end) if self.network else [(rmw.environment(end), ())] * 2
        except Unavailable as why:
            return {'failed': str(why)}
        (env_pub, enter_pub), (env_sub, enter_sub) = hosts
        watched = {env['AXON_RUNTIME_DIR'] for env in (env_pub, env_sub)}
        sub = keep(end, bench.start(env_sub, 'stream', 'sub', self.kind, self.size, enter=enter_sub))
        pub = keep(end, bench.start(
            env_pub, 'stream', 'pub', self.kind, self.size, self.hz, bench.seconds, enter=enter_pub))
        # In the middle of the stream: what the processes have mapped by then.
        time.sleep(bench.seconds / 2 + 1)
        of_daemons = [pid for runtime in watched for pid in daemons(runtime)]
        memory = {
            'pss_kib': [pss_kib(pub.pid), pss_kib(sub.pid)],
            'daemon_pss_kib': [pss_kib(pid) for pid in of_daemons]}
        at = cpu_s(of_daemons), time.monotonic()
        try:
            published = json.loads(pub.communicate(timeout=PATIENCE)[0])
            of_daemon = (cpu_s(of_daemons) - at[0]) / (time.monotonic() - at[1])
            taken = json.loads(sub.communicate(timeout=PATIENCE)[0])
        except (subprocess.TimeoutExpired, json.JSONDecodeError):
            return {'failed': 'it did not come to an end'}
        seconds = taken['seconds'] or 1
        return {
            'p50_us': taken['p50_us'], 'p99_us': taken['p99_us'], 'wrong': taken['wrong'],
            'sent': published['sent'], 'received': taken['received'],
            'per_second': taken['received'] / seconds,
            'gb_per_second': taken['received'] * self.size / seconds / 1e9,
            'cpu_us_a_message':
                1e6 * (published['cpu_s'] + taken['cpu_s']) / max(taken['received'], 1),
            'daemon_cores': of_daemon, **memory}


class First:
    """From the start of a process to its first message of a publisher that is there already."""

    title = 'median of 9'

    def measure(self, bench, rmw, end):
        env = rmw.environment(end)
        keep(end, bench.start(env, 'stream', 'pub', 'bytes', 64, 1000, 0))
        time.sleep(3)
        times = []
        for _ in range(9):
            started = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
            process = keep(end, bench.start(env, 'stream', 'first', 'bytes', 64, started))
            try:
                times.append(json.loads(process.communicate(timeout=PATIENCE)[0])['first_ms'])
            except (subprocess.TimeoutExpired, json.JSONDecodeError):
                return {'failed': 'no message came'}
        return {'first_ms': sorted(times)[4], 'all_ms': times}


class Launch:
    """Processes that are launched at once, until every graph has them all; then at rest."""

    def __init__(self, count):
        self.count = count
        self.title = f'{count} processes'

    def measure(self, bench, rmw, end):
        env = rmw.environment(end)
        first = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
        processes = [
            keep(end, bench.start(env, 'graph', n, self.count)) for n in range(self.count)]
        last = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
        overdue = subprocess.Popen(['sleep', str(PATIENCE)])
        end.callback(overdue.kill)
        whole = []
        for process in processes:
            line = read_line(process, overdue)
            if line is None:
                return {'failed': f'{len(whole)} of them whole in order after {PATIENCE} s'}
            whole.append(int(line))
        result = {
            'since_last_created_s': (max(whole) - last) / 1e9,
            'since_first_created_s': (max(whole) - first) / 1e9}
        time.sleep(5)
        pids = [process.pid for process in processes]
        of_daemons = daemons(env['AXON_RUNTIME_DIR'])
        memory = [pss_kib(pid) for pid in pids]
        before, since = cpu_s(pids + of_daemons), time.monotonic()
        time.sleep(10)
        used = cpu_s(pids + of_daemons) - before
        return {
            **result, 'cores_at_rest': used / (time.monotonic() - since),
            'pss_kib_a_process': sum(memory) / len(memory),
            'daemon_pss_kib': [pss_kib(pid) for pid in of_daemons]}


def read_line(process, overdue):
    """A line of its output; None when it is overdue, or has ended."""
    while overdue.poll() is None:
        if select.select([process.stdout], [], [], 0.2)[0]:
            return process.stdout.readline() or None
    return None


def plan(processes):
    """(part, its rows)"""
    paces = [(64, 1000), *PACES]
    yield PARTS[0], [Stream('bytes', size, hz) for size, hz in paces]
    yield PARTS[1], [Stream('fixed', size, hz) for size, hz in paces]
    yield PARTS[2], [Stream('bytes', size, 0) for size in (1024, 1048576)]
    yield PARTS[3], [First()]
    yield PARTS[4], [Launch(count) for count in processes]
    yield PARTS[5], [Stream('bytes', size, hz, network=True) for size, hz in PACES]
    yield PARTS[6], [Stream('bytes', size, 0, network=True) for size in (1024, 1048576)]


def two_hosts(rmw, end):
    """Environments of two hosts on a wire, and what runs a command on each."""
    a = Namespace()
    end.callback(a.close)
    b = Namespace(inside=a)
    end.callback(b.close)
    a.ip('link', 'add', 'eth0', 'type', 'veth', 'peer', 'name', 'eth0', 'netns', b.pid)
    hosts = []
    for number, host in enumerate((a, b), start=1):
        host.ip('address', 'add', f'10.89.0.{number}/24', 'dev', 'eth0')
        host.ip('link', 'set', 'eth0', 'up')
        host.ip('route', 'add', '224.0.0.0/4', 'dev', 'eth0')
        hosts.append((rmw.environment(end, network=True), host.enter))
    return hosts


def keep(end, process):
    """Ends with `end`, whatever happens."""
    def finish():
        process.kill()
        process.communicate()
    end.callback(finish)
    return process


def pss_kib(pid):
    """Memory of a process, what it shares divided among those who share it."""
    try:
        text = pathlib.Path(f'/proc/{pid}/smaps_rollup').read_text()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in text.splitlines() if line.startswith('Pss:')), 0)


def cpu_s(pids):
    """CPU time of processes so far, exact to the nanosecond."""
    total = 0
    for pid in pids:
        for task in pathlib.Path(f'/proc/{pid}/task').glob('*/schedstat'):
            try:
                total += int(task.read_text().split()[0])
            except OSError:
                pass
    return total / 1e9
