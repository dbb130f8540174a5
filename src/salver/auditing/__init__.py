"""Audits: whether the load stays along an existing motion of the tray or of the arm's joints.

`audit(path, scenario)` reads a file, estimates the accelerations of the tray, and judges the load.
"""

from salver.auditing.options import AuditOptions
from salver.auditing.verdict import Audit, audit, audit_legs, audit_samples, read_for

__all__ = ["Audit", "AuditOptions", "audit", "audit_legs", "audit_samples", "read_for"]
