"""Will it slip? The verdict on a motion that the user already has: of the tray, or of the arm's joints.

`audit(path, scenario)` reads a file, finds the accelerations in it, and says what everything on the tray does.
"""

from salver.auditing.options import AuditOptions
from salver.auditing.verdict import Audit, audit, audit_legs, audit_motion, audit_samples, read_for

__all__ = ["Audit", "AuditOptions", "audit", "audit_legs", "audit_motion", "audit_samples", "read_for"]
