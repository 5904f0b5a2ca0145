# SPDX-License-Identifier: MIT OR Apache-2.0
"""ROS_SECURITY_*: enforced, a context needs a mode of AXON that authenticates; else it says what has no effect."""

import subprocess

import pytest

from lan import lan  # noqa: F401 (a fixture)
from test_hosts import settings

WARNED = r'\[WARN\] \[\d+\.\d+\] \[rmw_axon\]: ROS security is enabled.*keystore'


@pytest.fixture
def keystore(tmp_path):
    """As much of one as rcl looks for: a directory for the enclave `/`."""
    made = tmp_path / 'keystore'
    (made / 'enclaves').mkdir(parents=True)
    return made


def enable(host, keystore, strategy):
    host.env.update(
        ROS_SECURITY_ENABLE='true', ROS_SECURITY_STRATEGY=strategy, ROS_SECURITY_KEYSTORE=str(keystore))


def pinned(directory):
    """Settings of a host that trusts its own key."""
    key = directory / 'host.key'
    line = subprocess.run(
        ['axon', 'trust', 'keygen', str(key)], stdout=subprocess.PIPE, text=True, check=True).stdout
    trust = directory / 'trust'
    trust.write_text(line, encoding='utf-8')
    return {'AXON_CLASSIC_KEY': str(key), 'AXON_CLASSIC_TRUST': str(trust)}


def publisher(host, *arguments):
    return host.node('qos', 'publisher', 100000, 0.1, *arguments)


def subscription(host):
    return host.node('qos', 'subscription', 0)


def heard(host):
    publisher(host)
    process = subscription(host)
    process.said('heard', count=3)
    return process


def test_enforced_security_fails_where_nobody_is_authenticated(host, keystore):
    enable(host, keystore, 'Enforce')
    process = subscription(host)
    assert process.wait() != 0
    for part in ('ROS_SECURITY_STRATEGY=Enforce', 'AXON_CLASSIC_AUTH is none', 'pinned', 'ca', 'qkd'):
        assert part in process.output, process.output
    assert not host.daemons(), 'a daemon was started'
    assert not any(host.runtime.iterdir()), 'something was created'


def test_enforced_security_is_content_with_pinned_keys(host, keystore, tmp_path):
    enable(host, keystore, 'Enforce')
    host.env.update(pinned(tmp_path))
    said = heard(host).said(WARNED)
    assert len(said) == 1 and str(keystore) in said[0] and 'AXON_CLASSIC_AUTH is pinned' in said[0], said


def test_enforced_security_takes_pinned_keys_of_the_settings_file(host, keystore, tmp_path):
    enable(host, keystore, 'Enforce')
    names = {'AXON_CLASSIC_KEY': 'classic_key', 'AXON_CLASSIC_TRUST': 'classic_trust'}
    with open(host.env['AXON_CONFIG'], 'r+', encoding='utf-8') as file:
        before = file.read()
        file.seek(0)
        for name, value in pinned(tmp_path).items():
            file.write(f'{names[name]} = "{value}"\n')
        file.write(before)
    heard(host)


def test_enforced_security_is_content_with_quantum_keys(lan, keystore):  # noqa: F811
    host = lan.host('a', **settings(lan, 'session')[0])
    enable(host, keystore, 'Enforce')
    heard(host).said(f'{WARNED}.*AXON_SECURITY_MODE is qkd')


def test_permissive_security_warns_once_and_goes_on(host, keystore):
    enable(host, keystore, 'Permissive')
    said = heard(host).said(WARNED)
    assert len(said) == 1 and 'AXON_CLASSIC_AUTH is none' in said[0], said


def test_permissive_security_without_a_keystore_warns_too(host, tmp_path):
    enable(host, tmp_path / 'none', 'Permissive')
    heard(host).said(WARNED)


def test_security_that_is_off_is_no_reason_to_warn(host):
    host.env.update(ROS_SECURITY_ENABLE='false', ROS_SECURITY_STRATEGY='Enforce')
    assert 'security' not in heard(host).output


def test_a_process_warns_once_of_all_its_contexts_and_obeys_its_level(host, keystore):
    enable(host, keystore, 'Permissive')
    two = '\n'.join([
        'import rclpy', 'from rclpy.context import Context', 'for name in ("one", "two"):',
        '    context = Context()', '    rclpy.init(context=context)',
        '    rclpy.create_node(name, context=context)', '    rclpy.shutdown(context=context)'])
    assert host.run('python3', '-c', two).count('ROS security is enabled') == 1
    silent = host.node('qos', 'subscription', 0, '--ros-args', '--log-level', 'rmw_axon:=error')
    publisher(host)
    silent.said('heard', count=3)
    assert 'ROS security is enabled' not in silent.output
