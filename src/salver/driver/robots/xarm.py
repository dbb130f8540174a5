"""Arms of UFACTORY (xArm 6, xArm 7, Lite 6): joint positions, 250 times a second, through the maker's SDK.

The positions go to port 502 in servo mode. The controller reports each of its periods on port 30000, with its clock,
state and mode: the loop runs by these reports, so that it sends one command a period; of two, the controller drops one.
Source: xarm-python-sdk 1.18 (calls, codes, `ReportDataStructure`); UFACTORY, ufactory_docs,
"Data Description of TCP port" (250 Hz from firmware 2.2 on), "Robot state and mode explanation", "How to solve C60
error?" (the speed limit of the tool in servo mode), private_tcp_protocol.
"""

from __future__ import annotations

import io
import logging
import socket
import time
import weakref
from contextlib import redirect_stdout
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.control.arm import ArmState
from salver.driver.preflight import Check
from salver.driver.robots.positions import Packages, PositionOptions, PositionRobot, unlike
from salver.errors import needs
from salver.geometry import Array, compose, invert, matrix_from_rpy

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel
    from salver.scenario import Scenario
    from salver.trajectory import JointMotion

# Names and numbers of the protocol and limits of the maker, from the sources above.
JOINTS = tuple(f"joint{k}" for k in range(1, 8))
PERIOD = 4e-3  # s
LEAST_VERSION = (2, 2, 0)  # of the firmware: reports each period
REPORTS, SETTINGS = 30000, 30002  # ports: each period; 5 times a second, with what the arm is set to
LEAST_REPORT = 784  # bytes
POSITION, SERVO = 0, 1  # modes
MOVES = (1, 2)  # states: moving, ready
STATES = {3: "it is paused", 4: "it was stopped", 5: "its settings were changed", 6: "it is being stopped"}
CODES = {-1: "the connection is lost", 3: "it does not answer", 8: "the connection is lost"}
STOP = 4  # state to set
WARNED, NOT_READY = 2, 9  # codes
LITE_6 = 9  # device type
USUAL = 1.2  # m/s at most of the tool in servo mode, and 0.5 m/s of a Lite 6, unless the arm is set to another factor


@dataclass(frozen=True)
class XArmOptions(PositionOptions):
    """Options of driving an arm of UFACTORY, beside those of `PositionOptions`.

    lag: s by which the joints follow their commands. The maker does not publish it: measure it (`salver track`). With
    too short a lag the arm seems to stand still at first, and is stopped.
    """

    lag: float = 0.03


class XArmRobot(PositionRobot):
    """An arm of UFACTORY with firmware 2.2 or later, without errors. Run with xarm-python-sdk 1.18.4."""

    kind, period, standard = "xarm", PERIOD, XArmOptions()

    @staticmethod
    def check(scenario: Scenario, arm: ArmModel, motion: JointMotion | None = None) -> list[Check]:
        fits = arm.n in (6, 7) and all(map(str.endswith, arm.joint_names, JOINTS))
        found = ", ".join(arm.joint_names)
        return [Check("arm", fits, f"The plan is for the joints {found}; --robot xarm drives joint1 to joint6 or 7.")]

    def __init__(self, address: str, mass: float, com_F: Array, options: XArmOptions | None = None) -> None:
        """Connect. Raises MissingDependencyError without the SDK, SalverError."""
        super().__init__(address, mass, com_F, options)
        self.lag, self._servo, timeout = self._options.lag, False, self._options.timeout
        with needs("xarm", "Driving an xArm"), redirect_stdout(io.StringIO()):  # the SDK prints
            from xarm.core.config.x_code import ControllerError
            from xarm.core.utils.log import logger, origin_logger
            from xarm.wrapper import XArmAPI
            from xarm.x3.report import ReportDataStructure
        self._title, self._layout = ControllerError, ReportDataStructure.create  # a layout for each port
        for each in (logger, origin_logger):
            each.setLevel(logging.CRITICAL)
        standard = socket.getdefaulttimeout()
        try:
            address = socket.gethostbyname(address)  # the SDK takes a name for a serial port
            self._reports = Packages(address, REPORTS, timeout, ">I")
            self._reports.next()  # the SDK would ask a controller that does not answer for minutes
            with redirect_stdout(io.StringIO()):
                self._api = XArmAPI(address, is_radian=True, enable_report=False, forbid_uds=True)
            weakref.finalize(self, self._api.disconnect)
            self._api.set_timeout(timeout)
        except Exception as error:  # the SDK raises nothing more exact
            raise self.said(error) from None
        finally:
            socket.setdefaulttimeout(standard)  # the SDK changes it

    def recognise(self, arm: ArmModel) -> None:
        """Keeps what limits the tool's speed, too."""
        api, found = self._api, self._layout(30002)
        try:
            found.update(Packages(self._address, SETTINGS, self._options.timeout, ">I").next())
        except Exception as error:  # a short package
            raise self.said(error) from None
        self._arm = arm
        self._refuse_errors()
        if (version := api.version_number) < LEAST_VERSION:
            least, old = (".".join(map(str, numbers)) for numbers in (LEAST_VERSION, version))
            raise self.said(f"its firmware is {old}; --robot xarm drives arms with {least} and later")
        if api.axis != arm.n:
            raise self.said(f"it has {api.axis} joints; the plan is for {arm.n}")
        if np.any(np.abs(found.world_offset) > 1e-6):
            raise self.said(f"the offset of its base coordinates is {found.world_offset}; it must be 0")
        pose, offset = np.array(found.actual_tcp_pose, dtype=float), np.array(found.tcp_offset, dtype=float)
        self._tool = (1e-3 * offset[:3], matrix_from_rpy(offset[3:]))
        p, R = compose(1e-3 * pose[:3], matrix_from_rpy(pose[3:]), *invert(*self._tool))
        q = np.array(found.actual_joint_angle, dtype=float)[: arm.n]
        if why := unlike(arm, q, p, R, self._options):
            raise self.said(why)
        code, factor = api.get_linear_spd_limit_factor()
        self._fastest = (factor if code == 0 else USUAL) * (0.5 / USUAL if api.device_type == LITE_6 else 1.0)

    def permit(self, motion: JointMotion) -> str:
        """The controller stops with the error C60 when its tool is faster than that."""
        arm, t = self._arm, np.arange(0.0, motion.duration, PERIOD)
        flanges = (arm.link_pose(q, arm.flange) for q in motion.sample(t)[0])
        tool = np.array([compose(*flange, *self._tool)[0] for flange in flanges])
        speed = np.linalg.norm(np.diff(tool, axis=0), axis=1) / PERIOD
        if len(speed) and speed.max() > self._fastest:
            at, most = t[int(np.argmax(speed))], speed.max()
            return (
                f"The tool moves at {most:.2f} m/s at t = {at:.2f} s; the arm at {self._address} allows "
                f"{self._fastest:.2f} m/s in servo mode (set_linear_spd_limit_factor of its SDK)."
            )
        return ""

    def look(self) -> ArmState:
        if not self._servo:  # reports that nobody read have filled the buffers, and newer ones were lost
            try:
                self._reports = Packages(self._address, REPORTS, self._options.timeout, ">I")
            except OSError as error:
                raise self.said(error) from None
        report = self._report()
        if self._servo and (report.state not in MOVES or report.mode != SERVO):
            self._refuse_errors()
            why = STATES.get(report.state, f"its state is {report.state}")
            raise self.said(why if report.mode == SERVO else f"its mode was changed to {report.mode}")
        self._at = 1e-6 * report.timestamp
        both = np.array([report.actual_joint_angle, report.actual_joint_velocity], dtype=float)
        return ArmState(*both[:, : self._api.axis])

    def start(self) -> None:
        """Set the payload, then servo mode, in which the arm holds its place until the first command."""
        api = self._api
        self._refuse_errors()  # the calls below would clear them
        self._demand(api.motion_enable(True))
        self._enter(POSITION)
        code = api.set_tcp_load(self._mass, (1e3 * self._com).tolist())
        self._demand(0 if code == NOT_READY else code)  # its state has changed with the payload
        self._enter(SERVO)
        self._first = self._servo = True
        self.look()

    def read(self) -> tuple[ArmState, float]:
        before, state = self._at, self.look()
        first, self._first = self._first, False
        return state, 0.0 if first else self._at - before

    def send(self, q: Array) -> None:
        # `set_servo_angle_j` asks for reports of the SDK's own. Whether the arm is ready, its own report says.
        code = self._api.core.move_servoj([*q.tolist(), *[0.0] * (7 - len(q))], 0.0, 0.0, 0.0)[0]
        self._demand(0 if code == WARNED else code)

    def stop(self) -> None:
        """No more commands are taken; an arm that still moves is stopped by the controller."""
        self._servo = False
        self._demand(self._api.set_state(STOP))

    def _enter(self, mode: int) -> None:
        self._demand(self._api.set_mode(mode))
        self._demand(self._api.set_state(0))
        until = time.monotonic() + self._options.timeout
        while time.monotonic() < until:
            report = self._report()
            if report.mode == mode and report.state in MOVES:
                return
        self._refuse_errors()
        raise self.said(f"it does not enter mode {mode}")

    def _report(self) -> Any:
        """The newest; waits until there is one."""
        package = b""
        try:
            while not package or self._reports.waiting():
                package = self._reports.next()
        except OSError as error:
            raise self.said(error) from None
        report = self._layout(30000)
        if len(package) < LEAST_REPORT:
            raise self.said(f"its report has {len(package)} bytes; {LEAST_REPORT} are needed")
        report.update(package)
        return report

    def _demand(self, code: int) -> None:
        """Raises SalverError when a call of the SDK failed, with the controller's error if it has one."""
        if code == 0:
            return
        if code not in CODES:
            self._refuse_errors()
        raise self.said(CODES.get(code, f"code {code} of its SDK"))

    def _refuse_errors(self) -> None:
        code, found = self._api.get_err_warn_code()
        if code in CODES:
            raise self.said(CODES[code])
        if found[0]:
            raise self.said(f"error {found[0]}, {self._title(found[0]).title['en']}")
