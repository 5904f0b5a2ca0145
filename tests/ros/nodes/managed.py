# SPDX-License-Identifier: MIT OR Apache-2.0
"""A lifecycle node."""

from program import main, say, spin
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from std_msgs.msg import String


class Managed(LifecycleNode):
    """Publishes while it is active."""

    def __init__(self):
        super().__init__('managed')
        self.publisher = None

    def on_configure(self, state):
        self.publisher = self.create_lifecycle_publisher(String, 'managed_topic', 10)
        self.timer = self.create_timer(0.05, lambda: self.publisher.publish(String(data='active')))
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state):
        self.destroy_timer(self.timer)
        self.destroy_publisher(self.publisher)
        return TransitionCallbackReturn.SUCCESS


def run():
    node = Managed()
    say('unconfigured')
    spin(node)


main(globals())
