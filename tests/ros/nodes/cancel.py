# SPDX-License-Identifier: MIT OR Apache-2.0
"""An action client that cancels its goal when it has begun, and waits for the result."""

from action_msgs.msg import GoalStatus
from example_interfaces.action import Fibonacci
import rclpy
from rclpy.action import ActionClient


rclpy.init()
node = rclpy.create_node('cancel')
client = ActionClient(node, Fibonacci, 'fibonacci')
client.wait_for_server()
begun = rclpy.Future()
sent = client.send_goal_async(Fibonacci.Goal(order=10_000), lambda _: begun.set_result(True))
rclpy.spin_until_future_complete(node, sent)
rclpy.spin_until_future_complete(node, begun)
rclpy.spin_until_future_complete(node, sent.result().cancel_goal_async())
result = sent.result().get_result_async()
rclpy.spin_until_future_complete(node, result)
assert result.result().status == GoalStatus.STATUS_CANCELED
print(f'cancelled after {len(result.result().result.sequence)}', flush=True)
