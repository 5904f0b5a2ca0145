# SPDX-License-Identifier: MIT OR Apache-2.0
"""ROS_SECURITY_*: enforced, a context needs a mode of AXON that authenticates, and the permissions of its enclave act."""

import datetime
import shutil
import socket
import subprocess

import pytest

from lan import lan  # noqa: F401 (a fixture)
from test_hosts import settings

WARNED = r'\[WARN\] \[\d+\.\d+\] \[rmw_axon\]: ROS security is enabled.*keystore'

DOCUMENT = """<dds xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" \
xsi:noNamespaceSchemaLocation="http://www.omg.org/spec/DDS-SECURITY/20170901/omg_shared_ca_permissions.xsd">
  <permissions>
    <grant name="{enclave}">
      <subject_name>CN={enclave}</subject_name>
      <validity>
        <not_before>{since}</not_before>
        <not_after>{until}</not_after>
      </validity>
{deny}{allow}      <default>DENY</default>
    </grant>
  </permissions>
</dds>
"""

# What each node of rclpy has by itself, as `ros2 security` lists it from the profile `common/node.xml`.
OWN_TOPICS = ['rt/parameter_events', 'rt/rosout']


class Keystore:
    """A keystore in the layout of `ros2 security create_keystore` and `create_enclave`."""

    def __init__(self, path):
        self.path = path
        (path / 'enclaves').mkdir(parents=True)
        for name in ('public', 'private'):
            (path / name).mkdir()
        self.key, self.certificate = path / 'private' / 'ca.key.pem', path / 'public' / 'ca.cert.pem'
        subprocess.run(
            ['openssl', 'req', '-x509', '-newkey', 'ec', '-pkeyopt', 'ec_paramgen_curve:prime256v1', '-nodes',
             '-keyout', str(self.key), '-out', str(self.certificate), '-subj', '/CN=sros2CA', '-days', '3650'],
            check=True, capture_output=True)
        for purpose in ('identity', 'permissions'):
            (path / 'public' / f'{purpose}_ca.cert.pem').symlink_to('ca.cert.pem')
            (path / 'private' / f'{purpose}_ca.key.pem').symlink_to('ca.key.pem')

    def __str__(self):
        return str(self.path)

    def folder(self, enclave):
        made = self.path / 'enclaves' / enclave.strip('/')
        made.mkdir(parents=True, exist_ok=True)
        return made

    def enclave(self, enclave, domain, allow=(('*',), ('*',)), deny=((), ()), days=3650):
        """Write and sign the permissions of an enclave; `allow` and `deny` each say what to publish and to subscribe to."""
        def rule(kind, lists):
            text = ''.join(
                f'          <{does}>\n            <topics>\n'
                + ''.join(f'              <topic>{topic}</topic>\n' for topic in topics)
                + f'            </topics>\n          </{does}>\n'
                for does, topics in zip(('publish', 'subscribe'), lists) if topics)
            domains = f'          <domains>\n            <id>{domain}</id>\n          </domains>\n'
            return f'        <{kind}>\n{domains}{text}        </{kind}>\n' if text else ''

        now = datetime.datetime.now(datetime.timezone.utc).replace(microsecond=0, tzinfo=None)
        folder = self.folder(enclave)
        document = folder / 'permissions.xml'
        document.write_text(DOCUMENT.format(
            enclave=enclave, since=(now - datetime.timedelta(days=20)).isoformat(),
            until=(now + datetime.timedelta(days=days)).isoformat(),
            deny=rule('deny_rule', deny), allow=rule('allow_rule', allow)), encoding='utf-8')
        subprocess.run(
            ['openssl', 'smime', '-sign', '-text', '-in', str(document), '-out', str(folder / 'permissions.p7s'),
             '-signer', str(self.certificate), '-inkey', str(self.key), '-md', 'sha256'],
            check=True, capture_output=True)
        return folder / 'permissions.p7s'


@pytest.fixture
def keystore(tmp_path):
    """A keystore with a folder for the enclave `/`, and nothing in it."""
    if shutil.which('openssl') is None:
        pytest.skip('openssl is missing')
    return Keystore(tmp_path / 'keystore')


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


def ca(directory):
    """Settings of a host with a certificate for its name, and with the root that issued it."""
    def openssl(*arguments):
        subprocess.run(['openssl', *arguments], cwd=directory, check=True, capture_output=True)

    new = ['-newkey', 'ec', '-pkeyopt', 'ec_paramgen_curve:prime256v1', '-nodes']
    openssl('req', '-x509', *new, '-keyout', 'root.key', '-out', 'root.pem', '-subj', '/CN=root', '-days', '10')
    openssl('req', *new, '-keyout', 'host.key', '-out', 'host.csr', '-subj', '/CN=host')
    (directory / 'host.ext').write_text(f'subjectAltName=DNS:{socket.gethostname()}\n', encoding='utf-8')
    openssl('x509', '-req', '-in', 'host.csr', '-CA', 'root.pem', '-CAkey', 'root.key', '-CAcreateserial',
            '-days', '10', '-extfile', 'host.ext', '-out', 'host.pem')
    (directory / 'host.key').chmod(0o600)
    return {
        'AXON_CLASSIC_AUTH': 'ca', 'AXON_CLASSIC_KEY': str(directory / 'host.key'),
        'AXON_CLASSIC_CERT': str(directory / 'host.pem'), 'AXON_CLASSIC_CA': str(directory / 'root.pem')}


def publisher(host, *arguments):
    return host.node('qos', 'publisher', 100000, 0.1, *arguments)


def subscription(host):
    return host.node('qos', 'subscription', 0)


def heard(host):
    publisher(host)
    process = subscription(host)
    process.said('heard', count=3)
    return process


def test_enforced_security_fails_without_peer_authentication(host, keystore):
    enable(host, keystore, 'Enforce')
    process = subscription(host)
    assert process.wait() != 0
    for part in ('ROS_SECURITY_STRATEGY=Enforce', 'AXON_CLASSIC_AUTH is none', 'pinned', 'ca', 'qkd'):
        assert part in process.output, process.output
    assert not host.daemons(), 'a daemon was started'
    assert not any(host.runtime.iterdir()), 'something was created'


def domain(host):
    return host.env['ROS_DOMAIN_ID']


def enforced(host, keystore, tmp_path, authentication=pinned):
    enable(host, keystore, 'Enforce')
    host.env.update(authentication(tmp_path))


def refused(host, process, *parts):
    """What a process said that has no context."""
    assert process.wait() != 0, process.output
    for part in parts:
        assert part in process.output, process.output
    assert not host.daemons(), 'a daemon was started'
    assert not any(host.runtime.iterdir()), 'something was created'


@pytest.mark.parametrize('authentication', [pinned, ca])
def test_enforced_security_is_content_with_authenticated_hosts(host, keystore, tmp_path, authentication):
    enforced(host, keystore, tmp_path, authentication)
    file = keystore.enclave('/', domain(host))
    said = heard(host).said(WARNED)
    assert len(said) == 1 and f'AXON_CLASSIC_AUTH is {authentication.__name__}' in said[0], said
    assert f'permissions of enclave / ({file})' in said[0] and 'does not verify their signature' in said[0], said


def test_enforced_security_fails_without_permissions_that_count(host, keystore, tmp_path):
    enforced(host, keystore, tmp_path)
    file = keystore.folder('/') / 'permissions.p7s'
    refused(host, subscription(host), str(file), 'ros2 security create_enclave')
    keystore.enclave('/', domain(host), days=-10)
    refused(host, subscription(host), str(file), 'are valid from', 'create_permission')
    keystore.enclave('/', 99)
    refused(host, subscription(host), str(file), f'allow nothing in domain {domain(host)}, but in 99')
    keystore.enclave('/', domain(host)).rename(keystore.path / 'other')
    keystore.enclave('/other', domain(host)).rename(file)
    refused(host, subscription(host), str(file), 'CN=/, but CN=/other')
    file.write_text('no permissions', encoding='utf-8')
    refused(host, subscription(host), str(file), 'not XML')
    file.write_text('', encoding='utf-8')
    file.chmod(0o666)
    refused(host, subscription(host), str(file), 'everybody may write it')


def test_a_process_stays_within_its_enclave(host, keystore, tmp_path):
    """Each of two enclaves may do one thing with a topic, and what its node does by itself."""
    enforced(host, keystore, tmp_path)

    # The services of parameters, of either node.
    replies, requests = ['rr/qos_*Reply'], ['rq/qos_*Request', 'rt/parameter_events']
    files = {
        enclave: keystore.enclave(
            enclave, domain(host), (OWN_TOPICS + replies + publish, requests + subscribe), (['rt/brake'], []))
        for enclave, publish, subscribe in (
            ('/robot/talker', ['rt/qos'], []), ('/robot/listener', [], ['rt/qos']))}

    def within(enclave):
        return '--ros-args', '--enclave', enclave

    publisher(host, *within('/robot/talker'))
    process = host.node('qos', 'subscription', 0, *within('/robot/listener'))
    process.said('heard', count=3)
    wrong = host.node('qos', 'publisher', 10, 0.1, *within('/robot/listener'))
    assert wrong.wait() != 0
    for part in ('/qos: enclave /robot/listener may not publish rt/qos', str(files['/robot/listener'])):
        assert part in wrong.output, wrong.output
    wrong = host.node('qos', 'subscription', 0, *within('/robot/talker'))
    assert wrong.wait() != 0
    assert 'may not subscribe to rt/qos' in wrong.output, wrong.output
    # rcl looks for the folder of this enclave then, whatever the argument is.
    host.env['ROS_SECURITY_ENCLAVE_OVERRIDE'] = '/robot/listener'
    wrong = host.node('qos', 'publisher', 10, 0.1, *within('/robot/talker'))
    assert wrong.wait() != 0
    assert 'enclave /robot/listener may not publish rt/qos' in wrong.output, wrong.output


def test_built_in_topics_of_a_node_need_permission_too(host, keystore, tmp_path):
    enforced(host, keystore, tmp_path)
    keystore.enclave('/', domain(host), (['rt/qos'], ['rt/qos']))
    process = subscription(host)
    assert process.wait() != 0
    assert 'enclave / may not publish rt/' in process.output, process.output


def test_a_denial_before_an_allowance_of_all_decides(host, keystore, tmp_path):
    enforced(host, keystore, tmp_path)
    file = keystore.enclave('/', domain(host), deny=(['rt/qos'], []))
    process = host.node('qos', 'publisher', 10, 0.1)
    assert process.wait() != 0
    line = 1 + file.read_text(encoding='utf-8').replace('\r', '').split('\n').index(
        '              <topic>rt/qos</topic>')
    assert f'denied by line {line} of {file}' in process.output, process.output
    # The call failed, and nothing else: the context lives on.
    two = '\n'.join([
        'import rclpy', 'from std_msgs.msg import String', 'rclpy.init()', 'node = rclpy.create_node("one")',
        'try:', '    node.create_publisher(String, "qos", 1)', 'except Exception as error:', '    print("refused", error)',
        'node.create_publisher(String, "other", 1).publish(String(data="x"))', 'print("went on")'])
    said = host.run('python3', '-c', two)
    assert 'refused' in said and 'may not publish rt/qos' in said and 'went on' in said, said


def test_enforced_security_takes_pinned_keys_of_the_settings_file(host, keystore, tmp_path):
    enable(host, keystore, 'Enforce')
    keystore.enclave('/', domain(host))
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
    keystore.enclave('/', domain(host))
    heard(host).said(f'{WARNED}.*AXON_SECURITY_MODE is qkd')


def test_permissive_security_warns_once_and_goes_on(host, keystore):
    enable(host, keystore, 'Permissive')
    said = heard(host).said(WARNED)
    assert len(said) == 1 and 'AXON_CLASSIC_AUTH is none' in said[0], said
    assert f'there is no permissions.p7s in {keystore}' in said[0] and 'is not limited' in said[0], said


def test_permissive_security_applies_the_permissions_that_are_there(host, keystore):
    enable(host, keystore, 'Permissive')
    file = keystore.enclave('/', domain(host), deny=(['rt/qos'], []))
    process = subscription(host)
    said = process.said(WARNED)
    assert f'permissions of enclave / ({file})' in said[0] and 'AXON_CLASSIC_AUTH is none' in said[0], said
    wrong = host.node('qos', 'publisher', 10, 0.1)
    assert wrong.wait() != 0
    assert 'enclave / may not publish rt/qos' in wrong.output, wrong.output
    # Those that are there and do not count are no reason to go on without.
    keystore.enclave('/', domain(host), days=-10)
    wrong = subscription(host)
    assert wrong.wait() != 0
    assert 'are valid from' in wrong.output, wrong.output


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
