# SPDX-License-Identifier: MIT OR Apache-2.0
"""A publisher and a subscription of any quality of service, which say what they are told of it."""

import time

import events
from program import main, say, spin
import rclpy
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String


def nanoseconds(text):
    return Duration(nanoseconds=int(text))


def profile(options):
    """`depth=1 deadline=NS lifespan=NS lease=NS manual best_effort transient_local`."""
    qos = QoSProfile(depth=10)
    for option in options:
        name, _, value = option.partition('=')
        if name == 'depth':
            qos.depth = int(value)
        elif name == 'deadline':
            qos.deadline = nanoseconds(value)
        elif name == 'lifespan':
            qos.lifespan = nanoseconds(value)
        elif name == 'lease':
            qos.liveliness_lease_duration = nanoseconds(value)
        elif name == 'manual':
            qos.liveliness = LivelinessPolicy.MANUAL_BY_TOPIC
        elif name == 'best_effort':
            qos.reliability = ReliabilityPolicy.BEST_EFFORT
        elif name == 'transient_local':
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        else:
            raise ValueError(option)
    return qos


def publisher(count, period, *options):
    """Publishes `count` messages, one every `period` seconds, and stays."""
    node = rclpy.create_node('qos_publisher')
    out = events.publisher(
        node, String, 'qos', profile(options),
        deadline=lambda e: say(f'offered deadline missed {e.total_count}'),
        liveliness=lambda e: say(f'liveliness lost {e.total_count}'),
        incompatible_qos=lambda e: say(f'offered incompatible {e.last_policy_kind}'),
        matched=lambda count: say(f'matched {count}'))
    sent = 0

    def publish():
        nonlocal sent
        if sent < int(count):
            sent += 1
            out.publish(String(data=str(sent)))
            say(f'published {sent}')

    node.create_timer(float(period), publish)
    spin(node)


def subscription(delay, *options):
    """Begins to take `delay` seconds after it sees a publisher."""
    node = rclpy.create_node('qos_subscription')
    events.subscription(
        node, String, 'qos', lambda message: say(f'heard {message.data}'), profile(options),
        deadline=lambda e: say(f'requested deadline missed {e.total_count}'),
        liveliness=lambda e: say(f'alive {e.alive_count}, not alive {e.not_alive_count}'),
        incompatible_qos=lambda e: say(f'requested incompatible {e.last_policy_kind}'),
        matched=lambda count: say(f'matched {count}'))
    if float(delay) > 0:
        # Without a spin, which might take a message.
        while node.count_publishers('qos') == 0:
            time.sleep(0.01)
        time.sleep(float(delay))
        say('taking')
    spin(node)


main(globals())
