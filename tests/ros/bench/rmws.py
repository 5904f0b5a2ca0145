# SPDX-License-Identifier: MIT OR Apache-2.0
"""The RMW implementations that are compared, and how each is set up."""

import os
import pathlib
import signal
import tempfile
import time

CYCLONE = (
    '<CycloneDDS><Domain><Discovery><ParticipantIndex>auto</ParticipantIndex>'
    '<MaxAutoParticipantIndex>400</MaxAutoParticipantIndex></Discovery></Domain></CycloneDDS>')

# Writers and readers of one host share their memory where the type has a fixed size.
FAST_DDS_SHARING = """<?xml version="1.0" encoding="UTF-8"?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <data_writer profile_name="default publisher profile" is_default_profile="true">
    <qos><data_sharing><kind>AUTOMATIC</kind></data_sharing></qos>
    <historyMemoryPolicy>PREALLOCATED_WITH_REALLOC</historyMemoryPolicy>
  </data_writer>
  <data_reader profile_name="default subscription profile" is_default_profile="true">
    <qos><data_sharing><kind>AUTOMATIC</kind></data_sharing></qos>
    <historyMemoryPolicy>PREALLOCATED_WITH_REALLOC</historyMemoryPolicy>
  </data_reader>
</profiles>
"""


class Rmw:
    """One implementation in one set-up."""

    def __init__(self, name, library=None, setup=lambda directory: {}, network_only=False):
        self.name = name
        self.library = library or name
        self._setup = setup
        self.network_only = network_only

    def environment(self, end, network=False):
        """Variables for one host's processes; what they need goes with `end`."""
        directory = pathlib.Path(end.enter_context(tempfile.TemporaryDirectory()))
        env = {
            name: value for name, value in os.environ.items()
            if not name.startswith(('AXON_', 'ROS_LOCALHOST', 'ROS_STATIC', 'FASTRTPS_'))}
        runtime = directory / 'axon'
        env.update(
            RMW_IMPLEMENTATION=self.library, ROS_DOMAIN_ID='77',
            ROS_AUTOMATIC_DISCOVERY_RANGE='SUBNET' if network else 'LOCALHOST',
            ROS_LOG_DIR=str(directory), RCUTILS_LOGGING_SEVERITY='ERROR',
            # Subscriptions lend too where they can.
            ROS_DISABLE_LOANED_MESSAGES='0', AXON_RUNTIME_DIR=str(runtime),
            **self._setup(directory))
        end.callback(end_daemons, runtime)
        return env


def fast_dds_sharing(directory):
    profile = directory / 'sharing.xml'
    profile.write_text(FAST_DDS_SHARING)
    return {
        'FASTRTPS_DEFAULT_PROFILES_FILE': str(profile),
        'FASTDDS_DEFAULT_PROFILES_FILE': str(profile),
        'RMW_FASTRTPS_USE_QOS_FROM_XML': '1'}


ALL = [
    Rmw('rmw_axon'),
    Rmw('rmw_axon, AES-256-GCM', 'rmw_axon', lambda _: {'AXON_QUIC_CIPHER': 'aes-256-gcm'},
        network_only=True),
    Rmw('rmw_cyclonedds_cpp', setup=lambda _: {'CYCLONEDDS_URI': CYCLONE}),
    Rmw('rmw_fastrtps_cpp'),
    Rmw('rmw_fastrtps_cpp, data sharing', 'rmw_fastrtps_cpp', fast_dds_sharing),
]


def found(names):
    """Those whose library is there, of `names` if any."""
    libraries = [
        pathlib.Path(prefix) / 'lib'
        for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(':') if prefix]
    return [
        rmw for rmw in ALL
        if any((lib / f'lib{rmw.library}.so').exists() for lib in libraries)
        and (not names or rmw.name in names)]


def daemons(runtime):
    """Process IDs of the AXON daemon of a runtime directory."""
    pids = []
    for entry in pathlib.Path('/proc').iterdir():
        with_pid = entry.name.isdigit()
        try:
            if with_pid and os.readlink(entry / 'exe').endswith('/axon_daemon') and (
                    f'AXON_RUNTIME_DIR={runtime}'.encode() in
                    (entry / 'environ').read_bytes().split(b'\0')):
                pids.append(int(entry.name))
        except OSError:
            pass
    return pids


def end_daemons(runtime):
    for pid in daemons(runtime):
        os.kill(pid, signal.SIGTERM)
    while daemons(runtime):
        time.sleep(0.05)
