# SPDX-License-Identifier: MIT OR Apache-2.0
"""Publishers of /tf, and who hears them all."""

from geometry_msgs.msg import TransformStamped
from program import main, say, spin
import rclpy
from rclpy.qos import QoSProfile
from tf2_msgs.msg import TFMessage


def joints(first, count):
    """Nodes that each publish their own frame at 20 Hz."""
    nodes = []
    for number in range(int(first), int(first) + int(count)):
        node = rclpy.create_node(f'joint_{number}')
        publisher = node.create_publisher(TFMessage, '/tf', QoSProfile(depth=100))

        def publish(node=node, publisher=publisher, number=number):
            transform = TransformStamped()
            transform.header.stamp = node.get_clock().now().to_msg()
            transform.header.frame_id = 'world'
            transform.child_frame_id = f'joint_{number}'
            transform.transform.translation.x = float(number)
            publisher.publish(TFMessage(transforms=[transform]))

        node.create_timer(0.05, publish)
        nodes.append(node)
    say('publishing')
    spin(*nodes)


def listener(count):
    """Says once that it has heard each of `count` frames twenty times, each true."""
    node = rclpy.create_node('tf_listener')
    heard = {}
    told = False

    def listen(message):
        nonlocal told
        for transform in message.transforms:
            name = transform.child_frame_id
            if f'joint_{int(transform.transform.translation.x)}' != name:
                say(f'BROKEN {name}')
            heard[name] = heard.get(name, 0) + 1
        if not told and len(heard) == int(count) and min(heard.values()) >= 20:
            told = True
            say('heard all')

    node.create_subscription(TFMessage, '/tf', listen, QoSProfile(depth=100))
    spin(node)


main(globals())
