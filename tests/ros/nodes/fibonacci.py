# SPDX-License-Identifier: MIT OR Apache-2.0
"""An action server that counts Fibonacci's way, slowly enough to be followed and cancelled."""

import time

from example_interfaces.action import Fibonacci
import rclpy
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node


class Server(Node):

    def __init__(self):
        super().__init__('fibonacci')
        self._server = ActionServer(
            self, Fibonacci, 'fibonacci', self.execute, callback_group=ReentrantCallbackGroup(),
            cancel_callback=lambda goal: CancelResponse.ACCEPT)
        print('ready', flush=True)

    def execute(self, goal):
        sequence = [0, 1]
        while len(sequence) <= goal.request.order:
            if goal.is_cancel_requested:
                goal.canceled()
                print('cancelled', flush=True)
                return Fibonacci.Result(sequence=sequence)
            sequence.append((sequence[-1] + sequence[-2]) % 2**31)
            goal.publish_feedback(Fibonacci.Feedback(sequence=sequence))
            time.sleep(0.1)
        goal.succeed()
        return Fibonacci.Result(sequence=sequence)


rclpy.init()
try:
    rclpy.spin(Server(), MultiThreadedExecutor())
except (KeyboardInterrupt, ExternalShutdownException):
    pass
