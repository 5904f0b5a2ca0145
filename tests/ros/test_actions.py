# SPDX-License-Identifier: MIT OR Apache-2.0
"""Actions: five services and topics that have to go together."""

FIBONACCI = 'example_interfaces/action/Fibonacci'


def test_a_goal_comes_to_its_end_and_another_is_canceled(host):
    server = host.node('fibonacci')
    server.said('ready')
    said = host.run(
        'ros2', 'action', 'send_goal', '--feedback', '/fibonacci', FIBONACCI, '{order: 6}')
    assert 'SUCCEEDED' in said and 'Feedback' in said and '- 8' in said, said
    assert '/fibonacci' in host.run('ros2', 'action', 'list').split()
    host.node('cancel').said(r'cancelled after \d+')
    server.said('cancelled')


def test_a_server_that_is_killed_while_it_works_is_replaced(host):
    server = host.node('fibonacci')
    server.said('ready')
    waiting = host.start(
        'ros2', 'action', 'send_goal', '--feedback', '/fibonacci', FIBONACCI, '{order: 100000}')
    waiting.said('Feedback')
    server.kill()
    host.node('fibonacci').said('ready')
    assert 'SUCCEEDED' in host.run(
        'ros2', 'action', 'send_goal', '/fibonacci', FIBONACCI, '{order: 2}')
    assert waiting.running
