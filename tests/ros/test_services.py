# SPDX-License-Identifier: MIT OR Apache-2.0
"""Services, actions, parameters."""


def test_three_clients_of_one_service_get_their_own_answers(host):
    host.start('ros2', 'run', 'demo_nodes_cpp', 'add_two_ints_server')
    calls = [
        host.start(
            'ros2', 'service', 'call', '/add_two_ints', 'example_interfaces/srv/AddTwoInts',
            f'{{a: {n}, b: {n * 1000}}}')
        for n in (1, 2, 3)
    ]
    for number, call in enumerate(calls, start=1):
        call.said(f'sum={number * 1001}')
        assert call.wait() == 0


def test_a_client_waits_for_a_server_that_comes_later(host):
    client = host.start('ros2', 'run', 'demo_nodes_cpp', 'add_two_ints_client')
    client.said('not available')
    host.start('ros2', 'run', 'demo_nodes_cpp', 'add_two_ints_server')
    client.said('Result of add_two_ints: 5')


def test_parameters_are_listed_set_and_read(host):
    talker = host.start('ros2', 'run', 'demo_nodes_cpp', 'parameter_blackboard')
    talker.said('Parameter blackboard node')
    node = '/parameter_blackboard'
    host.run('ros2', 'param', 'set', '--no-daemon', node, 'colour', 'red')
    assert 'red' in host.run('ros2', 'param', 'get', '--no-daemon', node, 'colour')
    assert 'colour' in host.run('ros2', 'param', 'list', '--no-daemon', node)
