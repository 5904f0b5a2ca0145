# SPDX-License-Identifier: MIT OR Apache-2.0
"""What the programs here have in common: `python3 FILE.py FUNCTION [ARGUMENT...]`.

Each says what it does in lines of its own, and ends when it is interrupted.
"""

import sys

import rclpy
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor


def say(text):
    print(text, flush=True)


def spin(*nodes):
    executor = MultiThreadedExecutor(2)
    for node in nodes:
        executor.add_node(node)
    executor.spin()


def main(functions):
    """Run the one of `functions` that the command line names."""
    rclpy.init()
    try:
        functions[sys.argv[1]](*sys.argv[2:])
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()
