# SPDX-License-Identifier: MIT OR Apache-2.0
"""Two distributions of ROS 2 on one host: AXON_ROS_OTHER names a setup.bash of the second, with rmw_axon in it."""

import copy
import os
import pathlib
import shutil
import subprocess

from conftest import NODES, OTHER_SETUP, until
import pytest

FIBONACCI = 'example_interfaces/action/Fibonacci'

# Variables that a setup file extends. The second distribution gets none of the first one's folders.
EXTENDED = (
    'AMENT_PREFIX_PATH', 'CMAKE_PREFIX_PATH', 'COLCON_PREFIX_PATH', 'LD_LIBRARY_PATH',
    'PKG_CONFIG_PATH', 'PYTHONPATH', 'ROS_DISTRO', 'ROS_PYTHON_VERSION', 'ROS_VERSION')

pytestmark = pytest.mark.skipif(
    not OTHER_SETUP, reason='no second distribution: AXON_ROS_OTHER names no setup.bash')


def folder_of(package, environment):
    """The folder of an installed package, or None."""
    for prefix in environment.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        found = pathlib.Path(prefix, 'share', package)
        if prefix and found.is_dir():
            return found
    return None


def sourced(setup):
    """The environment that a new shell has after `. setup`."""
    prefixes = os.environ['AMENT_PREFIX_PATH'].split(os.pathsep)
    clean = {name: value for name, value in os.environ.items() if name not in EXTENDED}
    clean['PATH'] = os.pathsep.join(
        part for part in os.environ['PATH'].split(os.pathsep)
        if not any(pathlib.Path(part).is_relative_to(prefix) for prefix in prefixes if prefix))
    said = subprocess.run(
        ['bash', '-c', '. "$0" >/dev/null; env -0', setup], env=clean, capture_output=True,
        check=True, text=True).stdout
    return dict(pair.split('=', 1) for pair in said.split('\0') if pair)


class Beside:
    """The same host, domain and runtime directory as `host`, with the programs of another distribution."""

    def __init__(self, host, environment):
        self._host = copy.copy(host)
        ours = {
            name: value for name, value in host.env.items()
            if name not in EXTENDED and value != os.environ.get(name)}
        self._host.env = {**environment, **ours}

    def __getattr__(self, name):
        return getattr(self._host, name)

    def node(self, name, *arguments):
        python = shutil.which('python3', path=self._host.env['PATH'])
        return self._host.start(python, NODES / f'{name}.py', *arguments)


@pytest.fixture(scope='module')
def environment():
    assert pathlib.Path(OTHER_SETUP).is_file(), f'AXON_ROS_OTHER={OTHER_SETUP}: no such file'
    made = sourced(OTHER_SETUP)
    assert folder_of('rmw_axon', made), f'AXON_ROS_OTHER={OTHER_SETUP}: no rmw_axon is installed there'
    assert folder_of('rmw', made) != folder_of('rmw', os.environ), (
        f'AXON_ROS_OTHER={OTHER_SETUP}: this is the distribution under test')
    return made


@pytest.fixture(params=['this one first', 'the other one first'])
def pair(request, host, environment):
    """Two hosts in one: servers and publishers run in the first, clients and subscribers in the second."""
    other = Beside(host, environment)
    return (host, other) if request.param == 'this one first' else (other, host)


def test_each_has_its_own_distribution(host, environment):
    other = Beside(host, environment)
    prefixes = [
        one.run('bash', '-c', 'ros2 pkg prefix rmw').strip().splitlines()[-1] for one in (host, other)]
    assert prefixes[0] != prefixes[1]


def test_a_topic_crosses(pair):
    # The talker of demo_nodes_cpp has another type on Rolling.
    first, second = pair
    subscription = second.node('qos', 'subscription', 0)
    publisher = first.node('qos', 'publisher', 100000, 0.1)
    subscription.said(r'heard \d+', count=3)
    assert publisher.running


def test_images_of_a_4k_camera_come_whole(pair):
    first, second = pair
    viewer = second.node('images', 'viewer')
    first.node('images', 'camera', 10)
    viewer.said(r'image \d+ whole', count=10)
    assert 'BROKEN' not in viewer.output


def test_a_service_is_called(pair):
    first, second = pair
    first.start('ros2', 'run', 'demo_nodes_cpp', 'add_two_ints_server')
    assert 'sum=1001' in second.run(
        'ros2', 'service', 'call', '/add_two_ints', 'example_interfaces/srv/AddTwoInts',
        '{a: 1, b: 1000}')
    second.start('ros2', 'run', 'demo_nodes_cpp', 'add_two_ints_client').said('add_two_ints: 5')


def test_an_action_is_followed_and_canceled(pair):
    first, second = pair
    server = first.node('fibonacci')
    server.said('ready')
    said = second.run(
        'ros2', 'action', 'send_goal', '--feedback', '/fibonacci', FIBONACCI, '{order: 6}')
    assert 'SUCCEEDED' in said and 'Feedback' in said and '- 8' in said, said
    second.node('cancel').said(r'cancelled after \d+')
    server.said('cancelled')


def test_parameters_are_set_and_read(pair):
    first, second = pair
    first.start('ros2', 'run', 'demo_nodes_cpp', 'parameter_blackboard').said('Parameter blackboard')
    node = '/parameter_blackboard'
    until(
        lambda: node in second.run('ros2', 'node', 'list', '--no-daemon').split(),
        'the node is listed')
    second.run('ros2', 'param', 'set', '--no-daemon', node, 'colour', 'red')
    assert 'red' in second.run('ros2', 'param', 'get', '--no-daemon', node, 'colour')
    assert 'colour' in second.run('ros2', 'param', 'list', '--no-daemon', node)


def test_the_graph_is_one(pair):
    first, second = pair
    first.node('qos', 'publisher', 100000, 0.1)
    second.node('qos', 'subscription', 0)
    for one in pair:
        until(
            lambda: {'/qos_publisher', '/qos_subscription'} <=
            set(one.run('ros2', 'node', 'list', '--no-daemon').split()),
            'both nodes are listed')
        info = one.run('ros2', 'topic', 'info', '-v', '/qos', '--no-daemon')
        for part in (
                'Type: std_msgs/msg/String', 'Publisher count: 1', 'Subscription count: 1',
                'Node name: qos_publisher', 'Node name: qos_subscription'):
            assert part in info, info
        node = one.run('ros2', 'node', 'info', '/qos_publisher', '--no-daemon')
        assert '/qos_publisher/get_parameters: rcl_interfaces/srv/GetParameters' in node
