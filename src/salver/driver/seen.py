"""The load in motion capture: it stayed, it did not, or the recording cannot tell.

The verdict "holds" needs a recording in which object and tray are seen all along, at rest before the motion, with a
clock and a world frame that fit the tray's motion by the joints. Every reason against it is a sentence of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from salver.auditing.recorded import sensor_of
from salver.driver.mocap import STANDARD, CaptureOptions, Track
from salver.errors import Status
from salver.geometry import Array, continuous, log, quat_wxyz_from_matrix
from salver.wording import listed

if TYPE_CHECKING:
    from salver.models.bodies import Body
    from salver.trajectory import Reference

HOLDS, SLIDES, CANNOT_TELL = "holds", "slides", "cannot_tell"


def judge(
    merged: Mapping[str, Array],
    tracks: Mapping[str, Track],
    reference: Reference,
    carried: Sequence[Body],
    object_name: str,
    tray_name: str,
    options: CaptureOptions = STANDARD,
) -> Status:
    """Judge merged tracks (`mocap.merge`), with the log's own p_SE beside them (arrays of `merged`)."""
    shift = float(merged["mocap_offset"])
    doubts = [
        f"{name}: {doubt}"
        for name in (object_name, tray_name)
        for doubt in _doubts(tracks[name], shift, reference, merged["t"], options)
    ]
    if not doubts:
        doubts += _misfits(merged, options.fits)
    if len(carried) > 1:
        others = ", ".join(body.name for body in carried if body.name != object_name)
        doubts.append(f"nothing is known of {others}")
    if doubts:
        return Status(CANNOT_TELL, f"It cannot be told whether the load held: {'; '.join(doubts)}.", False)
    during = merged["t"] >= 0
    moved = np.maximum(merged["slip"][during, 0], merged["lift"][during, 0])
    k = int(np.argmax(moved))
    where = f"{1e3 * moved[k]:.2f} mm at t = {merged['t'][during][k]:.2f} s"
    where += f"; {1e3 * options.slip:g} mm can be told from noise"
    if moved[k] > options.slip:
        return Status(SLIDES, f"{object_name} moved on its tray by up to {where}.", False)
    inner = [x.inside for x in carried if x.inner is not None and np.isfinite(x.inner.edge(x.inner.value))]
    first = f"Not judged: what {listed(inner)} did, which motion capture does not see. " if inner else ""
    return Status(HOLDS, f"{first}{object_name} kept its place on the tray, to {where}.", True)


def _doubts(track: Track, shift: float, reference: Reference, t: Array, options: CaptureOptions) -> Iterator[str]:
    """Why a track cannot be relied on, each as a part of a sentence."""
    own, end = track.t - shift, float(t[-1])
    rest, slip, sure = options.rest, options.slip, options.sure
    if not np.all(np.diff(own) > 0):
        yield "its clock does not go on evenly forwards"
        return
    if own[0] > end or own[-1] < 0:
        yield f"the clocks do not overlap: it was seen from {own[0]:.2f} to {own[-1]:.2f} s of the motion's time"
        return
    first, last = max(0, int(np.searchsorted(own, -rest)) - 1), int(np.searchsorted(own, end)) + 1
    part = slice(first, last)
    seen, p, R = own[part], track.p[part], track.R[part]
    resting = (seen >= -rest) & (seen <= 0)
    noise = sensor_of(seen, p, continuous(quat_wxyz_from_matrix(R))).displacement if len(seen) > options.fewest else 0.0
    allowed = max(options.stray, sure * noise)
    if sure * noise > slip:
        yield f"its noise of {1e3 * noise:.2g} mm hides a slip of {1e3 * slip:g} mm ({1e3 * slip / sure:.2g} mm do not)"
    if resting.sum() < options.fewest:
        yield f"it was not seen at rest before the motion ({resting.sum()} samples in the {rest:g} s before)"
    elif (stray := float(np.linalg.norm(p[resting] - p[resting].mean(axis=0), axis=1).max())) > allowed:
        yield f"at rest before the motion it strays by {1e3 * stray:.1f} mm ({1e3 * allowed:.2g} mm are allowed)"
    if seen[-1] < end:
        yield f"it was not seen after t = {seen[-1]:.2f} s of {end:.2f} s"
    steps = np.diff(seen)
    k = int(np.argmax(steps)) if len(steps) else 0
    if len(steps) and steps[k] > options.gap:
        yield f"it was not seen from {seen[k]:.2f} to {seen[k + 1]:.2f} s"
    if len(steps):
        top = float(np.linalg.norm(reference.sample(np.linspace(0, reference.duration, 201)).v_S, axis=1).max())
        speed = np.linalg.norm(np.diff(p, axis=0), axis=1) / steps
        turning = np.linalg.norm(log(np.swapaxes(R[:-1], 1, 2) @ R[1:]), axis=1) / steps
        for values, most, unit in ((speed, top + options.faster, "m/s"), (turning, options.spinning, "rad/s")):
            k = int(np.argmax(values))
            if values[k] > most:
                yield f"it jumps at t = {seen[k]:.2f} s ({values[k]:.1f} {unit})"


def _misfits(merged: Mapping[str, Array], fits: float) -> Iterator[str]:
    """Whether the recording is of this run."""
    during = merged["t"] >= 0
    if not np.all(np.isfinite(merged["slip"][during])):
        yield "object or tray was not seen all along"
        return
    off = 1e3 * np.linalg.norm(merged["tray_seen"] - merged["p_SE"], axis=1)[during]
    k = int(np.argmax(off))
    if not off[k] <= 1e3 * fits:
        yield (
            f"at t = {merged['t'][during][k]:.2f} s the tray is seen {off[k]:.0f} mm from where the joints put it "
            f"({1e3 * fits:g} mm are allowed): the clock or the world does not fit (--mocap-offset, --mocap-world), or "
            "it is the recording of another run"
        )
