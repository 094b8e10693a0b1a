"""Runs ``tumortrack track`` with the node's parameters; a parameter that is set starts it anew."""

from __future__ import annotations

import signal
import subprocess
import sys

import rclpy
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import Empty
from std_srvs.srv import Trigger

from tumortrack_ros.options import OPTIONS, command

_LOOK_S = 0.2  # how often it is seen whether the command has ended, or must be started anew
_FLUSH_S = 15.0  # for its sinks to say that it is over
_REFUSED = 2  # the command's exit code where it does not take a value


class TrackNode(Node):
    """``code``: what the command ended with; None: it runs."""

    def __init__(self) -> None:
        super().__init__("tumortrack")
        for name, option in OPTIONS.items():
            about = ParameterDescriptor(description=option.description)
            self.declare_parameter(name, option.default, about)
        self.code: int | None = None
        self._stale = False
        self._before: dict[str, object] = {}  # the values that it ran with before a change
        self._acknowledging = {}  # publishers, by topic
        self._start()
        self.create_service(Trigger, "~/acknowledge", self._acknowledge)
        self.add_on_set_parameters_callback(self._changed)
        self.create_timer(_LOOK_S, self._look)

    def end(self) -> None:
        """As Ctrl-C would, so that every topic says that it is over."""
        if self._track.poll() is None:
            self._track.send_signal(signal.SIGINT)
            try:
                self._track.wait(_FLUSH_S)
            except subprocess.TimeoutExpired:
                self._track.kill()

    def _values(self) -> dict[str, object]:
        return {name: self.get_parameter(name).value for name in OPTIONS}

    def _start(self) -> None:
        values = self._values()
        line = command(values)
        for sink in values["sinks"]:
            kind, _, namespace = sink.partition("?")[0].partition(":")
            topic = f"{namespace or '/tumortrack'}/acknowledge"
            if kind == "ros2" and topic not in self._acknowledging:
                self._acknowledging[topic] = self.create_publisher(Empty, topic, 1)
        self.get_logger().info(" ".join(line))
        self._track = subprocess.Popen(line)

    def _acknowledge(self, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """The user has seen what contradicts the answer."""
        heard = [one for one in self._acknowledging.values() if one.get_subscription_count()]
        for one in heard:
            one.publish(Empty())
        answer.success, answer.message = bool(heard), "" if heard else "no ros2 sink hears of it"
        return answer

    def _changed(self, parameters: list) -> SetParametersResult:
        ours = {one.name: one.value for one in parameters if one.name in OPTIONS}
        try:
            command({**self._values(), **ours})
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if ours and not self._stale:
            self._stale, self._before = True, self._values()
        return SetParametersResult(successful=True)

    def _look(self) -> None:
        if self._stale:
            self._stale = False
            self.end()
            self._start()
        code = self._track.poll()
        if code == _REFUSED and self._before:
            self.get_logger().error("the new values were refused; the former ones are back")
            self.set_parameters([Parameter(name, value=old) for name, old in self._before.items()])
            self._before = {}
        else:
            self.code = code


def main() -> None:
    """Until the command ends; its exit code is the node's."""
    rclpy.init()
    try:
        node = TrackNode()
    except (ValueError, OSError) as error:
        sys.exit(f"tumortrack: {error}")
    try:
        while rclpy.ok() and node.code is None:
            rclpy.spin_once(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.end()
        node.destroy_node()
        rclpy.try_shutdown()
    sys.exit(node.code or 0)
