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
        self._start()
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
        line = command(self._values())
        self.get_logger().info(" ".join(line))
        self._track = subprocess.Popen(line)

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
