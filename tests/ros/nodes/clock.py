# SPDX-License-Identifier: MIT OR Apache-2.0
"""A simulator's clock, and a node on its time."""

import time

from builtin_interfaces.msg import Time
from program import main, say, spin
import rclpy
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock


def simulator():
    """As a simulator does: 1,000 times a second, with the newest alone kept."""
    node = rclpy.create_node('simulator')
    qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = node.create_publisher(Clock, '/clock', qos)
    ticks = 0
    while rclpy.ok():
        ticks += 1
        publisher.publish(Clock(clock=Time(sec=ticks // 1000, nanosec=ticks % 1000 * 1_000_000)))
        time.sleep(0.001)


def user():
    """A node on simulated time."""
    node = rclpy.create_node(
        'clock_user', parameter_overrides=[Parameter('use_sim_time', value=True)])
    last = 0

    def tick():
        nonlocal last
        now = node.get_clock().now().nanoseconds
        say(f'{"BACKWARDS" if now < last else "time"} {now}')
        last = now

    node.create_timer(0.1, tick)
    spin(node)


main(globals())
