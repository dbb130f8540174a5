"""The node `salver`: topics, services and the controller's action, and nothing else; what they mean is in `carrier`.

It waits for joint_states, starts where the arm rests, and plans in a process of its own.
"""

from __future__ import annotations

import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields
from multiprocessing import get_context
from typing import Any

import rclpy
from control_msgs.action import FollowJointTrajectory
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from rclpy.action import ActionClient
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosidl_runtime_py import set_message_fields
from salver_msgs.srv import Audit, Goto, Plan, Run
from sensor_msgs.msg import JointState
from std_msgs.msg import Empty, Float64MultiArray
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

import salver as sv
from salver.errors import SalverError
from salver.live import Worker
from salver_ros import carrier as logic
from salver_ros import messages

OUTPUTS = ("action", "topic", "position")


def filled(message: Any, values: dict[str, Any]) -> Any:
    set_message_fields(message, values)
    return message


class Salver(Node):
    """Parameters: scenario, controller, output, rate, plan_seconds, and those of `carrier.Options` but streams."""

    def __init__(self) -> None:
        super().__init__("salver")
        value = lambda name, default: self.declare_parameter(name, default).value  # noqa: E731
        scenario, controller = value("scenario", "panda-cube"), value("controller", "joint_trajectory_controller")
        self.output, rate = value("output", "action"), value("rate", 100.0)
        self.seconds = value("plan_seconds", 10.0)
        if self.output not in OUTPUTS:
            raise SalverError(f'output is "{self.output}"; it must be one of {", ".join(OUTPUTS)}.')
        if not 40.0 <= rate <= 1000.0:
            raise SalverError(f"rate is {rate:g}; it must be from 40 to 1000 Hz.")
        given = {x.name: value(x.name, x.default) for x in fields(logic.Options) if x.name != "streams"}
        self.options = logic.Options(streams=self.output == "position", **given)
        self.scenario = sv.load_scenario(scenario)
        self.carrier: logic.Carrier | None = None
        self.worker: Worker | None = None
        self.pool = ProcessPoolExecutor(1, mp_context=get_context("spawn"))
        self.goal: Any = None  # the newest of the action; older ones were replaced
        one = MutuallyExclusiveCallbackGroup()  # the carrier belongs to one thread
        apart = ReentrantCallbackGroup()
        self.client = ActionClient(
            self, FollowJointTrajectory, f"{controller}/follow_joint_trajectory", callback_group=one
        )
        self.trajectories = self.create_publisher(JointTrajectory, f"{controller}/joint_trajectory", 1)
        self.positions = self.create_publisher(Float64MultiArray, f"{controller}/commands", 1)
        self.states = self.create_publisher(DiagnosticStatus, "~/state", 1)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.markers = self.create_publisher(MarkerArray, "~/markers", latched)
        for kind, topic, heard in (
            (JointState, "joint_states", self.on_joints),
            (TwistStamped, "~/twist", self.on_twist),
            (Empty, "~/heartbeat", self.on_heartbeat),
        ):
            self.create_subscription(kind, topic, heard, 1, callback_group=one)
        for kind, name, serve, group in (
            (Trigger, "~/stop", self.on_stop, one),
            (Trigger, "~/resume", self.on_resume, one),
            (Goto, "~/goto", self.on_goto, one),
            (Run, "~/run", self.on_run, one),
            (Plan, "~/plan", self.on_plan, apart),
            (Audit, "~/audit", self.on_audit, apart),
        ):
            self.create_service(kind, name, serve, callback_group=group)
        self.create_timer(1.0 / rate, self.on_period, callback_group=one)
        self.create_timer(0.1, self.on_state, callback_group=one)
        self.get_logger().info("waiting for joint_states")

    @property
    def now(self) -> float:
        return 1e-9 * self.get_clock().now().nanoseconds

    def say(self, refusal: str) -> None:
        if refusal:
            self.get_logger().warning(refusal, throttle_duration_sec=1.0)

    # --- in

    def on_joints(self, message: JointState) -> None:
        if self.carrier is not None:
            self.say(self.carrier.measured(message.name, message.position, self.now))
            return
        try:
            carrier = logic.Carrier(self.scenario, message.name, message.position, message.velocity, self.options)
        except SalverError as error:
            self.say(str(error))
            return
        self.worker = Worker(carrier.live, stops=True).start()
        self.carrier = carrier
        self.markers.publish(
            filled(MarkerArray(), messages.marker_messages(carrier.markers(), carrier.live.problem.arm.flange))
        )
        self.get_logger().info(f"ready to carry {carrier.scenario.name}")

    def on_twist(self, message: TwistStamped) -> None:
        if self.carrier is not None:
            v, omega = ([x.x, x.y, x.z] for x in (message.twist.linear, message.twist.angular))
            stamp = messages.seconds_of(message.header.stamp)
            self.say(self.carrier.twist(message.header.frame_id, stamp, v, omega, self.now))

    def on_heartbeat(self, _: Empty) -> None:
        if self.carrier is not None:
            self.carrier.beat(self.now)

    def answer(self, response: Any, told: tuple[bool, str]) -> Any:
        response.success, response.message = told
        return response

    def on_stop(self, _: Any, response: Any) -> Any:
        return self.answer(response, self.carrier.stop("by the service stop") if self.carrier else NOT_READY)

    def on_resume(self, _: Any, response: Any) -> Any:
        return self.answer(response, self.carrier.resume() if self.carrier else NOT_READY)

    def on_goto(self, request: Any, response: Any) -> Any:
        if self.carrier is None:
            return self.answer(response, NOT_READY)
        if request.posture.name:
            return self.answer(response, self.carrier.goto_posture(request.posture.name, request.posture.position))
        p, quat = request.pose.pose.position, request.pose.pose.orientation
        turned = None if request.any_heading else [quat.x, quat.y, quat.z, quat.w]
        return self.answer(response, self.carrier.goto(request.pose.header.frame_id, [p.x, p.y, p.z], turned))

    def on_run(self, request: Any, response: Any) -> Any:
        return self.answer(response, self.carrier.run(request.directory, self.now) if self.carrier else NOT_READY)

    def on_plan(self, request: Any, response: Any) -> Any:
        if self.carrier is None:
            return self.answer(response, NOT_READY)
        try:
            goal = logic.ordered(request.goal.name, request.goal.position, self.carrier.joints)
            start = self.carrier.command
            if request.start.name:
                start = logic.ordered(request.start.name, request.start.position, self.carrier.joints)
        except SalverError as error:
            return self.answer(response, (False, str(error)))
        asked = (self.scenario, start, goal, request.upright, request.speed, self.seconds)
        *told, motion = self.pool.submit(logic.plan, *asked).result()
        if motion is not None:
            set_message_fields(response.trajectory, messages.trajectory_message(motion))
        return self.answer(response, (told[0], told[1]))

    def on_audit(self, request: Any, response: Any) -> Any:
        try:
            motion = messages.trajectory_of(request.trajectory)
        except ValueError as error:
            return self.answer(response, (False, str(error)))
        return self.answer(response, self.pool.submit(logic.audit, self.scenario, motion).result())

    # --- out

    def on_period(self) -> None:
        if self.carrier is None:
            return
        motion = self.carrier.step(self.now)
        if self.output == "position":
            self.positions.publish(Float64MultiArray(data=self.carrier.command.tolist()))
        elif motion is not None:
            message = filled(JointTrajectory(), messages.trajectory_message(motion))
            if self.output == "topic":
                self.trajectories.publish(message)
            elif not self.client.server_is_ready():
                self.carrier.lost("the controller's action server is not there")
            else:
                goal = self.goal = object()
                sent = self.client.send_goal_async(FollowJointTrajectory.Goal(trajectory=message))
                sent.add_done_callback(lambda done: self.on_accepted(goal, done.result()))

    def on_accepted(self, goal: Any, handle: Any) -> None:
        if handle.accepted:
            handle.get_result_async().add_done_callback(lambda done: self.on_result(goal, done.result().result))
        elif goal is self.goal and self.carrier is not None:
            self.carrier.lost("the controller refuses the motion")

    def on_result(self, goal: Any, result: Any) -> None:
        if goal is self.goal and result.error_code != result.SUCCESSFUL and self.carrier is not None:
            self.carrier.lost(f"the controller ended the motion with {result.error_code}: {result.error_string}")

    def on_state(self) -> None:
        if self.carrier is not None:
            state = messages.state_message(*self.carrier.state(), self.scenario.name)
            self.states.publish(filled(DiagnosticStatus(), state))

    def close(self) -> None:
        """What is committed is finished by the controller."""
        if self.worker is not None:
            self.worker.close()
        self.pool.shutdown(wait=False, cancel_futures=True)


NOT_READY = (False, "The node waits for joint states of an arm that rests where the load is safe; its log says why.")


def main() -> int:
    rclpy.init()
    node = None
    try:
        node = Salver()
        executor = MultiThreadedExecutor(4)
        executor.add_node(node)
        executor.spin()
    except SalverError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if node is not None:
            node.close()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
