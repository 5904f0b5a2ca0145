# SPDX-License-Identifier: MIT OR Apache-2.0
"""A 4K camera, and who looks at its images."""

import array

from program import main, say, spin
import rclpy
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image


def camera(hertz):
    node = rclpy.create_node('camera')
    publisher = node.create_publisher(Image, 'image', QoSProfile(depth=2))
    width, height = 3840, 2160
    image = Image(width=width, height=height, encoding='rgb8', step=3 * width)
    rows = [array.array('B', [value]) * (3 * width * height) for value in range(4)]
    sent = 0

    def publish():
        nonlocal sent
        image.header.frame_id = str(sent)
        image.data = rows[sent % len(rows)]
        sent += 1
        publisher.publish(image)

    node.create_timer(1 / float(hertz), publish)
    spin(node)


def viewer():
    node = rclpy.create_node('viewer')

    def view(image):
        number = int(image.header.frame_id)
        data = image.data
        whole = len(data) == 3840 * 2160 * 3
        looked = (data[0], data[len(data) // 2], data[-1])
        say(f'image {number} {"whole" if whole and looked == (number % 4,) * 3 else "BROKEN"}')

    node.create_subscription(Image, 'image', view, QoSProfile(depth=2))
    spin(node)


main(globals())
