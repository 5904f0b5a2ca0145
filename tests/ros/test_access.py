# SPDX-License-Identifier: MIT OR Apache-2.0
"""Access rules under ROS 2: the commands of the wrong host never arrive, those of the right one do."""

import pytest

from conftest import until
from lan import lan, tool  # noqa: F401 (a fixture)

pytest.importorskip('std_srvs')

RULES = """
default = "deny"

[[allow]]
peer = "{}"
publish = "/cmd_vel"
call = "/stop"
"""


def robot_and_drivers(lan):  # noqa: F811
    """A robot whose rules name the base by its address, the base, and a stranger, in that order."""
    robot, base, stranger = [
        lan.host(name, AXON_SECURITY_MODE='classic') for name in ('robot', 'base', 'stranger')]
    rules = robot.runtime.parent / 'access.toml'
    rules.write_text(RULES.format('address:10.88.0.2'), encoding='utf-8')
    robot.env['AXON_ACCESS_FILE'] = str(rules)
    return robot, base, stranger, rules


def test_the_robot_hears_and_serves_the_host_that_its_rules_name(lan):  # noqa: F811
    robot, base, stranger, rules = robot_and_drivers(lan)
    process = robot.node('drive', 'robot')
    process.said('ready')
    wrong = stranger.node('drive', 'driver', 'wrong')
    right = base.node('drive', 'driver', 'right')
    process.said('heard right', count=10)
    process.said('stopped', count=3)
    right.said('answered stopped', count=3)
    wrong.said('matched', count=20)
    for part in ('matched 1', 'robot seen True', 'answered'):
        assert part not in wrong.output, wrong.output
    assert 'heard wrong' not in process.output, process.output
    # The rules change while both drive.
    rules.write_text(RULES.format('address:10.88.0.3'), encoding='utf-8')
    robot.run(tool('axon'), 'reload')
    process.said('heard wrong', count=10)
    wrong.said('answered stopped', count=3)
    until(lambda: 'matched 0' in right.lines[-1] or 'matched 0' in right.lines[-2], 'the pair ended')
    heard = sum('heard right' in line for line in process.lines)
    process.said('heard wrong', count=10, since=len(process.lines))
    assert sum('heard right' in line for line in process.lines) == heard, process.output
