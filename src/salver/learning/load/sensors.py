"""Readings of a wrist sensor and of the joints: what tray, load and links do to them, and a simulated log of a plan."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from salver.geometry import Array
from salver.learning.load.noise import SensorNoise
from salver.learning.logs import Log
from salver.models.interfaces import needed_at_tray, to_tray
from salver.models.rigid_body import RigidBody, inertia_entries
from salver.models.tray_motion import wrench_map
from salver.models.uncertain.parameters import phi_of
from salver.planning.plan import Plan
from salver.sensitivity.arm.terms import motion_terms

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel
    from salver.scenario import Tray


def simulated_log(plan: Plan, load: RigidBody | None, seed: int, rests: float = 0.2, step: float = 1e-3) -> Log:
    """Log of a wrist sensor in a run of a plan, with the noise of `SensorNoise`.

    load: in B; None for the empty tray. rests: s of rest before and after the motion. step: s between samples.
    """
    from scipy.signal import lfilter

    assert plan.joint is not None
    arm, sensors, rng = plan.scenario.load_arm(), SensorNoise(), np.random.default_rng(seed)
    t = np.arange(-rests, plan.duration + rests, step)
    states = plan.joint.sample(t)
    terms = motion_terms(arm.pin_model, arm.tray_id, *states)
    wrench = tray_wrench(plan.scenario.tray, arm, terms.w)
    if load is not None:
        wrench += terms.w @ at_flange(arm, needed_at_tray(plan.scenario.payload.first, load.phi)).T
    noise = [sensors.force] * 3 + [sensors.moment] * 3
    pole = np.exp(-step / sensors.colour)
    coloured = lfilter([np.sqrt(1 - pole**2)], [1.0, -pole], rng.standard_normal(wrench.shape), axis=0)
    wrench += [n.white for n in noise] * rng.standard_normal(wrench.shape) + [n.coloured for n in noise] * coloured
    return Log("simulated", t, states[0], None, wrench)


def heavier(model: Any, shares: dict[int, float]) -> None:
    """Multiply masses and inertias of links of a Pinocchio model by shares."""
    for k, share in shares.items():
        body = model.inertias[k]
        body.mass, body.inertia = share * body.mass, share * body.inertia
        model.inertias[k] = body


def at_flange(arm: ArmModel, at_E: Array) -> Array:
    """Wrenches (..., 6, k) at the tray frame E, converted to the flange."""
    return np.asarray(to_tray(arm.p_FE, arm.R_FE) @ at_E)


def tray_wrench(tray: Tray, arm: ArmModel, w: Array) -> Array:
    """Wrench (T, 6) of the tray itself at the flange, at w (T, 12)."""
    inertial = np.concatenate([[tray.mass], arm.tray_com_E, inertia_entries(np.diag(tray.inertia))])
    return at_flange(arm, wrench_map(phi_of(inertial)) @ w[:, :, None])[:, :, 0]
