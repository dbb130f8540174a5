"""Margins of a motion from sliding, tipping and lifting: the curves that page, words and tables share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from salver.contact_margins import Braking, Margins, braking, margin_model, margins
from salver.geometry import Array, invert, matrix_from_quat_wxyz, spread
from salver.trajectory import MotionSamples

if TYPE_CHECKING:
    from salver.scenario import Scenario


@dataclass(frozen=True)
class ContactCurves:
    """Over all interfaces, time first (T,).

    t: s. friction: largest friction needed, as a share of what there is, at nominal parameters. coefficient: the same
    as a coefficient when only one object stands on the tray, else None. available: its own then. nominal, worst: least
    exact margin, a share of the weight, at nominal parameters and in the worst case: what the plan was checked to keep
    over its tubes, with the paper's condition along the reference. tip, tip_worst: least distance of a zero-moment
    point from its edge, m; worst of what follows the reference.
    braking: which stops on the path keep the load, in the worst case; None with inner dynamics.
    """

    t: Array
    friction: Array
    coefficient: Array | None
    available: float
    nominal: Array
    worst: Array
    tip: Array
    tip_worst: Array
    braking: Braking | None


def planned_samples(a: Mapping[str, np.ndarray]) -> MotionSamples:
    """The object's motion, of the arrays of its plan."""
    turned = matrix_from_quat_wxyz(a["quat_SB_wxyz"])
    return MotionSamples(a["t"], a["p_SB"], a["v_S"], a["a_S"], turned, a["omega_B"], a["alpha_B"])


def contact_curves(scenario: Scenario, a: Mapping[str, np.ndarray]) -> ContactCurves:
    """All margins of a planned motion, given by the arrays of its plan."""
    keep = spread(len(a["t"]), 301)
    samples = planned_samples(a).only(keep)
    found = margins(scenario, samples)
    worst = found.exact_worst
    if scenario.contact.condition == "exact" and "contact_slack" in a:
        slack = a["contact_slack"][keep]  # the plan's own, which knows which errors go together
        others = len(scenario.payload.dynamic) + (scenario.motion.max_tilt_deg is not None)
        worst = slack[:, : slack.shape[1] - others].min(axis=1)  # brims and the limit on tilt come last
    first, rigid = scenario.payload.first, not scenario.payload.dynamic
    tray = samples.of_frame(*invert(first.p_EB, first.R_EB))
    return curves_of(found, worst, braking(margin_model(scenario), tray, worst=True) if rigid else None)


def curves_of(found: Margins, worst: Array, braking: Braking | None = None) -> ContactCurves:
    """The curves of margins that are known. worst: as in `ContactCurves`."""
    needed = [m.friction_needed for m in found.interfaces]
    share = [own / m.friction for own, m in zip(needed, found.interfaces, strict=True)]
    return ContactCurves(
        t=found.t,
        friction=np.max(share, axis=0),
        coefficient=needed[0] if len(needed) == 1 else None,
        available=found.interfaces[0].friction,
        nominal=found.exact,
        worst=worst,
        tip=np.min([m.tip_over for m in found.interfaces], axis=0),
        tip_worst=np.min([m.tip_over_worst for m in found.interfaces], axis=0),
        braking=braking,
    )
