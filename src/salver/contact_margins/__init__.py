"""Contact margins of all objects along a motion of the tray: over time, nominal and worst case.

For every interface (object on tray, object on object):
- exact margin: how far inside the contact wrench cone the required wrench is, as a share of the normal force
  at rest; split into the part that friction limits (leaving it: sliding) and the rest (tipping, lifting);
- friction needed: the least coefficient for which the wrench is in the cone;
- tip-over margin: distance of the zero-moment point to the edge of the support polygon, m.

Worst cases are over the scenario's uncertain set, for objects that follow their tray: bounds that are never
too optimistic (see `salver.models.contact_rows`).
"""

from salver.contact_margins.braking import Braking, BrakingOptions, braking
from salver.contact_margins.interface import InterfaceMargins
from salver.contact_margins.model import EDGES, MarginModel, margin_model, tray_motion
from salver.contact_margins.time_scaling import SafeSpeeds, safe_speeds
from salver.contact_margins.whole import Margins, margins

__all__ = [
    "EDGES",
    "Braking",
    "BrakingOptions",
    "InterfaceMargins",
    "MarginModel",
    "Margins",
    "SafeSpeeds",
    "braking",
    "margin_model",
    "margins",
    "safe_speeds",
    "tray_motion",
]
