# SPDX-License-Identifier: MIT OR Apache-2.0
"""A robot that hears `/cmd_vel` and serves `/stop`, and drivers that publish and call."""

from program import main, say, spin
import rclpy
from std_msgs.msg import String
from std_srvs.srv import Trigger


def robot():
    node = rclpy.create_node('robot')
    node.create_subscription(String, '/cmd_vel', lambda message: say(f'heard {message.data}'), 10)

    def stop(_request, response):
        say('stopped')
        response.success, response.message = True, 'stopped'
        return response

    node.create_service(Trigger, '/stop', stop)
    say('ready')
    spin(node)


def driver(name):
    """Publishes its name, and calls the robot whenever it is there."""
    node = rclpy.create_node(f'driver_of_{name}')
    out = node.create_publisher(String, '/cmd_vel', 10)
    client = node.create_client(Trigger, '/stop')

    def drive():
        out.publish(String(data=name))
        say(f'matched {out.get_subscription_count()}, robot seen {client.service_is_ready()}')
        # Whether or not it is there: rules decide at the robot's host.
        client.call_async(Trigger.Request()).add_done_callback(
            lambda done: say(f'answered {done.result().message}'))

    node.create_timer(0.1, drive)
    spin(node)


main(globals())
