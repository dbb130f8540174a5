"""Trace of a run at every command: poses, joints, contacts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from salver.geometry import Array, hat, matrix_from_quat_wxyz
from salver.simulation import creep
from salver.simulation.scene.elements import DAMPING_WIDTH
from salver.simulation.scene.engine import mujoco
from salver.simulation.scene.scene import Scene
from salver.simulation.tray_frame import TrayMotion

Take = Callable[[float, Array, Array, Array, Any], None]  # of t, q, dq, tau and data, as `Recorder.take`


def step(scene: Scene, data: Any, t: float, tau: Array, steps: int, take: Take) -> None:
    """One command period from time t, s: `steps` of the engine under the torque tau (n,).

    take: called with the state at its start, when the engine has made one step since.
    """
    n = scene.n
    q, dq = data.qpos[:n].copy(), data.qvel[:n].copy()
    data.qfrc_applied[:n] = tau
    scene.slide(data)
    scene.shake(data, t)
    _advance(scene, data, 1)
    take(t, q, dq, tau, data)
    _advance(scene, data, steps - 1)


def _advance(scene: Scene, data: Any, steps: int) -> None:
    if steps > 0 and not scene.beside_walls:
        mujoco.mj_step(scene.model, data, nstep=steps)
        return
    for _ in range(steps):
        mujoco.mj_step1(scene.model, data)
        _prevent_creep(scene, data)
        mujoco.mj_step2(scene.model, data)


def _prevent_creep(scene: Scene, data: Any) -> None:
    """Take the share of the bias that makes the creep off the accelerations which contacts of the load aim at, between
    `mj_step1` and `mj_step2`."""
    assert scene.arm is not None
    n, contact, time = scene.n, data.contact, scene.contact_time
    share = creep.gain(time, scene.model.opt.timestep, DAMPING_WIDTH) / (0.5 * DAMPING_WIDTH * time)
    tray = creep.tray_bias(scene.arm, data.qpos[None, :n], data.qvel[None, :n], scene.world.R_tilt)
    R_SE = scene.tray_pose(data)[1]
    biased = {int(scene.tray_id): (R_SE @ tray.linear[0], R_SE @ tray.by_place[0] @ R_SE.T)}
    for body, first in zip(scene.object_ids.tolist(), scene.qvel_ids.tolist(), strict=True):
        spin = hat(data.xmat[body].reshape(3, 3) @ data.qvel[first + 3 : first + 6])
        biased[body] = np.zeros(3), spin @ spin
    bodies, axes = scene.model.geom_bodyid[contact.geom], contact.frame.reshape(-1, 3, 3)
    for pair, row, place, frame in zip(bodies.tolist(), contact.efc_address.tolist(), contact.pos, axes, strict=True):
        if row >= 0 and all(body in biased for body in pair):
            own, other = (biased[body][0] + biased[body][1] @ (place - data.xpos[body]) for body in pair)
            data.efc_aref[row : row + 3] -= share * frame @ (other - own)


@dataclass(frozen=True)
class Trace:
    """A run at N instants, with m objects, n joints, n_f contact points (feet) of all objects, object by object.

    t (N,): s, 0 when the motion starts. q, dq, tau (N, n). p_XE, R_XE: the real tray in the engine's world X.
    p_XB, R_XB (N, m, ...): the objects. foot_force_B (N, n_f, 3): force on the object at each foot, in its B, N.
    force_X (N, m, 3): sum of contact forces on an object from its support. touches (N, m): whether there are any.
    collides (N,): whether tray or objects touch an obstacle.
    The rest is of the k objects with a liquid or a pendulum (`scene.Swing`). swung (N, k, n_modes, 2): joint angles of
    its modes. moved, turned (N, k, 3): velocity of the origin of its dynamics in X, angular velocity of its object in
    B. pulled (N, k, 3): acceleration of a free mass there in X.
    """

    t: Array
    q: Array
    dq: Array
    tau: Array
    p_XE: Array
    R_XE: Array
    p_XB: Array
    R_XB: Array
    foot_force_B: Array
    force_X: Array
    touches: Array
    collides: Array
    swung: Array = field(default_factory=lambda: np.zeros((0, 0, 0, 2)))
    moved: Array = field(default_factory=lambda: np.zeros((0, 0, 3)))
    turned: Array = field(default_factory=lambda: np.zeros((0, 0, 3)))
    pulled: Array = field(default_factory=lambda: np.zeros((0, 0, 3)))


class Recorder:
    """Collects a `Trace`: one `take` for each command."""

    def __init__(self, scene: Scene, count: int) -> None:
        n, model, swings = scene.n, scene.model, scene.swings
        self.scene = scene
        self.t = np.empty(count)
        self.q, self.dq, self.tau = (np.empty((count, n)) for _ in range(3))
        # Of all bodies and joints, because copying all is faster than selecting some.
        self.position, self.quaternion = np.empty((count, model.nbody, 3)), np.empty((count, model.nbody, 4))
        self.qpos, self.sensed = np.empty((count, model.nq)), np.empty((count, model.nsensordata))
        self.pulled = np.tile(scene.model.opt.gravity, (count, len(swings), 1))
        self.contacts: list[tuple[Array, Array, Array, Array]] = []
        self.count = 0

    def take(self, t: float, q: Array, dq: Array, tau: Array, data: Any) -> None:
        """Store the joint state at a command, the command, and the poses and contact forces of that state: `data` has
        been stepped once since, and has those of its start."""
        k = self.count
        self.t[k], self.q[k], self.dq[k], self.tau[k] = t, q, dq, tau
        self.position[k], self.quaternion[k] = data.xpos, data.xquat
        self.qpos[k], self.sensed[k] = data.qpos, data.sensordata
        contact = data.contact
        self.contacts.append(
            (contact.geom.copy(), contact.frame.copy(), contact.efc_address.copy(), data.efc_force.copy())
        )
        self.count = k + 1

    @property
    def full(self) -> bool:
        return self.count == len(self.t)

    def keep(self, last: int) -> None:
        """Discard all but the last `last` samples."""
        gone = max(0, self.count - last)
        joints = (self.t, self.q, self.dq, self.tau)
        for values in (*joints, self.position, self.quaternion, self.qpos, self.sensed, self.pulled):
            values[: self.count - gone] = values[gone : self.count]
        del self.contacts[:gone]
        self.count -= gone

    def seen_from_rest(self, motion: TrayMotion, step: int) -> None:
        """Add the tray's motion at a step to the last sample, when the tray is fixed to the engine's world."""
        k = self.count - 1
        for swing, pulled in zip(self.scene.swings, self.pulled[k], strict=True):
            sensed = self.sensed[k, swing.sensor : swing.sensor + 6]
            load = self.scene.loads[swing.load]
            at = load.p_EB + load.R_EB @ load.origin_B
            pulled[:] = motion.felt_at(step, at, load.R_EB @ sensed[:3])
            sensed[3:] += load.R_EB.T @ motion.omega[step]

    def trace(self) -> Trace:
        scene, count = self.scene, self.count
        m, swings = len(scene.loads), scene.swings
        bodies = [scene.tray_id, *scene.object_ids]
        position, R = self.position[:count, bodies], matrix_from_quat_wxyz(self.quaternion[:count, bodies])
        R_XB = R[:, 1:]
        most = max((len(s.qpos_ids) for s in swings), default=0)
        angles = np.zeros((len(swings), most, 2), dtype=int)
        for found, swing in zip(angles, swings, strict=True):
            found[: len(swing.qpos_ids)] = swing.qpos_ids
        sensors = np.array([s.sensor + np.arange(6) for s in swings], dtype=int).reshape(len(swings), 6)
        sensed = self.sensed[:count, sensors]
        instant = np.repeat(np.arange(count), [len(c[0]) for c in self.contacts])
        geom, frame, address, rows = (np.concatenate([c[i] for c in self.contacts]) for i in range(4))
        # The three constraint forces of each contact; their addresses restart at every instant.
        start = np.cumsum([0, *(len(c[3]) for c in self.contacts[:-1])])
        local = rows[(start[instant] + address)[:, None] + np.arange(3)]
        # Contact forces act on the second geom, in a frame whose rows are the normal and two tangents.
        force = np.einsum("cij,ci->cj", frame.reshape(-1, 3, 3), local)
        loaded = np.linalg.norm(force, axis=1) > 0
        owner = _owner(scene)
        offset = np.concatenate([[0], np.cumsum([len(load.outline_B) for load in scene.loads])])
        foot_force = np.zeros((count, offset[-1], 3))
        total = np.zeros((count, m, 3))
        touches = np.zeros((count, m), bool)
        for side, sign in ((1, 1.0), (0, -1.0)):
            mine, other = geom[:, side], geom[:, 1 - side]
            foot = loaded & (scene.foot_object[mine] >= 0)
            k, at = scene.foot_object[mine[foot]], instant[foot]
            touches[at, k] = True
            np.add.at(total, (at, k), sign * force[foot])
            number = offset[k] + scene.foot_number[mine[foot]]
            np.add.at(foot_force, (at, number), sign * np.einsum("cji,cj->ci", R_XB[at, k], force[foot]))
            other_is_foot = scene.foot_object[other] >= 0
            side_hit = loaded & (owner[mine] >= 0) & ~foot & ~other_is_foot
            touches[instant[side_hit], owner[mine[side_hit]]] = True
            np.add.at(total, (instant[side_hit], owner[mine[side_hit]]), sign * force[side_hit])
        collides = np.zeros(count, bool)
        collides[instant[loaded & scene.obstacle[geom].any(axis=1)]] = True
        return Trace(
            t=self.t[:count],
            q=self.q[:count],
            dq=self.dq[:count],
            tau=self.tau[:count],
            p_XE=position[:, 0],
            R_XE=R[:, 0],
            p_XB=position[:, 1:],
            R_XB=R_XB,
            foot_force_B=foot_force,
            force_X=total,
            touches=touches,
            collides=collides,
            swung=self.qpos[:count, angles],
            moved=np.einsum("tkij,tkj->tki", R_XB[:, [s.load for s in swings]], sensed[..., :3]),
            turned=sensed[..., 3:],
            pulled=self.pulled[:count],
        )


def _owner(scene: Scene) -> Array:
    """For each geom, the index of its object; -1 for tray, arm and obstacles."""
    index = np.full(scene.model.nbody, -1)  # liquids and pendulums have no geoms
    index[scene.object_ids] = np.arange(len(scene.object_ids))
    return index[scene.model.geom_bodyid]


def net_contact_wrench(scene: Scene, trace: Trace) -> Array:
    """Net contact wrench (N, 6) on the first object at B, in B, from its support and the objects that stand on it.

    It corresponds to the wrench of the plan, the inverse dynamics of the first object.
    """
    first = scene.loads[0]
    R_BX, p_XB = np.swapaxes(trace.R_XB[:, 0], -1, -2), trace.p_XB[:, 0]
    wrench = np.zeros((len(trace.t), 6))
    foot = 0
    for k, load in enumerate(scene.loads):
        for support, points in load.supports.items():
            force = trace.foot_force_B[:, foot : foot + len(points)]
            foot += len(points)
            if k > 0 and support != first.name:
                continue
            to_first = R_BX @ trace.R_XB[:, k]
            sign = 1.0 if k == 0 else -1.0
            force_B = sign * np.einsum("tij,tfj->tfi", to_first, force)
            arm_B = np.einsum("tij,tj->ti", R_BX, trace.p_XB[:, k] - p_XB)[:, None] + points @ np.swapaxes(
                to_first, -1, -2
            )
            wrench += np.concatenate([force_B.sum(axis=1), np.cross(arm_B, force_B).sum(axis=1)], axis=1)
    return wrench
