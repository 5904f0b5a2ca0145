# SPDX-License-Identifier: MIT OR Apache-2.0
"""Access rules under ROS 2, in each way in which a host proves its name.

A robot has rules. Its base is named in them, and so is a guest, who may do less. What rules deny never arrives, and what
they permit does at the same time.
"""

import re
import shutil
import subprocess

import pytest

from conftest import until
from lan import lan, tool  # noqa: F401 (a fixture)
from test_bag import counts, need_bags

pytest.importorskip('std_srvs')

NAMES = ('robot', 'base', 'guest')


def unproven(_lan, _directory):
    """Nobody proves anything: the rules are about addresses."""
    addresses = [f'address:10.88.0.{number}' for number, _ in enumerate(NAMES, 1)]
    return [({'AXON_SECURITY_MODE': 'classic'}, address) for address in addresses]


def pinned(_lan, directory):
    """Each trusts the keys of the others, by names of its own choice."""
    keys, lines = [directory / f'{name}.key' for name in NAMES], []
    for name, key in zip(NAMES, keys):
        made = subprocess.run(
            [tool('axon'), 'trust', 'keygen', str(key)], stdout=subprocess.PIPE, text=True, check=True)
        pin = re.search(r'spki-sha256:\S+', made.stdout).group()
        lines.append(f'my-{name} {pin}\n')
    trust = directory / 'trust'
    trust.write_text(''.join(lines), encoding='utf-8')
    return [
        ({'AXON_CLASSIC_KEY': str(key), 'AXON_CLASSIC_TRUST': str(trust)}, f'my-{name}')
        for name, key in zip(NAMES, keys)]


def certified(_lan, directory):
    """Each has a certificate of one authority."""
    if shutil.which('openssl') is None:
        pytest.skip('openssl is missing')

    def openssl(*arguments):
        subprocess.run(['openssl', *map(str, arguments)], check=True, capture_output=True, cwd=directory)

    curve = ('-newkey', 'ec', '-pkeyopt', 'ec_paramgen_curve:prime256v1', '-nodes')
    openssl('req', '-x509', *curve, '-keyout', 'ca.key', '-out', 'ca.crt', '-subj', '/CN=CA', '-days', 3650)
    made = []
    for name in NAMES:
        # DNS names are the same in any case.
        (directory / f'{name}.ext').write_text(f'subjectAltName = DNS:{name.title()}.Example\n', encoding='utf-8')
        openssl('req', *curve, '-keyout', f'{name}.key', '-out', f'{name}.csr', '-subj', '/CN=nobody')
        openssl('x509', '-req', '-in', f'{name}.csr', '-CA', 'ca.crt', '-CAkey', 'ca.key', '-CAcreateserial',
                '-out', f'{name}.crt', '-days', 3650, '-extfile', f'{name}.ext')
        (directory / f'{name}.key').chmod(0o600)
        made.append(({
            'AXON_CLASSIC_AUTH': 'ca', 'AXON_CLASSIC_CA': str(directory / 'ca.crt'),
            'AXON_CLASSIC_CERT': str(directory / f'{name}.crt'),
            'AXON_CLASSIC_KEY': str(directory / f'{name}.key')}, f'{name}.example'))
    return made


def quantum(key_mode):
    """Each has a KME; it is known by its SAE ID."""
    def made(lan, _directory):  # noqa: F811
        names = [f'sae-{name}' for name in NAMES]
        mode = {'AXON_SECURITY_MODE': 'qkd', 'AXON_QKD_KEY_MODE': key_mode}
        return [
            ({**mode, **kme, 'AXON_QKD_PEERS': ';'.join(peer for peer in names if peer != name)}, name)
            for name, kme in zip(names, lan.kmes(*names))]
    return made


MODES = {
    'none': unproven,
    'pinned': pinned,
    'ca': certified,
    'session': quantum('session'),
    'messages10': quantum('messages10'),
}


class Site:
    """A robot with rules, its base and a guest; nothing runs on them."""

    def __init__(self, lan, mode, directory):  # noqa: F811
        directory.mkdir()
        settings = MODES[mode](lan, directory)
        self.robot, self.base, self.guest = [
            lan.host(name, **variables) for name, (variables, _) in zip(NAMES, settings)]
        _, self._base, self._guest = [name for _, name in settings]
        self._rules = directory / 'access.toml'
        self.robot.env['AXON_ACCESS_FILE'] = str(self._rules)

    def write(self, rules, swapped=False):
        """Rules about BASE and GUEST; `swapped`, each has the rights of the other."""
        base, guest = (self._guest, self._base) if swapped else (self._base, self._guest)
        self._rules.write_text(rules.replace('BASE', base).replace('GUEST', guest), encoding='utf-8')

    def reload(self, rules, swapped=False):
        self.write(rules, swapped)
        self.robot.run(tool('axon'), 'reload')

    def denies(self, *uses):
        """Whether the robot's daemon says that it denies all of this to a peer."""
        status = self.robot.status() or {'links': []}
        denied = {use for link in status['links'] for use in link['denied']}
        return denied >= {f"{use} (the peer's)" for use in uses}


@pytest.fixture(params=MODES)
def site(lan, request, tmp_path):  # noqa: F811
    return Site(lan, request.param, tmp_path / 'site')


DRIVE = """
default = "deny"

[[allow]]
peer = "BASE"
publish = "/cmd_vel"
call = "/stop"

[[allow]]
peer = "GUEST"
subscribe = "/scan"
"""


def test_the_robot_hears_and_serves_the_host_that_its_rules_name(site):
    site.write(DRIVE)
    process = site.robot.node('drive', 'robot')
    process.said('ready')
    wrong = site.guest.node('drive', 'driver', 'wrong')
    right = site.base.node('drive', 'driver', 'right')
    process.said('heard right', count=10)
    process.said('stopped', count=3)
    right.said('answered stopped', count=3)
    until(lambda: site.denies('publish /cmd_vel', 'call /stop'), 'the robot denies it to the guest')
    wrong.said('matched', count=20)
    for part in ('matched 1', 'robot seen True', 'answered'):
        assert part not in wrong.output, wrong.output
    assert 'heard wrong' not in process.output, process.output
    # The rules change while both drive.
    site.reload(DRIVE, swapped=True)
    process.said('heard wrong', count=10)
    wrong.said('answered stopped', count=3)
    until(lambda: 'matched 0' in right.lines[-1] or 'matched 0' in right.lines[-2], 'the pair ended')
    heard = sum('heard right' in line for line in process.lines)
    process.said('heard wrong', count=10, since=len(process.lines))
    assert sum('heard right' in line for line in process.lines) == heard, process.output


USE = """
default = "deny"

[[allow]]
peer = "BASE"
act = "/dock"
parameters = true
lifecycle = "/managed"

[[allow]]
peer = "GUEST"
subscribe = "/scan"
"""

# What each line lets a user hear and be answered, as `nodes/use.py` says it.
OF_LINES = {
    'act': [
        'goal accepted True', r'result \[0, 1, 1\]', 'got /dock/_action/status', 'got /dock/_action/feedback'],
    'parameters': ['answered set_parameters', 'answered get_parameters', 'got /parameter_events'],
    'lifecycle': ['answered change_state', 'got /managed/transition_event'],
}

# What the daemon of the robot says of a user who has none of the lines.
DENIED = [
    'call /dock/_action/send_goal', 'subscribe /dock/_action/feedback', 'subscribe /dock/_action/status',
    'call /arm/set_parameters', 'call /arm/get_parameters', 'subscribe /parameter_events',
    'call /managed/change_state', 'subscribe /managed/transition_event',
]


def said(lines, parts):
    """Those of `parts` with which one of the lines begins."""
    return [part for part in parts if any(re.match(part, line) for line in lines)]


def silent(user, parts):
    """Whether a user says none of `parts` while it tries everything some times more."""
    so_far = len(user.lines)
    user.said('tried', count=4, since=so_far)
    return not said(user.lines[so_far:], parts)


def test_an_action_parameters_and_a_lifecycle_follow_from_a_line_each(site):
    site.write(USE)
    robot = site.robot.node('use', 'robot')
    robot.said('ready')
    wrong, right = site.guest.node('use', 'user', 7), site.base.node('use', 'user', 5)
    everything = [part for parts in OF_LINES.values() for part in parts]
    for part in everything:
        right.said(part, count=3)
    robot.said('docking for 5')
    robot.said('speed set by 5')
    until(lambda: site.denies(*DENIED), 'the robot denies it to the guest')
    wrong.said('tried', count=10)
    assert not said(wrong.lines, [*everything, 'goal', 'answered', 'got']), wrong.output
    for part in ('docking for 7', 'speed set by 7'):
        assert part not in robot.output, robot.output

    # ROS's tools, which look at the graph first.
    assert 'SUCCEEDED' in site.base.run(
        'ros2', 'action', 'send_goal', '/dock', 'example_interfaces/action/Fibonacci', '{order: 5}')
    assert '5' in site.base.run('ros2', 'param', 'get', '--no-daemon', '/arm', 'speed')
    state = site.base.run('ros2', 'lifecycle', 'get', '--no-daemon', '/managed')
    assert re.search('unconfigured|inactive', state), state
    for name, command in (('/arm', ('param', 'get', '--no-daemon', '/arm', 'speed')),
                          ('/managed', ('lifecycle', 'get', '--no-daemon', '/managed'))):
        asked = site.guest.start('ros2', *command)
        assert asked.wait() != 0 and 'not found' in asked.output.lower(), (name, asked.output)

    # Without one of the lines the others stay.
    for line, gone in OF_LINES.items():
        site.reload(re.sub(f'^{line} = .*\n', '', USE, flags=re.MULTILINE))
        until(lambda gone=gone: silent(right, gone), f'without {line} there is nothing of it')
        so_far = len(right.lines)
        for part in everything:
            if part not in gone:
                right.said(part, count=2, since=so_far)
        assert not said(right.lines[so_far:], gone), right.output
    # The two exchange their rights.
    site.reload(USE, swapped=True)
    for part in everything:
        wrong.said(part, count=2)
    robot.said('docking for 7')
    robot.said('speed set by 7')
    until(lambda: silent(right, everything), 'the base has nothing of it any more')


LISTEN = """
default = "deny"

[[allow]]
peer = "BASE"
subscribe = ["/map", "/text"]

[[allow]]
peer = "GUEST"
subscribe = "/mixed"
"""


def test_listening_tools_get_only_the_topics_the_rules_permit(site, tmp_path):
    need_bags()
    site.write(LISTEN)
    sources = site.robot.node('bag', 'sources')
    sources.said('sent 1')

    def echo(host, topic, *options):
        return host.start(
            'ros2', 'topic', 'echo', '--no-daemon', *options, f'/{topic}', 'std_msgs/msg/String')

    def record(host, bag, *topics):
        return host.start(
            'ros2', 'bag', 'record', '--storage', 'sqlite3', '--disable-keyboard-controls', '--output',
            tmp_path / bag, *topics)

    recorder = record(site.base, 'bag', '--all-topics')
    # It is told the names; no type of the topic is known there.
    named = record(site.guest, 'named', '--topics', '/text', '/mixed')
    allowed, denied = echo(site.base, 'text'), echo(site.base, 'mixed')
    guest_allowed, guest_denied = echo(site.guest, 'mixed'), echo(site.guest, 'text')
    latched = echo(site.guest, 'map', '--qos-durability', 'transient_local', '--qos-reliability', 'reliable')
    for topic in ('map', 'text'):
        recorder.said(rf"Subscribed to topic '/{topic}'")
    named.said(r"Subscribed to topic '/mixed'")
    allowed.said('data:', count=3)
    guest_allowed.said('data:', count=3)
    until(lambda: site.denies('subscribe /mixed', 'subscribe /text', 'subscribe /map'), 'the robot denies it')
    sources.said('sent', count=6, since=len(sources.lines))
    for process in (denied, guest_denied, latched):
        assert process.running and 'data:' not in process.output, process.output
    for process in (recorder, named):
        assert process.end() == 0, process.output
    recorded = {
        bag: counts(host.run('ros2', 'bag', 'info', '--storage', 'sqlite3', tmp_path / bag))
        for host, bag in ((site.base, 'bag'), (site.guest, 'named'))}
    of_robot = {topic: count for topic, count in recorded['bag'].items() if topic in ('map', 'text', 'image', 'mixed')}
    assert set(of_robot) == {'map', 'text'} and of_robot['map'] == 1 and of_robot['text'] >= 4, recorded
    assert set(recorded['named']) == {'mixed'} and recorded['named']['mixed'] >= 4, recorded
    # Nor is it in the lists, where no process of the host itself names it.
    for process in (allowed, denied, guest_allowed, guest_denied, latched):
        process.kill()
    for host, sees, sees_not in (
            (site.base, {'/map', '/text'}, {'/mixed', '/image'}),
            (site.guest, {'/mixed'}, {'/map', '/text', '/image'})):

        def lists(host=host, sees=sees, sees_not=sees_not):
            listed = set(host.run('ros2', 'topic', 'list', '--no-daemon').split())
            return sees <= listed and not listed & sees_not

        until(lists, f'{sees} are listed and {sees_not} are not')
