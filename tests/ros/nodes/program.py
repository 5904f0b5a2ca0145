# SPDX-License-Identifier: MIT OR Apache-2.0
"""What the programs here have in common: `python3 FILE.py FUNCTION [ARGUMENT...] [--ros-args ...]`.

Each says what it does in lines of its own, and ends when it is interrupted.
"""

import sys

import rclpy
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.utilities import remove_ros_args, try_shutdown


def say(text):
    # In one call: other threads say something, too.
    print(f'{text}\n', end='', flush=True)


def spin(*nodes):
    executor = MultiThreadedExecutor(2)
    for node in nodes:
        executor.add_node(node)
    executor.spin()


def main(functions):
    """Run the one of `functions` that the command line names."""
    rclpy.init()
    try:
        function, *arguments = remove_ros_args(sys.argv)[1:]
        functions[function](*arguments)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        try_shutdown()
