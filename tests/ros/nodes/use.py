# SPDX-License-Identifier: MIT OR Apache-2.0
"""A robot with an action, parameters and a lifecycle, and a user who tries all of them.

The user waits for nothing: it sends its requests whether or not it sees the servers. So only access rules keep it out.
"""

from action_msgs.msg import GoalStatusArray
from example_interfaces.action import Fibonacci
from lifecycle_msgs.msg import Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState
from program import main, say, spin
from rcl_interfaces.msg import (
    Parameter, ParameterEvent, ParameterType, ParameterValue, SetParametersResult)
from rcl_interfaces.srv import GetParameters, SetParameters
import rclpy
from rclpy._rclpy_pybind11 import RCLError
from rclpy.action import ActionClient, ActionServer
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile


class Managed(LifecycleNode):
    """A lifecycle node with nothing to do."""

    def on_configure(self, state):
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state):
        return TransitionCallbackReturn.SUCCESS


def robot():
    """Serves the action `/dock`; `/arm` has the parameter `speed`, and `/managed` a lifecycle."""
    arm = rclpy.create_node('arm')
    arm.declare_parameter('speed', 0)

    def changed(parameters):
        for parameter in parameters:
            say(f'{parameter.name} set by {parameter.value}')
        return SetParametersResult(successful=True)

    arm.add_on_set_parameters_callback(changed)
    dock = rclpy.create_node('docking')

    def execute(goal):
        say(f'docking for {goal.request.order}')
        goal.publish_feedback(Fibonacci.Feedback(sequence=[0, 1]))
        goal.succeed()
        return Fibonacci.Result(sequence=[0, 1, 1])

    server = ActionServer(dock, Fibonacci, '/dock', execute)
    managed = Managed('managed')
    say('ready')
    while rclpy.ok():
        try:
            spin(arm, dock, managed)
        except RCLError as error:
            # rclpy raises it where a transition does not fit the state.
            say(f'refused {error}')
    server.destroy()


def user(number):
    """Tries everything again and again; the robot knows this user by its number."""
    number = int(number)
    node = rclpy.create_node(f'user_{number}')
    latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)

    def hear(kind, topic, qos=10):
        node.create_subscription(kind, topic, lambda _: say(f'got {topic}'), qos)

    hear(GoalStatusArray, '/dock/_action/status', latched)
    hear(Fibonacci.Impl.FeedbackMessage, '/dock/_action/feedback')
    hear(TransitionEvent, '/managed/transition_event')

    def event(change):
        # Nodes of this host tell of their parameters, too.
        if change.node == '/arm':
            say('got /parameter_events')

    node.create_subscription(ParameterEvent, '/parameter_events', event, 10)
    dock = ActionClient(node, Fibonacci, '/dock')
    write = node.create_client(SetParameters, '/arm/set_parameters')
    read = node.create_client(GetParameters, '/arm/get_parameters')
    change = node.create_client(ChangeState, '/managed/change_state')
    speed = ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=number)
    parameters = SetParameters.Request(parameters=[Parameter(name='speed', value=speed)])
    turns = 0

    def accepted(sent):
        say(f'goal accepted {sent.result().accepted}')
        sent.result().get_result_async().add_done_callback(
            lambda got: say(f'result {list(got.result().result.sequence)}'))

    def call(client, request, what):
        client.call_async(request).add_done_callback(lambda done: say(f'answered {what}'))

    def use():
        nonlocal turns
        turns += 1
        dock.send_goal_async(Fibonacci.Goal(order=number)).add_done_callback(accepted)
        call(write, parameters, 'set_parameters')
        call(read, GetParameters.Request(names=['speed']), 'get_parameters')
        step = (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_CLEANUP)[turns % 2]
        call(change, ChangeState.Request(transition=Transition(id=step)), 'change_state')
        say(f'tried {turns}')

    node.create_timer(0.3, use)
    spin(node)


main(globals())
