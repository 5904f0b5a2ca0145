# SPDX-License-Identifier: MIT OR Apache-2.0
"""kill -9 of anything at any time: the rest goes on and has the graph right, and nothing is left behind."""

import os
import random
import signal
import time

from conftest import until

KINDS = {
    'talker': ('ros2', 'run', 'demo_nodes_cpp', 'talker'),
    'listener': ('ros2', 'run', 'demo_nodes_cpp', 'listener'),
    'server': ('ros2', 'run', 'demo_nodes_cpp', 'add_two_ints_server'),
    'parameters': ('ros2', 'run', 'demo_nodes_cpp', 'parameter_blackboard'),
}


class Crew:
    """A process of each kind, twice, and a watcher that nobody kills."""

    def __init__(self, host):
        self.host = host
        self.made = 0
        self.running = {}
        for kind in list(KINDS) * 2:
            self.hire(kind)

    def hire(self, kind):
        self.made += 1
        name = f'{kind}_{self.made}'
        self.running[name] = self.host.start(
            *KINDS[kind], '--ros-args', '-r', f'__node:={name}')

    def kill(self, name):
        self.running.pop(name).kill()
        self.hire(name.rsplit('_', 1)[0])

    def nodes(self):
        return {f'/{name}' for name in self.running}


def descriptors(pid):
    return len(os.listdir(f'/proc/{pid}/fd'))


def test_random_kills_leave_the_rest_whole(host, request):
    seed = random.randrange(1 << 32)
    print(f'seed {seed}')
    choice = random.Random(seed)
    seconds = 300 if request.config.getoption('--full') else 20
    watcher = host.start(
        'ros2', 'run', 'demo_nodes_cpp', 'listener', '--ros-args', '-r', '__node:=watcher')
    crew = Crew(host)

    def seen():
        listed = host.run('ros2', 'node', 'list', '--no-daemon').split()
        return {node for node in listed if not node.startswith('/_')}

    def whole():
        return seen() == crew.nodes() | {'/watcher'}

    until(whole, 'all are there')
    watcher.said('I heard')
    held, killed, end = descriptors(watcher.pid), 0, time.monotonic() + seconds
    while time.monotonic() < end:
        victim = choice.choice([*crew.running, 'daemon'])
        if victim == 'daemon':
            for pid in host.daemons():
                os.kill(pid, signal.SIGKILL)
        else:
            crew.kill(victim)
        killed += 1
        time.sleep(choice.uniform(0, 1.5))
        if killed % 8 == 0:
            until(whole, f'the graph is right after {killed} kills, seed {seed}')
    until(whole, f'the graph is right after {killed} kills, seed {seed}')
    heard = len(watcher.lines)
    watcher.said('I heard', count=4, since=heard)
    call = host.start(
        'ros2', 'service', 'call', '/add_two_ints', 'example_interfaces/srv/AddTwoInts',
        '{a: 2, b: 3}')
    call.said('sum=5')
    until(
        lambda: host.shows('Publisher count: 2', 'ros2', 'topic', 'info', '/chatter', '--no-daemon'),
        'there are two talkers')
    # It holds what it held at the beginning: those that were killed left nothing with it.
    until(lambda: descriptors(watcher.pid) <= held + 8, 'no descriptors gather')
    # AXON's memory has no names that could stay behind. LTTng, which a ROS 2 may have for traces, has one of its own.
    with open(f'/proc/{watcher.pid}/maps', encoding='utf-8') as maps:
        named = [line for line in maps if '/dev/shm/' in line and '/dev/shm/lttng-' not in line]
    assert not named
    assert watcher.running
