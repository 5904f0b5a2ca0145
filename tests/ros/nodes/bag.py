# SPDX-License-Identifier: MIT OR Apache-2.0
"""What a bag is recorded of, and who hears it played."""

import array

import events
from program import main, say, spin
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from std_msgs.msg import String

RELIABLE = QoSProfile(depth=10)
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
WIDTH, HEIGHT = 1920, 1080


def sources():
    """Publishes a map once, and a text, an image and two that differ in quality again and again."""
    node = rclpy.create_node('sources')
    latched = node.create_publisher(String, 'map', LATCHED)
    texts = node.create_publisher(String, 'text', RELIABLE)
    images = node.create_publisher(Image, 'image', BEST_EFFORT)
    mixed = {'sure': node.create_publisher(String, 'mixed', RELIABLE),
             'unsure': node.create_publisher(String, 'mixed', BEST_EFFORT)}
    image = Image(width=WIDTH, height=HEIGHT, encoding='rgb8', step=3 * WIDTH)
    rows = [array.array('B', [value]) * (3 * WIDTH * HEIGHT) for value in range(4)]
    sent = 0

    def publish():
        nonlocal sent
        texts.publish(String(data=str(sent)))
        image.header.frame_id = str(sent)
        image.data = rows[sent % len(rows)]
        images.publish(image)
        for kind, publisher in mixed.items():
            publisher.publish(String(data=kind))
        sent += 1
        say(f'sent {sent}')

    latched.publish(String(data='the map'))
    node.create_timer(0.3, publish)
    spin(node)


def listener():
    node = rclpy.create_node('listener')

    def hear(kind, topic, profile, tell):
        def on_matched(count):
            if count > 0:
                say(f'matched {topic}')

        events.subscription(node, kind, topic, tell, profile, on_matched)

    def view(image):
        number, data = int(image.header.frame_id), image.data
        looked = (data[0], data[len(data) // 2], data[-1])
        whole = len(data) == 3 * WIDTH * HEIGHT and looked == (number % 4,) * 3
        say(f'image {number} {"whole" if whole else "BROKEN"}')

    hear(String, 'map', LATCHED, lambda message: say(f'map {message.data}'))
    hear(String, 'text', RELIABLE, lambda message: say(f'text {message.data}'))
    hear(Image, 'image', BEST_EFFORT, view)
    hear(String, 'mixed', BEST_EFFORT, lambda message: say(f'mixed {message.data}'))
    spin(node)


main(globals())
