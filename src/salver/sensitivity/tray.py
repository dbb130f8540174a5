"""Closed-loop sensitivity of the carried object, as a linear filter of the inertial regressor.

To first order in the parameters the tracking error of object and controller obeys

    e'' + kd e' + kp e = D(t) dp,    D = [R D_v; D_w],    [D_v; D_w] = M_n^-1 Y(t) dphi/dp,

translation in S, rotation in B; the deviation of the state is -e. This is the exact solution of section III of the
paper for its plant (18) and controller (19). `salver.sensitivity.engine` integrates the variational equations in
general form; the tests compare both with central differences of the nonlinear closed loop.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from salver.control.object import Gains
from salver.geometry import GRAVITY_S, Array, Indices
from salver.linear_filter import LinearFilter, fastest_rate
from salver.models.rigid_body import RigidBody, inertia_matrix
from salver.sensitivity.dual import Dual, DualRotation, joined
from salver.trajectory import MotionSamples, Reference


@dataclass(frozen=True)
class BodyMotion:
    """The object's motion in B, (T, 1, 3) each: rotation, specific force R^T (a - g), omega, alpha, velocity.

    For a motion without rotation, rotation, omega and alpha are stored for one instant and broadcast.
    """

    rotation: DualRotation
    force: Dual
    omega: Dual
    alpha: Dual
    velocity: Dual

    @classmethod
    def of(
        cls,
        samples: MotionSamples,
        v_tangent: Array | None = None,
        a_tangent: Array | None = None,
        theta_tangent: Array | None = None,
        omega_tangent: Array | None = None,
        alpha_tangent: Array | None = None,
    ) -> BodyMotion:
        """The motion from samples (T), with tangents (T, 3, n_z) of v_S, a_S, the rotation (in B), omega_B, alpha_B."""

        def dual(value: Array, tangent: Array | None) -> Dual:
            return Dual(value[:, None], None if tangent is None else tangent[:, None])

        turns = theta_tangent is not None or bool(samples.omega_B.any() or samples.alpha_B.any())
        kept = slice(None) if turns else slice(0, 1)
        rotation = DualRotation(samples.R_SB[kept, None], None if theta_tangent is None else theta_tangent[:, None])
        return cls(
            rotation,
            rotation.to_body(dual(samples.a_S - GRAVITY_S, a_tangent)),
            dual(samples.omega_B[kept], omega_tangent),
            dual(samples.alpha_B[kept], alpha_tangent),
            rotation.to_body(dual(samples.v_S, v_tangent)),
        )

    def after(self, step: Array) -> BodyMotion:
        """The motion after a step (n_z,) of variables that do not turn it."""
        others = (x.after(step) for x in (self.force, self.omega, self.alpha, self.velocity))
        return BodyMotion(self.rotation, *others)

    def every(self, k: int) -> BodyMotion:
        """The motion at every k-th instant."""
        turned = Dual(self.rotation.matrix, self.rotation.tangent).every(k)
        others = (x.every(k) for x in (self.force, self.omega, self.alpha, self.velocity))
        return BodyMotion(DualRotation(turned.value, turned.tangent), *others)

    @property
    def weight(self) -> Dual:
        """R^T (-g): the specific force at rest in each orientation."""
        return self.rotation.to_body(Dual(-GRAVITY_S[None, None]))

    def of_frame(self, p_BX: Array, R_BX: Array) -> BodyMotion:
        """The motion of a frame X fixed to B."""
        arm = Dual(p_BX[None, None])
        force = self.force + self.alpha.cross(arm) + self.omega.cross(self.omega.cross(arm))
        turn, tangent = R_BX.T, self.rotation.tangent
        return BodyMotion(
            DualRotation(self.rotation.matrix @ R_BX, None if tangent is None else turn @ tangent),
            force.mapped(turn),
            self.omega.mapped(turn),
            self.alpha.mapped(turn),
            (self.velocity + self.omega.cross(arm)).mapped(turn),
        )

    def wrench(self, phi: Array) -> tuple[Dual, Dual]:
        """Wrench f, tau, each (T, P, 3), at B for bodies with inertial parameters phi (10, P): eq (1), linear in phi.

        With directions d phi as columns, it is Y(t) d phi.
        """
        return self.push(phi), self.turn(phi)

    @cached_property
    def still(self) -> bool:
        """Whether there is no rotation, for all values of the variables."""
        return self.omega.vanishes and self.alpha.vanishes

    def push(self, phi: Array) -> Dual:
        """f of `wrench`, which depends on mass and first moment."""
        pushed, moment = self.force.scaled(phi[0, :, None]), Dual(phi[1:4].T[None])
        if self.still or moment.vanishes:
            return pushed
        return pushed + self.alpha.cross(moment) + self.omega.cross(self.omega.cross(moment))

    def turn(self, phi: Array) -> Dual:
        """tau of `wrench`, which depends on first moment and inertia."""
        levered, inertia, omega = Dual(phi[1:4].T[None]).cross(self.force), inertia_matrix(phi[4:].T), self.omega
        if self.still:
            return levered
        return levered + self.alpha.mapped(inertia) + omega.cross(omega.mapped(inertia))


@dataclass(frozen=True)
class TraySensitivity:
    """First-order sensitivity of the closed loop along a motion of B, time axis first.

    e_p, e_v in S, e_R, e_w in B: tracking errors (T, n_p, 3) per unit of each parameter. They determine dp in S, dtheta
    in B, dv in S, domega in B (the rows of Pi), and df, dtau of the wrench at B, each (T, n_p, 3).
    """

    loop: TrayLoop
    motion: BodyMotion
    e_p: Dual
    e_v: Dual
    e_R: Dual
    e_w: Dual

    def after(self, step: Array) -> TraySensitivity:
        """The sensitivity after a step (n_z,) of variables that do not turn the motion: it is affine in them."""
        errors = (x.after(step) for x in (self.e_p, self.e_v, self.e_R, self.e_w))
        return TraySensitivity(self.loop, self.motion.after(step), *errors)

    @cached_property
    def dp(self) -> Dual:
        return -self.e_p

    @cached_property
    def dtheta(self) -> Dual:
        return -self.e_R

    @cached_property
    def dv(self) -> Dual:
        return -self.e_v

    @cached_property
    def domega(self) -> Dual:
        return self.motion.omega.cross(self.dtheta) - self.e_w

    @cached_property
    def df(self) -> Dual:
        kp, kd = self.loop.gains.kp[0], self.loop.gains.kd[0]
        feedback = self.motion.rotation.to_body(self.e_v.scaled(kd) + self.e_p.scaled(kp))
        return (self.motion.force.cross(self.dtheta) + feedback).scaled(self.loop.body.mass)

    @cached_property
    def dtau(self) -> Dual:
        kp, kd = self.loop.gains.kp[1], self.loop.gains.kd[1]
        omega, inertia = self.motion.omega, self.loop.body.inertia_com
        # alpha x dtheta + omega x domega - omega x (omega x dtheta); the last two combine to a term with e_w alone.
        turned = self.motion.alpha.cross(self.dtheta) - omega.cross(self.e_w)
        dalpha = turned + self.e_w.scaled(kd) + self.e_R.scaled(kp)
        gyroscopic = self.domega.cross(omega.mapped(inertia)) + omega.cross(self.domega.mapped(inertia))
        return dalpha.mapped(inertia) + gyroscopic

    @property
    def state(self) -> Array:
        """Pi (T, 12, n_p)."""
        return np.swapaxes(joined(self.dp, self.dtheta, self.dv, self.domega), 1, 2)

    @property
    def wrench(self) -> Array:
        """d wrench_B / dp (T, 6, n_p); Theta = pinv(grasp_map) @ wrench."""
        return np.swapaxes(joined(self.df, self.dtau), 1, 2)


@dataclass(frozen=True)
class TrayLoop:
    """Object and controller: nominal body (centre of mass at B's origin), gains, and d phi / d p (10, n_p)."""

    body: RigidBody
    gains: Gains
    phi_jacobian: Array

    def instants(self, duration: float, steps: int, longest: float = 0.35) -> Array:
        """Uniform instants (T,), s, from 0 to a duration: these steps, each divided until it is at most `longest`, a
        share of the fastest time constant. With half of it, errors are accurate to a sixteenth (1e-5 with the default),
        as the forcing is cubic between instants."""
        fastest = max(fastest_rate(*pair) for pair in zip(self.gains.kp, self.gains.kd, strict=True))
        return np.linspace(0.0, duration, steps * max(1, int(np.ceil(fastest * duration / steps / longest))) + 1)

    @cached_property
    def pushing(self) -> Indices:
        """Parameters that change mass or first moment, and so force and position."""
        return np.flatnonzero(self.phi_jacobian[:4].any(axis=0))

    @cached_property
    def turning(self) -> Indices:
        """Parameters that change first moment or inertia, and so torque and orientation."""
        return np.flatnonzero(self.phi_jacobian[1:].any(axis=0))

    def forcing(self, motion: BodyMotion) -> tuple[Dual, Dual]:
        """D: R D_v in S for the parameters `pushing`, D_w in B for those in `turning`, each (T, n, 3)."""
        f, tau = motion.push(self.phi_jacobian[:, self.pushing]), motion.turn(self.phi_jacobian[:, self.turning])
        return (
            motion.rotation.to_world(f.scaled(1 / self.body.mass)),
            tau.mapped(np.asarray(np.linalg.inv(self.body.inertia_com), dtype=float)),
        )

    def sensitivity(self, t: Array, motion: BodyMotion, count: int) -> TraySensitivity:
        """Pi and the wrench sensitivity at `count` evenly spaced ones of the instants t (T,), both ends included; the
        motion is given at all of them (`instants`)."""
        (kp, kp_R), (kd, kd_R), every = self.gains.kp, self.gains.kd, (len(t) - 1) // (count - 1)
        forcing_S, forcing_B = self.forcing(motion)
        e_p, e_v = self._respond(LinearFilter.on_nodes(t, kp, kd, 3), forcing_S, self.pushing, every)
        e_R, e_w = self._respond(LinearFilter.on_nodes(t, kp_R, kd_R, 3), forcing_B, self.turning, every)
        return TraySensitivity(self, motion.every(every), e_p, e_v, e_R, e_w)

    def along(self, reference: Reference, t: Array) -> TraySensitivity:
        """Sensitivities along a reference at uniform instants t (T,), the first of which is its start."""
        fine = self.instants(float(t[-1]), len(t) - 1, 0.03)
        return self.sensitivity(fine, BodyMotion.of(reference.sample(fine)), len(t))

    def _respond(self, loop: LinearFilter, forcing: Dual, which: Indices, every: int) -> tuple[Dual, Dual]:
        """Errors and their rates at every k-th instant; only the parameters `which` have a forcing."""

        def errors(drive: Array) -> Array:
            found = np.stack(loop.respond(drive))[:, ::every]
            whole = np.zeros((*found.shape[:2], self.phi_jacobian.shape[1], *found.shape[3:]))
            whole[:, :, which] = found
            return whole

        values = errors(forcing.value)
        tangents = (None, None) if forcing.tangent is None else errors(forcing.tangent)
        return Dual(values[0], tangents[0]), Dual(values[1], tangents[1])
