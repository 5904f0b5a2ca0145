# SPDX-License-Identifier: MIT OR Apache-2.0
"""The implementations that are compared over a path that loses packets, each as it comes and tuned for such a path."""

import os
import pathlib

# What the ROS documentation advises for links that lose packets: kernels forget incomplete packets soon.
FRAGMENTS = ('net.ipv4.ipfrag_time=3', 'net.ipv4.ipfrag_high_thresh=134217728')

# No datagram is longer than a packet; a loss is noticed and repaired within milliseconds.
CYCLONE = """<CycloneDDS><Domain>
<General><MaxMessageSize>1400B</MaxMessageSize><MaxRexmitMessageSize>1400B</MaxRexmitMessageSize>
<FragmentSize>1300B</FragmentSize></General>
<Internal><HeartbeatInterval min="1ms" minsched="5ms" max="10ms">5ms</HeartbeatInterval>
<NackDelay>1ms</NackDelay><AckDelay>1ms</AckDelay><AutoReschedNackDelay>10ms</AutoReschedNackDelay>
<PreEmptiveAckDelay>1ms</PreEmptiveAckDelay>
<SocketReceiveBufferSize min="4MB"/></Internal>
</Domain></CycloneDDS>"""

# The same, and a rate below the path's: 30,000 bytes in 5 ms are 48 Mbit/s.
FAST_DDS = """<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
  <transport_descriptors><transport_descriptor>
    <transport_id>packets</transport_id><type>UDPv4</type><maxMessageSize>1400</maxMessageSize>
    <sendBufferSize>4194304</sendBufferSize><receiveBufferSize>4194304</receiveBufferSize>
  </transport_descriptor></transport_descriptors>
  <participant profile_name="participant" is_default_profile="true"><rtps>
    <useBuiltinTransports>false</useBuiltinTransports>
    <userTransports><transport_id>packets</transport_id></userTransports>
    <flow_controller_descriptor_list><flow_controller_descriptor>
      <name>rate</name><scheduler>FIFO</scheduler>
      <max_bytes_per_period>30000</max_bytes_per_period><period_ms>5</period_ms>
    </flow_controller_descriptor></flow_controller_descriptor_list>
  </rtps></participant>
  <data_writer profile_name="writer" is_default_profile="true">
    WRITER
  </data_writer>
  <data_writer profile_name="/bench_keep_all">
    <topic><resourceLimitsQos>
      <max_samples>1</max_samples><max_samples_per_instance>1</max_samples_per_instance>
      <allocated_samples>1</allocated_samples>
    </resourceLimitsQos></topic>
    WRITER
  </data_writer>
  <data_reader profile_name="reader" is_default_profile="true">
    <times><heartbeatResponseDelay><nanosec>0</nanosec></heartbeatResponseDelay></times>
    <historyMemoryPolicy>PREALLOCATED_WITH_REALLOC</historyMemoryPolicy>
  </data_reader>
</profiles></dds>
""".replace('WRITER', """<qos>
      <publishMode><kind>ASYNCHRONOUS</kind><flow_controller_name>rate</flow_controller_name></publishMode>
      <reliability><max_blocking_time><sec>10</sec></max_blocking_time></reliability>
    </qos>
    <times>
      <initialHeartbeatDelay><nanosec>1000000</nanosec></initialHeartbeatDelay>
      <heartbeatPeriod><sec>0</sec><nanosec>10000000</nanosec></heartbeatPeriod>
      <nackResponseDelay><nanosec>0</nanosec></nackResponseDelay>
    </times>
    <historyMemoryPolicy>PREALLOCATED_WITH_REALLOC</historyMemoryPolicy>""")


class Setup:
    """One implementation in one set-up."""

    def __init__(self, name, library, setup, sysctl=(), daemon=None, waits=False,
                 best_effort_after=0):
        self.name = name
        self.library = library
        # (directory, addresses, number of the host) -> variables
        self._setup = setup
        # Of the network namespaces.
        self.sysctl = sysctl
        # (program of the library's package, (addresses, number of the host) -> variables), which runs on each host
        self.daemon = daemon
        # A publisher of large messages has KEEP_ALL, so that `publish` waits until the path has taken one.
        self.waits = waits
        # Seconds until a second link for BEST_EFFORT stands, also where the path loses its first packets.
        self.best_effort_after = best_effort_after

    def environment(self, directory, addresses, number):
        """The variables of the programs of a host, which keep their files in `directory`."""
        env = {
            name: value for name, value in os.environ.items()
            if not name.startswith(('AXON_', 'ROS_LOCALHOST', 'ROS_STATIC', 'FAST', 'CYCLONE', 'ZENOH'))}
        env.update(
            RMW_IMPLEMENTATION=self.library, ROS_DOMAIN_ID='77', ROS_LOG_DIR=str(directory),
            ROS_AUTOMATIC_DISCOVERY_RANGE='SUBNET', RCUTILS_LOGGING_SEVERITY='ERROR',
            # Zenoh writes its log to the standard output.
            RUST_LOG='off', **self._setup(pathlib.Path(directory), addresses, number))
        return env


def axon(directory, addresses, number):
    return {
        'AXON_RUNTIME_DIR': str(directory / 'axon'), 'AXON_DAEMON_PEERS': addresses[1 - number],
        'AXON_SECURITY_MODE': 'classic'}


def cyclone(directory, addresses, number):
    file = directory / 'cyclone.xml'
    file.write_text(CYCLONE)
    return {'CYCLONEDDS_URI': f'file://{file}'}


def fast_dds(directory, addresses, number):
    file = directory / 'fastdds.xml'
    file.write_text(FAST_DDS)
    return {'FASTRTPS_DEFAULT_PROFILES_FILE': str(file), 'RMW_FASTRTPS_USE_QOS_FROM_XML': '1'}


def zenoh_router(addresses, number):
    """As documented: the second host's router connects to the first one's."""
    return {'ZENOH_CONFIG_OVERRIDE': f'connect/endpoints=["tcp/{addresses[0]}:7447"]'} if number else {}


def zenoh_direct(directory, addresses, number):
    """No router: the second host's program connects to the first one's, RELIABLE over TCP and BEST_EFFORT over UDP."""
    links = [f'tcp/{addresses[0]}:7555?rel=1', f'udp/{addresses[0]}:7556?rel=0']
    ends = ', '.join(f'"{link}"' for link in links)
    side, other = ('connect', 'listen') if number else ('listen', 'connect')
    return {
        'ZENOH_ROUTER_CHECK_ATTEMPTS': '-1',
        'ZENOH_CONFIG_OVERRIDE': ';'.join([
            f'{side}/endpoints=[{ends}]', f'{other}/endpoints=[]',
            'transport/unicast/max_links=2', 'transport/link/tx/batch_size=1400'])}


def as_it_comes(directory, addresses, number):
    return {}


ALL = [
    Setup('rmw_axon', 'rmw_axon', axon),
    Setup('rmw_cyclonedds_cpp', 'rmw_cyclonedds_cpp', as_it_comes),
    Setup('rmw_cyclonedds_cpp, tuned', 'rmw_cyclonedds_cpp', cyclone, FRAGMENTS, waits=True),
    Setup('rmw_fastrtps_cpp', 'rmw_fastrtps_cpp', as_it_comes),
    Setup('rmw_fastrtps_cpp, tuned', 'rmw_fastrtps_cpp', fast_dds, FRAGMENTS, waits=True),
    Setup('rmw_fastrtps_cpp, LARGE_DATA', 'rmw_fastrtps_cpp',
          lambda *_: {'FASTDDS_BUILTIN_TRANSPORTS': 'LARGE_DATA'}, FRAGMENTS, waits=True),
    Setup('rmw_zenoh_cpp', 'rmw_zenoh_cpp', as_it_comes, daemon=('rmw_zenohd', zenoh_router)),
    Setup('rmw_zenoh_cpp, tuned', 'rmw_zenoh_cpp', zenoh_direct, waits=True,
          best_effort_after=15),
]


def prefixes():
    return [pathlib.Path(prefix) for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(':') if prefix]


def found(names):
    """Those whose library is there, of `names` if any."""
    return [
        setup for setup in ALL
        if any((prefix / 'lib' / f'lib{setup.library}.so').exists() for prefix in prefixes())
        and (not names or setup.name in names)]
