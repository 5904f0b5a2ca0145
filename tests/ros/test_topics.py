# SPDX-License-Identifier: MIT OR Apache-2.0
"""Topics between processes, as people use them."""

import pytest

from conftest import until


def test_a_talker_is_heard(host):
    listener = host.start('ros2', 'run', 'demo_nodes_cpp', 'listener')
    talker = host.start('ros2', 'run', 'demo_nodes_cpp', 'talker')
    listener.said(r'I heard: \[Hello World: \d+\]', count=3)
    assert talker.end() == 0 and listener.end() == 0


def test_languages_understand_each_other(host):
    listener = host.start('ros2', 'run', 'demo_nodes_py', 'listener')
    host.start('ros2', 'run', 'demo_nodes_cpp', 'talker')
    listener.said(r'I heard: \[Hello World: \d+\]', count=3)
    other = host.start('ros2', 'run', 'demo_nodes_cpp', 'listener', '--ros-args', '-r', 'chatter:=/py')
    host.start('ros2', 'run', 'demo_nodes_py', 'talker', '--ros-args', '-r', 'chatter:=/py')
    other.said(r'I heard: \[Hello World: \d+\]', count=3)


@pytest.mark.parametrize('domain_apart', [True, False])
def test_domains_are_apart(host, domain_apart):
    listener = host.start('ros2', 'run', 'demo_nodes_cpp', 'listener')
    if domain_apart:
        host.env['ROS_DOMAIN_ID'] = str(int(host.env['ROS_DOMAIN_ID']) + 100)
    talker = host.start('ros2', 'run', 'demo_nodes_cpp', 'talker')
    if domain_apart:
        talker.said('Publishing', count=5)
        assert 'I heard' not in listener.output
    else:
        listener.said('I heard')


def test_a_listener_that_is_killed_leaves_the_others_alone(host):
    listeners = [host.start('ros2', 'run', 'demo_nodes_cpp', 'listener') for _ in range(3)]
    talker = host.start('ros2', 'run', 'demo_nodes_cpp', 'talker')
    for listener in listeners:
        listener.said('I heard')
    listeners[0].kill()
    heard = len(listeners[1].lines)
    listeners[1].said('I heard', count=3, since=heard)
    until(
        lambda: host.shows(
            'Subscription count: 2', 'ros2', 'topic', 'info', '/chatter', '--no-daemon'),
        'the graph has two listeners')
    assert talker.running


def test_a_latched_message_reaches_a_late_subscriber(host):
    host.start(
        'ros2', 'topic', 'pub', '--qos-durability', 'transient_local', '--rate', '0.2',
        '/map', 'std_msgs/msg/String', '{data: the map}')
    until(
        lambda: host.shows('Publisher count: 1', 'ros2', 'topic', 'info', '/map', '--no-daemon'),
        'the publisher is there')
    heard = host.run(
        'ros2', 'topic', 'echo', '--no-daemon', '--once', '--qos-durability', 'transient_local',
        '--qos-reliability', 'reliable', '/map', 'std_msgs/msg/String')
    assert 'the map' in heard
