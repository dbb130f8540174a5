"""Recordings drawn at random: motions of a tray or an arm, violent and gentle, and the files they are written to."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from salver.contact_margins import margin_model
from salver.geometry import exp, quat_wxyz_from_matrix
from salver.models.arm.arm import ArmModel, load_arm
from salver.models.tray_motion import motion_vector
from salver.planning.follow import forward
from salver.scenario import Scenario, load
from salver.trajectory import JointMotion, MotionSamples, min_jerk_line

FINE = 1 / 8000  # s: steps in which accelerations are integrated
Q0 = np.array([0.082565, 1.039634, -0.777333, -1.678140, -2.197384, 0.842888, 1.123073])
POSES, JOINTS = ("csv", "csv_xyzw", "bag_pose"), ("joint_csv", "json", "yaml", "bag_joints")


@dataclass(frozen=True)
class Wave:
    """A scalar function of time by its samples: value, first and second derivative, every FINE seconds."""

    value: np.ndarray
    rate: np.ndarray
    bend: np.ndarray

    @classmethod
    def of(cls, bend: np.ndarray, speed: float = 0.0) -> Wave:
        rate = speed + np.concatenate([[0.0], np.cumsum(0.5 * FINE * (bend[1:] + bend[:-1]))])
        # Exact for an acceleration that is linear between its samples.
        step = FINE * rate[:-1] + FINE**2 * (2 * bend[:-1] + bend[1:]) / 6
        return cls(np.concatenate([[0.0], np.cumsum(step)]), rate, bend)

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        k = np.clip((t / FINE).astype(int), 0, len(self.bend) - 2)
        u = t - k * FINE
        slope = (self.bend[k + 1] - self.bend[k]) / FINE
        return (
            self.value[k] + self.rate[k] * u + self.bend[k] * u**2 / 2 + slope * u**3 / 6,
            self.rate[k] + self.bend[k] * u + slope * u**2 / 2,
            self.bend[k] + slope * u,
        )


@dataclass(frozen=True)
class Motion:
    """A motion of the tray, or of the joints of an arm; a Reference of the first object for the engine."""

    duration: float
    waves: tuple[Wave, ...]
    lines: np.ndarray
    base: Any
    axis: np.ndarray
    arm: ArmModel | None
    p_EB: np.ndarray
    R_EB: np.ndarray

    def tray(self, t: np.ndarray) -> MotionSamples:
        inside = np.clip(t, 0.0, self.duration)
        parts = [wave.at(inside) for wave in self.waves]
        value, rate, bend = (
            sum(np.outer(part[i], line) for part, line in zip(parts, self.lines, strict=True)) for i in range(3)
        )
        base = self.base.sample(inside)
        still = (t < 0) | (t > self.duration)
        rate, bend = np.where(still[:, None], 0, rate), np.where(still[:, None], 0, bend)
        if self.arm is not None:
            moved, r, b = base.p_SB - base.p_SB[:1], base.v_S, base.a_S
            gain = np.linalg.pinv(self.arm.body_jacobian(Q0)[:3])  # the base as joints, roughly
            q = Q0 + value + moved @ gain.T
            return forward.tray_motion(self.arm, JointMotion(t, q, rate + r @ gain.T, bend + b @ gain.T))
        turn = np.outer(parts[-1][0], self.axis)
        spin, swing = (
            np.outer(np.where(still, 0, parts[-1][1]), self.axis),
            np.outer(np.where(still, 0, parts[-1][2]), self.axis),
        )
        return MotionSamples(t, base.p_SB + value, base.v_S + rate, base.a_S + bend, exp(turn), spin, swing)

    def coordinates(self, t: np.ndarray) -> np.ndarray:
        """(T, 3) of the tray, or (T, 7) of the joints: what is sampled."""
        return self.tray(t).p_SB if self.arm is None else self.joints(t)

    def deviation(self, noise: float) -> float:
        """Noise of what is sampled that moves the tray by `noise`, m, in the mean of its directions."""
        if self.arm is None:
            return noise
        return float(noise * np.sqrt(3) / np.linalg.norm(self.arm.body_jacobian(Q0)[:3]))

    def cheapest(self, u_S: np.ndarray, when: float) -> tuple[np.ndarray, np.ndarray]:
        """Of all unit changes of what is sampled that which moves the tray furthest along u, and (3,) how far."""
        if self.arm is None:
            return u_S, u_S
        q = self.joints(np.array([when]))[0]
        jacobian = self.arm.tray_pose(q)[1] @ self.arm.body_jacobian(q)[:3]
        line = jacobian.T @ u_S
        line /= np.linalg.norm(line)
        return line, jacobian @ line

    def joints(self, t: np.ndarray) -> np.ndarray:
        parts = [wave.at(t)[0] for wave in self.waves]
        base = self.base.sample(t)
        gain = np.linalg.pinv(self.arm.body_jacobian(Q0)[:3])
        return (
            Q0
            + sum(np.outer(v, line) for v, line in zip(parts, self.lines, strict=True))
            + (base.p_SB - base.p_SB[:1]) @ gain.T
        )

    def sample(self, t: Any) -> MotionSamples:
        return self.tray(np.atleast_1d(np.asarray(t, dtype=float))).of_frame(self.p_EB, self.R_EB)


def scenario_of(rng: np.random.Generator) -> Scenario:
    return load("panda-cube").with_changes(
        objects__0__shape={"type": "box", "size": [0.04, 0.04, float(rng.choice([0.03, 0.06, 0.12]))]},
        objects__0__inertia=None,
        objects__0__friction=round(float(rng.uniform(0.15, 0.6)), 3),
        objects__0__uncertainty={},
        contact__edges=16,
    )


@cache
def panda() -> ArmModel:
    case = load("panda-cube")
    return load_arm(case.arm, case.tray)


def wave_of(rng: np.random.Generator, kind: str, duration: float) -> tuple[Wave, float]:
    """An acceleration of unit peak, and its (highest) frequency."""
    t = np.arange(round(duration / FINE) + 2) * FINE
    frequency = float(np.exp(rng.uniform(np.log(0.5), np.log(50))))
    phase = float(rng.uniform(0, 2 * np.pi))
    if kind == "jolt":
        length = float(np.exp(rng.uniform(np.log(0.01), np.log(0.2))))
        bend = np.zeros(len(t))
        when = np.sort(rng.uniform(0.05, 0.95 * duration - length, 2))
        shape = rng.integers(3)
        for start, sign in zip(when, (1, -1), strict=True):
            u = (t - start) / length
            on = (u > 0) & (u < 1)
            bend += sign * np.where(on, (np.sin(np.pi * u), np.sin(2 * np.pi * u), np.ones(len(t)))[shape], 0)
        bend /= max(1e-9, np.abs(bend).max())
        return Wave.of(bend), 1 / (2 * length)
    if kind == "chirp":
        other = float(np.exp(rng.uniform(np.log(0.5), np.log(50))))
        f = frequency + (other - frequency) * t / duration
        bend = np.sin(2 * np.pi * np.cumsum(f) * FINE + phase)
        frequency = max(frequency, other)
    else:
        bend = np.sin(2 * np.pi * frequency * t + phase)
    style = rng.integers(3)
    if style == 0:  # from rest to rest
        ramp = min(0.3 * duration, 2 / frequency)
        bend = bend * np.clip(np.minimum(t, duration - t) / ramp, 0, 1)
    elif style == 1:  # a burst
        centre, width = rng.uniform(0.2, 0.8) * duration, rng.uniform(0.05, 0.3) * duration
        bend = bend * np.exp(-(((t - centre) / width) ** 2))
    bend /= np.abs(bend).max()
    raw = Wave.of(bend)
    # A shake has no drift: what integration leaves is taken out as speed.
    return Wave.of(bend, -float(raw.value[-1] / duration)), frequency


def draw(rng: np.random.Generator) -> tuple[Scenario, Motion, str, str, float, float]:
    """Scenario, motion, kind, base, frequency, friction needed as a share."""
    scenario = scenario_of(rng)
    first = scenario.payload.first
    kind = str(rng.choice(["shake", "shake", "jolt", "chirp"]))
    base = str(rng.choice(["none", "none", "transfer", "sway"]))
    duration = float(rng.uniform(0.8, 3.0))
    wave, frequency = wave_of(rng, kind, duration)
    arm = panda() if rng.random() < 0.4 else None
    here = np.array([0.5, 0.0, 0.4])
    far = here + rng.uniform(-0.3, 0.3, 3) if base == "transfer" else here
    if base == "sway":
        far = here + rng.uniform(-0.05, 0.05, 3)
    line = min_jerk_line(duration, here, far, np.eye(3), np.eye(3))
    if arm is not None:
        lines = rng.normal(size=(1, 7))
    else:
        lines = rng.normal(size=(1, 3)) * [1, 1, 0.3]
    axis = np.zeros(3)
    if arm is None and rng.random() < 0.3:
        axis = rng.normal(size=3) * [1, 1, 1] * float(rng.uniform(0.1, 2))
    target = float(rng.uniform(0.1, 0.8)) if rng.random() < 0.5 else float(np.exp(rng.uniform(np.log(0.8), np.log(3))))

    def motion(size: float) -> Motion:
        return Motion(duration, (wave,), size * lines, line, size * axis, arm, first.p_EB, first.R_EB)

    size, t = 1e-2, np.linspace(0, duration, 3001)
    felt = motion(size).tray(t)
    strongest = np.argsort(-np.linalg.norm(felt.a_S, axis=1) - 0.05 * np.linalg.norm(felt.alpha_B, axis=1))[:150]
    some = t[np.unique(np.append(strongest, np.arange(0, 3001, 20)))]
    low = needed(scenario, motion(0.0), some)
    for _ in range(6):  # what is needed grows nearly in proportion
        now = needed(scenario, motion(size), some)
        size *= float(np.clip((target - min(low, 0.9 * target)) / max(now - low, 1e-9), 0.02, 50))
    made = motion(size)
    return scenario, made, kind, base, frequency, needed(scenario, made, t[::2])


def needed(scenario: Scenario, motion: Motion, t: np.ndarray) -> float:
    """Peak of what is asked for, as a share of what is borne: 1 - margin, scaled to the margin at rest."""
    s = motion.tray(t)
    w = motion_vector(s.R_SB, s.a_S, s.omega_B, s.alpha_B)
    rows = margin_model(scenario, 16).nominal[0]
    rest = -rows.worst(motion_vector(np.eye(3)[None], *np.zeros((3, 1, 3))))[0]
    values = rows.worst(w)
    return float(((values + rest) / rest).max())


def write(rng: np.random.Generator, motion: Motion, rate: float, noise: float, form: str, folder: Path) -> Path:
    t = np.arange(int(motion.duration * rate) + 1) / rate
    digits = int(rng.choice([6, 7, 9]))
    if form in JOINTS:
        q = motion.joints(t) + motion.deviation(noise) * rng.standard_normal((len(t), 7))
        return _write_joints(t, q, form, folder, digits)
    s = motion.tray(t)
    p = s.p_SB + noise * rng.standard_normal(s.p_SB.shape)
    R = s.R_SB @ exp(2 * noise * rng.standard_normal(s.p_SB.shape))
    quat = quat_wxyz_from_matrix(R)
    path = folder / "motion.csv"
    if form == "bag_pose":
        return _write_bag(folder / "bag", t, p=p, quat=quat)
    if form == "csv":
        rows, header = np.column_stack([t, p, quat]), "t,x,y,z,qw,qx,qy,qz"
    else:
        rows, header = np.column_stack([t * 1e9, quat[:, [1, 2, 3, 0]], p]), "t_ns,qx,qy,qz,qw,x,y,z"
    formats = ["%.9f" if form == "csv" else "%.0f", *[f"%.{digits}f"] * 7]
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt=formats)
    return path


def _write_joints(t: np.ndarray, q: np.ndarray, form: str, folder: Path, digits: int) -> Path:
    names = [f"panda_joint{i}" for i in range(1, 8)]
    if form == "joint_csv":
        path = folder / "motion.csv"
        np.savetxt(
            path, np.column_stack([t, q]), delimiter=",", header="t," + ",".join(names), comments="",
            fmt=["%.9f", *[f"%.{digits}f"] * 7],
        )  # fmt: skip
        return path
    if form == "bag_joints":
        return _write_bag(folder / "bag", t, q=q, names=names)
    points = [{"positions": row.tolist(), "time_from_start": float(now)} for now, row in zip(t, q, strict=True)]
    path = folder / f"motion.{form}"
    if form == "json":
        path.write_text(json.dumps({"joint_names": names, "points": points}))
    else:
        lines = [f"- {{positions: {p['positions']}, time_from_start: {p['time_from_start']}}}" for p in points]
        path.write_text("joint_names: [" + ", ".join(names) + "]\npoints:\n" + "\n".join(lines) + "\n")
    return path


def _write_bag(path: Path, t: np.ndarray, p: Any = None, quat: Any = None, q: Any = None, names: Any = None) -> Path:
    import shutil

    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    shutil.rmtree(path, ignore_errors=True)
    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    kind = "geometry_msgs/msg/PoseStamped" if q is None else "sensor_msgs/msg/JointState"
    empty = np.zeros(0)
    version: Any = 8
    with Writer(path, version=version, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/motion", kind, typestore=store)
        for k, now in enumerate(np.round(t * 1e9).astype(np.int64)):
            stamp = types["builtin_interfaces/msg/Time"](sec=100 + int(now // 10**9), nanosec=int(now % 10**9))
            header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="world")
            if q is None:
                point = types["geometry_msgs/msg/Point"](*p[k])
                turn = types["geometry_msgs/msg/Quaternion"](x=quat[k, 1], y=quat[k, 2], z=quat[k, 3], w=quat[k, 0])
                message = types[kind](header, types["geometry_msgs/msg/Pose"](point, turn))
            else:
                message = types[kind](header, names, q[k], empty, empty)
            writer.write(connection, int(now), store.serialize_cdr(message, kind))
    return path
