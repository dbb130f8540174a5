"""A Franka Research 3 as libfranka sees it: franky-sim's server of its protocol, with the tray and the load of a plan.

`python tests/helpers/franka_server.py RUN` prints its address and serves until its standard input closes; then it
writes what it saw to `--record`. The arm has the friction and the rotors' inertia of franky-sim, which the plan does
not know, and no hand. While a motion runs the server waits for each command, as long as it takes on a busy machine.

franky-sim 1.0.4 (version 10 of the protocol) serves libfranka 0.20 and 0.21. It differs from an arm: it holds joint
positions with gains that chatter (`held` here), reports no acceleration of its base, and never stops
the arm by itself (`--reflex` here).
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import time
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from franky_sim.base_simulator import RobotParameters
from franky_sim.franka_robot_protocol import MoveCommandControllerMode, MoveStatus, RobotCommand, RobotMode
from franky_sim.franka_robot_server import FrankaRobotServer
from franky_sim.franka_server import BaseCommand
from franky_sim.mujoco_simulator import MujocoSimulator
from franky_sim.simulation_server import LocalHostnames

from salver.geometry import quat_wxyz_from_matrix
from salver.models.arm.arm import load_arm
from salver.planning.plan import Plan, load_plan

NO_HAND = RobotParameters(ee_mass=1e-6, ee_com=(0.0, 0.0, 0.0), ee_inertia=(1e-9, 0, 0, 0, 1e-9, 0, 0, 0, 1e-9))
SUBSTEPS = 4  # of the engine in a period
REFLEX = 6  # bit of the errors: joint_reflex


class Server(FrankaRobotServer):
    """The arm's side of the protocol. at: s of torque control at which something happens, by name; None: never."""

    def __init__(self, robot: Any, at: dict[str, float | None]) -> None:
        self.at, self.periods, self.by_torque, self.came, self.reflex = at, 0, False, False, False
        super().__init__(robot, LocalHostnames())

    def start_motion(self, controller_mode: Any, generator: Any, motion_id: int) -> None:
        self.by_torque, self.came = controller_mode == MoveCommandControllerMode.kExternalController, False
        super().start_motion(controller_mode, generator, motion_id)

    def _handle_udp_command(self, data: bytes) -> None:
        self.came = self.new = True
        super()._handle_udp_command(data)

    def await_command(self) -> None:
        self.new = False
        until = time.monotonic() + 1.0
        while True:
            self.process_commands()
            waits = self.came and self.current_motion_id and self.udp_connected and not self.new
            if not waits or time.monotonic() > until:
                break
            time.sleep(2e-5)
        if self.by_torque and self.current_motion_id and self.new:
            self.periods += 1
            self.happen(1e-3 * self.periods)

    def happen(self, t: float) -> None:
        due = [name for name, when in self.at.items() if when is not None and t >= when]
        for name in due:
            self.at[name] = None
            if name == "die":
                os._exit(1)
            elif name == "interrupt":
                os.kill(os.getppid(), signal.SIGINT)
            else:
                self.reflex, motion = True, self.current_motion_id
                self.reset_current_motion_id()
                self.stop_motion(send_preemption_signal=False)
                BaseCommand.send_response(self._tcp_socket, RobotCommand.kMove, motion, MoveStatus.kReflexAborted)

    @property
    def robot_state(self) -> Any:
        state = super().robot_state
        if not self.reflex:
            return state
        errors = tuple(k == REFLEX for k in range(41))
        return state.replace(robot_mode=RobotMode.kReflex, errors=errors, reflex_reason=errors)


def load_on_tray(sim: MujocoSimulator, plan: Plan, q: Any) -> None:
    """The tray in place of the hand, and the first object, a box, on it."""
    arm, tray, body = (
        load_arm(plan.scenario.arm, plan.scenario.tray),
        plan.scenario.tray,
        plan.scenario.payload.bodies[0],
    )  # type: ignore[arg-type]
    touching: list[ET.Element] = []
    parents = {child: parent for parent in sim.worldbody.iter() for child in parent}
    for hand in [x for x in sim.worldbody.iter("body") if x.get("name", "").endswith(("hand", "finger"))]:
        for geom in hand.findall("geom"):
            hand.remove(geom)
        hand.find("inertial").attrib.update(mass="1e-6", diaginertia="1e-9 1e-9 1e-9")  # type: ignore[union-attr]
        link = parents[hand] if hand.get("name", "").endswith("hand") else None
        if link is not None:
            at = np.array([0.0, 0.0, 0.107]) + arm.p_FE
            on = ET.SubElement(link, "body", name="tray", pos=text(at), quat=text(quat_wxyz_from_matrix(arm.R_FE)))
            ET.SubElement(on, "inertial", pos=text(arm.tray_com_E), mass=str(tray.mass), diaginertia=text(tray.inertia))
            half = 0.5 * np.array([*tray.size, tray.thickness])
            touch = {"condim": "3", "friction": f"{body.friction} 0 0", "solref": "0.0005 3", "priority": "1"}
            touching.append(
                ET.SubElement(on, "geom", type="box", pos=text([0, 0, -half[2]]), size=text(half), mass="0", **touch)
            )
    p, R = arm.object_pose(q, body.p_EB, body.R_EB)
    load = ET.SubElement(sim.worldbody, "body", name="load", pos=text(p), quat=text(quat_wxyz_from_matrix(R)))
    ET.SubElement(load, "freejoint", name="load")
    low, high = np.min(body.solid.bounding_points_G, axis=0), np.max(body.solid.bounding_points_G, axis=0)
    touching.append(ET.SubElement(load, "geom", type="box", size=text(0.5 * (high - low))))
    inertial, moments = body.inertial, np.diag(body.inertial.inertia_com)
    ET.SubElement(load, "inertial", pos=text(inertial.com_B), mass=str(inertial.mass), diaginertia=text(moments))
    for geom in sim.scene.iter("geom"):
        if geom not in touching:
            geom.attrib.update(contype="0", conaffinity="0")
    for joint in sim.scene.iter("joint"):
        if "armature" in joint.attrib:
            joint.attrib.update(armature="0", frictionloss="0", damping="0")
    sim.scene.find("option").attrib.update(cone="elliptic", impratio="300")  # type: ignore[union-attr]


def held(sim: MujocoSimulator, robot: Any, plan: Plan) -> None:
    """Let the arm follow commanded positions exactly, with the load in its place: the gains of franky-sim let light
    wrists chatter."""
    arm, body, wanted = load_arm(plan.scenario.arm, plan.scenario.tray), plan.scenario.payload.bodies[0], []  # type: ignore[arg-type]

    def hold(q: Any) -> None:
        wanted[:] = [q]
        robot.torque_control(np.zeros(7))

    def follow(sim: Any) -> None:
        if wanted:
            q = wanted.pop()
            p, R = arm.object_pose(q, body.p_EB, body.R_EB)
            sim.data.qpos[:7], sim.data.qpos[-7:], sim.data.qvel[:] = q, [*p, *quat_wxyz_from_matrix(R)], 0.0

    sim.register_post_step_callback(follow)
    robot._joint_position_control, robot._pre_step = hold, lambda: None  # and its fingers are left alone


def text(numbers: Any) -> str:
    return " ".join(repr(float(x)) for x in numbers)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=Path)
    parser.add_argument("--record", type=Path)
    parser.add_argument("--away", type=float, default=0.0, help="rad of each joint from the start")
    for name in ("die", "interrupt", "reflex"):
        parser.add_argument(f"--{name}", type=float, help="s of torque control")
    given = parser.parse_args()
    plan, seen = load_plan(given.run), []
    with MujocoSimulator() as sim:
        start = plan.joint.q[0] + given.away  # type: ignore[union-attr]
        robot = sim.add_robot(start.tolist(), robot_parameters=NO_HAND)
        held(sim, robot, plan)
        load_on_tray(sim, plan, start)
        tray = plan.scenario.tray
        robot.set_load(tray.mass, (0.0, 0.0, tray.height), tuple(np.diag(tray.inertia).ravel()))  # as in Desk
        server = Server(robot, {name: getattr(given, name) for name in ("die", "interrupt", "reflex")})
        server.init()
        sim.start()
        sim.model.opt.timestep = 1e-3 / SUBSTEPS  # type: ignore[union-attr]
        print(server.hostname, flush=True)
        closing = threading.Event()
        threading.Thread(target=lambda: (sys.stdin.read(), closing.set()), daemon=True).start()
        while not closing.is_set():
            began = time.monotonic()
            server.await_command()
            sim.step()
            for _ in range(SUBSTEPS - 1 if server.by_torque and server.current_motion_id else 0):
                mujoco.mj_step(sim.model, sim.data)
            server.send_state()
            if server.by_torque and server.current_motion_id:
                plate, load = sim.data.body("tray"), sim.data.body("load")  # type: ignore[union-attr]
                slipped = plate.xmat.reshape(3, 3).T @ (load.xpos - plate.xpos)
                state = robot.inner_state
                seen.append(np.concatenate([state.q, state.dq, robot.state.tau_J_d, slipped]))
            time.sleep(max(0.0, 1e-3 - (time.monotonic() - began)))
        server.cleanup()
    if given.record:
        rows = np.array(seen).reshape(-1, 24)
        np.savez(given.record, q=rows[:, :7], dq=rows[:, 7:14], sent=rows[:, 14:21], p_EB=rows[:, 21:])


if __name__ == "__main__":
    main()
