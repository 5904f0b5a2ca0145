# SPDX-License-Identifier: MIT OR Apache-2.0
"""A message on its way through two processes, as ros2_tracing records it with LTTng."""

import collections
import ctypes
import os
import re
import shutil
import subprocess

import pytest

from conftest import PATIENCE, until

# How tracetools names the tracepoints' fields, by the name of a tracepoint.
Event = collections.namedtuple('Event', 'name pid fields')

LINE = re.compile(r' ros2:(\w+): .*\{ vpid = (\d+) \}, \{ (.*) \}$')
# A field is a number, a text in quotation marks, or an array.
FIELD = re.compile(r'(\w+) = ("(?:[^"\\]|\\.)*"|\[[^]]*\]|[^,\s]+)')


def missing():
    """Return why there is nothing to test here, or None."""
    for tool in ['lttng', 'lttng-sessiond', 'babeltrace2']:
        if shutil.which(tool) is None:
            return f'{tool} is missing'
    try:
        tracetools = ctypes.CDLL('libtracetools.so')
    except OSError:
        return 'this ROS 2 has no tracetools'
    if not tracetools.ros_trace_compile_status():
        return 'tracetools of this ROS 2 was built without LTTng'
    if not hasattr(tracetools, 'ros_trace_do_rmw_publish'):
        return 'rmw_publish of this tracetools has no timestamp'
    return None


WHY_NOT = missing()
pytestmark = pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT))


class Recording:
    """A session of LTTng that records what ROS 2's processes of this user trace."""

    def __init__(self, directory):
        self.trace = directory / 'trace'
        self.name = f'rmw_axon-{os.getpid()}-{directory.name}'
        # Its files are the test's own, but for root, who has one daemon of LTTng for the whole machine.
        self.env = {**os.environ, 'LTTNG_HOME': str(directory)}
        self.daemon = None
        if os.getuid() != 0 or self._lttng('list', check=False).returncode != 0:
            self.daemon = subprocess.Popen(
                ['lttng-sessiond', '--no-kernel'], env=self.env,
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            until(
                lambda: self._lttng('list', check=False).returncode == 0, 'LTTng answers')
        self._lttng('create', self.name, f'--output={self.trace}')
        self._lttng(
            'enable-channel', '--userspace', '--session', self.name,
            '--subbuf-size=65536', '--num-subbuf=8', 'ros')
        self._lttng(
            'enable-event', '--userspace', '--session', self.name, '--channel=ros', 'ros2:*')
        self._lttng(
            'add-context', '--userspace', '--session', self.name, '--channel=ros', '--type=vpid')
        self._lttng('start', self.name)

    def _lttng(self, *arguments, check=True):
        return subprocess.run(
            ['lttng', '--no-sessiond', *arguments], env=self.env, check=check, timeout=PATIENCE,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def events(self):
        """Stop, and return what was recorded, in order of time."""
        self._lttng('stop', self.name)
        said = subprocess.run(
            ['babeltrace2', str(self.trace)], check=True, timeout=PATIENCE,
            stdout=subprocess.PIPE, text=True).stdout
        found = []
        for line in said.splitlines():
            parts = LINE.search(line)
            if parts:
                fields = dict(FIELD.findall(parts[3]))
                found.append(Event(parts[1], int(parts[2]), fields))
        return found

    def close(self):
        self._lttng('destroy', self.name, check=False)
        if self.daemon is not None:
            self.daemon.terminate()
            self.daemon.wait(PATIENCE)


@pytest.fixture
def recording(tmp_path):
    made = Recording(tmp_path)
    yield made
    made.close()


def handles(events, name, rcl_name, topic, field):
    """Return the handles of a topic's endpoints, which rmw named by a GID and rcl by a topic."""
    of_rmw = {(e.pid, e.fields[field]): e.fields['gid'] for e in events if e.name == name}
    of_topic = {
        (e.pid, e.fields[field]) for e in events
        if e.name == rcl_name and e.fields['topic_name'] == f'"{topic}"'}
    assert of_topic, f'rcl traced no endpoint of {topic}'
    assert of_topic <= set(of_rmw), f'{name} is missing for {topic}'
    return of_topic


def test_a_message_is_followed_from_one_process_to_another(host, recording):
    host.env['LTTNG_HOME'] = recording.env['LTTNG_HOME']
    listener = host.start('ros2', 'run', 'demo_nodes_cpp', 'listener')
    other = host.start('ros2', 'run', 'demo_nodes_py', 'listener')
    talker = host.start('ros2', 'run', 'demo_nodes_cpp', 'talker')
    listener.said('I heard', count=3)
    other.said('I heard', count=3)
    for process in [talker, listener, other]:
        process.end()
    events = recording.events()
    assert events, 'no tracepoint of ROS 2 was recorded'

    publishers = handles(
        events, 'rmw_publisher_init', 'rcl_publisher_init', '/chatter', 'rmw_publisher_handle')
    subscriptions = handles(
        events, 'rmw_subscription_init', 'rcl_subscription_init', '/chatter',
        'rmw_subscription_handle')
    assert len(publishers) == 1 and len(subscriptions) == 2
    ((publishing_pid, publisher),) = publishers

    published = {}
    taken = collections.Counter()
    for event in events:
        pid, fields = event.pid, event.fields
        if event.name == 'rmw_publish' and (
                pid, fields['rmw_publisher_handle']) == (publishing_pid, publisher):
            assert fields['timestamp'] not in published
            published[fields['timestamp']] = fields['message']
        if event.name == 'rmw_take' and (pid, fields['rmw_subscription_handle']) in subscriptions:
            if fields['taken'] == '1':
                # In order of time: the message was published before it was taken.
                assert fields['source_timestamp'] in published, 'a take that joins no publish'
                assert pid != publishing_pid
                taken[pid] += 1
            else:
                assert fields['source_timestamp'] == '0'
    assert len(taken) == 2 and min(taken.values()) >= 3
