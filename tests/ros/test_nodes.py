# SPDX-License-Identifier: MIT OR Apache-2.0
"""Lifecycle nodes, and several nodes composed into one process."""

import pytest

from conftest import until


def test_a_lifecycle_node_goes_through_its_states(host):
    host.node('managed', 'run').said('unconfigured')
    listener = host.start(
        'ros2', 'topic', 'echo', '--no-daemon', '/managed_topic', 'std_msgs/msg/String')
    until(
        lambda: host.shows('/managed', 'ros2', 'lifecycle', 'nodes', '--no-daemon'),
        'it is listed')

    def state():
        return host.run('ros2', 'lifecycle', 'get', '--no-daemon', '/managed').split()[0]

    def go(transition):
        assert 'Transitioning successful' in host.run(
            'ros2', 'lifecycle', 'set', '--no-daemon', '/managed', transition)

    assert state() == 'unconfigured'
    go('configure')
    assert state() == 'inactive' and 'active' not in listener.output
    go('activate')
    listener.said('data: active', count=3)
    go('deactivate')
    go('cleanup')
    assert state() == 'unconfigured'
    go('shutdown')
    assert state() == 'finalized'


@pytest.mark.parametrize('intra_process', [False, True])
def test_components_of_one_process_hear_each_other(host, intra_process):
    if 'demo_nodes_cpp::Talker' not in host.start('ros2', 'component', 'types').complete():
        pytest.skip('demo_nodes_cpp has no components here')
    container = host.start('ros2', 'run', 'rclcpp_components', 'component_container')
    options = ('-e', 'use_intra_process_comms:=true') if intra_process else ()
    until(
        lambda: host.shows('/ComponentManager', 'ros2', 'component', 'list', '--no-daemon'),
        'the container is listed')
    for component in ('Talker', 'Listener'):
        loaded = host.run(
            'ros2', 'component', 'load', '--no-daemon', *options, '/ComponentManager',
            'demo_nodes_cpp', f'demo_nodes_cpp::{component}')
        assert 'Loaded component' in loaded
    container.said('I heard', count=3)
    # Somebody outside hears each of them once as well.
    outside = host.start('ros2', 'run', 'demo_nodes_cpp', 'listener', '--ros-args', '-r',
                         '__node:=outside')
    heard = [line.split('[')[-1] for line in outside.said('I heard', count=3)]
    assert len(set(heard)) == len(heard), heard
    nodes = host.run('ros2', 'component', 'list', '--no-daemon')
    assert '1  /talker' in nodes and '2  /listener' in nodes, nodes
    host.run('ros2', 'component', 'unload', '--no-daemon', '/ComponentManager', '1')
    until(
        lambda: '/talker' not in host.run('ros2', 'node', 'list', '--no-daemon').split(),
        'the talker is gone')
