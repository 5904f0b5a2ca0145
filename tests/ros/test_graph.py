# SPDX-License-Identifier: MIT OR Apache-2.0
"""What the command line shows of the graph."""

from conftest import until


def test_the_command_line_shows_nodes_topics_and_services(host):
    host.start('ros2', 'run', 'demo_nodes_cpp', 'talker')
    host.start('ros2', 'run', 'demo_nodes_cpp', 'listener')
    until(
        lambda: {'/talker', '/listener'} <=
        set(host.run('ros2', 'node', 'list', '--no-daemon').split()),
        'both nodes are listed')
    assert '/chatter [std_msgs/msg/String]' in host.run('ros2', 'topic', 'list', '-t', '--no-daemon')
    info = host.run('ros2', 'topic', 'info', '-v', '/chatter', '--no-daemon')
    parts = [
        'Type: std_msgs/msg/String', 'Publisher count: 1', 'Subscription count: 1',
        'Node name: talker', 'Node name: listener',
        'Reliability: RELIABLE', 'Durability: VOLATILE', 'Liveliness: AUTOMATIC']
    from rclpy.topic_endpoint_info import TopicEndpointInfo
    # Humble has no type hashes.
    if hasattr(TopicEndpointInfo, 'topic_type_hash'):
        parts.append('Topic type hash: RIHS01_')
    for part in parts:
        assert part in info, info
    node = host.run('ros2', 'node', 'info', '/talker', '--no-daemon')
    assert '/chatter: std_msgs/msg/String' in node
    assert '/talker/get_parameters: rcl_interfaces/srv/GetParameters' in node
    services = host.run('ros2', 'service', 'list', '--no-daemon')
    assert '/talker/get_parameters' in services.split()


def test_the_cli_daemon_sees_the_same(host):
    try:
        host.run('ros2', 'daemon', 'start')
        host.start('ros2', 'run', 'demo_nodes_cpp', 'talker')
        until(lambda: '/talker' in host.run('ros2', 'node', 'list').split(), 'the node is listed')
    finally:
        host.run('ros2', 'daemon', 'stop')


def test_rate_and_bandwidth_are_measured(host):
    host.start('ros2', 'run', 'demo_nodes_cpp', 'talker')
    rate = host.start('ros2', 'topic', 'hz', '/chatter')
    rate.said('average rate')
    bandwidth = host.start('ros2', 'topic', 'bw', '/chatter')
    bandwidth.said('B/s from')


def test_a_node_that_is_killed_is_gone(host):
    talker = host.start('ros2', 'run', 'demo_nodes_cpp', 'talker')
    talker.said('Publishing')
    talker.kill()
    until(
        lambda: '/talker' not in host.run('ros2', 'node', 'list', '--no-daemon').split(),
        'the node is gone')


def test_the_axon_daemon_killed_is_replaced_and_nothing_stops(host):
    import os
    import signal
    listener = host.start('ros2', 'run', 'demo_nodes_cpp', 'listener')
    host.start('ros2', 'run', 'demo_nodes_cpp', 'talker')
    listener.said('I heard')
    for pid in host.daemons():
        os.kill(pid, signal.SIGKILL)
    heard = len(listener.lines)
    listener.said('I heard', count=3, since=heard)
    until(
        lambda: {'/talker', '/listener'} <=
        set(host.run('ros2', 'node', 'list', '--no-daemon').split()),
        'the graph is whole again')
    late = host.start('ros2', 'run', 'demo_nodes_cpp', 'listener', '--ros-args', '-r', '__node:=late')
    late.said('I heard')
