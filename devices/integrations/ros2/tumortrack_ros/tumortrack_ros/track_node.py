"""Runs ``tumortrack track`` with the node's parameters, while the node is active; a parameter that
is set then restarts it."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable
from functools import partial

import rclpy
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from std_msgs.msg import Empty
from std_srvs.srv import Trigger

from tumortrack_ros.options import FIXED, OPTIONS, Option, check, command

_LOOK_S = 0.2  # how often it is seen whether the command has ended, or must be started anew
_FLUSH_S = 15.0  # for its sinks to say that it is over
_REFUSED = 2  # the command's exit code where it does not take a value
_ASKED = (
    "acknowledge",
    "cut",
    "forget",
    "halt",
)  # services, and the sinks' topics that they stand for
_AUTOSTART = "be active at once, and end with tracking; else transitions decide, and it stays"
Done = TransitionCallbackReturn


class TrackNode(LifecycleNode):
    """``code``: what the command ended with, of a node that ends with it; None: it runs."""

    def __init__(self) -> None:
        super().__init__("tumortrack")
        for name, option in OPTIONS.items():
            self.declare_parameter(name, option.default, _descriptor(name, option))
        about = ParameterDescriptor(description=_AUTOSTART, read_only=True)
        self._autostart: bool = self.declare_parameter("autostart", True, about).value
        self.code: int | None = None
        self._track: subprocess.Popen[bytes] | None = None  # while the node is active
        self._stale = False
        self._before: dict[str, object] = {}  # the values that it ran with before a change
        self._publishers_of = {name: {} for name in _ASKED}  # by topic
        for name in _ASKED:
            self.create_service(Trigger, f"~/{name}", partial(self._ask, name))
        self.add_on_set_parameters_callback(self._changed)
        self.create_timer(_LOOK_S, self._look)
        if self._autostart and self.trigger_configure() == Done.SUCCESS:
            self.trigger_activate()
        if self._autostart and self._track is None:
            self.code = _REFUSED

    # Transitions: `configure` checks the parameters, `activate` tracks, `deactivate` ends that

    def on_configure(self, state: LifecycleState) -> Done:
        return self._tried(lambda: command(self._values()))

    def on_activate(self, state: LifecycleState) -> Done:
        self._stale, self._before = False, {}
        return self._tried(self._start)

    def on_deactivate(self, state: LifecycleState) -> Done:
        self.end()
        return Done.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> Done:
        return self.on_deactivate(state)

    def _tried(self, step: Callable[[], object]) -> Done:
        try:
            step()
        except (ValueError, OSError) as error:
            self.get_logger().error(str(error))
            return Done.FAILURE
        return Done.SUCCESS

    def end(self) -> None:
        """As Ctrl-C would, so that every topic says that it is over."""
        track, self._track = self._track, None
        if track is not None and track.poll() is None:
            track.send_signal(signal.SIGINT)
            try:
                track.wait(_FLUSH_S)
            except subprocess.TimeoutExpired:
                track.kill()
                track.wait()

    def _values(self) -> dict[str, object]:
        return {name: self.get_parameter(name).value for name in OPTIONS}

    def _start(self) -> None:
        values = self._values()
        line = command(values)
        for sink in values["sinks"]:
            kind, _, namespace = sink.partition("?")[0].partition(":")
            for name, publishers in self._publishers_of.items():
                topic = f"{namespace or '/tumortrack'}/{name}"
                if kind == "ros2" and topic not in publishers:
                    publishers[topic] = self.create_publisher(Empty, topic, 1)
        self.get_logger().info(" ".join(line))
        self._track = subprocess.Popen(line)

    def _ask(self, name: str, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        """Says it to every sink that listens."""
        publishers = self._publishers_of[name].values()
        heard = [one for one in publishers if one.get_subscription_count()]
        for one in heard:
            one.publish(Empty())
        answer.success, answer.message = bool(heard), "" if heard else "no ros2 sink hears of it"
        return answer

    def _changed(self, parameters: list) -> SetParametersResult:
        before = self._values()
        new = {one.name: one.value for one in parameters if one.name in OPTIONS}
        try:
            for name, value in new.items():
                check(name, value)
                if self._track is not None and name in FIXED and value != before[name]:
                    raise ValueError(f"{name} is fixed while the node is active: deactivate it")
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if new and self._track is not None and not self._stale:
            self._stale, self._before = True, before
        return SetParametersResult(successful=True)

    def _look(self) -> None:
        if self._track is None:
            return
        if self._stale:
            self._stale = False
            self.end()
            if self._tried(self._start) != Done.SUCCESS:  # the command itself is gone
                self.code = _REFUSED
                return
        code = self._track.poll()
        if code == _REFUSED and self._before:
            self.get_logger().error("the new values were refused; the former ones are back")
            self.set_parameters([Parameter(name, value=old) for name, old in self._before.items()])
            self._before = {}
        elif code is not None and not self._autostart:
            self.get_logger().error(f"tracking has ended, exit code {code}")
            self.trigger_deactivate()
        else:
            self.code = code


def _descriptor(name: str, option: Option) -> ParameterDescriptor:
    """What `ros2 param describe` says; rclpy itself keeps numbers in their range."""
    about = ParameterDescriptor(description=option.description)
    if isinstance(option.default, float):
        low, high = option.limits
        about.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    elif option.limits:
        about.additional_constraints = f"allowed: {option.limits}"
    if name in FIXED:
        about.additional_constraints += " not while the node is active"
    return about


def main() -> None:
    """With autostart until the command ends; its exit code is the node's."""
    rclpy.init()
    try:
        node = TrackNode()
    except ParameterException as error:
        sys.exit(f"tumortrack: {error}")
    try:
        while rclpy.ok() and node.code is None:
            try:
                rclpy.spin_once(node)
            except RuntimeError as error:  # rclpy's, of a transition that this state does not have
                node.get_logger().error(str(error))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.end()
        node.destroy_node()
        rclpy.try_shutdown()
    sys.exit(node.code or 0)
