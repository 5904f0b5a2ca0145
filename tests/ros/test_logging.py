# SPDX-License-Identifier: MIT OR Apache-2.0
"""What AXON says of itself reaches ROS's logger, `rmw_axon`, and obeys its level."""

import os
import signal

from conftest import until


def level(name):
    return ('--ros-args', '--log-level', f'rmw_axon:={name}')


def test_a_daemon_that_is_killed_is_told_of_by_the_logger_unless_it_is_to_be_silent(host):
    told = host.node('qos', 'subscription', 0)
    silent = host.node('qos', 'subscription', 0, *level('error'))
    first = host.node('qos', 'publisher', 100000, 0.1)
    for subscription in (told, silent):
        subscription.said('heard', count=3)
    until(host.daemons, 'there is a daemon')
    for pid in host.daemons():
        os.kill(pid, signal.SIGKILL)
    told.said(r'\[WARN\] \[\d+\.\d+\] \[rmw_axon\]: the connection to the daemon is lost')
    # Who comes now is matched by another daemon: both have one, so both lost the one before.
    first.kill()
    host.node('qos', 'publisher', 100000, 0.1)
    for subscription in (told, silent):
        subscription.said('matched [12]', count=2)
    assert 'rmw_axon' not in silent.output


def test_early_log_messages_obey_log_levels_set_later(host):
    host.env['AXON_SHM'] = 'off'
    told = host.node('qos', 'subscription', 0)
    silent = host.node('qos', 'subscription', 0, *level('warn'))
    told.said(r'\[INFO\] \[\d+\.\d+\] \[rmw_axon\]: samples pass through the daemon')
    host.node('qos', 'publisher', 100000, 0.1)
    silent.said('heard', count=3)
    assert 'samples pass through the daemon' not in silent.output
