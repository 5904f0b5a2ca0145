# SPDX-License-Identifier: MIT OR Apache-2.0
"""Two hosts on a network, in each security mode; and that who does not fit in gets nothing."""

import pathlib
import sys

import pytest

from conftest import until
from lan import lan, tool  # noqa: F401 (a fixture)

NODES = pathlib.Path(__file__).parent / 'nodes'

MODES = {
    'classic': {'AXON_SECURITY_MODE': 'classic'},
    'session': {'AXON_SECURITY_MODE': 'qkd', 'AXON_QKD_KEY_MODE': 'session'},
    'messages10': {'AXON_SECURITY_MODE': 'qkd', 'AXON_QKD_KEY_MODE': 'messages10'},
}


def settings(lan, mode):  # noqa: F811
    """The settings of two hosts in one mode."""
    if mode == 'classic':
        return [MODES[mode], MODES[mode]]
    of_kmes = lan.kmes('sae-a', 'sae-b')
    peers = ['sae-b', 'sae-a']
    return [
        {**MODES[mode], **kme, 'AXON_QKD_PEERS': peer} for kme, peer in zip(of_kmes, peers)]


def both_ways(hosts):
    """(where it is offered, where it is used, what to call it)"""
    a, b = hosts
    return [(a, b, 'from_a'), (b, a, 'from_b')]


@pytest.fixture(params=MODES)
def hosts(lan, request):  # noqa: F811
    return [
        lan.host(name, **variables)
        for name, variables in zip('ab', settings(lan, request.param))]


def talker(host, topic, *more):
    return host.start(
        'ros2', 'run', 'demo_nodes_cpp', 'talker', '--ros-args', '-r', f'chatter:={topic}', *more)


def listener(host, topic, *more):
    return host.start(
        'ros2', 'run', 'demo_nodes_cpp', 'listener', '--ros-args', '-r', f'chatter:={topic}', *more)


def test_a_talker_is_heard_on_the_other_host(hosts):
    heard = []
    for here, there, topic in both_ways(hosts):
        heard.append(listener(there, topic))
        talker(here, topic)
    for process in heard:
        process.said(r'I heard: \[Hello World: \d+\]', count=3)
    # Who comes later hears it as well.
    for here, there, topic in both_ways(hosts):
        late = listener(there, topic, '-r', '__node:=late')
        late.said('I heard', count=3)


def test_the_graph_is_one(hosts):
    a, b = hosts
    talker(a, 'chatter', '-r', '__node:=on_a')
    listener(b, 'chatter', '-r', '__node:=on_b')
    for host in hosts:
        until(
            lambda host=host: {'/on_a', '/on_b'} <=
            set(host.run('ros2', 'node', 'list', '--no-daemon').split()),
            'both nodes are listed')
        info = host.run('ros2', 'topic', 'info', '-v', '/chatter', '--no-daemon')
        for part in ('Publisher count: 1', 'Subscription count: 1', 'on_a', 'on_b', 'RIHS01_'):
            assert part in info, info


def test_services_are_called_on_the_other_host(hosts):
    clients = []
    for here, there, name in both_ways(hosts):
        remap = ['--ros-args', '-r', f'add_two_ints:={name}']
        here.start('ros2', 'run', 'demo_nodes_cpp', 'add_two_ints_server', *remap)
        clients.append(
            there.start('ros2', 'run', 'demo_nodes_cpp', 'add_two_ints_client', *remap))
    for client in clients:
        client.said('Result of add_two_ints: 5')


def test_actions_are_followed_and_cancelled_from_the_other_host(hosts):
    for here, there, name in both_ways(hosts):
        server = here.start(
            sys.executable, NODES / 'fibonacci.py', '--ros-args', '-r', f'__ns:=/{name}')
        server.said('ready')
        goal = ['ros2', 'action', 'send_goal', '--feedback', f'/{name}/fibonacci',
                'example_interfaces/action/Fibonacci']
        said = there.run(*goal, '{order: 5}')
        for part in ('Goal accepted', 'Feedback:', 'Goal finished with status: SUCCEEDED'):
            assert part in said, said
        result = said[said.index('Result:'):]
        assert [int(n) for n in result.split() if n.isdigit()] == [0, 1, 1, 2, 3, 5], said
        client = there.run(
            sys.executable, NODES / 'cancel.py', '--ros-args', '-r', f'__ns:=/{name}')
        assert 'cancelled after' in client
        server.said('cancelled')


def test_latched_messages_reach_late_subscribers_on_the_other_host(hosts):
    latched = {
        'map': ('std_msgs/msg/String', '{data: the whole map}', 'the whole map'),
        'tf_static': (
            'tf2_msgs/msg/TFMessage',
            '{transforms: [{header: {frame_id: base}, child_frame_id: laser,'
            ' transform: {translation: {x: 0.25}}}]}', 'child_frame_id: laser'),
    }
    durable = ['--qos-durability', 'transient_local', '--qos-reliability', 'reliable']
    for here, there, prefix in both_ways(hosts):
        for name, (message_type, message, _) in latched.items():
            # Once, to nobody: what is heard later is what was kept.
            publisher = here.start(
                'ros2', 'topic', 'pub', '--once', '-w', '0', '--keep-alive', '3600', *durable,
                f'/{prefix}/{name}', message_type, message)
            publisher.said('publishing #1')
        for name, (message_type, _, part) in latched.items():
            heard = there.run(
                'ros2', 'topic', 'echo', '--no-daemon', '--once', *durable,
                f'/{prefix}/{name}', message_type)
            assert part in heard


@pytest.mark.parametrize('killed', [0, 1], ids=['of_the_talker', 'of_the_listener'])
def test_a_daemon_that_is_killed_comes_back(hosts, killed):
    a, b = hosts
    heard = listener(b, 'chatter')
    talker(a, 'chatter')
    heard.said('I heard', count=2)
    for _ in range(2):
        before = hosts[killed].daemons()
        hosts[killed].kill_daemon()
        until(
            lambda: hosts[killed].daemons() not in ([], before), 'there is a new daemon')
        so_far = len(heard.lines)
        heard.said('I heard', count=3, since=so_far)
    listener(b, 'chatter', '-r', '__node:=late').said('I heard')
    for host in hosts:
        until(
            lambda host=host: {'/talker', '/listener', '/late'} <=
            set(host.run('ros2', 'node', 'list', '--no-daemon').split()),
            'the graph is whole again')


def test_a_host_that_ends_and_starts_again_is_found_again(hosts):
    a, b = hosts
    heard = listener(b, 'chatter')
    for last in (False, False, True):
        so_far = len(heard.lines)
        speaker = talker(a, 'chatter')
        heard.said('I heard', count=2, since=so_far)
        if last:
            break
        speaker.kill()
        a.kill_daemon()
        until(
            lambda: b.shows(
                'Publisher count: 0', 'ros2', 'topic', 'info', '/chatter', '--no-daemon'),
            'the talker is gone')


def refused(a, b, reasons):
    """Both daemons know each other and give one of the reasons, and nothing is heard."""
    tool('axon')
    heard = listener(b, 'chatter')
    at_home = listener(a, 'chatter')
    speaker = talker(a, 'chatter')
    for host, reason in zip((a, b), reasons):
        until(lambda: reason in host.refusals(), f'a refusal that says {reason}')
    so_far = len(speaker.lines)
    speaker.said('Publishing', count=5, since=so_far)
    at_home.said('I heard')
    assert 'I heard' not in heard.output
    assert not a.linked() and not b.linked()
    # Nor is it in the graph.
    for host, node in ((a, '/listener'), (b, '/talker')):
        nodes = host.run('ros2', 'node', 'list', '--no-daemon').split()
        assert nodes.count(node) == (1 if host is a else 0), nodes


@pytest.mark.parametrize('modes, variable', [
    (('classic', 'session'), 'AXON_SECURITY_MODE'),
    (('messages10', 'classic'), 'AXON_SECURITY_MODE'),
    (('session', 'messages10'), 'AXON_QKD_KEY_MODE'),
])
def test_hosts_in_different_modes_exchange_nothing(lan, modes, variable):  # noqa: F811
    of_kmes = settings(lan, 'session')
    hosts = [
        lan.host(name, **({**of_kme, **MODES[mode]} if mode != 'classic' else MODES[mode]))
        for name, of_kme, mode in zip('ab', of_kmes, modes)]
    refused(*hosts, [variable, variable])


def test_a_host_without_the_right_key_exchanges_nothing(lan, tmp_path):  # noqa: F811
    lines = []
    for name in 'ab':
        made = lan.host(f'make_{name}').run(tool('axon'), 'trust', 'keygen', tmp_path / f'{name}.key')
        lines.append(next(line for line in made.splitlines() if 'spki-sha256:' in line))
    (tmp_path / 'a.trust').write_text(lines[0].replace(lines[0].split()[0], 'stranger') + '\n')
    (tmp_path / 'b.trust').write_text(lines[0] + '\n')
    a, b = (
        lan.host(
            name, AXON_CLASSIC_KEY=str(tmp_path / f'{name}.key'),
            AXON_CLASSIC_TRUST=str(tmp_path / f'{name}.trust'))
        for name in 'ab')
    refused(a, b, ['is not trusted', 'is not trusted'])


@pytest.mark.parametrize('mode', ['session', 'messages10'])
def test_a_host_whose_kme_is_on_another_qkd_network_exchanges_nothing(lan, mode):  # noqa: F811
    (of_a, _), (_, of_b) = settings(lan, mode), settings(lan, mode)
    unknown = 'the PSK identity is not known'
    refused(lan.host('a', **of_a), lan.host('b', **of_b), [unknown, unknown])


@pytest.mark.parametrize('first', ['kept_in', 'wide'])
@pytest.mark.parametrize('variables', [
    {'ROS_LOCALHOST_ONLY': '1'},
    {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'},
    {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'OFF'},
], ids=['localhost_only', 'localhost', 'off'])
def test_a_node_has_its_own_range_whichever_node_is_first(lan, variables, first):  # noqa: F811
    a, b = lan.host('a'), lan.host('b')
    heard_kept, heard_wide = listener(b, 'kept'), listener(b, 'wide', '-r', '__node:=of_wide')

    def start(which):
        if which == 'wide':
            return talker(a, 'wide', '-r', '__node:=talker_wide')
        return a.start_with(
            variables, 'ros2', 'run', 'demo_nodes_cpp', 'talker', '--ros-args',
            '-r', 'chatter:=kept', '-r', '__node:=talker_kept')

    order = [first, 'wide' if first == 'kept_in' else 'kept_in']
    speakers = {}
    for which in order:
        speakers[which] = start(which)
        speakers[which].said('Publishing', count=2)
    heard_wide.said(r'I heard', count=5)
    so_far = len(speakers['kept_in'].lines)
    speakers['kept_in'].said('Publishing', count=5, since=so_far)
    assert 'I heard' not in heard_kept.output
    nodes = b.run('ros2', 'node', 'list', '--no-daemon').split()
    assert '/talker_wide' in nodes and '/talker_kept' not in nodes, nodes
    # On its own host it is heard, unless it is OFF.
    nodes = a.run('ros2', 'node', 'list', '--no-daemon').split()
    off = 'OFF' in variables.values()
    assert ('/talker_kept' in nodes) != off, nodes
    if not off:
        listener(a, 'kept', '-r', '__node:=at_home').said('I heard')
    status = a.status()
    if status is not None:
        ranges = {session['range'] for session in status['sessions']} - {None}
        expected = 'OFF' if off else 'LOCALHOST'
        assert {'SUBNET', expected} <= ranges, ranges


def test_a_static_peer_on_one_side_is_enough(lan):  # noqa: F811
    a, b = lan.host('a'), lan.host('b')
    localhost = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    remap = ['--ros-args', '-r', '__node:=other', '-r', 'chatter:=not_listed']
    heard = [
        b.start_with(localhost, 'ros2', 'run', 'demo_nodes_cpp', 'listener'),
        b.start_with(localhost, 'ros2', 'run', 'demo_nodes_cpp', 'listener', *remap)]
    lists_b = {**localhost, 'ROS_STATIC_PEERS': '10.88.0.2'}
    a.start_with(lists_b, 'ros2', 'run', 'demo_nodes_cpp', 'talker')
    unlisted = a.start_with(localhost, 'ros2', 'run', 'demo_nodes_cpp', 'talker', *remap)
    heard[0].said('I heard', count=3)
    so_far = len(unlisted.lines)
    unlisted.said('Publishing', count=3, since=so_far)
    assert 'I heard' not in heard[1].output
